"""Being told to end while the arm is in use."""

import logging
import signal
import threading
from types import FrameType
from typing import Any

logger = logging.getLogger(__name__)

NAMES = ("SIGTERM", "SIGHUP")
"""`kill`, the end of a service, a terminal or connection that is closed. Not all systems have both."""


class OrderlyEnd:
    """Lets a program that is told to end do so in order: as with Ctrl-C, what it has to close is closed.

    Python ends at once on these signals. The arm is stopped in any case, but `lerobot-record` would lose every episode
    of its session: LeRobot writes the ends of the files, without which they cannot be read, when the recording ends.
    A program that deals with a signal by itself, or ignores it as under `nohup`, goes on doing so.
    """

    def __init__(self) -> None:
        self._taken: list[int] = []

    def begin(self) -> None:
        """From now on these signals raise `SystemExit`. Only the main thread may do this; in others nothing happens."""
        if threading.current_thread() is not threading.main_thread():
            return
        for name in NAMES:
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) == signal.SIG_DFL:
                signal.signal(number, self._end)
                self._taken.append(number)

    def end(self) -> None:
        """Restores what was before. Safe to call at any time."""
        if threading.current_thread() is not threading.main_thread():
            return
        while self._taken:
            number = self._taken.pop()
            # Somebody else may have taken the signal over meanwhile.
            if signal.getsignal(number) in (self._end, signal.SIG_IGN):
                signal.signal(number, signal.SIG_DFL)

    def _end(self, number: int, frame: FrameType | None) -> Any:
        for taken in self._taken:
            # Asked for once more, the program would be torn from what it closes.
            signal.signal(taken, signal.SIG_IGN)
        logger.warning("Ending, as asked for by %s: what is open is closed first.", signal.Signals(number).name)
        raise SystemExit(128 + number)
