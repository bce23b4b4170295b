"""Which keys are held: asked of the desktop, or of the terminal where there is no desktop."""

from abc import ABC, abstractmethod
from typing import Any

from lerobot.utils.keyboard_input import pynput_can_capture

from .errors import DeviceLostError, DeviceUnavailableError

SHIFTS = ("shift", "shift_l", "shift_r")


class KeySource(ABC):
    """Tells which keys are held."""

    instruction: str = ""
    """What the operator has to know beyond the keys."""

    @abstractmethod
    def open(self, keys: frozenset[str]) -> None:
        """Starts listening.

        Args:
            keys (`frozenset[str]`):
                Lower-case characters of interest; all others are left to whoever else listens.

        Raises:
            DeviceUnavailableError: If keys cannot be read here.
        """

    @abstractmethod
    def held(self) -> frozenset[str]:
        """The keys of interest that are held now.

        Raises:
            DeviceLostError: If nobody listens any more.
        """

    @abstractmethod
    def close(self) -> None:
        """Stops listening. Safe to call at any time."""


class PynputKeys(KeySource):
    """Keys from the desktop, which also tells when they are let go.

    It tells of keys typed into any window. So that writing a message does not move the arm, keys count only while
    Shift is held with them.
    """

    instruction = "Hold Shift with them: without it no key moves the arm, whichever window it is typed into."

    def __init__(self) -> None:
        self._listener: Any = None
        self._keys: frozenset[str] = frozenset()
        self._held: set[str] = set()
        self._shifts: set[str] = set()

    def open(self, keys: frozenset[str]) -> None:
        """Starts pynput's listener."""
        if not pynput_can_capture():
            raise DeviceUnavailableError(
                "pynput cannot read the keyboard here: it needs to be installed (`pip install pynput`) and an X11, "
                "Windows or macOS desktop, not Wayland or SSH. Use --teleop.keys=terminal."
            )
        from pynput import keyboard

        self._keys, self._held, self._shifts = keys, set(), set()
        self._listener = keyboard.Listener(on_press=self._press, on_release=self._release)
        self._listener.start()

    def held(self) -> frozenset[str]:
        """The keys that are down, if Shift is."""
        if self._listener is None or not self._listener.is_alive():
            raise DeviceLostError("pynput stopped listening to the keyboard: start the command again.")
        return frozenset(self._held.copy() & self._keys) if self._shifts else frozenset()

    def close(self) -> None:
        """Stops pynput's listener."""
        if self._listener is not None:
            self._listener.stop()
            self._listener = None

    def _press(self, key: Any) -> None:
        if (name := getattr(key, "name", None)) in SHIFTS:
            self._shifts.add(str(name))
        elif character := getattr(key, "char", None):
            self._held.add(character.lower())

    def _release(self, key: Any) -> None:
        if (name := getattr(key, "name", None)) in SHIFTS:
            self._shifts.discard(str(name))
        elif character := getattr(key, "char", None):
            self._held.discard(character.lower())


def make_key_source(kind: str, key_hold: float) -> KeySource:
    """The source of keys that was asked for.

    Args:
        kind (`str`):
            `"pynput"`, `"terminal"`, or `"auto"` for pynput where it works, else the terminal.
        key_hold (`float`):
            Seconds for which a key counts as held after the terminal has reported it.

    Returns:
        `KeySource`: not opened yet.
    """
    from .terminal_keys import TerminalKeys

    if kind == "auto":
        kind = "pynput" if pynput_can_capture() else "terminal"
    return PynputKeys() if kind == "pynput" else TerminalKeys(key_hold)
