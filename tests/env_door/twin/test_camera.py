import base64
import json
import time

import cv2
import numpy as np
import pytest

from env_door.env import DoorEnv
from env_door.rendering import make_renderer
from env_door.twin import TwinProcess, free_address
from env_door.twin.camera import HEIGHT, WIDTH, encode
from env_door.twin.configuration import TwinConfig
from env_door.twin.server import Twin


def picture_of_the_environment(env):
    renderer = make_renderer(env.model, "front", HEIGHT)
    try:
        return renderer.draw(env.data)
    finally:
        renderer.close()


def test_message_is_what_the_camera_of_lerobot_decodes():
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:, :, 0] = 255
    message = json.loads(encode(picture, 1.5))
    assert message["timestamps"] == {"front": 1.5}
    # The steps of LeRobot's ZMQCamera, which hands on OpenCV's channels as they are.
    jpeg = np.frombuffer(base64.b64decode(message["images"]["front"]), np.uint8)
    decoded = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert decoded.shape == picture.shape
    assert np.abs(decoded.astype(int) - picture).max() < 10


def test_without_pyzmq_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("env_door.twin.camera.zmq", None)
    with pytest.raises(ModuleNotFoundError, match=r"lerobot\[pyzmq-dep\].*--camera=false"):
        Twin(TwinConfig(address=free_address()))


@pytest.fixture(scope="module")
def watching():
    pytest.importorskip("zmq")
    from lerobot.cameras.zmq import ZMQCamera, ZMQCameraConfig

    with TwinProcess(kind="pull", seed=2, camera=True, door_offset=0.05) as twin:
        camera = ZMQCamera(ZMQCameraConfig(server_address=twin.address, camera_name="front", fps=30))
        camera.connect()
        yield twin, camera
        camera.disconnect()


def test_the_middle_is_the_picture_of_the_environment(watching):
    _, camera = watching
    env = DoorEnv(kind="pull", door_offset=0.05)
    env.reset(seed=2)
    seen = camera.async_read(timeout_ms=5000)
    assert seen.shape == (HEIGHT, WIDTH, 3)
    margin = (WIDTH - HEIGHT) // 2
    difference = np.abs(seen[:, margin:-margin].astype(int) - picture_of_the_environment(env))
    # JPEG and edges that fall on other pixels make 1; a shift by 8 pixels makes 11, a mirror or swapped colours 40.
    assert difference.mean() < 3


def test_pictures_are_only_drawn_while_somebody_watches():
    pytest.importorskip("zmq")
    with TwinProcess(camera=True) as twin:
        time.sleep(0.3)
        assert twin.state()["pictures"] == 0


@pytest.mark.parametrize("fault", ["camera_black", "camera_freeze", "camera_gone"])
def test_faults(watching, fault):
    twin, camera = watching
    before = camera.async_read(timeout_ms=5000)
    assert before.any()
    twin.inject(fault)
    time.sleep(0.5)
    twin.reset(seed=7)
    try:
        if fault == "camera_gone":
            with pytest.raises(TimeoutError):
                # The first of these may still be a picture that was under way.
                [camera.async_read(timeout_ms=700) for _ in range(3)]
        else:
            [camera.async_read(timeout_ms=5000) for _ in range(3)]
            after = camera.async_read(timeout_ms=5000)
            np.testing.assert_array_equal(after, np.zeros_like(before) if fault == "camera_black" else before)
    finally:
        twin.clear()
        twin.reset(seed=2)
    end = time.monotonic() + 10
    while not np.array_equal(camera.async_read(timeout_ms=5000), before):
        assert time.monotonic() < end
