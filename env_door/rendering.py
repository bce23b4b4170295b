"""Pictures of the scene, with whatever this machine can draw.

MuJoCo picks its OpenGL loader from the environment variable `MUJOCO_GL` while it is imported, and with
nothing set and no display it picks GLFW, which ends the process. `choose_backend` therefore runs before the
first `import mujoco` of this package and sets the variable where the user has not: EGL, then OSMesa, then
none at all, in which case pictures are ray-cast on the CPU.
"""

import ctypes
import ctypes.util
import importlib
import os
import sys
import warnings
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mujoco

_EGL_PLATFORM_DEVICE = 0x313F
_MAX_GEOMS = 1000  # MuJoCo's default of 10000 makes a renderer slower to create; the scene has some 50
_SMOOTHING = 1.5  # a smooth picture is drawn this much larger
_RAY_NOTICE = (
    "pictures are ray-cast on the CPU, in slightly other colours (do not mix both in one dataset); "
    "OpenGL needs EGL (Debian: libegl1, libgl1-mesa-dri) or OSMesa"
)


def choose_backend() -> str:
    """Sets `MUJOCO_GL` where it is unset, without loading MuJoCo and without risk to the process.

    Where MuJoCo has been imported already, it is made to look again.

    Returns:
        `str`: the value of `MUJOCO_GL` that holds: the user's own, `egl`, `osmesa`, or `disable` for
        ray-casting.

    Raises:
        RuntimeError: If the user's own choice is EGL or OSMesa and that library does not work here.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if not sys.platform.startswith("linux"):
        return chosen
    works = {"egl": _egl_works, "osmesa": _osmesa_works}
    if chosen in works and not works[chosen]():
        raise RuntimeError(
            f"MUJOCO_GL={chosen} is set, but that library does not work on this machine; unset MUJOCO_GL to let "
            "env_door choose, or set MUJOCO_GL=disable for pictures without OpenGL"
        )
    if not chosen:
        chosen = next((loader for loader, probe in works.items() if probe()), "disable")
        os.environ["MUJOCO_GL"] = chosen
        if "mujoco.rendering.classic.gl_context" in sys.modules:
            importlib.reload(sys.modules["mujoco.rendering.classic.gl_context"])
    return chosen


def _osmesa_works() -> bool:
    return ctypes.util.find_library("OSMesa") is not None


def _egl_works() -> bool:
    """Whether some EGL device initialises: asked of libEGL itself, as MuJoCo will do later."""
    try:
        egl = ctypes.CDLL(ctypes.util.find_library("EGL") or "libEGL.so.1")
        egl.eglGetProcAddress.restype = ctypes.c_void_p
        query = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
        display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
        if not query or not display:
            return False
        count = ctypes.c_int(0)
        devices = (ctypes.c_void_p * 16)()
        query_devices = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(query)
        if not query_devices(16, ctypes.byref(devices), ctypes.byref(count)):
            return False
        get_display = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(display)
        egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        for device in devices[: count.value]:
            handle = get_display(_EGL_PLATFORM_DEVICE, device, None)
            if handle and egl.eglInitialize(handle, None, None):
                return True
    except (OSError, AttributeError):
        return False
    return False


class Renderer(Protocol):
    """Draws the scene from one of its cameras."""

    def draw(self, data: "mujoco.MjData") -> NDArray[np.uint8]:
        """Picture of the current state, shape `(size, size, 3)`."""

    def close(self) -> None:
        """Frees what the renderer holds."""


class OpenGLRenderer:
    """Draws with OpenGL.

    Args:
        model (`mujoco.MjModel`):
            The scene.
        camera (`str`):
            Name of the camera.
        size (`int`):
            Height and width of the picture in pixels.
        smooth (`bool`, *optional*, defaults to `False`):
            Whether to smooth edges, for people rather than for a policy.
    """

    def __init__(self, model: "mujoco.MjModel", camera: str, size: int, smooth: bool = False):
        import mujoco

        self._size = size
        # On a CPU, drawing larger and shrinking costs a third of what OpenGL's own multisampling does.
        drawn = round(size * _SMOOTHING) if smooth else size
        # The context takes the size of its buffer from the model at creation.
        settings = model.vis.global_
        buffer = settings.offwidth, settings.offheight
        settings.offwidth = settings.offheight = drawn
        try:
            self._renderer = mujoco.Renderer(model, drawn, drawn, max_geom=_MAX_GEOMS)
        finally:
            settings.offwidth, settings.offheight = buffer
        self._camera = camera
        # Shadows alone would multiply the cost of a picture by four on a CPU.
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = 0

    def draw(self, data: "mujoco.MjData") -> NDArray[np.uint8]:
        """Picture of the current state.

        Args:
            data (`mujoco.MjData`):
                State of the scene.

        Returns:
            `NDArray[np.uint8]`: picture, shape `(size, size, 3)`.
        """
        self._renderer.update_scene(data, self._camera)
        picture = self._renderer.render()
        if len(picture) == self._size:
            return picture
        return cv2.resize(picture, (self._size, self._size), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()


def make_renderer(model: "mujoco.MjModel", camera: str, size: int, smooth: bool = False) -> Renderer:
    """The best renderer that works here.

    Args:
        model (`mujoco.MjModel`):
            The scene.
        camera (`str`):
            Name of the camera.
        size (`int`):
            Height and width of the picture in pixels.
        smooth (`bool`, *optional*, defaults to `False`):
            Whether to smooth edges where OpenGL draws.

    Returns:
        `Renderer`: an `OpenGLRenderer`, or a `RayCastRenderer` together with a warning where OpenGL does not
        work.
    """
    from env_door.ray_casting import RayCastRenderer

    loader = _loader_of_mujoco()
    if loader == "glfw" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        # Even trying GLFW without a display would end the process.
        loader = "none"
    if loader == "none":
        _notice("no OpenGL for off-screen drawing is set up")
        return RayCastRenderer(model, camera, size)
    try:
        return OpenGLRenderer(model, camera, size, smooth)
    except Exception as error:
        # Drivers fail in many ways (ImportError, AttributeError, GLError, RuntimeError): all mean "no
        # picture".
        _notice(f"OpenGL through {loader} failed ({error})")
        return RayCastRenderer(model, camera, size)


def _loader_of_mujoco() -> str:
    """Which loader MuJoCo was imported with: `egl`, `osmesa`, `glfw`, `cgl`, `wgl` or `none`."""
    import mujoco.rendering.classic.gl_context as gl_context

    context = getattr(gl_context, "GLContext", None)
    if context is None or context.__name__ == "_MissingGLContext":
        return "none"
    return str(context.__module__).split(".")[1]


def _notice(reason: str) -> None:
    # Always the same place, so that Python shows it once and not for every renderer.
    warnings.warn(f"{reason}: {_RAY_NOTICE}", RuntimeWarning, stacklevel=2)
