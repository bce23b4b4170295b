"""The robot on the digital twin, through the real client library: what it does, and what it does when it fails."""

import importlib
import logging
import os
import signal
import socket
import struct
import sys
import time

import numpy as np
import pytest
from lerobot.robots import make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from teleoperators_fakes import FEATURES
from waiting import wait_until

pytest.importorskip("rtde_control", reason="ur_rtde is not installed")

from env_door.twin import TwinProcess, ports
from lerobot_ufrnn.robots.ur5e_robotiq import Fault, RobotFaultError, UR5eRobotiq, UR5eRobotiqConfig

pytestmark = pytest.mark.real_time

STILL = 0.01  # rad/s of a joint below which the arm stands
TURN = np.array([0, 0, 0, 0, 0, 0.05])  # a step of the last joint


def make_robot(ip="127.1.250.250", **settings) -> UR5eRobotiq:
    return make_robot_from_config(UR5eRobotiqConfig(ip=ip, id="test", image_size=0, **settings))


@pytest.fixture
def twin():
    with TwinProcess(kind="push", seed=3, unlock_seconds=0.2) as process:
        yield process


@pytest.fixture
def robot(twin):
    """Not connected yet."""
    robot = make_robot(twin.address)
    yield robot
    if robot.is_connected:
        robot.disconnect()


@pytest.fixture
def connected(robot):
    robot.connect()
    return robot


def measured(robot: UR5eRobotiq) -> np.ndarray:
    return joints_of(robot.get_observation())


def joints_of(values: dict[str, float]) -> np.ndarray:
    return np.array([values[name] for name in FEATURES[:-1]])


def action_of(joints: np.ndarray, gripper: float = 0.0) -> dict[str, float]:
    return dict(zip(FEATURES, [*joints.tolist(), gripper], strict=True))


def move(robot: UR5eRobotiq, change: np.ndarray, steps: int, gripper: float = 0.0) -> np.ndarray:
    """Asks for steps of `change` at 10 Hz; the joints that were sent last."""
    target = measured(robot)
    for _ in range(steps):
        target = target + change
        sent = robot.send_action(action_of(target, gripper))
        time.sleep(0.1)
    return joints_of(sent)


def until_it_fails(robot: UR5eRobotiq) -> RobotFaultError:
    """Goes on asking for small movements until the robot refuses."""
    with pytest.raises(RobotFaultError) as told:
        wait_until(lambda: move(robot, 0.4 * TURN, 1) is None, 4.0)
    return told.value


def assert_still(twin: TwinProcess, after: float = 0.5) -> None:
    time.sleep(after)
    assert twin.state()["arm_speed"] < STILL


# ── Use ───────────────────────────────────────────────────────────────


def test_it_holds_then_follows_and_then_rests_where_it_was_sent(twin, connected):
    with pytest.raises(DeviceAlreadyConnectedError):
        connected.connect()
    start = measured(connected)
    time.sleep(0.3)
    np.testing.assert_allclose(measured(connected), start, atol=1e-3)
    change = np.array([0.01, 0.0, -0.01, 0.0, 0.0, 0.03])
    np.testing.assert_allclose(move(connected, change, 10, gripper=0.6), start + 10 * change, atol=1e-6)
    assert_still(twin, after=1.0)
    now = connected.get_observation()
    np.testing.assert_allclose(joints_of(now), start + 10 * change, atol=5e-3)
    assert now["gripper.pos"] == pytest.approx(0.6, abs=0.02)
    connected.disconnect()
    assert_still(twin, after=0.0)
    assert not connected.is_connected


def test_a_jump_is_limited_and_what_was_sent_is_told_and_what_is_no_action_is_refused(connected):
    start = measured(connected)
    action = action_of(start + 0.05)
    for broken in (action | {"elbow.pos": float("nan")}, dict(list(action.items())[:4])):
        with pytest.raises(ValueError, match="nothing was sent"):
            connected.send_action(broken)
    time.sleep(0.3)
    np.testing.assert_allclose(measured(connected), start, atol=1e-3)
    sent = connected.send_action(action_of(start + 1.0))  # and it goes on
    assert np.abs(joints_of(sent) - start).max() <= connected.config.command_limit + 1e-3
    time.sleep(0.5)
    assert np.abs(measured(connected) - start).max() <= connected.config.command_limit + 5e-3


