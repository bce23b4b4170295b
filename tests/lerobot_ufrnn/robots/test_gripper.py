"""The gripper's side of the socket, played by a thread that does what the test says."""

import contextlib
import socket
import threading
import time
from types import SimpleNamespace

import pytest
from waiting import wait_until

from lerobot_ufrnn.robots.ur5e_robotiq import Fault, RobotFaultError, UR5eRobotiqConfig
from lerobot_ufrnn.robots.ur5e_robotiq import gripper as gripper_module
from lerobot_ufrnn.robots.ur5e_robotiq.gripper import RobotiqGripper


class FakeGripper:
    """Answers as the URCap does; moves at once."""

    def __init__(self, status: int = 3):
        self.values = {"STA": status, "FLT": 0, "POS": 3, "ACT": int(status == 3), "GTO": 0, "SPE": 0, "FOR": 0}
        self.commands: list[str] = []
        self.is_silent = False
        self.answer: str | None = None
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                while data := connection.recv(1024):
                    for line in data.decode().splitlines():
                        if not self.is_silent:
                            connection.sendall((self.answer or self._reply(line)).encode())

    def _reply(self, line: str) -> str:
        self.commands.append(line)
        verb, *words = line.split()
        if verb == "GET":
            return f"{words[0]} {self.values[words[0]]}"
        for name, value in zip(words[::2], words[1::2], strict=True):
            self.values[name] = int(value)
        if self.values["ACT"] == 1 and "ACT" in words:
            self.values["STA"] = 3
        return "ack"

    def close(self) -> None:
        self._listener.close()


@pytest.fixture
def connect(monkeypatch):
    """Connects to a fake gripper."""
    monkeypatch.setattr(gripper_module, "TIMEOUT", 0.3)
    open_ones = []

    def connect(server: FakeGripper, **settings) -> RobotiqGripper:
        gripper = RobotiqGripper(UR5eRobotiqConfig(ip="127.0.0.1", gripper_port=server.port, **settings))
        open_ones.extend([gripper.disconnect, server.close])
        gripper.connect()
        return gripper

    yield connect
    for close in open_ones:
        close()


def test_an_active_gripper_is_not_moved_by_connecting(connect):
    server = FakeGripper()
    gripper = connect(server, gripper_force=0.2, gripper_speed=1.0)
    assert gripper.closure == 0
    assert "SET GTO 1 SPE 255 FOR 51" in server.commands
    assert not any("ACT" in command for command in server.commands)
    time.sleep(0.15)
    assert not any(command.startswith("SET POS") for command in server.commands)


def test_a_gripper_that_is_not_active_is_activated_first(connect):
    server = FakeGripper(status=0)
    connect(server, gripper_force=0.2)
    assert server.commands.index("SET ACT 1 GTO 1") < server.commands.index("SET GTO 1 SPE 255 FOR 51")


@pytest.mark.parametrize(("closure", "position"), [(0.0, 3), (0.5, 116), (1.0, 230)])
def test_targets_and_readings_share_one_scale(connect, closure, position):
    server = FakeGripper()
    server.values["POS"] = 99
    gripper = connect(server)
    gripper.move_to(closure)
    wait_until(lambda: server.values["POS"] == position)
    wait_until(lambda: gripper.closure == pytest.approx(closure, abs=0.005))
    sent = [command for command in server.commands if command.startswith("SET POS")]
    assert sent == [f"SET POS {position}"]  # once, not at every poll


def test_a_reading_beyond_the_range_is_open_or_closed(connect):
    server = FakeGripper()
    gripper = connect(server)
    server.values["POS"] = 255
    wait_until(lambda: gripper.closure == 1.0)
    server.values["POS"] = 0
    wait_until(lambda: gripper.closure == 0.0)


def test_where_nobody_listens_there_is_no_gripper(connect):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        nobody = SimpleNamespace(port=listener.getsockname()[1], close=lambda: None)
    with pytest.raises(RobotFaultError, match="does not answer") as error:
        connect(nobody)
    assert error.value.fault is Fault.GRIPPER_SILENT


@pytest.mark.parametrize(
    ("breaks", "fault", "message"),
    [
        (lambda server: setattr(server, "is_silent", True), Fault.GRIPPER_SILENT, "does not answer"),
        (lambda server: server.values.update(FLT=11), Fault.GRIPPER_FAULT, "reports fault 11"),
        (lambda server: setattr(server, "answer", "?\x00%"), Fault.GRIPPER_SILENT, "does not answer .*it answered"),
    ],
)
@pytest.mark.parametrize("before", [True, False])
def test_what_breaks_before_or_while_connected_is_told(connect, breaks, fault, message, before):
    server = FakeGripper()
    if before:
        breaks(server)
        with pytest.raises(RobotFaultError, match=message) as error:
            connect(server)
        assert error.value.fault is fault
        return
    gripper = connect(server)
    breaks(server)
    with pytest.raises(RobotFaultError, match=message) as error:
        wait_until(lambda: gripper.closure < 0)
    assert error.value.fault is fault
    with pytest.raises(RobotFaultError, match=message):
        gripper.move_to(0.5)


def test_a_lesser_fault_only_says_that_it_is_not_ready(connect):
    server = FakeGripper()
    server.values["FLT"] = 5
    assert connect(server).closure == 0


def test_disconnecting_neither_opens_nor_closes(connect):
    server = FakeGripper()
    gripper = connect(server)
    gripper.move_to(0.7)
    wait_until(lambda: server.values["POS"] > 100)
    before = len([command for command in server.commands if command.startswith("SET")])
    gripper.disconnect()
    gripper.disconnect()
    assert len([command for command in server.commands if command.startswith("SET")]) == before
