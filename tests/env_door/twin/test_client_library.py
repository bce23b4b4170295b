"""The real client library against the twin, in good order and in every kind of trouble."""

import os
import select
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from waiting import wait_until

from env_door.kinematics import InverseKinematics
from env_door.scene import UR5E, load_model
from env_door.twin import TwinClient, TwinError, TwinProcess, free_address

rtde_control = pytest.importorskip("rtde_control")
rtde_receive = pytest.importorskip("rtde_receive")
dashboard_client = pytest.importorskip("dashboard_client")

RATE = 125.0
BASE = (0.0, -0.06, 0.5)  # of the arm in the world, in m
SERVO = (0.5, 0.5, 1 / RATE, 0.1, 300.0)


@pytest.fixture(scope="module")
def running():
    with TwinProcess(kind="push", seed=3, unlock_seconds=0.2) as made:
        yield made


@pytest.fixture
def dashboard(running):
    client = dashboard_client.DashboardClient(running.address)
    client.connect()
    yield client
    client.disconnect()


@pytest.fixture
def twin(running, dashboard):
    yield running
    recover(running, dashboard)
    running.reset(seed=3)


def recover(twin, dashboard):
    twin.clear()
    wait_until(lambda: unlocked(dashboard))
    for command, mode in ((dashboard.powerOn, "IDLE"), (dashboard.brakeRelease, "RUNNING")):
        command()
        wait_until(lambda mode=mode: twin.state()["robot_mode"] in (mode, "RUNNING"))
    dashboard.stop()


def unlocked(dashboard):
    try:
        dashboard.unlockProtectiveStop()
    except RuntimeError:
        return False
    return True


@pytest.fixture
def receive(twin):
    client = rtde_receive.RTDEReceiveInterface(twin.address, RATE)
    yield client
    client.disconnect()


@pytest.fixture
def control(twin):
    client = rtde_control.RTDEControlInterface(twin.address, RATE)
    yield client
    client.disconnect()


def servo(control, receive, change, seconds):
    """Streams a target that moves by `change` (rad) over some time; whether the client was content."""
    start = np.array(receive.getActualQ())
    count = round(seconds * RATE)
    answers = []
    for index in range(1, count + 1):
        period = control.initPeriod()
        answers.append(control.servoJ(list(start + np.asarray(change) * index / count), *SERVO))
        control.waitPeriod(period)
    return all(answers)


def goes_on_after_an_upload(control, receive):
    if control.servoJ(receive.getActualQ(), *SERVO):  # nothing goes on by itself
        return False
    assert control.reuploadScript()
    wait_until(control.isProgramRunning)
    return control.servoJ(receive.getActualQ(), *SERVO)


# ── In good order ─────────────────────────────────────────────────────


def test_state_and_pose_are_read_as_from_a_robot(twin, receive):
    joints = receive.getActualQ()
    np.testing.assert_allclose(joints, list(twin.state()["joints"].values())[:6], atol=1e-3)
    assert (receive.getRobotMode(), receive.getSafetyMode(), receive.getSafetyStatusBits()) == (7, 1, 1)
    pose = receive.getActualTCPPose()
    position, rotation = InverseKinematics(load_model("ur5e"), UR5E.joints).forward(np.array(joints))
    np.testing.assert_allclose(pose[:3], position - BASE, atol=1e-3)
    np.testing.assert_allclose(Rotation.from_rotvec(pose[3:]).as_matrix(), rotation, atol=1e-3)


def test_servo_moves_the_arm_by_what_was_asked_for(twin, control, receive):
    before = np.array(receive.getActualQ())
    change = [0.1, -0.05, 0.05, 0.0, 0.1, -0.2]
    twin.arrivals()
    assert servo(control, receive, change, 0.8)
    arrivals = np.array(twin.arrivals())
    assert len(arrivals) == round(0.8 * RATE)
    assert (np.diff(arrivals) >= 0).all()
    assert twin.arrivals() == []
    wait_until(lambda: np.abs(receive.getActualQ() - before - change).max() < 0.01)  # it trails by the lookahead
    assert control.servoStop(10.0)
    wait_until(control.isSteady)
    np.testing.assert_allclose(np.array(receive.getActualQ()) - before, change, atol=0.01)
    assert twin.state()["motion"] == "hold"


def test_move_arrives_before_it_returns_and_asynchronously_after(twin, control, receive):
    target = np.add(receive.getActualQ(), [0.1, 0, 0, 0, 0, 0.1])
    assert control.moveJ(list(target), 1.0, 2.0)
    assert twin.state()["targets"]["shoulder_pan"] == pytest.approx(target[0], abs=1e-6)
    assert control.moveJ(list(target - 0.1), 0.2, 2.0, True)
    assert twin.state()["motion"] == "move"
    assert control.getAsyncOperationProgress() >= 0
    control.stopJ(5.0)
    assert twin.state()["motion"] == "hold"
    wait_until(lambda: control.getAsyncOperationProgress() < 0)
    assert twin.state()["targets"]["shoulder_pan"] > target[0] - 0.09


@pytest.mark.parametrize("registers", [0, 0x08], ids=["lower registers", "upper registers"])
def test_questions_are_answered_in_either_half_of_the_registers(twin, registers):
    flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT | registers
    client = rtde_control.RTDEControlInterface(twin.address, RATE, flags)
    try:
        for offset in (0.1, 0.15):
            assert client.setTcp([0, 0, offset, 0, 0, 0])
            assert client.getTCPOffset() == pytest.approx([0, 0, offset, 0, 0, 0])
        assert client.isJointsWithinSafetyLimits([0.0] * 6)
        assert not client.isJointsWithinSafetyLimits([7.0] * 6)
        assert client.setWatchdog(5.0)
        assert twin.state()["watchdog"]
    finally:
        client.disconnect()


