"""A 3Dconnexion SpaceMouse through `pyspacemouse`."""

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from .configuration import SpaceMouseTwistConfig
from .device import CLOSE, OPEN, DeviceLostError, DeviceState, DeviceUnavailableError, TwistDevice

POLL_SECONDS = 0.002  # between two looks for a report; a deflected cap sends two every 8 ms
JOIN_SECONDS = 1.0  # that the thread may take to end

PERMISSIONS = (
    'a rule such as KERNEL=="hidraw*", ATTRS{idVendor}=="256f", MODE="0660", TAG+="uaccess" in '
    "/etc/udev/rules.d/99-spacemouse.rules (older devices: idVendor 046d), then "
    "`sudo udevadm control --reload-rules` and plug it in again"
)


class SpaceMouseDevice(TwistDevice):
    """Push and twist of the cap are the twist; the left button closes the gripper, the right one opens it.

    On a model with more buttons these are the first two in `pyspacemouse`'s list (Menu and Alt on a Pro).

    A thread reads all reports as they come: the kernel keeps only 64 and then drops the newest, so that after a pause
    a reader would take an old deflection for the present one.
    """

    def __init__(self, config: SpaceMouseTwistConfig, clock: Callable[[], float] = time.monotonic):
        self._config = config
        self._clock = clock
        self._mouse: Any = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    def open(self) -> None:
        """Opens the first SpaceMouse."""
        try:
            import pyspacemouse

            self._mouse = pyspacemouse.open(axis_convention=pyspacemouse.AxisConvention.ROS)
        except Exception as error:
            raise DeviceUnavailableError(_explain(error)) from error
        self._latest, self._heard = DeviceState(), -np.inf
        self._loss: Exception | None = None
        self._stop.clear()
        self._thread = threading.Thread(target=self._follow, name="spacemouse", daemon=True)
        self._thread.start()

    def read(self) -> DeviceState:
        """The cap and the buttons now."""
        if self._loss is not None:
            raise DeviceLostError(
                f"The SpaceMouse is gone ({self._loss}): plug it in (or charge it) and start the command again."
            ) from self._loss
        state = self._latest
        if self._clock() - self._heard > self._config.stale_after:
            # Buttons are reported only when they change, so their silence means nothing.
            return DeviceState(buttons=state.buttons)
        return state

    def close(self) -> None:
        """Ends the thread and closes the mouse."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(JOIN_SECONDS)
            self._thread = None
        if self._mouse is not None:
            with contextlib.suppress(Exception):
                self._mouse.close()
            self._mouse = None

    def _follow(self) -> None:
        before = -1.0  # what it says before the first report
        while not self._stop.is_set():
            try:
                report = self._mouse.read()
            except Exception as error:
                self._loss = error
                return
            if report.t == before:  # nothing came
                self._stop.wait(POLL_SECONDS)
                continue
            before = report.t
            self._latest = self._translate(report)
            self._heard = self._clock()

    def _translate(self, report: Any) -> DeviceState:
        raw = np.array([report.x, report.y, report.z, report.roll, report.pitch, report.yaw], dtype=np.float64)
        deadzone = self._config.deadzone
        twist = np.sign(raw) * np.clip((np.abs(raw) - deadzone) / (1.0 - deadzone), 0.0, 1.0)
        held = (name for name, is_held in zip((CLOSE, OPEN), report.buttons, strict=False) if is_held == 1)
        return DeviceState(twist, frozenset(held))


def _explain(error: Exception) -> str:
    if isinstance(error, ImportError):
        return (
            f"--teleop.type=spacemouse_twist needs pyspacemouse, which cannot be imported ({error}): "
            "`pip install 'lerobot_policy_ufrnn[spacemouse]'`. --teleop.type=keyboard_twist works without it."
        )
    if "Failed to open" in str(error):
        return f"The SpaceMouse may not be opened by this user ({error}): add {PERMISSIONS}."
    if "HID API" in str(error) or isinstance(error, OSError):  # which pyspacemouse raises where it loads the library
        return (
            f"pyspacemouse does not find the library hidapi ({error}): `sudo apt install libhidapi-hidraw0` on Debian "
            "and Ubuntu, `brew install hidapi` on macOS."
        )
    return (
        f"No SpaceMouse can be opened ({error}): plug one in, quit 3Dconnexion's own driver, and if it is not listed "
        f"by `pyspacemouse --list-connected` although it is there, add {PERMISSIONS}."
    )
