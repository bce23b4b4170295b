"""What every input device looks like to the teleoperator, and a file of events that is played in place of one.

The file, for a rehearsal or a test, holds one JSON object a line, such as `EXAMPLE`: seconds since the first read,
deflections in -1 to 1, held buttons. A state lasts until the next one; after the last one the device is at rest.
"""

import bisect
import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.errors import DeviceNotConnectedError
from numpy.typing import NDArray

BUTTONS = OPEN, CLOSE = "open", "close"  # the gripper opens or closes while they are held
EXAMPLE = '{"time": 1.25, "twist": [0, 0, 0.5, 0, 0, 0], "buttons": ["close"]}'


class DeviceUnavailableError(ConnectionError):
    """The input device cannot be opened: a library, a permission or the device itself is missing."""


class DeviceLostError(DeviceNotConnectedError):
    """The input device was there and is gone."""


@dataclass(frozen=True)
class DeviceState:
    """What the operator wants at one moment; at rest unless given."""

    twist: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))
    """Deflections in -1 to 1, (6,): ahead, left and up, then about those axes by the right-hand rule (the body
    convention of ROS)."""
    buttons: frozenset[str] = frozenset()
    """Those of `BUTTONS` that are held."""

    def fault(self) -> str | None:
        """What is wrong with the state, if anything, so that nothing may be done with it."""
        if np.shape(self.twist) != (6,):
            return f"the device gave a twist of shape {np.shape(self.twist)} instead of (6,)"
        if not np.isfinite(self.twist).all():
            return f"the device gave the twist {np.asarray(self.twist).tolist()}, which is not finite"
        if unknown := set(self.buttons) - set(BUTTONS):
            return f"the device gave the buttons {sorted(unknown)}; only {', '.join(BUTTONS)} are known"
        return None


class TwistDevice(ABC):
    """An input device with six axes and gripper buttons."""

    @abstractmethod
    def open(self) -> None:
        """Gets ready to be read; a `DeviceUnavailableError` says what is missing."""

    @abstractmethod
    def read(self) -> DeviceState:
        """What the operator wants now, at once; at rest where the device has not been heard of lately.

        Raises a `DeviceLostError` if the device is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Lets go of the device. Safe to call at any time."""


class EventStreamDevice(TwistDevice):
    """Plays a file of events; its time starts at the first read."""

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic):
        self._path = path
        self._clock = clock

    def open(self) -> None:
        """Reads the whole file, and says in which line there is something else."""
        try:
            lines = self._path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise DeviceUnavailableError(f"The events in {self._path} cannot be read: {error}.") from error
        self._times: list[float] = []
        self._states: list[DeviceState] = []
        self._start: float | None = None
        for number, line in enumerate(lines, start=1):
            if not line.strip():
                continue
            try:
                moment, state = _parse(line)
                if self._times and moment < self._times[-1]:
                    raise ValueError(f"its time {moment} lies before {self._times[-1]}, the time of the one above")
            except (ValueError, TypeError) as error:
                raise DeviceUnavailableError(
                    f"Line {number} of {self._path} is no event: {error}. An event looks like {EXAMPLE}."
                ) from error
            self._times.append(moment)
            self._states.append(state)
        if not self._times:
            raise DeviceUnavailableError(f"{self._path} holds no events; each line is one, such as {EXAMPLE}.")

    def read(self) -> DeviceState:
        """The state that the file has for this moment."""
        now = self._clock()
        if self._start is None:
            self._start = now
        index = bisect.bisect_right(self._times, now - self._start) - 1
        return self._states[index] if 0 <= index < len(self._states) - 1 else DeviceState()

    def close(self) -> None:
        """Nothing is held open."""


def _parse(line: str) -> tuple[float, DeviceState]:
    event: Any = json.loads(line)
    if not isinstance(event, dict) or not {"time", "twist"} <= set(event) <= {"time", "twist", "buttons"}:
        raise ValueError("it must be an object with `time`, `twist` and perhaps `buttons`")
    moment = float(event["time"])
    if not (math.isfinite(moment) and moment >= 0):
        raise ValueError(f"its time must be finite and not negative, got {moment}")
    buttons = event.get("buttons", [])
    if not isinstance(buttons, list) or not all(isinstance(button, str) for button in buttons):
        raise ValueError(f"its buttons must be a list of names, got {buttons!r}")
    state = DeviceState(np.array(event["twist"], dtype=np.float64), frozenset(buttons))
    if (fault := state.fault()) is not None:
        raise ValueError(fault)
    return moment, state
