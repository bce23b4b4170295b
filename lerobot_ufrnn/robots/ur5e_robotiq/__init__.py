"""UR5e with a Robotiq 2F-85: `--robot.type=ur5e_robotiq`."""

from .configuration_ur5e_robotiq import UR5eRobotiqConfig
from .errors import Fault, RobotFaultError
from .ur5e_robotiq import UR5eRobotiq

__all__ = ["Fault", "RobotFaultError", "UR5eRobotiq", "UR5eRobotiqConfig"]
