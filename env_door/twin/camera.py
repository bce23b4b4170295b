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
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from env_door.rendering import make_renderer
from env_door.scene import load_model
from env_door.twin import ports

NAME = "front"
"""Name of the camera in the scene and in the messages."""

WIDTH, HEIGHT = 640, 480
JPEG_QUALITY = 90
START_SECONDS = 60.0

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


@dataclass
class _Shared:
    """What both processes see. No lock: a pose mixed from two moments 2 ms apart is only a rolling shutter."""

    pose: Any
    doorway: Any
    mode: Any
    drawn: Any


class Camera:
    """The camera as the twin's process sees it, of a scene with so many joint positions (`nq`)."""

    def __init__(self, address: str, fps: float, num_positions: int):
        if zmq is None:
            raise ModuleNotFoundError(
                "the twin's camera needs pyzmq: pip install 'lerobot[pyzmq-dep]', or start the twin with --camera=false"
            )
        context = multiprocessing.get_context("spawn")
        self._shared = _Shared(
            pose=context.RawArray("d", num_positions),
            doorway=context.RawArray("d", 3),
            mode=context.RawValue("i", CameraMode.NORMAL),
            drawn=context.RawValue("l", 0),
        )
        self._pose, self._doorway = np.frombuffer(self._shared.pose), np.frombuffer(self._shared.doorway)
        self._answer, theirs = context.Pipe(duplex=False)
        endpoint = f"tcp://{address}:{ports.CAMERA}"
        self._process = context.Process(target=_run, args=(endpoint, fps, self._shared, theirs), daemon=True)

    def start(self) -> None:
        """Starts the process and waits until it publishes; raises a RuntimeError if it does not."""
        self._process.start()
        problem = self._answer.recv() if self._answer.poll(START_SECONDS) else "it did not answer"
        if problem is not None:
            self.close()
            raise RuntimeError(f"the twin's camera did not start: {problem}")

    def show(self, pose: NDArray[np.float64], doorway: NDArray[np.float64]) -> None:
        """Tells where everything is now: the scene's joint positions, and the doorway in m."""
        self._pose[:] = pose
        self._doorway[:] = doorway

    @property
    def mode(self) -> CameraMode:
        """What the camera does."""
        return CameraMode(self._shared.mode.value)

    @mode.setter
    def mode(self, mode: CameraMode) -> None:
        self._shared.mode.value = int(mode)

    @property
    def drawn(self) -> int:
        """Pictures drawn so far."""
        return self._shared.drawn.value

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
        # A square as wide as the picture, whose middle rows have the camera's own field of view.
        index = int(self._model.camera(NAME).id)
        half = np.tan(np.radians(self._model.cam_fovy[index]) / 2) * WIDTH / HEIGHT
        self._model.cam_fovy[index] = 2 * np.degrees(np.arctan(half))
        self._renderer = make_renderer(self._model, NAME, WIDTH)

    def draw(self, pose: NDArray[np.float64], doorway: NDArray[np.float64]) -> NDArray[np.uint8]:
        self._data.qpos[:] = pose
        self._model.body_pos[self._doorway] = doorway
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


def _run(endpoint: str, fps: float, shared: _Shared, answer: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    context = zmq.Context()
    try:
        socket = _bind(context, endpoint)
        view = _View()
    except Exception as error:
        answer.send(f"{endpoint}: {error}")
        return
    answer.send(None)
    pose, doorway = np.frombuffer(shared.pose), np.frombuffer(shared.doorway)
    parent = multiprocessing.parent_process()
    watched, message = False, b""
    due = time.monotonic()
    while parent is not None and parent.is_alive():
        mode = CameraMode(shared.mode.value)
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
                message = encode(view.draw(pose.copy(), doorway.copy()), time.time())
                shared.drawn.value += 1
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
