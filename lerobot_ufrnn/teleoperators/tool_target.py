"""From a twist of the tool to joint targets that the arm can follow.

The pose that the tool is to have is integrated in the frame of the arm's base,

    p <- p + v dt,    R <- exp([w] dt) R,

and inverse kinematics, started at the present target, turns it into joint angles. The step from one target to the
next is shortened, on its straight line, so that no joint is faster than agreed or further ahead of the measured arm
than agreed. A blocked arm is thus not leant against harder and harder, and no target is ever far from the arm.
"""

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from env_door.kinematics import InverseKinematics, UnreachableError, rotation_about
from env_door.scene import UR5E, load_model

from .configuration import TwistTeleoperatorConfig

MAX_ITERATIONS = 30
"""Iterations of the inverse kinematics; a step of a few centimetres takes about three."""

MAX_CHANGE = 0.3
"""Largest joint step in rad that belongs to a small step of the tool; a larger one is another way to hold the arm."""

MIN_PROGRESS = 0.05
"""Share of a step below which the arm counts as blocked."""


class Hindrance(Enum):
    """Why the target does not do what the operator asks, and what to do about it."""

    UNREACHABLE = "The arm cannot reach further that way; the target stays. Move another way."
    NEAR_SINGULAR = "The arm is nearly singular (stretched or folded) that way; the target stays. Move another way."
    BLOCKED = "The arm does not follow (blocked?); the target waits for it. Move back, or free the arm."
    MOVED = "The arm was moved by something else; the target follows it."


class ToolTarget:
    """Where the tool is to be, and the joint targets for it."""

    def __init__(self, config: TwistTeleoperatorConfig):
        self._joint_speed = config.joint_speed
        self._max_lead = config.max_lead
        self._min_manipulability = config.min_manipulability
        model = load_model(UR5E.name)
        self._kinematics = InverseKinematics(model, UR5E.joints, max_iterations=MAX_ITERATIONS)
        self._ranges = np.array([model.joint(name).range for name in UR5E.joints])
        self.hindrance: Hindrance | None = None
        self._joints: NDArray[np.float64] = np.array(UR5E.ready_pose)
        self._position, self._rotation = self._kinematics.forward(self._joints)

    def start(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Makes the target where the arm is, at measured joints in rad, (6,), which it returns.

        Raises a `ValueError` if one is beyond its range, from where the inverse kinematics would take it back at once.
        """
        outside = (joints < self._ranges[:, 0]) | (joints > self._ranges[:, 1])
        if outside.any():
            names = [UR5E.joints[i] for i in np.flatnonzero(outside)]
            raise ValueError(
                f"The joints {', '.join(names)} are at {joints[outside].tolist()} rad, beyond their ranges, "
                f"{self._ranges[outside].tolist()}. Move them back on the pendant, then start again."
            )
        self.hindrance = None
        self._place(joints.copy())
        return self._joints.copy()

    @property
    def rotation(self) -> NDArray[np.float64]:
        """`NDArray[np.float64]`: orientation that the tool is to have, (3, 3), in the frame of the arm's base."""
        return self._rotation

    def step(self, twist: NDArray[np.float64], seconds: float, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joint targets in rad, (6,), within `max_lead` of the measured ones.

        The twist, velocity (m/s) and angular velocity (rad/s) of the tool in the frame of the arm's base, (6,), lasts
        for some seconds. `hindrance` says afterwards if something is in the way.
        """
        self.hindrance = None
        low, high = measured - self._max_lead, measured + self._max_lead
        followed = np.clip(self._joints, low, high)
        if not np.array_equal(followed, self._joints):
            if np.abs(followed - self._joints).max() > self._max_lead:
                self.hindrance = Hindrance.MOVED
            self._place(followed)
        if twist.any():
            position = self._position + twist[:3] * seconds
            rotation = _turn(twist[3:] * seconds) @ self._rotation
            joints = self._solve(position, rotation)
            if joints is not None:
                self._approach(joints, position, rotation, seconds, low, high)
        return self._joints.copy()

    def _solve(self, position: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64] | None:
        try:
            joints = self._kinematics.solve(position, rotation, self._joints)
        except UnreachableError:
            self.hindrance = Hindrance.UNREACHABLE
            return None
        manipulability = self._manipulability(joints)
        worse = manipulability < min(self._min_manipulability, self._manipulability(self._joints))
        if worse or np.abs(joints - self._joints).max() > MAX_CHANGE:
            self.hindrance = Hindrance.NEAR_SINGULAR
            return None
        return joints

    def _approach(
        self,
        joints: NDArray[np.float64],
        position: NDArray[np.float64],
        rotation: NDArray[np.float64],
        seconds: float,
        low: NDArray[np.float64],
        high: NDArray[np.float64],
    ) -> None:
        change = joints - self._joints
        moving = np.abs(change) > 1e-12
        room = np.where(change > 0, high - self._joints, low - self._joints)
        share = min(1.0, float(np.min(self._joint_speed * seconds / np.abs(change[moving]), initial=1.0)))
        free = float(np.min(room[moving] / change[moving], initial=1.0))
        if free < MIN_PROGRESS * share:
            self.hindrance = self.hindrance or Hindrance.BLOCKED
        share = max(0.0, min(share, free))
        if share < 1.0:
            self._place(self._joints + share * change)
        else:
            # Kept as integrated, so that the tolerance of the inverse kinematics does not add up over the steps.
            self._joints, self._position, self._rotation = joints, position, rotation

    def _place(self, joints: NDArray[np.float64]) -> None:
        self._joints = joints
        self._position, self._rotation = self._kinematics.forward(joints)

    def _manipulability(self, joints: NDArray[np.float64]) -> float:
        return abs(float(np.linalg.det(self._kinematics.jacobian(joints))))


def _turn(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    angle = float(np.linalg.norm(rotation))
    return rotation_about(rotation / angle, angle) if angle > 0 else np.eye(3)
