import importlib
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


@pytest.mark.parametrize("loader", ["egl", "osmesa"])
def test_broken_choice_of_the_user_is_told(monkeypatch, loader):
    monkeypatch.setenv("MUJOCO_GL", loader)
    monkeypatch.setattr(rendering, f"_{loader}_works", lambda: False)
    with pytest.raises(RuntimeError, match=f"MUJOCO_GL={loader} is set, but .* unset MUJOCO_GL .* MUJOCO_GL=disable"):
        rendering.make_renderer(None, "front", 32)


def test_a_choice_with_which_mujoco_cannot_be_imported_is_told():
    result = run_fresh("import env_door, env_door.env", MUJOCO_GL="telepathy")
    assert "MUJOCO_GL=telepathy is set; unset it to let env_door choose" in result.stderr


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has a choice")
@pytest.mark.parametrize(
    ("egl", "osmesa", "settled", "expected"),
    [
        (True, True, "", "egl"),
        (False, True, "", "osmesa"),
        (False, False, "", "disable"),
        (True, True, "osmesa", "osmesa"),  # PyOpenGL was imported by something else
        (True, True, "glx", "disable"),
    ],
)
def test_order_of_preference_when_nothing_is_set(monkeypatch, egl, osmesa, settled, expected):
    monkeypatch.setattr(rendering, "_egl_works", lambda: egl)
    monkeypatch.setattr(rendering, "_osmesa_works", lambda: osmesa)
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setenv("PYOPENGL_PLATFORM", settled)
    assert choose_backend() == expected


def test_failing_driver_falls_back(env, monkeypatch):
    def fail(*arguments):
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setattr(rendering, "OpenGLRenderer", fail)
    monkeypatch.setattr(rendering, "choose_backend", lambda: "egl")
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


def test_pictures_are_those_of_mujocos_own_renderer(env, opengl, monkeypatch):
    """Bit by bit, whatever the size of its buffer: data recorded with that renderer must stay comparable."""
    context = importlib.import_module(f"mujoco.{choose_backend()}").GLContext
    monkeypatch.setattr("mujoco.rendering.classic.gl_context.GLContext", context)
    reference = mujoco.Renderer(env.model, 128, 128)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        reference.scene.flags[flag] = 0
    reference.update_scene(env.data, "front")
    np.testing.assert_array_equal(opengl.draw(env.data), reference.render())
    reference.close()
