import contextlib
import importlib
import sys

import mujoco
import numpy as np
import pytest

from env_door import rendering
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


@pytest.fixture(autouse=True)
def shut(env):
    env.reset(seed=0, options={"door_offset": 0.0})


@pytest.fixture
def draw_with_opengl(env):
    """Makes OpenGL renderers, and frees them after the test."""
    if (backend := choose_backend()) == "disable":
        pytest.skip("no OpenGL on this machine")
    with contextlib.ExitStack() as made:

        def make(camera="front", size=128, smooth=False):
            renderer = OpenGLRenderer(env.model, camera, size, smooth, backend)
            made.callback(renderer.close)
            return renderer.draw

        yield make


@pytest.mark.parametrize("loader", ["disable", "glfw"])
def test_without_opengl_or_display_pictures_are_ray_cast_and_the_user_is_told_once(run_fresh, loader):
    """The process goes on, too, though GLFW ends one that has no display."""
    result = run_fresh(DRAW, MUJOCO_GL=loader)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "RayCastRenderer"
    assert result.stderr.count("ray-cast") == 1


def test_import_of_mujoco_first_draws_the_same_as_import_of_env_door_first(run_fresh):
    first = run_fresh("import mujoco\n" + DRAW)
    assert first.returncode == 0, first.stderr
    assert first.stdout == run_fresh(DRAW).stdout


def test_a_choice_with_which_mujoco_cannot_be_imported_is_told(run_fresh):
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
    monkeypatch.setattr(rendering, "_is_installed", {"egl": egl, "osmesa": osmesa}.get)
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setenv("PYOPENGL_PLATFORM", settled)
    assert choose_backend() == expected


def fail(*arguments):
    raise AttributeError("'NoneType' object has no attribute 'glGetError'")


def test_failing_driver_falls_back(env, monkeypatch):
    monkeypatch.setattr(rendering, "OpenGLRenderer", fail)
    monkeypatch.setattr(rendering, "choose_backend", lambda: "egl")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.warns(RuntimeWarning, match="glGetError"):
        renderer = rendering.make_renderer(env.model, "front", 32)
    assert isinstance(renderer, RayCastRenderer)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has a choice")
@pytest.mark.parametrize("loader", ["egl", "osmesa"])
def test_broken_choice_of_the_user_is_told(env, monkeypatch, loader):
    monkeypatch.setenv("MUJOCO_GL", loader)
    monkeypatch.setattr(rendering, "OpenGLRenderer", fail)
    with pytest.raises(RuntimeError, match=f"MUJOCO_GL={loader} is set, but .* unset MUJOCO_GL .* MUJOCO_GL=disable"):
        rendering.make_renderer(env.model, "front", 32)


def test_ray_casting_agrees_with_opengl(env, draw_with_opengl):
    """Two independent ways to draw must show the same things in the same places, if in slightly other shades."""
    picture = draw_with_opengl()(env.data).astype(int)
    cast = RayCastRenderer(env.model, "front", 128).draw(env.data).astype(int)
    different, mirrored = (np.abs(picture - other).max(axis=-1) > 70 for other in (cast, cast[:, ::-1]))
    assert different.mean() < 0.02
    assert mirrored.mean() > 0.2, "the comparison must be able to fail"


@pytest.mark.parametrize("size", [100, 101, 768])
def test_smooth_picture_is_the_plain_one_with_softer_edges(env, draw_with_opengl, size):
    plain, smooth = (draw_with_opengl("view", size, smooth)(env.data) for smooth in (False, True))
    assert smooth.shape == plain.shape == (size, size, 3)
    assert smooth.dtype == np.uint8
    difference = np.abs(plain.astype(int) - smooth).max(axis=-1)
    assert 0.005 < (difference > 8).mean() < 0.1, "only edges differ"
    assert len(np.unique(smooth.reshape(-1, 3), axis=0)) > len(np.unique(plain.reshape(-1, 3), axis=0))


def test_renderers_leave_the_model_unchanged(env, draw_with_opengl):
    before = env.model.vis.global_.offwidth, env.model.vis.global_.offheight
    draw_with_opengl("view", 64, smooth=True)
    assert (env.model.vis.global_.offwidth, env.model.vis.global_.offheight) == before


def test_pictures_are_those_of_mujocos_own_renderer_each_time(env, draw_with_opengl, monkeypatch):
    """Bit by bit, whatever the size of its buffer: data recorded with that renderer must stay comparable."""
    draw = draw_with_opengl()
    context = importlib.import_module(f"mujoco.{choose_backend()}").GLContext
    monkeypatch.setattr("mujoco.rendering.classic.gl_context.GLContext", context)
    reference = mujoco.Renderer(env.model, 128, 128)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        reference.scene.flags[flag] = 0
    reference.update_scene(env.data, "front")
    for _ in range(2):
        np.testing.assert_array_equal(draw(env.data), reference.render())
    reference.close()
