"""Events that are played instead of reading a device, for a rehearsal or a test.

A file holds one JSON object a line, such as `EXAMPLE`: seconds since the first read, deflections in -1 to 1, held
buttons. A state lasts until the next one; after the last one the device is at rest.
"""

import bisect
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .device import DeviceState, DeviceUnavailableError, TwistDevice

EXAMPLE = '{"time": 1.25, "twist": [0, 0, 0.5, 0, 0, 0], "buttons": ["close"]}'


class EventStreamDevice(TwistDevice):
    """Plays a file of events; its time starts at the first read."""

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic):
        self._path = path
        self._clock = clock
        self._times: list[float] = []
        self._states: list[DeviceState] = []
        self._start: float | None = None

    def open(self) -> None:
        """Reads the whole file, and says in which line there is something else."""
        try:
            lines = self._path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise DeviceUnavailableError(f"The events in {self._path} cannot be read: {error}.") from error
        self._times, self._states, self._start = [], [], None
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