@pytest.mark.parametrize("rate", [*(pytest.param(rate, marks=pytest.mark.slow) for rate in (10, 60)), 125])
def test_no_motion_is_lost_whatever_the_rate_of_actions(twin, connected, rate):
    speed, way = 0.4, 0.6  # rad/s and rad of the last joint
    start = measured(connected)
    begin = time.monotonic()
    for number in range(1, round(rate * way / speed) + 1):
        time.sleep(max(begin + number / rate - time.monotonic(), 0.0))
        fraction = min((time.monotonic() - begin) * speed / way, 1.0)
        connected.send_action(action_of(start + np.array([0, 0, 0, 0, 0, fraction * way])))
    connected.send_action(action_of(start + np.array([0, 0, 0, 0, 0, way])))
    time.sleep(0.5)
    assert measured(connected)[-1] - start[-1] == pytest.approx(way, abs=5e-3)


@pytest.mark.slow
def test_a_speed_slider_that_is_not_at_its_end_is_told_at_connect_and_on_change(twin, robot, caplog):
    def told():
        return [record.getMessage() for record in caplog.records if "speed" in record.getMessage()]

    caplog.set_level(logging.INFO)
    twin.inject("speed_slider", fraction=0.2)
    robot.connect()
    assert len(told()) == 1
    assert "20 %" in told()[0]
    for fraction in (0.5, 1.0):
        twin.inject("speed_slider", fraction=fraction)
        time.sleep(0.3)
        for _ in range(3):
            robot.get_observation()
    assert ["50 %" in told()[1], "100 %" in told()[2], len(told())] == [True, True, 3]


# ── Faults ────────────────────────────────────────────────────────────


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameters", "fault"),
    [
        ("drop_link", {}, Fault.LINK_LOST),
        ("close_link", {}, Fault.LINK_LOST),
        ("close_control", {}, Fault.LINK_LOST),
        ("freeze", {}, Fault.STALE_DATA),
        ("delay", {"ms": 500}, Fault.STALE_DATA),
        ("protective_stop", {}, Fault.PROTECTIVE_STOP),
        ("emergency_stop", {}, Fault.EMERGENCY_STOP),
        ("power_off", {}, Fault.NOT_RUNNING),
        ("script_stop", {}, Fault.PROGRAM_STOPPED),
        ("gripper_silent", {}, Fault.GRIPPER_SILENT),
        ("gripper_garbage", {}, Fault.GRIPPER_SILENT),
        ("gripper_gone", {}, Fault.GRIPPER_SILENT),
        ("gripper_fault", {}, Fault.GRIPPER_FAULT),
        ("gripper_fault", {"code": 5}, Fault.GRIPPER_NOT_ACTIVE),
        ("gripper_reset", {}, Fault.GRIPPER_NOT_ACTIVE),
        ("safeguard_stop", {}, Fault.SAFEGUARD_STOP),
        ("recovery_mode", {}, Fault.RECOVERY_MODE),
        ("safety_violation", {}, Fault.SAFETY_VIOLATION),
    ],
)
def test_whatever_fails_stops_the_arm_and_leaves_it_stopped(twin, connected, name, parameters, fault):
    move(connected, TURN, 3)
    twin.inject(name, **parameters)
    told = until_it_fails(connected)
    assert told.fault is fault
    assert "To go on: " in str(told)
    assert_still(twin)
    twin.clear()
    joints = twin.state()["joints"]
    for _ in range(3):  # what has failed stays so, whatever is asked for
        with pytest.raises(RobotFaultError):
            connected.send_action(action_of(np.zeros(6)))
        with pytest.raises(RobotFaultError):
            connected.get_observation()
        time.sleep(0.1)
    assert twin.state()["joints"] == pytest.approx(joints, abs=2e-3)
    connected.disconnect()
    assert not connected.is_connected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fault", "message"),
    [
        ("dashboard_gone", Fault.LINK_LOST, "no controller answers"),
        ("emergency_stop", Fault.EMERGENCY_STOP, "safety status"),
        ("protective_stop", Fault.PROTECTIVE_STOP, "safety status"),
        ("power_off", Fault.NOT_RUNNING, "robot mode"),
        ("remote_control_off", Fault.LOCAL_CONTROL, "local control"),
        ("safeguard_stop", Fault.SAFEGUARD_STOP, "safety status"),
        ("recovery_mode", Fault.RECOVERY_MODE, "safety status"),
        ("safety_violation", Fault.SAFETY_VIOLATION, "safety status"),
        ("freeze", Fault.LINK_LOST, "port 30004"),
        ("gripper_gone", Fault.GRIPPER_SILENT, "does not answer"),
        ("gripper_fault", Fault.GRIPPER_FAULT, "reports fault"),
    ],
)
def test_an_arm_that_is_not_ready_is_not_connected_to(twin, robot, name, fault, message):
    twin.inject(name)
    with pytest.raises(RobotFaultError, match=message) as error:
        robot.connect()
    assert error.value.fault is fault
    assert not robot.is_connected
    assert_still(twin, after=0.0)


