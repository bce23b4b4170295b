"""The real client library against the twin, in good order and in every kind of trouble."""

import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from waiting import wait_until

from env_door.demonstration import demonstrate
from env_door.env import DoorEnv
from env_door.twin import TwinClient, TwinError, TwinProcess, free_address, ports

rtde_control = pytest.importorskip("rtde_control")
rtde_receive = pytest.importorskip("rtde_receive")
dashboard_client = pytest.importorskip("dashboard_client")

RATE = 125.0
SERVO = (0.5, 0.5, 1 / RATE, 0.1, 300.0)


@pytest.fixture(scope="module")
def running():
    with TwinProcess(kind="push", seed=3, unlock_seconds=0.2) as made:
        yield made


@pytest.fixture
def twin(running):
    yield running
    running.clear()
    with_dashboard(running, lambda dashboard: recover(running, dashboard))
    running.reset(seed=3)


def with_dashboard(twin, work):
    dashboard = dashboard_client.DashboardClient(twin.address)
    dashboard.connect()
    try:
        work(dashboard)
    finally:
        dashboard.disconnect()


def recover(twin, dashboard):
    if twin.state()["safety_mode"] == "PROTECTIVE_STOP":
        wait_until(lambda: unlocked(dashboard))
    if twin.state()["robot_mode"] != "RUNNING":
        dashboard.powerOn()
        twin.wait_for(robot_mode="IDLE")
        dashboard.brakeRelease()
        twin.wait_for(robot_mode="RUNNING")
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


def test_state_is_read_as_from_a_robot(twin, receive):
    state = twin.state()
    np.testing.assert_allclose(receive.getActualQ(), list(state["joints"].values())[:6], atol=1e-3)
    assert (receive.getRobotMode(), receive.getSafetyMode(), receive.getSafetyStatusBits()) == (7, 1, 1)
    assert not receive.isProtectiveStopped()
    assert not receive.isEmergencyStopped()


def test_tool_pose_follows_from_the_published_geometry(twin, receive):
    # Denavit-Hartenberg parameters as Universal Robots publishes them, chained here from scratch.
    d = [0.1625, 0, 0, 0.1333, 0.0997, 0.0996]
    a = [0, -0.425, -0.3922, 0, 0, 0]
    twist = [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]
    pose = np.eye(4)
    for joint, angle in enumerate(receive.getActualQ()):
        c, s, ct, st = np.cos(angle), np.sin(angle), np.cos(twist[joint]), np.sin(twist[joint])
        pose = pose @ np.array(
            [
                [c, -s * ct, s * st, a[joint] * c],
                [s, c * ct, -c * st, a[joint] * s],
                [0, st, ct, d[joint]],
                [0, 0, 0, 1],
            ]
        )
    expected = pose @ [0, 0, 0.15, 1]
    np.testing.assert_allclose(receive.getActualTCPPose()[:3], expected[:3], atol=1e-3)


def test_servo_moves_the_arm_by_what_was_asked_for(twin, control, receive):
    before = np.array(receive.getActualQ())
    change = [0.1, -0.05, 0.05, 0.0, 0.1, -0.2]
    assert servo(control, receive, change, 0.8)
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


def test_tool_offset_and_limits(control):
    assert control.getTCPOffset() == pytest.approx([0, 0, 0.15, 0, 0, 0])
    assert control.setTcp([0, 0, 0.1, 0, 0, 0])
    assert control.getTCPOffset() == pytest.approx([0, 0, 0.1, 0, 0, 0])
    assert control.setTcp([0, 0, 0.15, 0, 0, 0])
    assert control.isJointsWithinSafetyLimits([0.0] * 6)
    assert not control.isJointsWithinSafetyLimits([7.0] * 6)


def test_stopping_the_script_and_uploading_it_again(control, receive):
    control.stopScript()
    assert not control.isProgramRunning()
    assert not control.servoJ(receive.getActualQ(), *SERVO)
    assert control.reuploadScript()
    wait_until(control.isProgramRunning)
    assert control.servoJ(receive.getActualQ(), *SERVO)


def test_disconnecting_and_connecting_again(twin, control, receive):
    control.disconnect()
    receive.disconnect()
    assert not receive.isConnected()
    twin.wait_for(rtde_clients=0)
    assert receive.reconnect()
    assert control.reconnect()
    assert servo(control, receive, [0.05, 0, 0, 0, 0, 0], 0.2)


def test_a_second_control_client_is_refused(twin, control):
    with pytest.raises(RuntimeError, match="already in use"):
        rtde_control.RTDEControlInterface(twin.address, RATE)


