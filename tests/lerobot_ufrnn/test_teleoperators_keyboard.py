import os
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.utils import keyboard_input
from teleoperators_fakes import Clock
from waiting import wait_until

from lerobot_ufrnn.teleoperators import DeviceLostError, DeviceUnavailableError, key_sources
from lerobot_ufrnn.teleoperators.key_sources import KeySource, PynputKeys, make_key_source
from lerobot_ufrnn.teleoperators.keyboard_device import AXES, GRIPPER, KeyboardDevice
from lerobot_ufrnn.teleoperators.terminal_keys import TerminalKeys


class TypedKeys(KeySource):
    def __init__(self, *keys):
        self.keys = frozenset(keys)

    def open(self, keys):
        pass

    def held(self):
        return self.keys

    def close(self):
        pass


@pytest.mark.parametrize(
    ("keys", "twist"),
    [
        ("", [0, 0, 0, 0, 0, 0]),
        ("w", [1, 0, 0, 0, 0, 0]),
        ("sd", [-1, -1, 0, 0, 0, 0]),
        ("ws", [0, 0, 0, 0, 0, 0]),
        ("ae", [0, 1, 1, 0, 0, 0]),
        ("okj", [0, 0, 0, 1, -1, 1]),
        ("cuil", [0, 0, -1, -1, 1, -1]),
    ],
)
def test_keys_are_axes_in_the_body_convention_of_ros(keys, twist):
    np.testing.assert_array_equal(KeyboardDevice(TypedKeys(*keys)).read().twist, twist)


def test_gripper_keys_are_buttons():
    assert KeyboardDevice(TypedKeys("g")).read().buttons == {"close"}
    assert KeyboardDevice(TypedKeys("g", "h")).read().buttons == {"open", "close"}


def test_no_key_is_one_of_the_keys_of_lerobots_recording():
    for key in (*AXES, *GRIPPER):
        events = dict.fromkeys(("exit_early", "rerecord_episode", "stop_recording"), False)
        recorded = []

        def apply(control, _, recorded=recorded):
            recorded.append(control)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(keyboard_input, "apply_recording_control", apply)
            patch.setattr(keyboard_input, "create_key_listener", lambda dispatch, **_: dispatch(key))  # noqa: B023
            keyboard_input.init_keyboard_listener()
        assert not recorded
        assert not any(events.values())


@pytest.fixture
def terminal(monkeypatch):
    """A terminal as `sys.stdin`, and the end at which somebody types."""
    master, slave = os.openpty()
    with os.fdopen(slave, "r") as stdin, monkeypatch.context() as patch:
        patch.setattr(sys, "stdin", stdin)
        terminal = SimpleNamespace(stdin=stdin, master=master, type=lambda text: os.write(master, text.encode()))
        yield terminal
    if terminal.master >= 0:
        os.close(master)


def test_a_key_of_the_terminal_is_held_for_a_moment(terminal):
    clock = Clock()
    keys = TerminalKeys(0.15, clock)
    keys.open(frozenset("wa"))
    try:
        assert keys.held() == set()
        terminal.type("w")
        wait_until(lambda: keys.held() == {"w"})
        clock.now += 0.1
        terminal.type("a")
        wait_until(lambda: keys.held() == {"w", "a"})
        clock.now += 0.1
        assert keys.held() == {"a"}
        clock.now += 0.1
        assert keys.held() == set()
    finally:
        keys.close()


def test_lerobots_own_listener_gets_all_other_keys_of_the_same_terminal(terminal, monkeypatch):
    monkeypatch.setattr(keyboard_input, "pynput_can_capture", lambda: False)
    keys = TerminalKeys(60.0)
    keys.open(frozenset("wa"))
    listener, events = keyboard_input.init_keyboard_listener()
    try:
        assert listener is not None
        terminal.type("w")
        terminal.type("\x1b[C")  # the right arrow
        wait_until(lambda: events["exit_early"])
        assert not events["rerecord_episode"]
        terminal.type("aan")
        wait_until(lambda: keys.held() == {"w", "a"})
        events["exit_early"] = False
        terminal.type("\x1bOD")  # the left arrow of some terminals
        wait_until(lambda: events["rerecord_episode"])
        terminal.type("q")
        wait_until(lambda: events["stop_recording"])
    finally:
        listener.stop()
        keys.close()


