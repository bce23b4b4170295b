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
from scipy.spatial.transform import Rotation

from env_door.kinematics import InverseKinematics, UnreachableError
from env_door.scene import UR5E, load_model

from .configuration import TwistTeleoperatorConfig

MAX_ITERATIONS = 30  # of the inverse kinematics; a step of a few centimetres takes about three
MAX_CHANGE = 0.3  # rad of a joint that belong to a small step of the tool; more is another way to hold the arm
MIN_PROGRESS = 0.05  # share of a step below which the arm counts as blocked


class Hindrance(Enum):
    """Why the target does not do what the operator asks, and what to do about it."""

    UNREACHABLE = "The arm cannot reach further that way; the target stays. Move another way."
    NEAR_SINGULAR = "The arm is nearly singular (stretched or folded) that way; the target stays. Move another way."
    BLOCKED = "The arm does not follow (blocked?); the target waits for it. Move back, or free the arm."
    MOVED = "The arm was moved by something else; the target follows it."


class ToolTarget:
    """Where the tool is to be (`rotation`, (3, 3), in the frame of the arm's base), and the joint targets for it."""

    def __init__(self, config: TwistTeleoperatorConfig):
        self._config = config
        model = load_model(UR5E.name)
        self._kinematics = InverseKinematics(model, UR5E.joints, max_iterations=MAX_ITERATIONS)
        self._ranges = np.array([model.joint(name).range for name in UR5E.joints])
        self.hindrance: Hindrance | None = None
        self._joints: NDArray[np.float64] = np.array(UR5E.ready_pose)
        self._position, self.rotation = self._kinematics.forward(self._joints)

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

    def step(self, twist: NDArray[np.float64], seconds: float, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joint targets in rad, (6,), within `max_lead` of the measured ones.

        The twist, velocity (m/s) and angular velocity (rad/s) of the tool in the frame of the arm's base, (6,), lasts
        for some seconds. `hindrance` says afterwards if something is in the way.
        """
        self.hindrance = None
        low, high = measured - self._config.max_lead, measured + self._config.max_lead
        followed = np.clip(self._joints, low, high)
        if not np.array_equal(followed, self._joints):
            if np.abs(followed - self._joints).max() > self._config.max_lead:
                self.hindrance = Hindrance.MOVED
            self._place(followed)
        if twist.any():
            self._lead(twist * seconds, self._config.joint_speed * seconds, low, high)
        return self._joints.copy()

    def _lead(
        self, motion: NDArray[np.float64], max_change: float, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> None:
        """Leads the target on by a motion of the tool, as far as the joints' largest change and bounds allow."""
        position = self._position + motion[:3]
        rotation = Rotation.from_rotvec(motion[3:]).as_matrix() @ self.rotation
        try:
            joints = self._kinematics.solve(position, rotation, self._joints)
        except UnreachableError:
            self.hindrance = Hindrance.UNREACHABLE
            return
        change = joints - self._joints
        least = min(self._config.min_manipulability, self._manipulability(self._joints))
        if self._manipulability(joints) < least or np.abs(change).max() > MAX_CHANGE:
            self.hindrance = Hindrance.NEAR_SINGULAR
            return
        moving = np.abs(change) > 1e-12
        room = np.where(change > 0, high - self._joints, low - self._joints)
        share = float(np.min(max_change / np.abs(change[moving]), initial=1.0))
        free = float(np.min(room[moving] / change[moving], initial=1.0))
        if free < MIN_PROGRESS * share:
            self.hindrance = self.hindrance or Hindrance.BLOCKED
        share = max(0.0, min(share, free))
        if share < 1.0:
            self._place(self._joints + share * change)
        else:
            # Kept as integrated, so that the tolerance of the inverse kinematics does not add up over the steps.
            self._joints, self._position, self.rotation = joints, position, rotation

    def _place(self, joints: NDArray[np.float64]) -> None:
        self._joints = joints
        self._position, self.rotation = self._kinematics.forward(joints)

    def _manipulability(self, joints: NDArray[np.float64]) -> float:
        return abs(float(np.linalg.det(self._kinematics.jacobian(joints))))
