"""ur_rtde's control script, commanded through registers by a raw socket."""

import numpy as np
import pytest

from env_door.demonstration import demonstrate
from env_door.env import DoorEnv
from env_door.twin import ports

SERVO = (0.5, 0.5, 0.008, 0.1, 300.0)


@pytest.fixture
def script(connect, upload):
    upload()
    client = connect(ports.RTDE)
    names = ["input_int_register_0", *(f"input_double_register_{i}" for i in range(11))]
    client.exchange("I", ",".join(names).encode())
    assert client.twin.state()["program"] == "PLAYING"
    return client


def joints(twin):
    return np.array(list(twin.state()["joints"].values())[:6])


def test_servo_follows_and_an_interrupted_client_leaves_the_arm_at_its_last_target(twin, script):
    target = joints(twin) + 0.1
    script.command(11, *target, *SERVO)
    script.turn(2)
    script.socket.close()
    twin.turn(1500)
    np.testing.assert_allclose(joints(twin), target, atol=5e-3)


@pytest.mark.parametrize(
    "command",
    [(11, float("nan"), 0, 0, 0, 0, 0, *SERVO), (11, 0, float("inf"), 0, 0, 0, 0, *SERVO), (3,)],
    ids=["not a number", "infinite", "moveL, which is not emulated"],
)
def test_what_cannot_be_done_ends_the_program_rather_than_to_be_ignored(twin, script, command):
    script.command(*command)
    script.turn(3)
    assert twin.state()["program"] == "STOPPED"


def test_one_motion_at_a_time(twin, script):
    for command, arguments, program in ((11, SERVO, "PLAYING"), (1, (0.5, 0.5), "STOPPED")):
        script.command(command, *joints(twin), *arguments)
        script.turn(3)
        assert twin.state()["program"] == program


def test_other_programs_are_not_run(twin, upload):
    upload(name="something_else")
    assert twin.state()["program"] == "STOPPED"


def test_watchdog_ends_the_program_when_its_input_falls_silent(twin, script):
    script.command(35, 10.0)
    script.turn(3)
    assert twin.state()["watchdog"]
    for _ in range(10):
        script.command(0)
        script.turn(25)
    assert twin.state()["program"] == "PLAYING"
    script.turn(60)
    assert twin.state()["program"] == "STOPPED"
    assert not twin.state()["watchdog"]


@pytest.mark.parametrize("kind", ["push", "pull", "slide"])
def test_what_opens_the_door_in_the_environment_opens_it_through_the_protocols(twin, connect, script, kind):
    actions = demonstrate(DoorEnv(kind=kind, observation_size=16), kind, seed=5, num_steps=110).actions
    twin.reset(kind=kind, seed=5)
    gripper = connect(ports.GRIPPER)
    gripper.ask("SET ACT 1 GTO 1 SPE 255 FOR 255 POS 0")
    gripper.turn(600)
    target = actions[0][:6]
    for action in actions:
        gripper.put(f"SET POS {round(3 + 227 * float(action[6]))}\n".encode())
        start, target = target, action[:6]
        for part in np.arange(1, 13) / 12:
            script.command(11, *(start + (target - start) * part), *SERVO)
            script.turn(4)
    assert twin.state()["is_open"]
    assert twin.state()["attempts"] == [kind]