def test_escape_sequences_are_no_letters(terminal):
    keys = TerminalKeys(60.0)
    keys.open(frozenset("waAC"))
    try:
        terminal.type("\x1bOw")  # a key of the number block
        time.sleep(0.05)
        terminal.type("a")
        wait_until(lambda: keys.held() == {"a"})
    finally:
        keys.close()


def test_the_terminal_is_given_back_as_it_was_and_a_full_queue_blocks_nothing(terminal):
    import termios

    before = termios.tcgetattr(terminal.stdin.fileno())
    keys = TerminalKeys(60.0)
    keys.open(frozenset("w"))
    assert sys.stdin is not terminal.stdin
    for _ in range(20):
        terminal.type("x" * 1000)  # nobody reads what is passed on
    terminal.type("w")
    wait_until(lambda: keys.held() == {"w"})
    keys.close()
    keys.close()
    assert sys.stdin is terminal.stdin
    assert termios.tcgetattr(terminal.stdin.fileno()) == before


def test_a_terminal_that_hangs_up_is_told(terminal):
    keys = TerminalKeys(60.0)
    keys.open(frozenset("w"))
    try:
        os.close(terminal.master)
        terminal.master = -1
        with pytest.raises(DeviceLostError, match="terminal is gone"):  # noqa: PT012 (it takes a moment)
            for _ in range(500):
                keys.held()
                time.sleep(0.01)
    finally:
        keys.close()


def test_without_a_terminal_it_says_what_to_do(monkeypatch):
    with open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        with pytest.raises(DeviceUnavailableError, match=r"--teleop\.device=FILE"):
            TerminalKeys().open(frozenset("w"))


class FakeListener:
    def __init__(self, on_press, on_release):
        self.press, self.release = on_press, on_release
        self.alive = False

    def start(self):
        self.alive = True

    def stop(self):
        self.alive = False

    def is_alive(self):
        return self.alive


@pytest.fixture
def desktop(monkeypatch):
    """A desktop with pynput, and its listener."""
    listeners = []

    def listen(on_press, on_release):
        listeners.append(FakeListener(on_press, on_release))
        return listeners[-1]

    keyboard = SimpleNamespace(Listener=listen)
    monkeypatch.setitem(sys.modules, "pynput", SimpleNamespace(keyboard=keyboard))
    monkeypatch.setattr(key_sources, "pynput_can_capture", lambda: True)
    return listeners


def char(letter):
    return SimpleNamespace(char=letter)


def test_keys_of_the_desktop_count_only_with_shift(desktop):
    keys = PynputKeys()
    keys.open(frozenset("wa"))
    (listener,) = desktop
    listener.press(char("w"))
    assert keys.held() == set()
    listener.press(SimpleNamespace(name="shift_r"))
    listener.press(char("A"))  # as Shift makes it
    listener.press(char("x"))
    assert keys.held() == {"w", "a"}
    listener.release(char("W"))
    assert keys.held() == {"a"}
    listener.release(SimpleNamespace(name="shift_r"))
    assert keys.held() == set()
    listener.press(SimpleNamespace(name="esc"))
    listener.stop()
    with pytest.raises(DeviceLostError, match="pynput stopped"):
        keys.held()
    keys.close()


def test_the_source_of_keys_is_chosen_by_what_works_here(desktop, monkeypatch):
    assert isinstance(make_key_source("auto", 0.1), PynputKeys)
    assert isinstance(make_key_source("terminal", 0.1), TerminalKeys)
    monkeypatch.setattr(key_sources, "pynput_can_capture", lambda: False)
    assert isinstance(make_key_source("auto", 0.1), TerminalKeys)
    with pytest.raises(DeviceUnavailableError, match=r"--teleop\.keys=terminal"):
        make_key_source("pynput", 0.1).open(frozenset("w"))