def test_upper_registers_serve_as_well(twin):
    flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT | 0x08
    client = rtde_control.RTDEControlInterface(twin.address, RATE, flags)
    try:
        assert client.isJointsWithinSafetyLimits([0.0] * 6)
        assert client.setWatchdog(5.0)
        assert twin.state()["watchdog"]
    finally:
        client.disconnect()


def test_the_twin_tells_when_set_points_came(twin, control, receive):
    twin.arrivals()
    assert servo(control, receive, [0.0] * 6, 0.4)
    arrivals = np.array(twin.arrivals())
    assert len(arrivals) == round(0.4 * RATE)
    assert (np.diff(arrivals) >= 0).all()
    assert twin.arrivals() == []


def test_watchdog_stops_the_arm_when_the_client_falls_silent(twin, control, receive):
    assert control.setWatchdog(2.0)
    assert servo(control, receive, [0.1, 0, 0, 0, 0, 0], 0.5)
    assert twin.state()["program"] == "PLAYING"
    twin.wait_for(program="STOPPED", motion="hold")
    wait_until(lambda: not control.isProgramRunning())
    assert not control.kickWatchdog()
    assert not control.servoJ(receive.getActualQ(), *SERVO)


# Faults of the link are tested with a client that only listens. One that commands connects again by itself and crashes
# now and then: only a process of its own may hold it when a link breaks, as that of the robot's servo does.
def test_dropped_link_leaves_stale_values_and_can_be_made_again(twin, receive):
    twin.inject("drop_link")
    wait_until(lambda: not receive.isConnected())
    stale = receive.getTimestamp()
    time.sleep(0.05)
    assert receive.getTimestamp() == stale
    assert len(receive.getActualQ()) == 6
    with pytest.raises(RuntimeError, match="verify the IP"):
        rtde_receive.RTDEReceiveInterface(twin.address, RATE)
    twin.clear("drop_link")
    assert receive.reconnect()
    assert receive.getTimestamp() > stale


def test_frozen_link_stays_connected_while_nothing_comes(twin, receive):
    twin.inject("freeze")
    time.sleep(0.05)
    stale = receive.getTimestamp()
    time.sleep(0.1)
    assert receive.getTimestamp() == stale
    assert receive.isConnected()
    twin.clear()
    wait_until(lambda: receive.getTimestamp() > stale)


def test_frozen_for_long_the_client_gives_up(twin, receive):
    twin.inject("freeze")
    wait_until(lambda: not receive.isConnected())


def test_delayed_measurements(twin, receive):
    def lateness():
        return twin.request("state")["controller_time"] - receive.getTimestamp()

    assert lateness() < 0.15
    twin.inject("delay", ms=400.0)
    wait_until(lambda: lateness() > 0.35)
    assert receive.isConnected()
    twin.clear("delay")
    wait_until(lambda: lateness() < 0.15)


def test_protective_stop(twin, control, receive):
    assert control.servoJ(receive.getActualQ(), *SERVO)
    twin.inject("protective_stop")
    wait_until(receive.isProtectiveStopped)
    wait_until(lambda: not control.isProgramRunning())
    assert not control.servoJ(receive.getActualQ(), *SERVO)
    assert receive.getSafetyMode() == 3

    def unlock(dashboard):
        assert dashboard.safetystatus() == "Safetystatus: PROTECTIVE_STOP"
        wait_until(lambda: unlocked(dashboard))

    with_dashboard(twin, unlock)
    wait_until(lambda: not receive.isProtectiveStopped())
    assert not control.servoJ(receive.getActualQ(), *SERVO)
    assert control.reuploadScript()
    wait_until(control.isProgramRunning)
    assert control.servoJ(receive.getActualQ(), *SERVO)


def test_protective_stop_stops_the_moving_arm(twin, control, receive):
    assert control.moveJ(list(np.add(receive.getActualQ(), [0.5, 0, 0, 0, 0, 0])), 1.0, 2.0, True)
    wait_until(lambda: twin.state()["arm_speed"] > 0.2)
    assert not control.triggerProtectiveStop()
    wait_until(lambda: twin.state()["arm_speed"] < 0.01)
    assert twin.state()["safety_mode"] == "PROTECTIVE_STOP"


