"""UR5e with a Robotiq 2F-85: `--robot.type=ur5e_robotiq`."""

from typing import TYPE_CHECKING, Any

from .configuration import UR5eRobotiqConfig
from .faults import Fault, RobotFaultError

if TYPE_CHECKING:
    from .robot import UR5eRobotiq

__all__ = ["Fault", "RobotFaultError", "UR5eRobotiq", "UR5eRobotiqConfig"]


def __getattr__(name: str) -> Any:
    # On demand: the plug-in imports the configuration at the start of every command.
    if name == "UR5eRobotiq":
        from .robot import UR5eRobotiq

        return UR5eRobotiq
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
