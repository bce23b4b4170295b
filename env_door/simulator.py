"""MuJoCo, or a clear word about why it cannot be used. The modules that compute with it take it from here."""

import os

MIN_MUJOCO = "3.6"
"""Lowest version that the tests run on, as pyproject.toml declares it; 3.4 cannot return the normals of rays."""

INSTALL = f"`pip install 'mujoco>={MIN_MUJOCO}'`"

try:
    import mujoco
except Exception as error:  # OpenGL's loaders fail in many ways, and MuJoCo imports the one that MUJOCO_GL names
    remedy = f"Install it with {INSTALL}."
    if loader := os.environ.get("MUJOCO_GL"):
        remedy = (
            f"MUJOCO_GL={loader} is set; unset it to let env_door choose, or set MUJOCO_GL=disable for pictures "
            "without OpenGL."
        )
    raise ImportError(f"MuJoCo cannot be imported: {error}. {remedy}") from error

__all__ = ["mujoco"]

if [int(part) for part in mujoco.__version__.split(".")[:2]] < [int(part) for part in MIN_MUJOCO.split(".")]:
    raise ImportError(
        f"the door needs MuJoCo {MIN_MUJOCO} or later, and {mujoco.__version__} is installed: {INSTALL}. "
        "A package that holds MuJoCo back needs an environment of its own."
    )
