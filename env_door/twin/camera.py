"""The camera, in a process of its own: pictures of 640x480 pixels for LeRobot's `zmq` camera.

Drawing takes about 20 ms of a processor without a graphics card, far longer than the controller may pause; so this
process draws from a copy of the scene's pose, and only while somebody watches.

The field of view upwards is that of the data set's square pictures: cut the middle 480x480 out and shrink it, and you
have the picture that `DoorEnv` draws.
"""

import base64
import json
import multiprocessing
import signal
import time
from collections.abc import Callable
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from env_door.rendering import make_renderer
from env_door.scene import load_model
from env_door.twin import ports

NAME = "front"  # of the camera in the scene and in the messages
WIDTH, HEIGHT = 640, 480
JPEG_QUALITY = 90
FPS = 30.0  # pictures a second; fewer where the machine cannot draw as many
START_SECONDS = 60.0
NORMAL, FROZEN, BLACK, GONE = range(4)  # what the camera does: its mode

try:
    import zmq
except ImportError:
    zmq = None  # type: ignore[assignment]


class Camera:
    """The camera as the twin's process sees it, of a scene with so many joint positions (`nq`).

    Shared with its process: its `mode`, the number of pictures `drawn`, and where everything is.
    """

    def __init__(self, address: str, num_positions: int):
        if zmq is None:
            raise ModuleNotFoundError(
                "the twin's camera needs pyzmq: pip install 'lerobot[pyzmq-dep]', or start the twin with --camera=false"
            )
        context = multiprocessing.get_context("spawn")
        # No locks: a pose mixed from two moments 2 ms apart is only a rolling shutter.
        self.mode, self.drawn = context.RawValue("i", NORMAL), context.RawValue("i", 0)
        scene = context.RawArray("d", num_positions + 1)
        self._scene = np.frombuffer(scene)
        self._answer, theirs = context.Pipe(duplex=False)
        shared = (f"tcp://{address}:{ports.CAMERA}", self.mode, self.drawn, scene, theirs)
        self._process = context.Process(target=_run, args=shared, daemon=True)

    def start(self) -> None:
        """Starts the process and waits until it publishes; raises a RuntimeError if it does not."""
        self._process.start()
        problem = self._answer.recv() if self._answer.poll(START_SECONDS) else "it did not answer"
        if problem is not None:
            self.close()
            raise RuntimeError(f"the twin's camera did not start: {problem}")

    def show(self, pose: NDArray[np.float64], door_offset: float) -> None:
        """Tells where everything is now: the scene's joint positions, and the door's sideways shift in m."""
        self._scene[:-1], self._scene[-1] = pose, door_offset

    def close(self) -> None:
        """Ends the process."""
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()


def _make_view() -> Callable[[NDArray[np.float64]], NDArray[np.uint8]]:
    """What draws 640x480 pixels of a pose and the door's shift, with a renderer that only draws squares."""
    model = load_model("ur5e")
    data = mujoco.MjData(model)
    doorway = int(model.body("doorway").id)
    home = float(model.body_pos[doorway, 1])
    # A square as wide as the picture, whose middle rows have the camera's own field of view.
    index = int(model.camera(NAME).id)
    half = np.tan(np.radians(model.cam_fovy[index]) / 2) * WIDTH / HEIGHT
    model.cam_fovy[index] = 2 * np.degrees(np.arctan(half))
    renderer = make_renderer(model, NAME, WIDTH)
    margin = (WIDTH - HEIGHT) // 2

    def draw(scene: NDArray[np.float64]) -> NDArray[np.uint8]:
        data.qpos[:], model.body_pos[doorway, 1] = scene[:-1], home + scene[-1]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        return renderer.draw(data)[margin : margin + HEIGHT]

    return draw


def _encode(picture: NDArray[np.uint8]) -> bytes:
    """A message as LeRobot's `zmq` camera reads it: JSON with a picture, red first, as JPEG in base64."""
    # OpenCV takes blue first, and neither LeRobot's image server nor its camera swaps: colours come out right
    # because both ends leave them alone.
    _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    message = {"timestamps": {NAME: time.time()}, "images": {NAME: base64.b64encode(jpeg.tobytes()).decode()}}
    return json.dumps(message).encode()


def _run(endpoint: str, mode: Any, drawn: Any, scene: Any, answer: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    context = zmq.Context()
    try:
        socket = _bind(context, endpoint)
        draw = _make_view()
    except Exception as error:
        answer.send(f"{endpoint}: {error}")
        return
    answer.send(None)
    parent = multiprocessing.parent_process()
    watched, message = False, b""
    due = time.monotonic()
    while parent is not None and parent.is_alive():
        if (mode.value == GONE) != socket.closed:
            if socket.closed:
                socket = _bind(context, endpoint)
            else:
                socket.close()
                watched = False
        while not socket.closed and socket.poll(0):
            watched = socket.recv()[:1] == b"\x01"
        if watched:
            if mode.value == BLACK:
                message = _encode(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
            elif mode.value == NORMAL or not message:
                message = _encode(draw(np.frombuffer(scene)))
                drawn.value += 1
            socket.send(message)
        due = max(due + 1 / FPS, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


def _bind(context: Any, endpoint: str) -> Any:
    # Unlike PUB, XPUB tells whether anybody has subscribed.
    socket = context.socket(zmq.XPUB)
    socket.setsockopt(zmq.SNDHWM, 2)
    socket.setsockopt(zmq.LINGER, 0)
    socket.bind(endpoint)
    return socket
