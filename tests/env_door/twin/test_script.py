"""ur_rtde's control script, commanded through registers by a raw socket."""

import numpy as np
import pytest

INPUTS = ["input_int_register_0", *(f"input_double_register_{i}" for i in range(11))]
SERVO = (0.5, 0.5, 0.008, 0.1, 300.0)


@pytest.fixture
def script(rtde, upload):
    upload()
    rtde.inputs(*INPUTS)
    return rtde


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
    assert twin.state()["program"] == "PLAYING"
    script.command(*command)
    script.turn(3)
    assert twin.state()["program"] == "STOPPED"


def test_one_motion_at_a_time(twin, script):
    script.command(11, *joints(twin), *SERVO)
    script.turn(3)
    assert twin.state()["program"] == "PLAYING"
    script.command(1, *joints(twin), 0.5, 0.5)
    script.turn(3)
    assert twin.state()["program"] == "STOPPED"


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
