"""Recorded events: what an operator did, played again for a rehearsal or a test.

A file holds one JSON object a line, `{"time": 1.25, "twist": [0, 0, 0.5, 0, 0, 0], "buttons": ["close"]}`: seconds
since the first read, deflections in -1 to 1, held buttons. A state lasts until the next one; after the last one the
device is at rest.
"""

import bisect
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from .device import DeviceState, TwistDevice
from .errors import DeviceUnavailableError


class EventStreamDevice(TwistDevice):
    """Plays a file of events; its time starts at the first read.

    Args:
        path (`Path`):
            The file.
        clock (`Callable[[], float]`, *optional*, defaults to `time.monotonic`):
            Time in seconds.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic):
        self._path = Path(path)
        self._clock = clock
        self._times: list[float] = []
        self._states: list[DeviceState] = []
        self._start: float | None = None

    def open(self) -> None:
        """Reads the whole file.

        Raises:
            DeviceUnavailableError: If it cannot be read or holds something else; says in which line.
        """
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
                    f"Line {number} of {self._path} is no event: {error}. An event looks like "
                    '{"time": 1.25, "twist": [0, 0, 0.5, 0, 0, 0], "buttons": ["close"]}.'
                ) from error
            self._times.append(moment)
            self._states.append(state)
        if not self._times:
            raise DeviceUnavailableError(f"{self._path} holds no events; record some with --teleop.record_events=FILE.")

    def read(self) -> DeviceState:
        """The state that the file has for this moment."""
        now = self._clock()
        if self._start is None:
            self._start = now
        index = bisect.bisect_right(self._times, now - self._start) - 1
        return self._states[index] if 0 <= index < len(self._states) - 1 else DeviceState()

    def close(self) -> None:
        """Nothing is held open."""


class EventRecorder(TwistDevice):
    """Another device whose states are written to a file as they change.

    Args:
        device (`TwistDevice`):
            The device.
        path (`Path`):
            The file; must not exist yet.
        clock (`Callable[[], float]`, *optional*, defaults to `time.monotonic`):
            Time in seconds.
    """

    def __init__(self, device: TwistDevice, path: Path, clock: Callable[[], float] = time.monotonic):
        self._device = device
        self._path = Path(path)
        self._clock = clock
        self._file: TextIO | None = None
        self._start: float | None = None
        self._last: str | None = None

    def open(self) -> None:
        """Opens the device, then the file.

        Raises:
            DeviceUnavailableError: If either cannot be opened.
        """
        self._device.open()
        try:
            self._file = self._path.open("x", encoding="utf-8")
        except OSError as error:
            self._device.close()
            raise DeviceUnavailableError(
                f"Events cannot be recorded to {self._path}: {error}. Name a new file in a folder that exists."
            ) from error

    def read(self) -> DeviceState:
        """The device's state, written down if it differs from the one before."""
        state = self._device.read()
        if state.fault() is None:
            self._write(state)
        return state

    def close(self) -> None:
        """Writes the end and closes both."""
        try:
            if self._file is not None:
                if self._start is not None:
                    self._last = None  # the end is written even if the device has been at rest
                    self._write(DeviceState())
                self._file.close()
                self._file = None
        finally:
            self._device.close()

    def _write(self, state: DeviceState) -> None:
        now = self._clock()
        if self._start is None:
            self._start = now
        twist = [round(float(value), 6) for value in state.twist]
        text = f'"twist": {json.dumps(twist)}, "buttons": {json.dumps(sorted(state.buttons))}'
        if self._file is not None and text != self._last:
            # Rounded down: played again, the state is there at that moment, not just after it.
            moment = math.floor(1000 * (now - self._start)) / 1000
            self._file.write(f'{{"time": {moment}, {text}}}\n')
            self._file.flush()
            self._last = text


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
