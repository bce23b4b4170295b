"""What the controller is asked before it is commanded, and how its program is ended: played by threads."""

import contextlib
import logging
import re
import socket
import struct
import threading
import time

import pytest

from lerobot_ufrnn.robots.ur5e_robotiq import Fault, RobotFaultError
from lerobot_ufrnn.robots.ur5e_robotiq import controller as controller_module
from lerobot_ufrnn.robots.ur5e_robotiq.controller import DASHBOARD_PORT, RTDE_PORT, check_version, end_program
from lerobot_ufrnn.robots.ur5e_robotiq.faults import SAFETY_MODES, safety_fault

ADDRESS = "127.0.0.11"


@pytest.fixture
def serve():
    """Serves one client of a port, with a function of its connection."""
    listeners = []

    def serve(port, talk):
        listener = socket.create_server((ADDRESS, port))
        listeners.append(listener)

        def accept():
            with contextlib.suppress(OSError):
                talk(listener.accept()[0])

        threading.Thread(target=accept, daemon=True).start()

    yield serve
    for listener in listeners:
        listener.close()


def rtde(version):
    """A controller of a version, which sends a message in between."""

    def talk(connection):
        assert connection.recv(100) == b"\x00\x05V\x00\x02"
        connection.sendall(b"\x00\x05M!!" + b"\x00\x04V" + b"\x01")
        assert connection.recv(100) == b"\x00\x03v"
        connection.sendall(b"\x00\x13v" + struct.pack(">4I", *version))

    return talk


@pytest.mark.parametrize("version", [(5, 11, 0, 1), (5, 25, 1, 0)])
def test_a_controller_that_is_known_is_taken(serve, version):
    serve(RTDE_PORT, rtde(version))
    check_version(ADDRESS)


@pytest.mark.parametrize(
    ("version", "says"),
    [
        ((3, 15, 8, 0), r"is 3\.15\.8, .*PolyScope 5 from 5\.11 on"),
        ((5, 10, 2, 0), r"is 5\.10\.2,"),
        ((10, 7, 0, 0), r"\(PolyScope X\)"),
    ],
)
def test_a_controller_that_is_not_known_is_refused_with_its_version(serve, version, says):
    serve(RTDE_PORT, rtde(version))
    with pytest.raises(RobotFaultError, match=says) as told:
        check_version(ADDRESS)
    assert told.value.fault is Fault.CONTROLLER_VERSION


@pytest.mark.parametrize("talk", [lambda connection: time.sleep(5), lambda connection: connection.close()])
def test_a_port_that_is_silent_or_hangs_up_is_told_soon(serve, monkeypatch, talk):
    monkeypatch.setattr(controller_module, "TIMEOUT", 0.2)
    serve(RTDE_PORT, talk)
    begin = time.monotonic()
    with pytest.raises(RobotFaultError, match=f"port {RTDE_PORT}") as told:
        check_version(ADDRESS)
    assert told.value.fault is Fault.LINK_LOST
    assert time.monotonic() - begin < 2.0


def dashboard(answers, heard):
    """A dashboard that answers commands so, the last answers again and again."""

    def talk(connection):
        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
        for line in connection.makefile("rb"):
            command = line.decode().strip()
            heard.append(command)
            mine = answers[command]
            connection.sendall((mine.pop(0) if len(mine) > 1 else mine[0]).encode() + b"\n")

    return talk


@pytest.mark.parametrize(
    ("running", "says"),
    [
        (["true", "true", "false"], None),
        (["false"], None),
        (["true"], "runs on after 'stop'.*'Failed to execute: stop'"),
    ],
)
def test_a_program_is_ended_and_what_runs_on_is_told(serve, monkeypatch, caplog, running, says):
    monkeypatch.setattr(controller_module, "END_SECONDS", 0.2)
    heard: list[str] = []
    answers = {"stop": ["Failed to execute: stop"], "running": [f"Program running: {one}" for one in running]}
    serve(DASHBOARD_PORT, dashboard(answers, heard))
    caplog.set_level(logging.WARNING)
    end_program(ADDRESS)
    assert heard[0] == "stop"
    assert bool(caplog.records) == bool(says)
    assert says is None or re.search(says, caplog.text)


def test_without_a_dashboard_the_operator_is_sent_to_the_pendant(caplog):
    end_program(ADDRESS)
    assert "See on the pendant that no program runs" in caplog.text


def test_each_reason_why_an_arm_may_not_move_has_a_name_of_its_own():
    stops = {mode: safety_fault(name) for mode, name in SAFETY_MODES.items()}
    assert {mode: stop and stop.fault for mode, stop in stops.items()} == {
        1: None,
        2: None,
        3: Fault.PROTECTIVE_STOP,
        4: Fault.RECOVERY_MODE,
        5: Fault.SAFEGUARD_STOP,
        6: Fault.EMERGENCY_STOP,
        7: Fault.EMERGENCY_STOP,
        8: Fault.SAFETY_VIOLATION,
        9: Fault.SAFETY_VIOLATION,
    }
    assert safety_fault("11").fault is Fault.SAFETY_VIOLATION
