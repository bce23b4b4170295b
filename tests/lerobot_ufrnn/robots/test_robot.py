"""The robot on the digital twin, through the real client library: what it does, and what it does when it fails."""

import importlib
import sys
import time

import numpy as np
import pytest
from lerobot.robots import make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from waiting import wait_until

pytest.importorskip("rtde_control", reason="ur_rtde is not installed")

from env_door.env import DoorEnv
from env_door.twin import TwinProcess
from lerobot_ufrnn.robots.ur5e_robotiq import Fault, RobotFaultError, UR5eRobotiq, UR5eRobotiqConfig

pytestmark = pytest.mark.real_time

STILL = 0.01
"""Joint speed in rad/s below which the arm stands."""

TURN = np.array([0, 0, 0, 0, 0, 0.05])
"""A step of the last joint."""


@pytest.fixture
def twin():
    with TwinProcess(kind="push", seed=3, unlock_seconds=0.2) as process:
        yield process


@pytest.fixture
def connected(twin):
    robots = []

    def connect(**settings) -> UR5eRobotiq:
        settings = {"image_size": 0, **settings}
        robots.append(UR5eRobotiq(UR5eRobotiqConfig(ip=twin.address, id="test", **settings)))
        robots[-1].connect()
        return robots[-1]

    yield connect
    for robot in robots:
        if robot.is_connected:
            robot.disconnect()


def joints_of(values: dict[str, float]) -> np.ndarray:
    return np.array([value for name, value in values.items() if name != "gripper.pos"])


def action_of(robot: UR5eRobotiq, joints: np.ndarray, gripper: float = 0.0) -> dict[str, float]:
    return dict(zip(robot.action_features, [*joints.tolist(), gripper], strict=True))


def move(robot: UR5eRobotiq, change: np.ndarray, steps: int, gripper: float = 0.0) -> list[dict[str, float]]:
    """Asks for a step of `change` at 10 Hz; what was sent."""
    target = joints_of(robot.get_observation())
    sent = []
    for _ in range(steps):
        target = target + change
        sent.append(robot.send_action(action_of(robot, target, gripper)))
        time.sleep(0.1)
    return sent


def until_it_fails(robot: UR5eRobotiq) -> RobotFaultError:
    """Goes on asking for small movements until the robot refuses."""
    try:
        wait_until(lambda: move(robot, 0.4 * TURN, 1) is None, 4.0)
    except RobotFaultError as fault:
        return fault
    raise AssertionError("it never failed")


def speed_of(twin: TwinProcess) -> float:
    return twin.state()["arm_speed"]


# ── Use ───────────────────────────────────────────────────────────────


def test_its_features_are_those_of_the_simulated_data_set():
    robot = make_robot_from_config(UR5eRobotiqConfig(ip="127.1.250.250", id="test"))
    env = DoorEnv()
    names = [f"{name}.pos" for name in env.joint_names]
    env.close()
    assert list(robot.action_features) == names
    assert list(robot.observation_features) == names
    assert not robot.is_connected
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()


def test_it_holds_then_follows_and_then_rests_where_it_was_sent(twin, connected):
    robot = connected()
    with pytest.raises(DeviceAlreadyConnectedError):
        robot.connect()
    start = joints_of(robot.get_observation())
    time.sleep(0.3)
    np.testing.assert_allclose(joints_of(robot.get_observation()), start, atol=1e-3)
    change = np.array([0.01, 0.0, -0.01, 0.0, 0.0, 0.03])
    sent = move(robot, change, 10, gripper=0.6)
    np.testing.assert_allclose(joints_of(sent[-1]), start + 10 * change, atol=1e-6)
    time.sleep(1.0)
    assert speed_of(twin) < STILL
    now = robot.get_observation()
    np.testing.assert_allclose(joints_of(now), start + 10 * change, atol=5e-3)
    assert now["gripper.pos"] == pytest.approx(0.6, abs=0.02)
    robot.disconnect()
    assert speed_of(twin) < STILL
    assert not robot.is_connected


def test_a_jump_is_limited_and_what_was_sent_is_told(connected):
    robot = connected()
    start = joints_of(robot.get_observation())
    sent = robot.send_action(action_of(robot, start + 1.0))
    assert np.abs(joints_of(sent) - start).max() <= robot.config.command_limit + 1e-3
    time.sleep(0.5)
    assert np.abs(joints_of(robot.get_observation()) - start).max() <= robot.config.command_limit + 5e-3


@pytest.mark.parametrize("broken", [float("nan"), None])
def test_what_is_no_action_is_refused_and_the_arm_stays(connected, broken):
    robot = connected()
    start = joints_of(robot.get_observation())
    action = action_of(robot, start + 0.05)
    if broken is None:
        del action["elbow.pos"], action["wrist_1.pos"], action["wrist_2.pos"]
    else:
        action["elbow.pos"] = broken
    with pytest.raises(ValueError, match="nothing was sent"):
        robot.send_action(action)
    time.sleep(0.3)
    np.testing.assert_allclose(joints_of(robot.get_observation()), start, atol=1e-3)
    move(robot, np.zeros(6), 1)  # and it goes on


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
    robot = connected()
    move(robot, TURN, 3)
    twin.inject(name, **parameters)
    told = until_it_fails(robot)
    assert told.fault is fault
    assert "To go on: " in str(told)
    time.sleep(0.5)
    assert speed_of(twin) < STILL
    twin.clear()
    joints = twin.state()["joints"]
    for _ in range(3):  # what has failed stays so, whatever is asked for
        with pytest.raises(RobotFaultError):
            robot.send_action(action_of(robot, np.zeros(6)))
        with pytest.raises(RobotFaultError):
            robot.get_observation()
        time.sleep(0.1)
    assert twin.state()["joints"] == pytest.approx(joints, abs=2e-3)
    robot.disconnect()
    assert not robot.is_connected


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
def test_an_arm_that_is_not_ready_is_not_connected_to(twin, connected, name, fault, message):
    twin.inject(name)
    with pytest.raises(RobotFaultError, match=message) as error:
        connected()
    assert error.value.fault is fault
    assert speed_of(twin) < STILL


def test_after_the_operator_has_looked_it_connects_again(twin, connected):
    robot = connected()
    twin.inject("protective_stop")
    until_it_fails(robot)
    robot.disconnect()
    with pytest.raises(RobotFaultError, match="safety status"):
        robot.connect()
    assert not robot.is_connected
    twin.clear()
    pendant = importlib.import_module("dashboard_client").DashboardClient(twin.address)
    pendant.connect()
    pendant.unlockProtectiveStop()
    pendant.disconnect()
    robot.connect()
    move(robot, TURN, 1)


def test_where_there_is_no_controller_it_says_so():
    robot = UR5eRobotiq(UR5eRobotiqConfig(ip="127.1.250.250", id="test"))
    with pytest.raises(RobotFaultError, match=r"no controller answers at 127\.1\.250\.250"):
        robot.connect()
    assert not robot.is_connected


def test_without_the_client_library_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    robot = UR5eRobotiq(UR5eRobotiqConfig(ip="127.1.250.250", id="test"))
    with pytest.raises(ImportError, match=r"needs ur_rtde.*lerobot_policy_ufrnn\[ur5e\]"):
        robot.connect()
    assert not robot.is_connected


def test_if_the_servo_process_is_killed_the_watchdog_stops_the_arm(twin, connected):
    robot = connected()
    move(robot, TURN, 2)
    robot._servo._process.kill()
    assert until_it_fails(robot).fault is Fault.SERVO_DIED
    time.sleep(0.5)
    assert speed_of(twin) < STILL
