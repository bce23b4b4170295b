"""Teleoperators for a UR5e that are moved like a tool: `--teleop.type=spacemouse_twist` and `keyboard_twist`."""

from typing import TYPE_CHECKING, Any

from .configuration import KeyboardTwistConfig, SpaceMouseTwistConfig, TwistTeleoperatorConfig
from .device import ArmStateError, DeviceLostError, DeviceState, DeviceUnavailableError, TwistDevice

if TYPE_CHECKING:
    from .twist_teleoperator import KeyboardTwist, SpaceMouseTwist, TwistTeleoperator

__all__ = [
    "ArmStateError",
    "DeviceLostError",
    "DeviceState",
    "DeviceUnavailableError",
    "KeyboardTwist",
    "KeyboardTwistConfig",
    "SpaceMouseTwist",
    "SpaceMouseTwistConfig",
    "TwistDevice",
    "TwistTeleoperator",
    "TwistTeleoperatorConfig",
]


def __getattr__(name: str) -> Any:
    # On demand: the plug-in imports the configurations at the start of every command, the teleoperators need MuJoCo.
    if name in ("KeyboardTwist", "SpaceMouseTwist", "TwistTeleoperator"):
        from . import twist_teleoperator

        return getattr(twist_teleoperator, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
