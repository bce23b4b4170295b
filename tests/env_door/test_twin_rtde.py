"""The protocols from the outside, by raw sockets, on a twin whose clock the test turns."""

import socket
import struct

import numpy as np
import pytest

from env_door.env import DoorEnv
from env_door.twin import free_address, ports
from env_door.twin.configuration import TwinConfig
from env_door.twin.twin import Twin

SERVO_INPUTS = ["input_int_register_0", *(f"input_double_register_{i}" for i in range(11))]


@pytest.fixture
def twin():
    made = Twin(TwinConfig(address=free_address(), kind="pull", seed=5, camera=False, unlock_seconds=1.0))
    yield made
    made.close()


class Client:
    """A socket beside a twin in the same thread: waiting for an answer turns the twin's clock."""

    def __init__(self, twin, port):
        self.twin = twin
        self.socket = socket.create_connection((twin.hub.address, port))
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.received = b""

    def turn(self, ticks=1):
        for _ in range(ticks):
            self.twin.hub.poll(0)
            self.twin.tick()
        self.twin.hub.poll(0)
        try:
            while data := self.socket.recv(65536):
                self.received += data
        except BlockingIOError:
            return True
        except ConnectionError:
            return False
        return False

    def put(self, data):
        self.socket.sendall(data)
        self.twin.hub.poll(1.0)  # returns as soon as it has arrived

    def ask(self, text):
        self.put(text.encode() + b"\n")
        self.turn(2)
        answer, self.received = self.received.decode(), b""
        return answer

    def send(self, kind, body=b""):
        self.put(struct.pack(">HB", 3 + len(body), ord(kind)) + body)

    def packages(self):
        found = []
        while len(self.received) >= 3:
            size, kind = struct.unpack_from(">HB", self.received)
            if len(self.received) < size:
                break
            found.append((chr(kind), self.received[3:size]))
            self.received = self.received[size:]
        return found

    def exchange(self, kind, body=b""):
        self.send(kind, body)
        self.turn(2)
        return next(answer for name, answer in self.packages() if name == kind)

    def set_up_outputs(self, names, frequency=125.0):
        return self.exchange("O", struct.pack(">d", frequency) + ",".join(names).encode())

    def set_up_inputs(self, names):
        return self.exchange("I", ",".join(names).encode())


@pytest.fixture
def rtde(twin):
    client = Client(twin, ports.RTDE)
    assert client.exchange("V", struct.pack(">H", 2)) == b"\x01"
    return client


@pytest.fixture
def dashboard(twin):
    client = Client(twin, ports.DASHBOARD)
    client.turn(2)
    assert client.received == b"Connected: Universal Robots Dashboard Server\n"
    client.received = b""
    return client


def upload(twin, name="rtde_control"):
    client = Client(twin, ports.SCRIPT[-1])
    source = f"def {name}():\n    global reg_offset_int = # int register offset\n0\n    end\n"
    client.put(source.encode())
    client.turn(20)
    assert twin.state()["program"] == "STOPPED"
    client.put(b"end\n")
    client.turn(20)


def command(rtde, number, *values):
    arguments = [*values, *[0.0] * (11 - len(values))]
    rtde.send("U", struct.pack(">Bi11d", 1, number, *arguments))


def test_other_protocol_versions_are_refused(twin):
    assert Client(twin, ports.RTDE).exchange("V", struct.pack(">H", 1)) == b"\x00"


def test_measurements_are_those_of_the_scene_at_the_rate_asked_for(twin, rtde):
    env = DoorEnv(kind="pull")
    env.reset(seed=5)
    assert rtde.set_up_outputs(["timestamp", "actual_q", "runtime_state"]) == b"\x01DOUBLE,VECTOR6D,UINT32"
    assert rtde.exchange("S") == b"\x01"
    rtde.packages()
    rtde.turn(40)
    packages = [struct.unpack(">B7dI", body) for kind, body in rtde.packages() if kind == "U"]
    assert len(packages) == 10
    np.testing.assert_allclose(np.diff([package[1] for package in packages]), 0.008, atol=1e-9)
    np.testing.assert_allclose(packages[-1][2:8], env.measured_joints()[:6], atol=1e-3)
    assert packages[-1][8] == 1
    assert rtde.exchange("P") == b"\x01"
    rtde.turn(20)
    assert not rtde.packages()


