"""Teleoperators for a UR5e that are moved like a tool: `--teleop.type=spacemouse_twist` and `keyboard_twist`."""

from .configuration_twist import KeyboardTwistConfig, SpaceMouseTwistConfig, TwistTeleoperatorConfig
from .device import DeviceState, TwistDevice
from .errors import ArmStateError, DeviceLostError, DeviceUnavailableError
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
