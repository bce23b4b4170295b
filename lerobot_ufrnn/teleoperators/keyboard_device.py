"""A keyboard as an input device: which key means what."""

import logging

import numpy as np

from .device import CLOSE, OPEN, DeviceState, TwistDevice
from .key_sources import KeySource

logger = logging.getLogger(__name__)

AXES = {
    "w": (0, 1.0),
    "s": (0, -1.0),
    "a": (1, 1.0),
    "d": (1, -1.0),
    "e": (2, 1.0),
    "c": (2, -1.0),
    "o": (3, 1.0),
    "u": (3, -1.0),
    "i": (4, 1.0),
    "k": (4, -1.0),
    "j": (5, 1.0),
    "l": (5, -1.0),
}
"""Axis of the twist and direction of each key. None of them is one that LeRobot's recording listens to: n, r, q,
the arrows and Escape."""

GRIPPER = {"g": CLOSE, "h": OPEN}

HELP = (
    "w/s ahead/back, a/d left/right, e/c up/down; u/o roll left/right, i/k tip over/up, j/l turn left/right; "
    "g/h close/open the gripper"
)


class KeyboardDevice(TwistDevice):
    """Keys that are held move the tool, each at full deflection.

    Args:
        keys (`KeySource`):
            Tells which keys are held.
    """

    def __init__(self, keys: KeySource):
        self._keys = keys

    def open(self) -> None:
        """Starts listening.

        Raises:
            DeviceUnavailableError: If keys cannot be read here.
        """
        self._keys.open(frozenset(AXES) | frozenset(GRIPPER))
        logger.info(f"Keys: {HELP}. {self._keys.instruction}")

    def read(self) -> DeviceState:
        """What the held keys amount to; opposite keys cancel out.

        Raises:
            DeviceLostError: If nobody listens to the keyboard any more.
        """
        held = self._keys.held()
        twist = np.zeros(6)
        for key in held & set(AXES):
            axis, direction = AXES[key]
            twist[axis] += direction
        buttons = {GRIPPER[key] for key in held & set(GRIPPER)}
        return DeviceState(twist, frozenset(buttons))

    def close(self) -> None:
        """Stops listening."""
        self._keys.close()