def test_a_second_client_may_not_command_before_the_first_has_disconnected(twin, control, receive):
    with pytest.raises(RuntimeError, match="already in use"):
        rtde_control.RTDEControlInterface(twin.address, RATE)
    control.disconnect()
    receive.disconnect()
    assert not receive.isConnected()
    wait_until(lambda: twin.state()["rtde_clients"] == 0)
    assert receive.reconnect()
    assert control.reconnect()
    assert servo(control, receive, [0.05, 0, 0, 0, 0, 0], 0.2)


# ── In trouble ────────────────────────────────────────────────────────


# What happens to the link is tested with a client that only listens. One that commands connects again by itself and
# crashes now and then: only a process of its own may hold it when a link breaks, as that of the robot's servo does.
@pytest.mark.parametrize(
    ("name", "parameters", "stays_connected"),
    [("drop_link", {}, False), ("freeze", {}, True), ("delay", {"ms": 400.0}, True)],
)
def test_measurements_grow_old_and_come_again(twin, receive, name, parameters, stays_connected):
    def age():
        return twin.state()["controller_time"] - receive.getTimestamp()

    wait_until(lambda: age() < 0.15)
    twin.inject(name, **parameters)
    wait_until(lambda: age() > 0.35)
    assert receive.isConnected() == stays_connected
    assert len(receive.getActualQ()) == 6  # stale values, without a word
    twin.clear(name)
    assert receive.isConnected() or receive.reconnect()
    wait_until(lambda: age() < 0.15)


@pytest.mark.parametrize(
    ("name", "robot_mode", "safety_mode", "safety_status"),
    [
        ("protective_stop", 7, 3, "PROTECTIVE_STOP"),
        ("emergency_stop", 3, 7, "ROBOT_EMERGENCY_STOP"),
        ("power_off", 3, 1, "NORMAL"),
        ("script_stop", 7, 1, "NORMAL"),
    ],
)
def test_what_ends_the_program_is_told_and_undone_by_hand(
    twin, control, receive, dashboard, name, robot_mode, safety_mode, safety_status
):
    assert control.servoJ(receive.getActualQ(), *SERVO)
    twin.inject(name)
    # Told on two connections, one after the other.
    wait_until(lambda: (receive.getRobotMode(), receive.getSafetyMode()) == (robot_mode, safety_mode))
    wait_until(lambda: not control.isProgramRunning())
    assert receive.isProtectiveStopped() == (name == "protective_stop")
    assert receive.isEmergencyStopped() == (name == "emergency_stop")
    assert dashboard.safetystatus() == f"Safetystatus: {safety_status}"
    assert not control.servoJ(receive.getActualQ(), *SERVO)
    recover(twin, dashboard)
    wait_until(lambda: (receive.getRobotMode(), receive.getSafetyMode()) == (7, 1))
    assert goes_on_after_an_upload(control, receive)


def test_a_client_ends_its_script_and_uploads_it_again(control, receive):
    control.stopScript()
    assert not control.isProgramRunning()
    assert goes_on_after_an_upload(control, receive)


def test_protective_stop_stops_the_moving_arm(twin, control, receive):
    assert control.moveJ(list(np.add(receive.getActualQ(), [0.5, 0, 0, 0, 0, 0])), 1.0, 2.0, True)
    wait_until(lambda: twin.state()["arm_speed"] > 0.2)
    assert not control.triggerProtectiveStop()
    wait_until(lambda: twin.state()["arm_speed"] < 0.01)
    assert twin.state()["safety_mode"] == "PROTECTIVE_STOP"


@pytest.mark.parametrize(
    ("name", "interface", "says"),
    [
        ("remote_control_off", rtde_control.RTDEControlInterface, "remote control"),
        ("drop_link", rtde_receive.RTDEReceiveInterface, "verify the IP"),
    ],
)
def test_local_control_and_a_dropped_link_refuse_a_new_client(twin, name, interface, says):
    twin.inject(name)
    with pytest.raises(RuntimeError, match=says):
        interface(twin.address, RATE)


# ── The process ───────────────────────────────────────────────────────


def test_it_is_told_where_there_is_a_twin_already_and_where_there_is_none(running):
    with pytest.raises(TwinError, match="another twin"), TwinProcess(address=running.address):
        pass
    with pytest.raises(TwinError, match=r"python -m env_door\.twin"):
        TwinClient(free_address()).state()


def test_it_dies_with_its_parent():
    code = (
        "import time; from env_door.twin import TwinProcess\n"
        f"with TwinProcess(address={free_address()!r}) as twin: print(twin.process.pid, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        twin = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    assert select.select([twin], [], [], 10.0)[0]  # it has ended
    os.close(twin)


@pytest.mark.parametrize(
    ("flag", "says"),
    [
        ("--kind=lift", "'slide_right_ccw', 'random'], got 'lift'"),
        ("--door_offset=1", "at most 0.05 m, got 1.0"),
        ("--address=8.8.8.8", "choose an address of this machine"),
        ("--speed=1", "--speed"),
    ],
)
def test_wrong_flags_are_explained(flag, says):
    run = subprocess.run(
        [sys.executable, "-m", "env_door.twin", "--camera=false", flag], capture_output=True, text=True
    )
    assert run.returncode != 0
    assert says in run.stderr
    assert "Traceback" not in run.stderr
