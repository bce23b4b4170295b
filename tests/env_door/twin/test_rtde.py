"""RTDE from the outside, by raw sockets."""

import struct

import numpy as np
import pytest

from env_door.env import DoorEnv
from env_door.twin import ports


@pytest.fixture
def rtde(connect):
    return connect(ports.RTDE)


def ask_for(rtde, names):
    return rtde.exchange("O", struct.pack(">d", 125.0) + names)


def test_only_the_second_version_of_the_protocol_is_spoken(rtde):
    assert [rtde.exchange("V", struct.pack(">H", version)) for version in (1, 2)] == [b"\x00", b"\x01"]


def test_measurements_are_those_of_the_scene_at_the_rate_asked_for(rtde):
    env = DoorEnv(kind="pull")
    env.reset(seed=5)
    assert ask_for(rtde, b"timestamp,actual_q,runtime_state") == b"\x01DOUBLE,VECTOR6D,UINT32"
    assert rtde.exchange("S") == b"\x01"
    rtde.packages()
    rtde.turn(40)
    packages = np.array([struct.unpack(">B7dI", body) for kind, body in rtde.packages() if kind == "U"])
    assert len(packages) == 10
    np.testing.assert_allclose(np.diff(packages[:, 1]), 0.008, atol=1e-9)
    np.testing.assert_allclose(packages[-1, 2:8], env.measured_joints()[:6], atol=1e-3)
    assert packages[-1, 8] == 1
    assert rtde.exchange("P") == b"\x01"
    rtde.turn(20)
    assert not rtde.packages()


def test_an_unknown_variable_is_named_and_nothing_starts_or_goes_on(rtde):
    ask_for(rtde, b"timestamp")
    rtde.exchange("S")
    assert ask_for(rtde, b"timestamp,nonsense") == b"\x00DOUBLE,NOT_FOUND"
    rtde.turn(10)
    assert not rtde.packages()
    assert rtde.exchange("S") == b"\x00"


def test_inputs_belong_to_one_client_until_it_leaves(connect, rtde):
    names = b"input_int_register_0,input_double_register_0"
    assert rtde.exchange("I", names) == b"\x01INT32,DOUBLE"
    assert rtde.exchange("I", b"input_int_register_0") == b"\x02INT32"
    other = connect(ports.RTDE)
    assert other.exchange("I", names + b",output_int_register_0") == b"\x00IN_USE,IN_USE,NOT_FOUND"
    rtde.socket.close()
    other.turn(2)
    assert other.exchange("I", names) == b"\x01INT32,DOUBLE"


@pytest.mark.parametrize(("name", "only_commanding"), [("close_link", False), ("close_control", True)])
def test_clients_are_hung_up_on_in_order_and_may_come_again(twin, connect, rtde, name, only_commanding):
    commanding = connect(ports.RTDE)
    commanding.exchange("I", b"input_int_register_0")
    twin.inject(name)
    assert not commanding.turn(3)
    assert rtde.turn(3) == only_commanding
    assert connect(ports.RTDE).exchange("I", b"input_int_register_0") == b"\x01INT32"


def test_the_speed_slider_is_told(twin, rtde):
    twin.inject("speed_slider", fraction=0.3)
    ask_for(rtde, b"speed_scaling,target_speed_fraction")
    rtde.exchange("S")
    rtde.packages()
    rtde.turn(5)
    assert struct.unpack(">B2d", rtde.packages()[-1][1])[1:] == pytest.approx((0.3, 0.3))


@pytest.mark.parametrize(
    "package",
    [b"\x00\x02U", b"\x00\x03U", b"\x00\x04U\x07", b"\x00\x05U\x01\x00", b"\x00\x04O\x00", b"\x00\x04I\xff"],
    ids=["short header", "empty", "unknown recipe", "short data", "short recipe", "no text"],
)
def test_malformed_packages_end_the_connection_and_nothing_else(connect, rtde, package):
    rtde.exchange("I", b"input_int_register_0")
    rtde.put(package)
    assert not rtde.turn(3)
    assert connect(ports.RTDE).exchange("V", struct.pack(">H", 2)) == b"\x01"
