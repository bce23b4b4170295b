import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from env_door import rendering
from env_door.env import DoorEnv
from env_door.ray_casting import RayCastRenderer
from env_door.rendering import OpenGLRenderer, choose_backend

DRAW = """
from env_door.env import DoorEnv
env = DoorEnv()
front = env.reset(seed=0)[0]["pixels"]["front"]
assert front.shape == (128, 128, 3) and front.std() > 20, front.std()
assert env.render().shape == (192, 192, 3)
print(type(env._renderer("front")).__name__)
"""


def run_fresh(code, **variables):
    """Runs code in a new process without a display; variables set to None are unset."""
    environment = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment.pop("MUJOCO_GL", None)
    environment.pop("PYOPENGL_PLATFORM", None)
    environment.update(variables)
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def env():
    env = DoorEnv()
    env.reset(seed=0)
    yield env
    env.close()


@pytest.fixture
def opengl(env):
    if choose_backend() == "disable":
        pytest.skip("no OpenGL on this machine")
    renderer = OpenGLRenderer(env.model, "front", 128)
    yield renderer
    renderer.close()


def test_without_opengl_pictures_are_ray_cast_and_the_user_is_told_once():
    result = run_fresh(DRAW, MUJOCO_GL="disable")
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "RayCastRenderer"
    assert result.stderr.count("ray-cast") == 1


def test_glfw_without_display_does_not_end_the_process():
    result = run_fresh(DRAW, MUJOCO_GL="glfw")
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "RayCastRenderer"


def test_import_of_mujoco_first_draws_the_same_as_import_of_env_door_first():
    first = run_fresh("import mujoco\n" + DRAW)
    assert first.returncode == 0, first.stderr
    assert first.stdout == run_fresh(DRAW).stdout


def test_mujocos_own_renderer_works_after_import_of_env_door():
    code = "import env_door, mujoco\nm = mujoco.MjModel.from_xml_string('<mujoco/>')\nmujoco.Renderer(m, 8, 8).close()"
    if choose_backend() == "disable":
        pytest.skip("no OpenGL on this machine")
    assert run_fresh(code).returncode == 0


@pytest.mark.parametrize("loader", ["egl", "osmesa"])
def test_broken_choice_of_the_user_is_told(monkeypatch, loader):
    monkeypatch.setenv("MUJOCO_GL", loader)
    monkeypatch.setattr(rendering, f"_{loader}_works", lambda: False)
    with pytest.raises(RuntimeError, match=f"MUJOCO_GL={loader}"):
        choose_backend()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has a choice")
@pytest.mark.parametrize(
    ("egl", "osmesa", "expected"), [(True, True, "egl"), (False, True, "osmesa"), (False, False, "disable")]
)
def test_order_of_preference(monkeypatch, egl, osmesa, expected):
    monkeypatch.setattr(rendering, "_egl_works", lambda: egl)
    monkeypatch.setattr(rendering, "_osmesa_works", lambda: osmesa)
    monkeypatch.setattr(rendering.importlib, "reload", lambda module: module)
    monkeypatch.setenv("MUJOCO_GL", "")
    assert choose_backend() == expected
    assert os.environ["MUJOCO_GL"] == expected


def test_failing_driver_falls_back(env, monkeypatch):
    def fail(*arguments):
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setattr(rendering, "OpenGLRenderer", fail)
    monkeypatch.setattr(rendering, "_loader_of_mujoco", lambda: "egl")
    with pytest.warns(RuntimeWarning, match="glGetError"):
        renderer = rendering.make_renderer(env.model, "front", 32)
    assert isinstance(renderer, RayCastRenderer)


def test_ray_casting_agrees_with_opengl(env, opengl):
    """Two independent ways to draw must show the same things in the same places, if in slightly other shades."""
    picture = opengl.draw(env.data).astype(int)
    cast = RayCastRenderer(env.model, "front", 128).draw(env.data).astype(int)
    different = np.abs(picture - cast).max(axis=-1) > 70
    assert different.mean() < 0.02
    mirrored = np.abs(picture - cast[:, ::-1]).max(axis=-1) > 70
    assert mirrored.mean() > 0.2, "the comparison must be able to fail"


def test_frames_repeat_exactly(env, opengl):
    np.testing.assert_array_equal(opengl.draw(env.data), opengl.draw(env.data))


@pytest.mark.parametrize("size", [100, 101, 768])
def test_smooth_picture_is_the_plain_one_with_softer_edges(env, opengl, size):
    plain = OpenGLRenderer(env.model, "view", size)
    smooth = OpenGLRenderer(env.model, "view", size, smooth=True)
    first, second = plain.draw(env.data).astype(int), smooth.draw(env.data)
    assert second.shape == first.shape == (size, size, 3)
    assert second.dtype == np.uint8
    difference = np.abs(first - second).max(axis=-1)
    assert 0.005 < (difference > 8).mean() < 0.1, "only edges differ"
    assert len(np.unique(second.reshape(-1, 3), axis=0)) > len(np.unique(first.reshape(-1, 3), axis=0))
    plain.close()
    smooth.close()


def test_renderers_leave_the_model_unchanged(env, opengl):
    before = env.model.vis.global_.offwidth, env.model.vis.global_.offheight
    OpenGLRenderer(env.model, "view", 64, smooth=True).close()
    assert (env.model.vis.global_.offwidth, env.model.vis.global_.offheight) == before


def test_size_of_the_buffer_does_not_change_a_picture(env, opengl):
    """Data recorded with a buffer of another size must stay comparable, bit by bit."""
    reference = mujoco.Renderer(env.model, 128, 128)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        reference.scene.flags[flag] = 0
    reference.update_scene(env.data, "front")
    np.testing.assert_array_equal(opengl.draw(env.data), reference.render())
    reference.close()
