import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from teleoperators_fakes import Clock
from waiting import wait_until

from lerobot_ufrnn.teleoperators import DeviceLostError, DeviceUnavailableError, SpaceMouseTwistConfig
from lerobot_ufrnn.teleoperators.spacemouse import SpaceMouseDevice


def make_device(clock=time.monotonic, **settings):
    return SpaceMouseDevice(SpaceMouseTwistConfig(robot_ip="192.0.2.1", **settings), clock)


class FakeMouse:
    """What `pyspacemouse.open` returns; `report` is what it read last."""

    def __init__(self):
        self.report = self.make(t=-1.0)
        self.fault: Exception | None = None
        self.closed = False

    @staticmethod
    def make(t, twist=(0, 0, 0, 0, 0, 0), buttons=(0, 0)):
        names = ("x", "y", "z", "roll", "pitch", "yaw")
        return SimpleNamespace(t=t, buttons=list(buttons), **dict(zip(names, twist, strict=True)))

    def read(self):
        if self.fault is not None:
            raise self.fault
        return self.report

    def close(self):
        self.closed = True


@pytest.fixture
def library(monkeypatch):
    """pyspacemouse with one mouse plugged in."""
    library = SimpleNamespace(mouse=FakeMouse(), fault=None, asked=[], AxisConvention=SimpleNamespace(ROS="ros"))

    def open_mouse(axis_convention):
        library.asked.append(axis_convention)
        if library.fault is not None:
            raise library.fault
        return library.mouse

    library.open = open_mouse
    monkeypatch.setitem(sys.modules, "pyspacemouse", library)
    return library


@pytest.fixture
def opened(library):
    clock = Clock()
    device = make_device(clock, deadzone=0.2)
    device.open()
    yield SimpleNamespace(device=device, clock=clock, mouse=library.mouse)
    device.close()
    assert library.mouse.closed


def test_the_axes_of_ros_are_asked_for_and_small_deflections_are_none(opened, library):
    assert library.asked == ["ros"]
    assert not opened.device.read().twist.any()
    opened.mouse.report = FakeMouse.make(1.0, (0.6, -0.2, 0.1, 1.2, -1.0, 0.0))
    wait_until(lambda: opened.device.read().twist.any())
    np.testing.assert_allclose(opened.device.read().twist, [0.5, 0, 0, 1, -1, 0], atol=1e-12)


def test_a_deflection_that_is_not_repeated_fades_but_a_button_stays(opened):
    opened.mouse.report = FakeMouse.make(1.0, (1, 0, 0, 0, 0, 0), (1, 0))
    wait_until(lambda: opened.device.read().twist.any())
    opened.clock.now += 0.19
    assert opened.device.read().twist[0] == 1
    opened.clock.now += 0.02
    state = opened.device.read()
    assert not state.twist.any()
    assert state.buttons == {"close"}
    opened.mouse.report = FakeMouse.make(2.0, (1, 0, 0, 0, 0, 0), (0, 1))
    wait_until(lambda: opened.device.read().buttons == {"open"})
    assert opened.device.read().twist[0] == 1


def test_a_value_that_is_no_number_is_passed_on_to_be_seen(opened):
    opened.mouse.report = FakeMouse.make(1.0, (float("nan"), 0, 0, 0, 0, 0))
    wait_until(lambda: opened.device.read().fault() is not None)


def test_an_unplugged_mouse_is_told(opened):
    opened.mouse.fault = OSError("Failed to read from HID device: -1")
    with pytest.raises(DeviceLostError, match="plug it in"):
        wait_until(lambda: opened.device.read() is None)


@pytest.mark.parametrize(
    ("fault", "remedy"),
    [
        (RuntimeError("HID API is probably not installed."), "libhidapi-hidraw0"),
        (RuntimeError("Failed to open device"), "udev"),
        (RuntimeError("No connected or supported devices found."), "plug one in"),
    ],
)
def test_what_is_missing_is_told_with_its_remedy(library, fault, remedy):
    library.fault = fault
    with pytest.raises(DeviceUnavailableError, match=remedy):
        make_device().open()


def test_a_missing_library_is_told_with_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyspacemouse", None)
    with pytest.raises(DeviceUnavailableError, match=r"lerobot_policy_ufrnn\[spacemouse\]"):
        make_device().open()


class FakeHid:
    """A HID device that sends raw reports."""

    product_string = manufacturer_string = serial_number = "fake"
    release_number = 1

    def __init__(self, *reports):
        self.reports = [bytes(report) for report in reports]

    def open(self):
        pass

    def set_nonblocking(self, _):
        pass

    def read(self, _):
        return self.reports.pop(0) if self.reports else b""

    def close(self):
        pass


def words(channel, *values):
    return [channel, *(byte for value in values for byte in (value & 0xFFFF).to_bytes(2, "little"))]


@pytest.mark.parametrize(
    ("report", "axis", "direction"),
    [
        # USB's axes of the cap: x right, y towards the user, z down; rotations by the right-hand rule about them.
        (words(1, 0, -350, 0), 0, 1),
        (words(1, -350, 0, 0), 1, 1),
        (words(1, 0, 0, -350), 2, 1),
        (words(2, 0, -350, 0), 3, 1),
        (words(2, -350, 0, 0), 4, 1),
        (words(2, 0, 0, -350), 5, 1),
        (words(2, 0, 0, 350), 5, -1),
    ],
)
def test_raw_reports_become_axes_of_ros_in_the_real_library(monkeypatch, report, axis, direction):
    pyspacemouse = pytest.importorskip("pyspacemouse", reason="needs the extra `spacemouse`")
    from pyspacemouse import api

    hid = FakeHid(report, [3, 2, 0, 0, 0, 0, 0])
    hid.vendor_id, hid.product_id = pyspacemouse.get_device_specs()["SpaceMouseCompact"].hid_id
    monkeypatch.setattr(api, "Enumeration", lambda: SimpleNamespace(find=lambda: [hid]))
    device = make_device(deadzone=0.0, stale_after=1.0)
    device.open()
    try:
        wait_until(lambda: device.read().buttons == {"open"})
        expected = np.zeros(6)
        expected[axis] = direction
        np.testing.assert_allclose(device.read().twist, expected, atol=1e-12)
    finally:
        device.close()
