import pytest

from env_door.twin import ports
from env_door.twin.gripper import GripperModel

STEP = 0.002


class Fingers:
    """Fingers that follow their target unless an object is between them."""

    def __init__(self, gripper, object_at=None):
        self.gripper, self.object_at, self.closure = gripper, object_at, 0.0

    def run(self, seconds):
        for _ in range(round(seconds / STEP)):
            self.gripper.step(self.closure, STEP)
            self.closure = self.gripper.target
            if self.object_at is not None:
                self.closure = min(self.closure, self.object_at)
        return self


@pytest.fixture
def active():
    gripper = GripperModel()
    gripper.set({"ACT": 1})
    Fingers(gripper).run(1.1)
    return gripper


def test_it_moves_once_it_is_activated_which_takes_a_moment():
    gripper = GripperModel()
    gripper.set({"GTO": 1, "SPE": 255, "POS": 255})
    assert Fingers(gripper).run(1.0).closure == 0.0
    assert (gripper.get("STA"), gripper.get("FLT")) == ("0", "7")
    gripper.set({"ACT": 1})
    for seconds, status in ((0.5, "1"), (0.6, "3")):
        Fingers(gripper).run(seconds)
        assert gripper.get("STA") == status


@pytest.mark.parametrize(("speed", "seconds"), [(255, 85 / 150), (0, 85 / 20)])
def test_closing_takes_the_time_of_the_real_gripper(active, speed, seconds):
    active.set({"GTO": 1, "SPE": speed, "FOR": 100, "POS": 255})
    fingers = Fingers(active).run(0.95 * seconds)
    assert active.get("OBJ") == "0"
    assert fingers.closure < 1.0
    fingers.run(0.05 * seconds + 0.1)
    assert (active.get("POS"), active.get("OBJ"), active.get("PRE")) == ("230", "3", "255")


def test_an_object_is_detected_and_squeezed(active):
    active.set({"GTO": 1, "SPE": 255, "FOR": 255, "POS": 255})
    Fingers(active, object_at=0.6).run(1.0)
    assert (active.get("OBJ"), active.get("POS")) == ("2", str(round(3 + 0.6 * 227)))
    assert active.target == pytest.approx(1.0)


@pytest.mark.parametrize("stop", [lambda active: active.set({"GTO": 0}), lambda active: active.fail(14)])
def test_without_goto_and_with_a_major_fault_it_stays(active, stop):
    active.set({"GTO": 1, "SPE": 255, "POS": 255})
    fingers = Fingers(active).run(0.2)
    stop(active)
    stopped_at = fingers.closure
    assert fingers.run(0.5).closure == pytest.approx(stopped_at, abs=0.01)


def test_a_major_fault_lasts_until_it_is_activated_again(active):
    active.fail(14)
    active.fail(0)
    assert active.get("FLT") == "14"
    for value in (0, 1):
        active.set({"ACT": value})
    Fingers(active).run(1.1)
    assert (active.get("FLT"), active.get("STA")) == ("0", "3")


def test_without_power_it_answers_with_question_marks_and_forgets_its_activation(active):
    active.switch_off()
    assert active.get("POS") == "?"
    active.switch_on(0.2)
    assert active.get("STA") == "0"


@pytest.mark.parametrize(
    ("request_line", "answer"),
    [
        ("GET POS", "POS 3\n"),
        ("GET STA", "STA 3\n"),
        ("SET POS 200 SPE 255 FOR 1 GTO 1", "ack"),
        ("SET POS 256", "?\n"),
        ("SET XXX 1", "?\n"),
        ("SET POS", "?\n"),
        ("SET POS nan", "?\n"),
        ("hello", "?\n"),
    ],
)
def test_requests_are_answered_as_by_the_urcap(active, request_line, answer):
    assert active.answer(request_line) == answer


def test_the_fingers_of_the_scene_close_and_open(twin, connect):
    client = connect(ports.GRIPPER)
    for request, reading, closure in (("GTO 1 SPE 255 FOR 200 POS 255", 230, 1.0), ("POS 0", 3, 0.0)):
        assert client.ask(f"SET ACT 1 {request}") == "ack"
        client.turn(1000)
        assert client.ask("GET POS") == f"POS {reading}\n"
        assert client.ask("GET OBJ") == "OBJ 3\n"
        assert twin.state()["joints"]["gripper"] == pytest.approx(closure, abs=0.01)


def test_the_socket_takes_split_and_joined_lines_and_can_be_made_to_fail(twin, connect):
    client = connect(ports.GRIPPER)
    client.put(b"GET P")
    client.turn()
    assert client.take() == ""
    client.put(b"OS\nGET STA\n")
    client.turn()
    assert client.take() == "POS 3\nSTA 0\n"
    twin.inject("gripper_garbage")
    garbage = client.ask("GET POS")
    assert garbage
    assert not garbage.startswith("POS")
    twin.inject("gripper_silent")
    assert client.ask("GET POS") == ""
