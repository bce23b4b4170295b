"""Safety, power and the pendant, by the dashboard's lines."""

import pytest

from env_door.twin import ports


@pytest.fixture
def dashboard(connect):
    client = connect(ports.DASHBOARD)
    client.turn(2)
    assert client.take() == "Connected: Universal Robots Dashboard Server\n"
    return client


def check(dashboard, *dialogue):
    """Whether each command, followed by so many ticks, is answered so."""
    for command, answer, ticks in dialogue:
        assert dashboard.ask(command) == answer + "\n"
        dashboard.turn(ticks)


def test_protective_stop_waits_before_it_can_be_unlocked(twin, dashboard, upload):
    upload()
    twin.inject("protective_stop")
    assert dashboard.ask("unlock protective stop").startswith("Cannot unlock protective stop until 5s")
    check(
        dashboard,
        ("safetystatus", "Safetystatus: PROTECTIVE_STOP", 0),
        ("programState", "PAUSED <unnamed>", 500),
        ("unlock protective stop", "Protective stop releasing", 0),
        ("safetymode", "Safetymode: NORMAL", 0),
        # Unlocking moves nothing; a person may resume the program, or a client upload its own again.
        ("running", "Program running: false", 0),
        ("play", "Starting program", 0),
        ("running", "Program running: true", 0),
    )


@pytest.mark.parametrize(
    ("name", "status"),
    [
        ("safeguard_stop", "SAFEGUARD_STOP"),
        ("recovery_mode", "RECOVERY"),
        ("safety_violation", "VIOLATION"),
    ],
)
def test_other_stops_end_by_themselves_and_leave_the_program_paused(twin, dashboard, upload, name, status):
    upload()
    twin.inject(name)
    check(dashboard, ("safetystatus", f"Safetystatus: {status}", 0), ("programState", "PAUSED <unnamed>", 0))
    twin.inject("emergency_stop")
    twin.turn()
    twin._loop.run_until_complete(twin.clear(name))  # which has been replaced
    check(dashboard, ("safetystatus", "Safetystatus: ROBOT_EMERGENCY_STOP", 0))


def test_power_comes_back_step_by_step(twin, connect, dashboard):
    twin.inject("emergency_stop")
    check(dashboard, ("robotmode", "Robotmode: POWER_OFF", 0), ("power on", "Powering on", 200))
    check(dashboard, ("robotmode", "Robotmode: POWER_OFF", 0))
    connect(ports.TWIN).ask('{"do": "clear"}')
    check(dashboard, ("power on", "Powering on", 200), ("robotmode", "Robotmode: IDLE", 0))
    check(dashboard, ("brake release", "Brake releasing", 200), ("robotmode", "Robotmode: RUNNING", 0))


def test_local_control_refuses_programs_and_commands(twin, dashboard, upload):
    twin.inject("remote_control_off")
    check(dashboard, ("is in remote control", "false", 0), ("power off", "Failed to execute: power off", 0))
    upload()
    assert twin.state()["program"] == "STOPPED"


def test_a_blocked_arm_makes_a_protective_stop(twin):
    # Nothing touches the arm itself in the scene: its target is taken away instead.
    twin.controller.motion.hold(twin.door.joints + 1.0)
    twin.turn(20)
    assert twin.state()["safety_mode"] == "PROTECTIVE_STOP"
    assert twin.state()["motion"] == "hold"