def test_after_the_operator_has_looked_it_connects_again(twin, connected):
    twin.inject("protective_stop")
    until_it_fails(connected)
    connected.disconnect()
    with pytest.raises(RobotFaultError, match="safety status"):
        connected.connect()
    assert not connected.is_connected
    twin.clear()
    pendant = importlib.import_module("dashboard_client").DashboardClient(twin.address)
    pendant.connect()
    pendant.unlockProtectiveStop()
    pendant.disconnect()
    connected.connect()
    move(connected, TURN, 1)


def test_without_a_controller_or_its_client_it_says_what_is_missing(monkeypatch):
    robot = make_robot()
    with pytest.raises(RobotFaultError, match=r"no controller answers at 127\.1\.250\.250"):
        robot.connect()
    assert not robot.is_connected
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    with pytest.raises(ImportError, match=r"needs ur_rtde.*lerobot_policy_ufrnn\[ur5e\]"):
        robot.connect()
    assert not robot.is_connected
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()


def test_if_the_servo_process_is_killed_the_watchdog_stops_the_arm(twin, connected):
    move(connected, TURN, 2)
    connected._servo._process.kill()
    assert until_it_fails(connected).fault is Fault.SERVO_DIED
    assert_still(twin)


def test_a_servo_process_that_somebody_else_ends_is_told_and_nothing_goes_on(twin, connected):
    move(connected, TURN, 2)
    os.kill(connected._servo._process.pid, signal.SIGTERM)
    wait_until(lambda: not connected._servo._process.is_alive())
    for use in (connected.get_observation, lambda: connected.send_action(action_of(np.zeros(6), gripper=1.0))):
        with pytest.raises(RobotFaultError) as told:
            use()
        assert told.value.fault is Fault.SERVO_DIED
    assert_still(twin)
    assert twin.state()["targets"]["gripper"] == 0.0
    wait_until(lambda: twin.state()["program"] == "STOPPED", 2.0)


@pytest.mark.parametrize("name", ["close_link", pytest.param("close_control", marks=pytest.mark.slow)])
def test_a_link_that_closes_in_order_is_lost_and_leaves_no_program_behind(twin, connected, name):
    move(connected, TURN, 2)
    twin.inject(name)
    assert until_it_fails(connected).fault is Fault.LINK_LOST
    wait_until(lambda: twin.state()["program"] == "STOPPED", 2.0)
    for _ in range(10):
        time.sleep(0.1)
        assert twin.state()["program"] == "STOPPED"
        assert twin.state()["rtde_clients"] == 0
    connected.disconnect()
    connected.connect()
    move(connected, TURN, 1)


def test_disconnecting_later_does_not_stop_what_the_operator_has_started_meanwhile(twin, connected):
    twin.inject("script_stop")
    until_it_fails(connected)
    start_a_program(twin)
    connected.disconnect()
    time.sleep(0.2)
    assert twin.state()["program"] == "PLAYING"


def start_a_program(twin: TwinProcess) -> None:
    """Starts what nobody commands."""
    with socket.create_connection((twin.address, ports.SCRIPT[-1])) as connection:
        connection.sendall(b"def rtde_control():\n    global reg_offset_int = # int register offset\n0\nend\n")
    wait_until(lambda: twin.state()["program"] == "PLAYING", 2.0)


def test_a_program_that_runs_already_is_stopped_only_if_that_is_asked_for(twin, robot):
    start_a_program(twin)
    with pytest.raises(RobotFaultError, match=r"PLAYING.*stop_running_program=true") as told:
        robot.connect()
    assert told.value.fault is Fault.PROGRAM_RUNNING
    assert twin.state()["program"] == "PLAYING"
    bold = make_robot(twin.address, stop_running_program=True)
    bold.connect()
    move(bold, TURN, 1)
    bold.disconnect()
    assert twin.state()["program"] == "STOPPED"


@pytest.mark.slow
def test_who_comes_second_does_not_disturb_the_first(twin, connected):
    with pytest.raises(RobotFaultError) as told:
        make_robot(twin.address).connect()
    assert told.value.fault is Fault.PROGRAM_RUNNING
    move(connected, TURN, 1)


@pytest.mark.slow
def test_registers_that_somebody_else_writes_are_told_with_what_to_do(twin, robot):
    with socket.create_connection((twin.address, ports.RTDE)) as fieldbus:
        names = b"input_int_register_0"
        fieldbus.sendall(struct.pack(">HB", 3 + len(names), ord("I")) + names)
        fieldbus.recv(100)
        with pytest.raises(RobotFaultError, match="EtherNet/IP") as told:
            robot.connect()
    assert told.value.fault is Fault.REGISTERS_IN_USE
