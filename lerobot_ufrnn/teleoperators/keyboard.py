"""A keyboard as an input device: which keys are held, and what they mean."""

import logging
from typing import Any

import numpy as np
from lerobot.utils.import_utils import _pynput_available
from lerobot.utils.keyboard_input import pynput_can_capture, pynput_listener_is_trusted

from .device import CLOSE, OPEN, DeviceLostError, DeviceState, DeviceUnavailableError, TwistDevice

logger = logging.getLogger(__name__)

# Axis of the twist and direction of each key; none is one that LeRobot's recording listens to (n, r, q, ...).
AXES = {
    key: (axis, direction)
    for axis, pair in enumerate(("ws", "ad", "ec", "ou", "ik", "jl"))
    for key, direction in zip(pair, (1.0, -1.0), strict=True)
}
GRIPPER = {"g": CLOSE, "h": OPEN}
SHIFTS = {"shift", "shift_l", "shift_r"}

HELP = (
    "w/s ahead/back, a/d left/right, e/c up/down; u/o roll left/right, i/k tip over/up, j/l turn left/right; "
    "g/h close/open the gripper. Hold Shift with them: without it no key moves the arm, whichever window it is typed "
    "into."
)


class KeyboardDevice(TwistDevice):
    """Keys that are held move the tool, each at full deflection.

    `pynput` asks the desktop, which also tells when a key is let go; a terminal never does, so that an arm led from one
    would go on for a while by itself. The desktop tells of keys typed into any window: so that writing a message does
    not move the arm, keys count only while Shift is held with them.
    """

    def __init__(self) -> None:
        self._listener: Any = None
        self._held: set[str] = set()

    def open(self) -> None:
        """Starts listening."""
        if not _pynput_available:
            raise DeviceUnavailableError(
                "--teleop.type=keyboard_twist needs pynput: `pip install 'lerobot_policy_ufrnn[keyboard]'`."
            )
        if not pynput_can_capture():
            raise DeviceUnavailableError(
                "pynput cannot read the keyboard here, and a terminal does not tell when a key is let go: log in at "
                "the computer (not over SSH) to an X11 session (not Wayland), Windows or macOS, use another device "
                "(--teleop.type=spacemouse_twist), or play events with --teleop.device=FILE."
            )
        from pynput import keyboard

        self._held.clear()
        self._listener = keyboard.Listener(
            on_press=lambda key: self._held.add(_name(key)), on_release=lambda key: self._held.discard(_name(key))
        )
        self._listener.start()
        if not pynput_listener_is_trusted(self._listener):
            self.close()
            raise DeviceUnavailableError(
                "macOS does not let this program read the keyboard: allow the terminal under System Settings, "
                "Privacy & Security, Accessibility and Input Monitoring, then start it again."
            )
        logger.info(f"Keys: {HELP}")

    def read(self) -> DeviceState:
        """What the held keys amount to; opposite keys cancel out."""
        if self._listener is None or not self._listener.is_alive():
            raise DeviceLostError("pynput stopped listening to the keyboard: start the command again.")
        held = self._held.copy()
        if not held & SHIFTS:
            return DeviceState()
        twist = np.zeros(6)
        for key in held & set(AXES):
            axis, direction = AXES[key]
            twist[axis] += direction
        return DeviceState(twist, frozenset(GRIPPER[key] for key in held & set(GRIPPER)))

    def close(self) -> None:
        """Stops listening."""
        if self._listener is not None:
            self._listener.stop()
            self._listener = None


def _name(key: Any) -> str:
    """What a key of pynput is called: its character, or "shift_r" and the like."""
    return (getattr(key, "char", None) or getattr(key, "name", None) or "").lower()