def test_an_unknown_variable_is_named_and_nothing_starts(rtde):
    assert rtde.set_up_outputs(["timestamp", "nonsense"]) == b"\x00DOUBLE,NOT_FOUND"
    assert rtde.exchange("S") == b"\x00"


def test_inputs_belong_to_one_client_until_it_leaves(twin, rtde):
    assert rtde.set_up_inputs(SERVO_INPUTS)[:1] == b"\x01"
    assert rtde.set_up_inputs(SERVO_INPUTS[:1])[:1] == b"\x02"
    other = Client(twin, ports.RTDE)
    assert other.set_up_inputs(SERVO_INPUTS[:2]) == b"\x00IN_USE,IN_USE"
    rtde.socket.close()
    other.turn(2)
    assert other.set_up_inputs(SERVO_INPUTS[:2]) == b"\x01INT32,DOUBLE"


@pytest.mark.parametrize(
    "package",
    [b"\x00\x02U", b"\x00\x03U", b"\x00\x04U\x07", b"\x00\x05U\x01\x00", b"\x00\x04O\x00", b"\x00\x04I\xff"],
    ids=["short header", "empty", "unknown recipe", "short data", "short recipe", "no text"],
)
def test_malformed_packages_end_the_connection_and_nothing_else(twin, rtde, package):
    rtde.set_up_inputs(SERVO_INPUTS)
    rtde.put(package)
    assert not rtde.turn(3)
    assert Client(twin, ports.RTDE).exchange("V", struct.pack(">H", 2)) == b"\x01"


def test_servo_follows_and_an_interrupted_client_leaves_the_arm_at_its_last_target(twin, rtde):
    upload(twin)
    rtde.set_up_inputs(SERVO_INPUTS)
    target = np.array(list(twin.state()["joints"].values())[:6]) + 0.1
    command(rtde, 11, *target, 0.5, 0.5, 0.008, 0.1, 300.0)
    rtde.turn(2)
    rtde.socket.close()
    for _ in range(1500):
        twin.hub.poll(0)
        twin.tick()
    np.testing.assert_allclose(list(twin.state()["joints"].values())[:6], target, atol=5e-3)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_target_that_is_not_finite_ends_the_program(twin, rtde, bad):
    upload(twin)
    rtde.set_up_inputs(SERVO_INPUTS)
    command(rtde, 11, bad, 0, 0, 0, 0, 0, 0.5, 0.5, 0.008, 0.1, 300.0)
    rtde.turn(3)
    assert twin.state()["program"] == "STOPPED"


def test_a_command_that_is_not_emulated_ends_the_program_rather_than_to_do_nothing(twin, rtde):
    upload(twin)
    rtde.set_up_inputs(SERVO_INPUTS)
    command(rtde, 3)  # moveL
    rtde.turn(3)
    assert twin.state()["program"] == "STOPPED"


def test_one_motion_at_a_time(twin, rtde):
    upload(twin)
    rtde.set_up_inputs(SERVO_INPUTS)
    joints = list(twin.state()["joints"].values())[:6]
    command(rtde, 11, *joints, 0.5, 0.5, 0.008, 0.1, 300.0)
    rtde.turn(3)
    command(rtde, 1, *joints, 0.5, 0.5)
    rtde.turn(3)
    assert twin.state()["program"] == "STOPPED"


def test_other_programs_are_not_run(twin):
    upload(twin, name="something_else")
    assert twin.state()["program"] == "STOPPED"


def test_watchdog_ends_the_program_when_its_input_falls_silent(twin, rtde):
    upload(twin)
    rtde.set_up_inputs(SERVO_INPUTS)
    command(rtde, 35, 10.0)
    rtde.turn(3)
    assert twin.state()["watchdog"]
    for _ in range(10):
        command(rtde, 0)
        rtde.turn(25)
    assert twin.state()["program"] == "PLAYING"
    rtde.turn(60)
    assert twin.state()["program"] == "STOPPED"
    assert not twin.state()["watchdog"]


