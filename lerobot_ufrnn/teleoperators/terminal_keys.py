"""Keys from the terminal, shared with LeRobot's own listener."""

import atexit
import contextlib
import os
import select
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from .errors import DeviceLostError, DeviceUnavailableError
from .key_sources import KeySource

POLL_SECONDS = 0.05
JOIN_SECONDS = 1.0
ESCAPE = b"\x1b"


class TerminalKeys(KeySource):
    """Keys as a terminal reports them: it tells when one is pressed or repeats, never when it is let go.

    So a key counts as held for a moment after each report. A tap moves the tool for that moment; a held key moves it
    evenly once the keyboard repeats it; when it is let go, or the connection to the terminal breaks, the tool stops
    after that moment.

    `lerobot-record` listens to the same terminal for its own keys (n, r, q, arrows, Escape). Two readers of one
    terminal would each get some of the keys. Therefore this one reads alone, and puts a pseudo-terminal in the
    place of `sys.stdin` through which it passes on all keys that it does not use itself.

    Args:
        key_hold (`float`, *optional*, defaults to `0.15`):
            Seconds for which a key counts as held after it was reported.
        clock (`Callable[[], float]`, *optional*, defaults to `time.monotonic`):
            Time in seconds.
    """

    instruction = "Keep this terminal focused and hold a key until it repeats; Caps Lock must be off."

    def __init__(self, key_hold: float = 0.15, clock: Callable[[], float] = time.monotonic):
        self._key_hold = key_hold
        self._clock = clock
        self._keys: frozenset[str] = frozenset()
        self._reported: dict[str, float] = {}
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._stdin: Any = None
        self._attributes: Any = None
        self._passed_on: tuple[int, Any] | None = None
        self._hung_up = False

    def open(self, keys: frozenset[str]) -> None:
        """Takes over the terminal.

        Raises:
            DeviceUnavailableError: If standard input is no terminal.
        """
        try:
            import termios
            import tty
        except ImportError as error:
            raise DeviceUnavailableError("Windows has no such terminals; use --teleop.keys=pynput.") from error
        if not sys.stdin.isatty():
            raise DeviceUnavailableError(
                "Standard input is no terminal, so no keys can be read from it: start the command in a terminal "
                "(`ssh -t`, `docker run -it`), without a pipe, or play events with --teleop.device=FILE."
            )
        self._keys, self._reported, self._hung_up = keys, {}, False
        self._stdin = sys.stdin
        terminal = self._stdin.fileno()
        self._attributes = termios.tcgetattr(terminal)
        tty.setcbreak(terminal)  # keys at once and without echo; Ctrl-C goes on working
        master, slave = os.openpty()
        tty.setraw(slave)  # or it would echo into the master, which nobody empties
        os.set_blocking(master, False)
        self._passed_on = (master, os.fdopen(slave, "r"))
        sys.stdin = self._passed_on[1]
        atexit.register(self.close)
        self._stop.clear()
        self._thread = threading.Thread(target=self._follow, args=(terminal, master), name="keys", daemon=True)
        self._thread.start()

    def held(self) -> frozenset[str]:
        """The keys that were reported a moment ago."""
        if self._hung_up:
            raise DeviceLostError("The terminal is gone, and its keyboard with it: start the command again.")
        now = self._clock()
        return frozenset(key for key, moment in self._reported.copy().items() if now - moment <= self._key_hold)

    def close(self) -> None:
        """Gives the terminal back as it was."""
        atexit.unregister(self.close)
        self._stop.set()
        if self._thread is not None:
            self._thread.join(JOIN_SECONDS)
            self._thread = None
        if self._passed_on is not None:
            master, slave = self._passed_on
            if sys.stdin is slave:
                sys.stdin = self._stdin
            with contextlib.suppress(OSError):
                slave.close()
            os.close(master)
            self._passed_on = None
        if self._attributes is not None:
            import termios

            with contextlib.suppress(termios.error, OSError, ValueError):  # the terminal may be gone
                termios.tcsetattr(self._stdin.fileno(), termios.TCSADRAIN, self._attributes)
            self._attributes = None

    def _follow(self, terminal: int, master: int) -> None:
        while not self._stop.is_set():
            try:
                if not select.select([terminal], [], [], POLL_SECONDS)[0]:
                    continue
                data = os.read(terminal, 1024)
            except OSError:
                data = b""
            if not data:
                self._hung_up = True
                return
            self._receive(data, master)

    def _receive(self, data: bytes, master: int) -> None:
        # The keys of an escape sequence come in one piece and are not letters that somebody typed.
        typed, escape, sequence = data.partition(ESCAPE)
        others = bytearray()
        for byte in typed:
            if chr(byte) in self._keys:
                self._reported[chr(byte)] = self._clock()
            else:
                others.append(byte)
        if others or escape:
            with contextlib.suppress(OSError):  # full, as nobody listens
                os.write(master, bytes(others) + escape + sequence)
