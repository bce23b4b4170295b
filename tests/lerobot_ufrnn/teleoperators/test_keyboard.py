import sys
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.utils import keyboard_input

from lerobot_ufrnn.teleoperators import keyboard
from lerobot_ufrnn.teleoperators.device import DeviceLostError, DeviceUnavailableError
from lerobot_ufrnn.teleoperators.keyboard import AXES, GRIPPER, KeyboardDevice

SHIFT = SimpleNamespace(name="shift_r")


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
    """A desktop with pynput; tests change what it allows."""
    desktop = SimpleNamespace(captures=True, trusted=True)
    monkeypatch.setitem(sys.modules, "pynput", SimpleNamespace(keyboard=SimpleNamespace(Listener=FakeListener)))
    monkeypatch.setattr(keyboard, "pynput_can_capture", lambda: desktop.captures)
    monkeypatch.setattr(keyboard, "pynput_listener_is_trusted", lambda _: desktop.trusted)
    return desktop


@pytest.fixture
def device(desktop):
    device = KeyboardDevice()
    device.open()
    yield device
    device.close()
    device.close()


def char(letter):
    return SimpleNamespace(char=letter)


@pytest.mark.parametrize(
    ("keys", "twist", "buttons"),
    [
        ("", [0, 0, 0, 0, 0, 0], set()),
        ("w", [1, 0, 0, 0, 0, 0], set()),
        ("sd", [-1, -1, 0, 0, 0, 0], set()),
        ("ws", [0, 0, 0, 0, 0, 0], set()),
        ("ae", [0, 1, 1, 0, 0, 0], set()),
        ("okj", [0, 0, 0, 1, -1, 1], set()),
        ("cuil", [0, 0, -1, -1, 1, -1], set()),
        ("g", [0, 0, 0, 0, 0, 0], {"close"}),
        ("gh", [0, 0, 0, 0, 0, 0], {"open", "close"}),
    ],
)
def test_keys_are_axes_in_the_body_convention_of_ros_and_buttons(device, keys, twist, buttons):
    for key in (SHIFT, *map(char, keys.upper())):  # as Shift makes them
        device._listener.press(key)
    state = device.read()
    np.testing.assert_array_equal(state.twist, twist)
    assert state.buttons == buttons


def test_keys_count_while_they_are_held_and_only_with_shift(device):
    def twist():
        return device.read().twist[:2].tolist()

    listener = device._listener
    listener.press(char("w"))
    assert twist() == [0, 0]
    listener.press(SHIFT)
    listener.press(char("A"))
    for meaningless in (char("x"), char(None), SimpleNamespace(name="esc"), None):
        listener.press(meaningless)
    assert twist() == [1, 1]
    listener.release(char("W"))
    assert twist() == [0, 1]
    listener.release(SHIFT)
    assert twist() == [0, 0]


def test_a_listener_that_ends_is_told(device):
    device._listener.stop()
    with pytest.raises(DeviceLostError, match="pynput stopped"):
        device.read()


@pytest.mark.parametrize(
    ("lacks", "remedy"),
    [
        ("installed", r"lerobot_policy_ufrnn\[keyboard\]"),
        ("captures", "X11 session .*--teleop.type=spacemouse_twist.*--teleop.device=FILE"),
        ("trusted", "Input Monitoring"),
    ],
)
def test_where_pynput_cannot_run_it_says_what_to_do(desktop, monkeypatch, lacks, remedy):
    setattr(desktop, lacks, False)
    monkeypatch.setattr(keyboard, "_pynput_available", lacks != "installed")
    device = KeyboardDevice()
    with pytest.raises(DeviceUnavailableError, match=remedy):
        device.open()
    assert device._listener is None


@pytest.mark.parametrize("key", [*AXES, *GRIPPER])
def test_no_key_is_one_of_the_keys_of_lerobots_recording(monkeypatch, key):
    recorded = []
    monkeypatch.setattr(keyboard_input, "apply_recording_control", lambda control, _: recorded.append(control))
    monkeypatch.setattr(keyboard_input, "create_key_listener", lambda dispatch, **_: dispatch(key))
    _, events = keyboard_input.init_keyboard_listener()
    assert not recorded
    assert not any(events.values())
