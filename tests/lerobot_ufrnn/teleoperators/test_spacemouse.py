import contextlib
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from teleoperators_fakes import Clock
from waiting import wait_until

from lerobot_ufrnn.teleoperators import SpaceMouseTwistConfig
from lerobot_ufrnn.teleoperators.device import DeviceLostError, DeviceUnavailableError
from lerobot_ufrnn.teleoperators.spacemouse import SpaceMouseDevice


def make_device(clock=time.monotonic, **settings):
    return SpaceMouseDevice(SpaceMouseTwistConfig(robot_ip="192.0.2.1", **settings), clock)


def report(t, x=0, y=0, z=0, roll=0, pitch=0, yaw=0, buttons=(0, 0)):
    """What the mouse says; `t` tells a new report from an old one."""
    return SimpleNamespace(t=t, x=x, y=y, z=z, roll=roll, pitch=pitch, yaw=yaw, buttons=list(buttons))


class FakeLibrary:
    """pyspacemouse, and its one mouse."""

    AxisConvention = SimpleNamespace(ROS="ros")

    def __init__(self):
        self.report, self.fault, self.asked, self.closed = report(-1.0), None, [], False

    def open(self, axis_convention):
        self.asked.append(axis_convention)
        self.read()
        return self

    def read(self):
        if self.fault is not None:
            raise self.fault
        return self.report

    def close(self):
        self.closed = True


@pytest.fixture
def mouse(monkeypatch):
    mouse = FakeLibrary()
    monkeypatch.setitem(sys.modules, "pyspacemouse", mouse)
    return mouse


@pytest.fixture
def device(mouse):
    device = make_device(Clock(), deadzone=0.2)
    device.open()
    yield device
    device.close()
    assert mouse.closed


def test_the_axes_of_ros_are_asked_for_and_small_deflections_are_none(device, mouse):
    assert mouse.asked == ["ros"]
    assert not device.read().twist.any()
    mouse.report = report(1.0, 0.6, -0.2, 0.1, 1.2, -1.0)
    wait_until(lambda: device.read().twist.any())
    np.testing.assert_allclose(device.read().twist, [0.5, 0, 0, 1, -1, 0], atol=1e-12)


def test_a_deflection_that_is_not_repeated_fades_but_a_button_stays(device, mouse):
    mouse.report = report(1.0, x=1, buttons=(1, 0))
    wait_until(lambda: device.read().twist.any())
    device._clock.now += 0.19
    assert device.read().twist[0] == 1
    device._clock.now += 0.02
    state = device.read()
    assert not state.twist.any()
    assert state.buttons == {"close"}
    mouse.report = report(2.0, x=1, buttons=(0, 1))
    wait_until(lambda: device.read().buttons == {"open"})
    assert device.read().twist[0] == 1


def test_a_value_that_is_no_number_is_passed_on_to_be_seen(device, mouse):
    mouse.report = report(1.0, x=float("nan"))
    wait_until(lambda: device.read().fault() is not None)


def test_an_unplugged_mouse_is_told(device, mouse):
    mouse.fault = OSError("Failed to read from HID device: -1")
    with pytest.raises(DeviceLostError, match="plug it in"):
        wait_until(lambda: device.read() is None)


@pytest.mark.parametrize(
    ("fault", "remedy"),
    [
        (RuntimeError("HID API is probably not installed."), "libhidapi-hidraw0"),
        (RuntimeError("Failed to open device"), "udev"),
        (RuntimeError("No connected or supported devices found."), "plug one in"),
        (OSError("cannot load library"), "libhidapi-hidraw0"),
    ],
)
def test_what_is_missing_is_told_with_its_remedy(mouse, fault, remedy):
    mouse.fault = fault
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
        self.open = self.close = lambda: None
        self.set_nonblocking = lambda _: None

    def read(self, _):
        return self.reports.pop(0) if self.reports else b""


def words(channel, *values):
    return [channel, *(byte for value in values for byte in (value & 0xFFFF).to_bytes(2, "little"))]


@pytest.mark.parametrize(
    ("raw", "axis", "direction"),
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
def test_raw_reports_become_axes_of_ros_in_the_real_library(monkeypatch, raw, axis, direction):
    pyspacemouse = pytest.importorskip("pyspacemouse", reason="needs the extra `spacemouse`")
    hid = FakeHid(raw, [3, 2, 0, 0, 0, 0, 0])
    hid.vendor_id, hid.product_id = pyspacemouse.get_device_specs()["SpaceMouseCompact"].hid_id
    monkeypatch.setattr(pyspacemouse.api, "Enumeration", lambda: SimpleNamespace(find=lambda: [hid]))
    with contextlib.closing(make_device(deadzone=0.0, stale_after=1.0)) as device:
        device.open()
        wait_until(lambda: device.read().buttons == {"open"})
        np.testing.assert_allclose(device.read().twist, direction * np.eye(6)[axis], atol=1e-12)
