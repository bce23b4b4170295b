"""Safety, power and the pendant, by the dashboard's lines."""

import pytest

from env_door.twin import ports


@pytest.fixture
def dashboard(connect):
    client = connect(ports.DASHBOARD)
    client.turn(2)
    assert client.take() == "Connected: Universal Robots Dashboard Server\n"
    return client


def test_protective_stop_waits_before_it_can_be_unlocked(twin, dashboard, upload):
    upload()
    twin.injections.start("protective_stop")
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


def test_power_comes_back_step_by_step(twin, dashboard, requests):
    twin.injections.start("emergency_stop")
    assert dashboard.ask("robotmode") == "Robotmode: POWER_OFF\n"
    dashboard.ask("power on")
    dashboard.turn(200)
    assert dashboard.ask("robotmode") == "Robotmode: POWER_OFF\n"
    requests.ask('{"do": "clear"}')
    for command, answer, mode in (
        ("power on", "Powering on\n", "IDLE"),
        ("brake release", "Brake releasing\n", "RUNNING"),
    ):
        assert dashboard.ask(command) == answer
        dashboard.turn(200)
        assert dashboard.ask("robotmode") == f"Robotmode: {mode}\n"


def test_local_control_refuses_programs_and_commands(twin, dashboard, upload):
    twin.injections.start("remote_control_off")
    assert dashboard.ask("is in remote control") == "false\n"
    assert dashboard.ask("power off") == "Failed to execute: power off\n"
    upload()
    assert twin.state()["program"] == "STOPPED"


def test_the_pendant_says_what_it_does_not_understand_and_says_goodbye(dashboard):
    assert dashboard.ask("Dance!") == "could not understand: 'Dance!'\n"
    dashboard.put(b"quit\n")
    assert not dashboard.turn(2)
    assert dashboard.take() == "Disconnected\n"


def test_a_blocked_arm_makes_a_protective_stop(twin):
    # Nothing touches the arm itself in the scene: its target is taken away instead.
    twin.controller.motion.hold(twin.door.joints + 1.0)
    twin.turn(20)
    assert twin.state()["safety_mode"] == "PROTECTIVE_STOP"
    assert twin.state()["motion"] == "hold"
