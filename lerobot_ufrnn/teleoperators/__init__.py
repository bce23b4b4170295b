"""Teleoperators for a UR5e that are moved like a tool: `--teleop.type=spacemouse_twist` and `keyboard_twist`."""

from typing import TYPE_CHECKING, Any

from .configuration import KeyboardTwistConfig, SpaceMouseTwistConfig

if TYPE_CHECKING:
    from .twist_teleoperator import KeyboardTwist, SpaceMouseTwist

__all__ = ["KeyboardTwist", "KeyboardTwistConfig", "SpaceMouseTwist", "SpaceMouseTwistConfig"]


def __getattr__(name: str) -> Any:
    # On demand: the plug-in imports the configurations at the start of every command, the teleoperators need MuJoCo.
    if name in ("KeyboardTwist", "SpaceMouseTwist"):
        from . import twist_teleoperator

        return getattr(twist_teleoperator, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
