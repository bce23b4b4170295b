"""The robot on the digital twin, through the real client library: what it does, and what it does when it fails."""

import importlib
import sys
import time

import numpy as np
import pytest
from lerobot.robots import make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from teleoperators_fakes import FEATURES
from waiting import wait_until

pytest.importorskip("rtde_control", reason="ur_rtde is not installed")

from env_door.twin import TwinProcess
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


# ── Faults ────────────────────────────────────────────────────────────


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameters", "fault"),
    [
        ("drop_link", {}, Fault.LINK_LOST),
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
        ("remote_control_off", Fault.PROGRAM_STOPPED, "local control"),
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
