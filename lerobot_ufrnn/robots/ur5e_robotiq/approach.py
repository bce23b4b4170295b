"""The way from one target to the next, and the set-points that make the arm follow it."""

import math

import numpy as np
from numpy.typing import NDArray

from .configuration_ur5e_robotiq import UR5eRobotiqConfig

FADE = 0.25
"""Part of a control period within which set-points stop running ahead when no new target comes."""


class Approach:
    """A straight line in joint space to the newest target, one control period long.

    The controller smooths set-points, so that the arm trails them by its lookahead time. They therefore run ahead of
    the line by `servo_lead` seconds at the line's speed. If the next target is late, that lead fades instead of ending
    at once, which the arm would answer with a jerk.

    Args:
        joints (`NDArray[np.float64]`):
            Where the arm is, in rad, (6,).
        config (`UR5eRobotiqConfig`):
            Control period, lead and command limit.
    """

    def __init__(self, joints: NDArray[np.float64], config: UR5eRobotiqConfig):
        self._period, self._lead, self._limit = config.control_period, config.servo_lead, config.command_limit
        self._position = self._begin = self._end = joints
        self._began = -math.inf

    @property
    def position(self) -> NDArray[np.float64]:
        """`NDArray[np.float64]`: where on the line the arm is to be by now, in rad, (6,)."""
        return self._position

    def aim(self, target: NDArray[np.float64], measured: NDArray[np.float64], now: float) -> None:
        """Begins a new line where the last one has got to.

        Args:
            target (`NDArray[np.float64]`):
                Where it ends, in rad, (6,).
            measured (`NDArray[np.float64]`):
                Where the arm is, in rad, (6,).
            now (`float`):
                Time in s, not before that of the last call.
        """
        self._go_on(measured, now)
        self._begin, self._end, self._began = self._position, target, now

    def set_point(self, measured: NDArray[np.float64], now: float) -> NDArray[np.float64]:
        """What to send.

        Args:
            measured (`NDArray[np.float64]`):
                Where the arm is, in rad, (6,).
            now (`float`):
                Time in s, not before that of the last call.

        Returns:
            `NDArray[np.float64]`: joint angles in rad, (6,), at most `command_limit` from the measured ones.
        """
        periods = self._go_on(measured, now)
        lead = self._lead / self._period * min(max((1.0 + FADE - periods) / FADE, 0.0), 1.0)
        return self._within(measured, self._position + lead * (self._end - self._begin))

    def _go_on(self, measured: NDArray[np.float64], now: float) -> float:
        periods = (now - self._began) / self._period
        self._position = self._within(measured, self._begin + (self._end - self._begin) * min(periods, 1.0))
        return periods

    def _within(self, measured: NDArray[np.float64], joints: NDArray[np.float64]) -> NDArray[np.float64]:
        # A blocked arm must not be leant against harder than agreed, however far it is pushed back between targets.
        return np.clip(joints, measured - self._limit, measured + self._limit)
