"""Pictures of the scene, with whatever this machine can draw.

How is chosen at the first picture: what `MUJOCO_GL` names, or else EGL, OSMesa, or nothing at all, in which case
pictures are ray-cast on the CPU. MuJoCo's own `Renderer` draws with what was chosen while MuJoCo was imported: GLFW
where no variable was set, which ends the process without a display. So only MuJoCo's OpenGL contexts are used here; no
variable needs to be set for them, and it does not matter who imported MuJoCo first.
"""

import contextlib
import ctypes
import ctypes.util
import importlib
import os
import sys
import warnings
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from env_door.ray_casting import RayCastRenderer
from env_door.simulator import mujoco

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}  # the first that is installed draws
_MAX_GEOMS = 1000  # MuJoCo's default of 10000 makes a scene slower to create; this one has some 50
_SMOOTHING = 1.5  # a smooth picture is drawn this much larger
_OFF = ("disable", "disabled", "off", "false", "0")
_RAY_NOTICE = (
    "pictures are ray-cast on the CPU, in slightly other colours (do not mix both in one dataset); "
    "OpenGL needs EGL (Debian: libegl1, libgl1-mesa-dri) or OSMesa"
)


def choose_backend() -> str:
    """`egl`, `osmesa`, `glfw`, `mujoco` (its own choice, safe on macOS and Windows), or `disable`: ray-casting."""
    chosen = _user_choice()
    if chosen in _OFF:
        return "disable"
    if not sys.platform.startswith("linux"):
        return "mujoco"
    if chosen in _LIBRARIES:
        return chosen
    if chosen in ("glfw", "glx"):
        # Even trying GLFW without a display would end the process.
        return "glfw" if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") else "disable"
    # PyOpenGL serves one of them in a process: whoever was here before may have settled which.
    settled = os.environ.get("PYOPENGL_PLATFORM", "").strip().lower()
    return next((name for name in _LIBRARIES if settled in ("", name) and _is_installed(name)), "disable")


def _user_choice() -> str:
    return os.environ.get("MUJOCO_GL", "").strip().lower()


def _is_installed(backend: str) -> bool:
    library = _LIBRARIES[backend]
    try:
        ctypes.CDLL(ctypes.util.find_library(library) or f"lib{library}.so.1")
    except OSError:
        return False
    return True


class OpenGLRenderer:
    """Draws with OpenGL; takes what `make_renderer` takes, and what `choose_backend` returned."""

    def __init__(self, model: mujoco.MjModel, camera: str, size: int, smooth: bool, backend: str):
        self._context: Any = None
        self._drawing: mujoco.MjrContext | None = None
        self._model = model
        self._size = size
        # On a CPU, drawing larger and shrinking costs a third of what OpenGL's own multisampling does.
        drawn = round(size * _SMOOTHING) if smooth else size
        self._rectangle = mujoco.MjrRect(0, 0, drawn, drawn)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera(camera).id
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(model=model, maxgeom=_MAX_GEOMS)
        # Shadows alone would multiply the cost of a picture by four on a CPU.
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        package = mujoco if backend == "mujoco" else importlib.import_module(f"mujoco.{backend}")
        self._context = package.GLContext(drawn, drawn)
        self._context.make_current()
        # The context takes the size of its buffer from the model at creation.
        settings = model.vis.global_
        buffer = settings.offwidth, settings.offheight
        settings.offwidth = settings.offheight = drawn
        try:
            self._drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        finally:
            settings.offwidth, settings.offheight = buffer
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawing)

    def draw(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Picture of the current state, shape `(size, size, 3)`."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, everything, self._scene)
        self._context.make_current()
        picture = np.empty((self._rectangle.height, self._rectangle.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rectangle, self._scene, self._drawing)
        mujoco.mjr_readPixels(picture, None, self._rectangle, self._drawing)
        picture = np.ascontiguousarray(picture[::-1])  # OpenGL's first row is the lowest one
        if len(picture) == self._size:
            return picture
        return cv2.resize(picture, (self._size, self._size), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)

    def close(self) -> None:
        """Frees the OpenGL context."""
        if self._drawing is not None:
            self._context.make_current()
            self._drawing.free()
        if self._context is not None:
            self._context.free()
        self._drawing = self._context = None

    def __del__(self, suppress: type = contextlib.suppress) -> None:
        # Without its context at hand, freeing what was drawn with would crash; at exit the display may be gone already,
        # and so may this module's names.
        with suppress(Exception):
            self.close()


Renderer = OpenGLRenderer | RayCastRenderer


def make_renderer(model: mujoco.MjModel, camera: str, size: int, smooth: bool = False) -> Renderer:
    """The best renderer that works here, for square pictures; ray-casting comes with a warning.

    `smooth` smooths edges where OpenGL draws.

    Raises:
        RuntimeError: If the user set `MUJOCO_GL` to a library that does not work here.
    """
    backend = choose_backend()
    if backend == "disable":
        _notice("no OpenGL for off-screen drawing is set up")
        return RayCastRenderer(model, camera, size)
    try:
        return OpenGLRenderer(model, camera, size, smooth, backend)
    except Exception as error:
        # Drivers fail in many ways (ImportError, AttributeError, GLError, RuntimeError): all mean "no picture".
        if backend in _LIBRARIES and _user_choice() == backend:
            raise RuntimeError(
                f"MUJOCO_GL={backend} is set, but that library does not work on this machine ({error}); unset "
                "MUJOCO_GL to let env_door choose, or set MUJOCO_GL=disable for pictures without OpenGL"
            ) from error
        _notice(f"OpenGL through {backend} failed ({error})")
        return RayCastRenderer(model, camera, size)


def _notice(reason: str) -> None:
    # Always the same place, so that Python shows it once and not for every renderer.
    warnings.warn(f"{reason}: {_RAY_NOTICE}", RuntimeWarning, stacklevel=2)
