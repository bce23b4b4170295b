import time

import numpy as np
import pytest

from env_door.env import DoorEnv
from env_door.rendering import make_renderer
from env_door.twin import TwinProcess, free_address
from env_door.twin.camera import HEIGHT, WIDTH
from env_door.twin.server import Twin, TwinConfig


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
    renderer = make_renderer(env.model, "front", HEIGHT)
    difference = np.abs(seen[:, margin:-margin].astype(int) - renderer.draw(env.data))
    renderer.close()
    # JPEG and edges that fall on other pixels make 1; a shift by 8 pixels makes 11, a mirror or swapped colours 40.
    assert difference.mean() < 3


def test_pictures_are_only_drawn_while_somebody_watches():
    pytest.importorskip("zmq")
    with TwinProcess(camera=True) as twin:
        time.sleep(0.3)
        assert twin.state()["pictures"] == 0


@pytest.mark.parametrize("name", ["camera_black", "camera_freeze", "camera_gone"])
def test_the_camera_goes_black_freezes_or_is_gone_until_that_is_cleared(watching, name):
    twin, camera = watching
    before = camera.async_read(timeout_ms=5000)
    assert before.any()
    twin.inject(name)
    time.sleep(0.5)
    twin.reset(seed=7)
    try:
        if name == "camera_gone":
            with pytest.raises(TimeoutError):
                # The first of these may still be a picture that was under way.
                [camera.async_read(timeout_ms=700) for _ in range(3)]
        else:
            [camera.async_read(timeout_ms=5000) for _ in range(3)]
            after = camera.async_read(timeout_ms=5000)
            np.testing.assert_array_equal(after, np.zeros_like(before) if name == "camera_black" else before)
    finally:
        twin.clear()
        twin.reset(seed=2)
    end = time.monotonic() + 10
    while not np.array_equal(camera.async_read(timeout_ms=5000), before):
        assert time.monotonic() < end
