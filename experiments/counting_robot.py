"""A robot and a teleoperator without hardware that count, so that each recorded frame tells where it belongs.

For `--robot.discover_packages_path=counting_robot --robot.type=counting_robot --teleop.type=counting_teleop`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

__path__: list[str] = []  # LeRobot expects a package
JOINT, CAMERA, SIZE = "joint.pos", "front", 32


def picture(count: int) -> np.ndarray:
    """Image `(32, 32, 3)` of one grey level that belongs to a count; neighbours differ clearly."""
    return np.full((SIZE, SIZE, 3), 20 + 37 * count % 210, np.uint8)


@RobotConfig.register_subclass("counting_robot")
@dataclass(kw_only=True)
class CountingRobotConfig(RobotConfig):
    """Where to start to count."""

    first: int = 0


@TeleoperatorConfig.register_subclass("counting_teleop")
@dataclass(kw_only=True)
class CountingTeleopConfig(TeleoperatorConfig):
    """Where to start to count."""

    first: int = 0


class Counting:
    """What the two have in common."""

    is_calibrated, is_connected = True, False

    @cached_property
    def action_features(self) -> dict[str, type]:
        return {JOINT: float}

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass


class CountingRobot(Counting, Robot):
    """Observes its count and a picture of it."""

    config_class, name = CountingRobotConfig, "counting_robot"
    cameras = (CAMERA,)

    def __init__(self, config: CountingRobotConfig):
        super().__init__(config)
        self.count = config.first

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        return {JOINT: float, CAMERA: (SIZE, SIZE, 3)}

    def get_observation(self) -> dict[str, Any]:
        self.count += 1
        return {JOINT: float(self.count - 1), CAMERA: picture(self.count - 1)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action


class CountingTeleop(Counting, Teleoperator):
    """Commands half a count more than the robot observes."""

    config_class, name = CountingTeleopConfig, "counting_teleop"
    feedback_features: ClassVar[dict[str, type]] = {}

    def __init__(self, config: CountingTeleopConfig):
        super().__init__(config)
        self.count = config.first

    def get_action(self) -> dict[str, Any]:
        self.count += 1
        return {JOINT: self.count - 0.5}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        pass