def test_protective_stop_waits_before_it_can_be_unlocked(twin, dashboard):
    upload(twin)
    twin.faults.start("protective_stop", {})
    assert dashboard.ask("safetystatus") == "Safetystatus: PROTECTIVE_STOP\n"
    assert dashboard.ask("programState") == "PAUSED <unnamed>\n"
    assert dashboard.ask("unlock protective stop").startswith("Cannot unlock protective stop until 5s")
    dashboard.turn(500)
    assert dashboard.ask("unlock protective stop") == "Protective stop releasing\n"
    assert dashboard.ask("safetymode") == "Safetymode: NORMAL\n"
    # Unlocking moves nothing; a person may resume the program, or a client upload its own again.
    assert dashboard.ask("running") == "Program running: false\n"
    assert dashboard.ask("play") == "Starting program\n"
    assert dashboard.ask("running") == "Program running: true\n"


def test_somebody_holds_the_door_for_a_while(twin):
    client = Client(twin, ports.CONTROL)
    assert client.ask('{"do": "hold", "seconds": 0.1}') == '{"ok": true}\n'
    assert twin.state()["held"]
    client.turn(50)
    assert not twin.state()["held"]


def test_power_comes_back_step_by_step(twin, dashboard):
    twin.faults.start("emergency_stop", {})
    assert dashboard.ask("robotmode") == "Robotmode: POWER_OFF\n"
    dashboard.ask("power on")
    dashboard.turn(200)
    assert dashboard.ask("robotmode") == "Robotmode: POWER_OFF\n"
    twin.faults.clear(None)
    assert dashboard.ask("power on") == "Powering on\n"
    dashboard.turn(200)
    assert dashboard.ask("robotmode") == "Robotmode: IDLE\n"
    assert dashboard.ask("brake release") == "Brake releasing\n"
    dashboard.turn(200)
    assert dashboard.ask("robotmode") == "Robotmode: RUNNING\n"


def test_local_control_refuses_programs_and_commands(twin, dashboard):
    twin.faults.start("remote_control_off", {})
    assert dashboard.ask("is in remote control") == "false\n"
    assert dashboard.ask("power off") == "Failed to execute: power off\n"
    upload(twin)
    assert twin.state()["program"] == "STOPPED"


def test_a_blocked_arm_makes_a_protective_stop(twin):
    # Nothing touches the arm itself in the scene: its target is taken away instead.
    twin.controller.motion.hold(twin.door.joints + 1.0)
    for _ in range(20):
        twin.tick()
    assert twin.state()["safety_mode"] == "PROTECTIVE_STOP"
    assert twin.state()["motion"] == "hold"


@pytest.mark.parametrize("kind", ["push", "pull", "slide"])
def test_trials_are_those_of_the_environment(twin, kind):
    env = DoorEnv(kind=kind)
    env.reset(seed=11)
    state = twin.reset(kind=kind, seed=11)
    np.testing.assert_array_equal(list(state["joints"].values()), env.measured_joints())
    assert state["kind"] == kind
    assert not state["attempts"]


def test_a_new_trial_can_leave_the_arm_where_it_is(twin):
    before = twin.state()["joints"]
    assert twin.reset(seed=99, keep_arm=True)["joints"] == before
    assert twin.reset(seed=99)["joints"] != before


@pytest.mark.parametrize(
    ("request_line", "says"),
    [
        ("nonsense", "Expecting value"),
        ('{"do": "dance"}', "must be"),
        ('{"do": "reset", "kind": "lift"}', "choose one of"),
        ('{"do": "reset", "seed": -1}', "not negative"),
        ('{"do": "hold", "seconds": -1}', "negative"),
        ('{"do": "fault", "name": "rain"}', "drop_link"),
        ('{"do": "fault", "name": "delay"}', "parameters are ['ms']"),
        ('{"do": "fault", "name": "delay", "ms": -5}', "above 0"),
        ('{"do": "fault", "name": "camera_black"}', "no camera"),
        ('{"do": "clear", "name": "script_stop"}', "uploads its script"),
    ],
)
def test_twin_control_says_what_is_wrong(twin, request_line, says):
    client = Client(twin, ports.CONTROL)
    answer = client.ask(request_line)
    assert '"ok": false' in answer
    assert says in answer
    assert '"ok": true' in client.ask('{"do": "state"}')
