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
from enum import IntEnum
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
START_SECONDS = 60.0
MODE, DRAWN, OFFSET, POSE = 0, 1, 2, slice(3, None)  # where both processes find what they share

try:
    import zmq
except ImportError:
    zmq = None  # type: ignore[assignment]


class CameraMode(IntEnum):
    """What the camera does."""

    NORMAL = 0
    FROZEN = 1
    BLACK = 2
    GONE = 3


class Camera:
    """The camera as the twin's process sees it, of a scene with so many joint positions (`nq`)."""

    def __init__(self, address: str, fps: float, num_positions: int):
        if zmq is None:
            raise ModuleNotFoundError(
                "the twin's camera needs pyzmq: pip install 'lerobot[pyzmq-dep]', or start the twin with --camera=false"
            )
        context = multiprocessing.get_context("spawn")
        # No lock: a pose mixed from two moments 2 ms apart is only a rolling shutter.
        shared = context.RawArray("d", POSE.start + num_positions)
        self._shared = np.frombuffer(shared)
        self._answer, theirs = context.Pipe(duplex=False)
        endpoint = f"tcp://{address}:{ports.CAMERA}"
        self._process = context.Process(target=_run, args=(endpoint, fps, shared, theirs), daemon=True)

    def start(self) -> None:
        """Starts the process and waits until it publishes; raises a RuntimeError if it does not."""
        self._process.start()
        problem = self._answer.recv() if self._answer.poll(START_SECONDS) else "it did not answer"
        if problem is not None:
            self.close()
            raise RuntimeError(f"the twin's camera did not start: {problem}")

    def show(self, pose: NDArray[np.float64], door_offset: float) -> None:
        """Tells where everything is now: the scene's joint positions, and the door's sideways shift in m."""
        self._shared[POSE], self._shared[OFFSET] = pose, door_offset

    @property
    def mode(self) -> CameraMode:
        """What the camera does."""
        return CameraMode(self._shared[MODE])

    @mode.setter
    def mode(self, mode: CameraMode) -> None:
        self._shared[MODE] = mode

    @property
    def drawn(self) -> int:
        """Pictures drawn so far."""
        return int(self._shared[DRAWN])

    def close(self) -> None:
        """Ends the process."""
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()


class _View:
    """Draws 640x480 pixels with a renderer that only draws squares."""

    def __init__(self) -> None:
        self._model = load_model("ur5e")
        self._data = mujoco.MjData(self._model)
        self._doorway = int(self._model.body("doorway").id)
        self._home = float(self._model.body_pos[self._doorway, 1])
        # A square as wide as the picture, whose middle rows have the camera's own field of view.
        index = int(self._model.camera(NAME).id)
        half = np.tan(np.radians(self._model.cam_fovy[index]) / 2) * WIDTH / HEIGHT
        self._model.cam_fovy[index] = 2 * np.degrees(np.arctan(half))
        self._renderer = make_renderer(self._model, NAME, WIDTH)

    def draw(self, pose: NDArray[np.float64], door_offset: float) -> NDArray[np.uint8]:
        self._data.qpos[:] = pose
        self._model.body_pos[self._doorway, 1] = self._home + door_offset
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        margin = (WIDTH - HEIGHT) // 2
        return self._renderer.draw(self._data)[margin : margin + HEIGHT]


def encode(picture: NDArray[np.uint8], timestamp: float) -> bytes:
    """A message as LeRobot's `zmq` camera reads it: JSON with a picture, red first, as JPEG in base64."""
    # OpenCV takes blue first, and neither LeRobot's image server nor its camera swaps: colours come out right
    # because both ends leave them alone.
    _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    message = {"timestamps": {NAME: timestamp}, "images": {NAME: base64.b64encode(jpeg.tobytes()).decode()}}
    return json.dumps(message).encode()


def _run(endpoint: str, fps: float, raw: Any, answer: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    context = zmq.Context()
    try:
        socket = _bind(context, endpoint)
        view = _View()
    except Exception as error:
        answer.send(f"{endpoint}: {error}")
        return
    answer.send(None)
    shared = np.frombuffer(raw)
    parent = multiprocessing.parent_process()
    watched, message = False, b""
    due = time.monotonic()
    while parent is not None and parent.is_alive():
        mode = CameraMode(shared[MODE])
        if (mode == CameraMode.GONE) != (socket is None):
            if socket is not None:
                socket.close(linger=0)
            watched = False
            socket = None if mode == CameraMode.GONE else _bind(context, endpoint)
        while socket is not None and socket.poll(0):
            watched = socket.recv()[:1] == b"\x01"
        if socket is not None and watched:
            if mode == CameraMode.BLACK:
                message = encode(np.zeros((HEIGHT, WIDTH, 3), np.uint8), time.time())
            elif mode == CameraMode.NORMAL or not message:
                message = encode(view.draw(shared[POSE], shared[OFFSET]), time.time())
                shared[DRAWN] += 1
            socket.send(message)
        due = max(due + 1 / fps, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


def _bind(context: Any, endpoint: str) -> Any:
    # Unlike PUB, XPUB tells whether anybody has subscribed.
    socket = context.socket(zmq.XPUB)
    socket.setsockopt(zmq.SNDHWM, 2)
    socket.setsockopt(zmq.LINGER, 0)
    socket.bind(endpoint)
    return socket
