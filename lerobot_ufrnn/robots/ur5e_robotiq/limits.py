"""What may be sent to the arm: every target passes through here first."""

from math import isfinite
from typing import SupportsFloat

import numpy as np
from numpy.typing import NDArray

from .configuration import FEATURES, UR5eRobotiqConfig

# Denavit-Hartenberg parameters of the UR5e as its maker publishes them, in m and rad (a real arm's differ by some
# 0.1 mm). The limits must not depend on the simulator, whose kinematics a test compares them with.
LINK_OFFSETS = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)
LINK_LENGTHS = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)
LINK_TWISTS = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)

HALVINGS = 6  # of a step that would leave the workspace, before it is not made at all


def flange_position(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position of the flange in m, in the frame of the arm's base, (3,), at joint angles in rad, (6,)."""
    pose = np.eye(4)
    for angle, offset, length, twist in zip(joints, LINK_OFFSETS, LINK_LENGTHS, LINK_TWISTS, strict=True):
        cos, sin, cos_twist, sin_twist = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
        pose = pose @ np.array(
            [
                [cos, -sin * cos_twist, sin * sin_twist, length * cos],
                [sin, cos * cos_twist, -cos * sin_twist, length * sin],
                [0.0, sin_twist, cos_twist, offset],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    return pose[:3, 3]


class Limits:
    """Turns what is asked for into what may be sent.

    A target is limited, in this order, to the joint ranges, to the joint speed, to a distance from the measured joints
    and to the workspace. What is no target at all (a wrong number of values, one that is no finite number) is refused.
    """

    def __init__(self, config: UR5eRobotiqConfig):
        self._config = config

    def check(self, action: dict[str, float]) -> tuple[NDArray[np.float64], float]:
        """Joint targets in rad, (6,), and the gripper's from 0 to 1; a `ValueError` says what is none of these."""
        if set(action) != set(FEATURES):
            raise ValueError(
                f"An action must have exactly {list(FEATURES)}, got {sorted(action)}; "
                "nothing was sent, the arm holds its pose."
            )
        # `float` would read a text, too.
        if texts := {name: value for name, value in action.items() if not isinstance(value, SupportsFloat)}:
            raise ValueError(f"An action must be numbers, got {texts}; nothing was sent, the arm holds its pose.")
        values = {name: float(action[name]) for name in FEATURES}
        if wrong := {name: value for name, value in values.items() if not isfinite(value)}:
            raise ValueError(f"An action must be finite, got {wrong}; nothing was sent, the arm holds its pose.")
        *target, closure = values.values()
        return np.array(target), min(max(closure, 0.0), 1.0)

    def limit(
        self, target: NDArray[np.float64], commanded: NDArray[np.float64], measured: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The target that may be sent: joint angles in rad, (6,), as are what is asked for, last sent and measured."""
        config = self._config
        change = config.joint_speed * config.control_period
        target = np.clip(target, config.joint_low, config.joint_high)
        target = np.clip(target, commanded - change, commanded + change)
        target = np.clip(target, measured - config.command_limit, measured + config.command_limit)
        outside = self._outside(commanded)
        for halving in range(HALVINGS):
            shortened = commanded + (target - commanded) / 2**halving
            if self._outside(shortened) <= outside:
                return shortened
        return commanded.copy()

    def _outside(self, joints: NDArray[np.float64]) -> float:
        """How far in m the flange is outside the workspace; 0 inside."""
        position = flange_position(joints)
        low, high = self._config.workspace_low, self._config.workspace_high
        return float(np.abs(position - np.clip(position, low, high)).max())