def test_emergency_stop_takes_the_power_away(twin, control, receive):
    twin.inject("emergency_stop")
    wait_until(lambda: receive.isEmergencyStopped() and not control.isProgramRunning())
    assert receive.getRobotMode() == 3
    assert not control.servoJ(receive.getActualQ(), *SERVO)
    twin.clear()
    wait_until(lambda: not receive.isEmergencyStopped())
    with_dashboard(twin, lambda dashboard: recover(twin, dashboard))
    assert control.reuploadScript()
    wait_until(control.isProgramRunning)


def test_power_off(twin, control, receive):
    twin.inject("power_off")
    wait_until(lambda: receive.getRobotMode() == 3 and not control.isProgramRunning())  # told on two connections
    assert not control.servoJ(receive.getActualQ(), *SERVO)
    assert not receive.isEmergencyStopped()


def test_program_stopped_on_the_pendant(twin, control, receive):
    twin.inject("script_stop")
    wait_until(lambda: not control.isProgramRunning())
    assert not control.servoJ(receive.getActualQ(), *SERVO)
    assert receive.getSafetyMode() == 1


def test_local_control_refuses_a_new_client(twin):
    twin.inject("remote_control_off")
    with pytest.raises(RuntimeError, match="remote control"):
        rtde_control.RTDEControlInterface(twin.address, RATE)


def test_dashboard_gone(twin):
    twin.inject("dashboard_gone")
    with pytest.raises(RuntimeError, match="dashboard"):
        dashboard_client.DashboardClient(twin.address).connect(500)
    twin.clear()
    with_dashboard(twin, lambda dashboard: dashboard.robotmode())


def test_gripper_closes_and_opens(twin):
    with socket.create_connection((twin.address, ports.GRIPPER), timeout=5.0) as gripper:

        def ask(line):
            gripper.sendall(line.encode() + b"\n")
            return gripper.recv(100).decode().strip()

        assert ask("SET ACT 1") == "ack"
        wait_until(lambda: ask("GET STA") == "STA 3")
        assert ask("SET GTO 1 SPE 255 FOR 200 POS 255") == "ack"
        wait_until(lambda: ask("GET OBJ") == "OBJ 3")
        assert ask("GET POS") == "POS 230"
        assert twin.state()["joints"]["gripper"] == pytest.approx(1.0, abs=0.01)
        assert ask("SET POS 0") == "ack"
        wait_until(lambda: ask("GET POS") == "POS 3")


def test_a_twin_tells_when_its_address_is_taken(twin):
    with pytest.raises(TwinError, match="another twin"):
        TwinProcess(address=twin.address).start()


def test_nobody_there():
    with pytest.raises(TwinError, match=r"python -m env_door\.twin"):
        TwinClient(free_address()).state()


def test_it_dies_with_its_parent():
    address = free_address()
    code = (
        "import time; from env_door.twin import TwinProcess\n"
        f"with TwinProcess(address={address!r}) as twin: print(twin.pid, flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    pid = int(parent.stdout.readline())
    os.kill(parent.pid, signal.SIGKILL)
    parent.communicate()

    def gone():
        try:
            with open(f"/proc/{pid}/stat") as stat:
                return stat.read().split(") ")[1][0] == "Z"
        except FileNotFoundError:
            return True

    wait_until(gone)


@pytest.mark.parametrize(
    ("flag", "says"), [("--kind=lift", "choose one of"), ("--door_offset=1", "0.05"), ("--speed=1", "--speed")]
)
def test_wrong_flags_are_explained(flag, says):
    run = subprocess.run([sys.executable, "-m", "env_door.twin", flag], capture_output=True, text=True)
    assert run.returncode != 0
    assert says in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["push", "pull", "slide"])
def test_what_opens_the_door_in_the_environment_opens_it_through_the_client(twin, control, receive, kind):
    actions = demonstrate(DoorEnv(kind=kind, observation_size=16), kind, seed=5, num_steps=110).actions
    twin.reset(kind=kind, seed=5)
    with socket.create_connection((twin.address, ports.GRIPPER), timeout=5.0) as gripper:
        gripper.sendall(b"SET ACT 1 GTO 1 SPE 255 FOR 255 POS 0\n")
        time.sleep(1.2)
        target = actions[0][:6]
        for action in actions:
            gripper.sendall(f"SET POS {round(3 + 227 * float(action[6]))}\n".encode())
            start, target = target, action[:6]
            for part in np.arange(1, 13) / 12:
                period = control.initPeriod()
                assert control.servoJ(list(start + (target - start) * part), *SERVO)
                control.waitPeriod(period)
    state = twin.state()
    assert state["is_open"]
    assert state["attempts"] == [kind]
