"""The gripper's side of the socket, played by a thread that does what the test says."""

import socket
import time
from types import SimpleNamespace

import pytest
from teleoperators_fakes import FakeGripper
from waiting import wait_until

from lerobot_ufrnn.robots.ur5e_robotiq import Fault, RobotFaultError, UR5eRobotiqConfig
from lerobot_ufrnn.robots.ur5e_robotiq import gripper as gripper_module
from lerobot_ufrnn.robots.ur5e_robotiq.gripper import RobotiqGripper, ask


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
    assert connect(server, gripper_force=0.2, gripper_speed=1.0).closure == 0
    time.sleep(0.15)
    assert server.sets() == ["SET GTO 1 SPE 255 FOR 51"]


def test_a_gripper_that_is_not_active_is_activated_first(connect):
    server = FakeGripper(STA=0, ACT=0)
    connect(server, gripper_force=0.2)
    assert server.sets() == ["SET ACT 0", "SET ACT 1 GTO 1", "SET GTO 1 SPE 255 FOR 51"]


@pytest.mark.parametrize(("closure", "position"), [(0.0, 3), (0.5, 116), (1.0, 230)])
def test_targets_and_readings_share_one_scale(connect, closure, position):
    server = FakeGripper(POS=99)
    gripper = connect(server)
    gripper.move_to(closure)
    wait_until(lambda: gripper.closure == pytest.approx(closure, abs=0.005))
    assert server.sets("POS") == [f"SET POS {position}"]  # once, not at every poll


def test_a_reading_beyond_the_range_is_open_or_closed(connect):
    server = FakeGripper()
    gripper = connect(server)
    for reading, closure in ((255, 1.0), (0, 0.0)):
        server.values["POS"] = reading
        wait_until(lambda closure=closure: gripper.closure == closure)


def test_where_nobody_listens_there_is_no_gripper(connect):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        nobody = SimpleNamespace(port=listener.getsockname()[1], close=lambda: None)
    with pytest.raises(RobotFaultError, match="does not answer") as error:
        connect(nobody)
    assert error.value.fault is Fault.GRIPPER_SILENT


@pytest.mark.parametrize(
    ("breaks", "fault", "message"),
    [
        (lambda server: setattr(server, "answer", b""), Fault.GRIPPER_SILENT, "does not answer"),
        (lambda server: server.values.update(FLT=11), Fault.GRIPPER_FAULT, "reports fault 11"),
        (lambda server: setattr(server, "answer", b"?\x00%"), Fault.GRIPPER_SILENT, "does not answer .*it answered"),
    ],
)
@pytest.mark.parametrize("before", [True, False])
def test_what_breaks_before_or_while_connected_is_told(connect, breaks, fault, message, before):
    server = FakeGripper()
    gripper = None if before else connect(server)
    breaks(server)
    with pytest.raises(RobotFaultError, match=message) as error:
        connect(server) if before else wait_until(lambda: gripper.closure < 0)
    assert error.value.fault is fault
    if gripper:
        with pytest.raises(RobotFaultError, match=message):
            gripper.move_to(0.5)


@pytest.mark.parametrize("waiting", [5, 7])
def test_a_fault_that_only_waits_for_activation_is_ended_by_it(connect, waiting):
    server = FakeGripper(FLT=waiting)
    assert connect(server).closure == 0
    assert server.sets("ACT") == ["SET ACT 0", "SET ACT 1 GTO 1"]


@pytest.mark.parametrize("lost", [{"STA": 0, "ACT": 0}, {"FLT": 5}, {"FLT": 7}])
def test_an_activation_that_is_lost_while_connected_is_told(connect, lost):
    server = FakeGripper()
    gripper = connect(server)
    server.values.update(lost)
    with pytest.raises(RobotFaultError, match="lost its activation") as told:
        wait_until(lambda: gripper.closure < 0)
    assert told.value.fault is Fault.GRIPPER_NOT_ACTIVE
    assert "connect again" in str(told.value)


def test_a_position_that_is_too_old_is_not_passed_off_as_measured(connect, monkeypatch):
    gripper = connect(FakeGripper())
    wait_until(lambda: gripper.closure == 0)
    monkeypatch.setattr(gripper_module, "MAX_AGE", 0.0)
    with pytest.raises(RobotFaultError, match=r"position is .* s old") as told:
        wait_until(lambda: gripper.closure < 0)
    assert told.value.fault is Fault.GRIPPER_SILENT


def test_a_position_that_grew_old_while_the_program_was_held_up_is_replaced(connect):
    server = FakeGripper()
    gripper = connect(server)
    server.values["POS"] = 230
    gripper._asked -= 10.0
    gripper._position = 3
    assert gripper.closure == 1.0


class Pieces:
    """A connection on which an answer comes in so many pieces."""

    def __init__(self, *pieces: bytes):
        self._pieces = list(pieces)

    def sendall(self, data):
        assert data.endswith(b"\n")

    def gettimeout(self):
        return 0.3

    def settimeout(self, seconds):
        pass

    def recv(self, size):
        if not self._pieces:
            raise TimeoutError("timed out")
        return self._pieces.pop(0)


@pytest.mark.parametrize(
    "pieces", [(b"POS 116",), (b"POS 116\n",), (b"PO", b"S 116\n"), (b"POS 1", b"16"), (b"POS", b" 1", b"16\r\n")]
)
def test_an_answer_may_come_in_pieces(pieces):
    assert ask(Pieces(*pieces), "GET POS", r"POS\s+(\d+)") == "116"


@pytest.mark.parametrize("pieces", [(b"PO",), (b"PO", b""), (b"?\n",), (b"POS 1x",)])
def test_what_is_no_answer_is_quoted(pieces):
    with pytest.raises(ConnectionError, match=pieces[0].decode().strip().replace("?", r"\?")):
        ask(Pieces(*pieces), "GET POS", r"POS\s+(\d+)")


def test_disconnecting_neither_opens_nor_closes(connect):
    server = FakeGripper()
    gripper = connect(server)
    gripper.move_to(0.7)
    wait_until(lambda: server.values["POS"] > 100)
    before = server.sets()
    gripper.disconnect()
    gripper.disconnect()
    assert server.sets() == before
