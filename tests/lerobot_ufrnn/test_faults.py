"""What is measured when something fails, what counts as a failure, and two faults from end to end."""

import json
import os
import shutil
import signal
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from small import make_dataset

from env_door.twin.faults import Faults
from lerobot_ufrnn.analysis.fault_table import Outcome, Sample, moves_again, standstill, to_markdown, travel
from lerobot_ufrnn.commands import faults, main
from lerobot_ufrnn.commands.injection import FAULTS
from lerobot_ufrnn.commands.recorded import readable_episodes
from lerobot_ufrnn.commands.stock import StockCommand, describe_failure, last_error
from lerobot_ufrnn.robots.ur5e_robotiq.orderly_end import OrderlyEnd

# ── Speeds ────────────────────────────────────────────────────────────


def braking(stops_at: float, end: float = 3.0, again: tuple[float, float] = (9.0, 9.0)) -> list[Sample]:
    """An arm whose elbow turns at 0.4 rad/s until `stops_at`, and once more between the two moments `again`.

    A hundred samples a second; the elbow's angle is the exact integral of its speed.
    """

    def angle(time):
        return 0.4 * (min(time, stops_at) + max(0.0, min(time, again[1]) - again[0]))

    def speed(time):
        return 0.4 if time < stops_at or again[0] <= time < again[1] else 0.001

    times = [number / 100 for number in range(round(100 * end) + 1)]
    return [Sample(time, speed(time), (0.5, angle(time))) for time in times]


def test_a_standstill_is_counted_from_the_fault_to_the_first_moment_of_rest():
    samples = braking(stops_at=1.25)
    assert standstill(samples, 1.0) == pytest.approx(0.25)
    assert travel(samples, 1.0, 0.25) == pytest.approx(0.4 * 0.25)
    assert not moves_again(samples, 1.0)


def test_an_arm_that_already_stood_stands_at_once():
    assert standstill(braking(stops_at=0.5), 1.0) == pytest.approx(0.0)
    assert travel(braking(stops_at=0.5), 1.0, None) == pytest.approx(0.0)


def test_a_moment_of_rest_is_no_standstill():
    samples = braking(stops_at=1.2, again=(1.6, 2.0))
    assert standstill(samples, 1.0) == pytest.approx(1.0)
    assert travel(samples, 1.0, None) == pytest.approx(0.4 * (0.2 + 0.4))
    assert not moves_again(samples, 1.0)


def test_an_arm_that_goes_on_or_stands_too_briefly_to_tell_has_no_standstill():
    assert standstill(braking(stops_at=99.0), 1.0) is None
    assert standstill(braking(stops_at=2.8), 1.0) is None
    assert not moves_again(braking(stops_at=99.0), 1.0)
    assert standstill([], 1.0) is None


def test_what_moves_after_a_standstill_moves_again():
    samples = braking(stops_at=1.2, again=(2.2, 2.4))
    assert standstill(samples, 1.0) == pytest.approx(0.2)
    assert moves_again(samples, 1.0)


def test_travel_goes_by_the_farthest_joint_in_either_direction_and_within_the_time():
    samples = [Sample(0.0, 1.0, (0.0, 0.0)), Sample(1.0, 1.0, (0.1, -0.3)), Sample(2.0, 1.0, (0.9, 0.0))]
    assert travel(samples, 0.0, 1.0) == pytest.approx(0.3)
    assert travel(samples, 0.0, None) == pytest.approx(0.9)
    assert travel(samples, 5.0, None) == 0.0


# ── Verdicts ──────────────────────────────────────────────────────────

STOPPED = Outcome(
    fault="drop_link",
    must_stop=True,
    may_resume=False,
    may_die_of=0,
    may_lose=False,
    speed=0.2,
    standstill=0.31,
    moved_again=False,
    travel=0.0456,
    ended=2.84,
    status=1,
    told="RobotFaultError: the link | broke",
    still_when_cleared=True,
    left_running=(),
    episodes=(58,),
)
UNNOTICED = replace(STOPPED, fault="dashboard_gone", must_stop=False, status=0, told="", episodes=(60, 60))


def test_a_fault_that_stops_the_arm_is_in_order():
    assert STOPPED.problems() == []
    assert STOPPED.verdict == "stopped"


def test_a_fault_that_need_not_stop_the_arm_may_go_unnoticed_and_may_be_noticed():
    assert (UNNOTICED.problems(), UNNOTICED.verdict) == ([], "went on, not noticed")
    assert replace(UNNOTICED, status=1).verdict == "stopped"


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"standstill": None}, "moved on"),
        ({"standstill": 3.5}, "moved on"),
        ({"moved_again": True}, "moved again"),
        ({"status": 0}, "nobody was told"),
        ({"ended": None, "status": None}, "hung"),
        ({"status": -signal.SIGABRT}, "crashed (SIGABRT)"),
        ({"status": -signal.SIGSEGV, "may_die_of": signal.SIGINT}, "crashed (SIGSEGV)"),
        ({"left_running": ("servo",)}, "left running: servo"),
        ({"still_when_cleared": False}, "moved when the fault was cleared"),
        ({"episodes": ()}, "recorded episode lost"),
        ({"episodes": (0,)}, "recorded episode lost"),
    ],
)
def test_what_must_not_be_is_said(changes, problem):
    outcome = replace(STOPPED, **changes)
    assert problem in " ".join(outcome.problems())
    assert "FAILED" in outcome.verdict
    assert problem in outcome.verdict


def test_what_a_fault_allows_is_no_problem_but_is_said():
    assert replace(STOPPED, status=-signal.SIGINT, may_die_of=signal.SIGINT).verdict == "stopped"
    killed = replace(STOPPED, status=-signal.SIGKILL, may_die_of=signal.SIGKILL, may_lose=True, episodes=())
    assert (killed.problems(), killed.verdict) == ([], "stopped; the recording cannot be read")
    paused = replace(STOPPED, may_resume=True, moved_again=True, status=0, episodes=(60, 40))
    assert (paused.problems(), paused.verdict) == ([], "stopped, then went on")


def test_a_row_has_what_was_measured():
    header, line, stopped, unnoticed = to_markdown([STOPPED, UNNOTICED]).splitlines()
    assert header.count("|") == line.count("|") == unnoticed.count("|")
    assert stopped == (
        "| drop_link | 0.20 | 0.31 | 0.046 | 2.8 | 1 | RobotFaultError: the link \\| broke | at rest | 1 (58) "
        "| stopped |"
    )
    # The arm stood when the recording was over, which says nothing of the fault.
    assert (
        unnoticed
        == "| dashboard_gone | 0.20 | - | - | 2.8 | 0 | nothing | at rest | 2 (60, 60) | went on, not noticed |"
    )


# ── The recording ─────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    root = tmp_path_factory.mktemp("recording") / "dataset"
    make_dataset(root, (5, 7), use_videos=True)
    return root


def test_all_frames_of_a_recording_can_be_read(recording):
    assert readable_episodes(recording) == (5, 7)


def test_a_recording_without_the_end_of_a_file_cannot_be_read(recording, tmp_path):
    for folder in ("data", "meta/episodes"):
        root = tmp_path / folder.replace("/", "-")
        shutil.copytree(recording, root)
        (file,) = (root / folder).rglob("*.parquet")
        file.write_bytes(file.read_bytes()[:-8])
        assert readable_episodes(root) == ()


def test_an_episode_whose_images_are_missing_counts_as_lost(recording, tmp_path):
    root = tmp_path / "dataset"
    shutil.copytree(recording, root)
    (video,) = (root / "videos").rglob("*.mp4")
    video.write_bytes(b"")
    assert readable_episodes(root) == (0, 0)


def test_a_recording_that_was_never_begun_has_no_episodes(tmp_path):
    assert readable_episodes(tmp_path / "nothing") == ()


# ── Being told to end ─────────────────────────────────────────────────


@pytest.fixture
def as_at_first():
    """Signals as Python has them when it starts."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_program_that_is_told_to_end_closes_what_it_has_open_undisturbed(as_at_first, number):
    ending, closed = OrderlyEnd(), []

    def work():
        try:
            os.kill(os.getpid(), number)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)  # impatience
            os.kill(os.getpid(), signal.SIGHUP)
            closed.append("all")

    ending.begin()
    with pytest.raises(SystemExit) as end:
        work()
    assert closed == ["all"]
    assert end.value.code == 128 + number
    ending.end()
    assert signal.getsignal(signal.SIGTERM) == signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_what_a_program_does_on_a_signal_by_itself_it_goes_on_doing(as_at_first):
    told = []
    signal.signal(signal.SIGTERM, lambda *_: told.append("before"))
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    ending = OrderlyEnd()
    ending.begin()
    os.kill(os.getpid(), signal.SIGTERM)
    os.kill(os.getpid(), signal.SIGHUP)
    ending.end()
    os.kill(os.getpid(), signal.SIGTERM)
    assert told == ["before", "before"]
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def test_a_signal_that_somebody_takes_over_later_stays_with_them(as_at_first):
    ending = OrderlyEnd()
    ending.begin()
    signal.signal(signal.SIGTERM, later := lambda *_: None)
    ending.end()
    assert signal.getsignal(signal.SIGTERM) is later
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_in_another_thread_signals_are_left_alone(as_at_first):
    ending = OrderlyEnd()
    thread = threading.Thread(target=lambda: (ending.begin(), ending.end()))
    thread.start()
    thread.join()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


# ── The command ───────────────────────────────────────────────────────


def test_every_fault_of_the_twin_is_tried():
    class Nothing:
        def __getattr__(self, name):
            return self

    nothing = Nothing()
    assert set(Faults(nothing, nothing, nothing, None).names) <= set(FAULTS)


def test_the_arm_never_rests_and_keeps_away_from_the_door_wherever_a_pause_cuts_its_way():
    events = [json.loads(line) for line in faults._movement().splitlines()]
    times = np.array([event["time"] for event in events])
    velocities = 0.1 * np.array([event["twist"][:3] for event in events])[:-1]
    assert np.linalg.norm(velocities, axis=1) == pytest.approx(0.08, abs=1e-4)
    steps = velocities * np.diff(times)[:, None]
    assert times[-1] > 120
    for pause_begin in range(12, 60):
        for pause_steps in range(30):
            way = np.delete(steps, slice(pause_begin, pause_begin + pause_steps), axis=0).cumsum(axis=0)
            assert way[:, 0].max() < 0.0
            assert np.abs(way).max() < 0.25


def test_the_last_error_is_what_the_user_saw():
    output = """Traceback (most recent call last):
  File "x.py", line 3, in <module>
    raise ValueError
ValueError: first

During handling of the above exception, another exception occurred:

lerobot_ufrnn.robots.errors.RobotFaultError: The arm was stopped (freeze): no data. To go on: look at it.
INFO 2025-01-01 errors.py:12 Exiting
"""
    assert last_error(output) == "RobotFaultError: The arm was stopped (freeze): no data"
    assert last_error("INFO all is well\nKeyboardInterrupt\n") == "KeyboardInterrupt"
    assert last_error("INFO no Error in here\n") == ""
    ending = "WARNING 2025-01-01 orderly_end.py:12 Ending, as asked for by SIGHUP: what is open is closed first.\n"
    assert last_error(ending + "INFO 2025-01-01 Exiting\n") == "Ending, as asked for by SIGHUP"


def test_a_failure_is_told_even_without_an_error():
    assert describe_failure(1, "INFO connected\nValueError: no arm\nINFO bye\n") == "status 1: ValueError: no arm"
    assert describe_failure(2, "usage\nrecord: error: unknown\n") == "status 2: record: error: unknown"
    assert describe_failure(-9, "") == "status -9: it printed nothing"


def test_a_command_that_ends_without_saying_so_is_told(monkeypatch):
    monkeypatch.setattr("lerobot_ufrnn.commands.stock.with_this_python", lambda command: command)
    with StockCommand([sys.executable, "-c", "print('connected'); print('no arm'); raise SystemExit(3)"]) as command:
        command.wait_for("connected", 30.0)
        with pytest.raises(RuntimeError, match=r"status 3 before it printed 'moving'(.|\n)*no arm"):
            command.wait_for("moving", 30.0)


def test_a_command_heeds_an_interrupt_even_if_a_background_job_started_it(monkeypatch):
    monkeypatch.setattr("lerobot_ufrnn.commands.stock.with_this_python", lambda command: command)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with StockCommand([sys.executable, "-c", "import time; print('here', flush=True); time.sleep(60)"]) as command:
            command.wait_for("here", 30.0)
            command.stop()
            assert command.process.returncode == -signal.SIGINT
            assert "KeyboardInterrupt" in command.output()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_command_that_takes_too_long_is_told(monkeypatch):
    monkeypatch.setattr("lerobot_ufrnn.commands.stock.with_this_python", lambda command: command)
    with (
        StockCommand([sys.executable, "-c", "import time; time.sleep(60)"]) as command,
        pytest.raises(RuntimeError, match="did not print 'moving' within 0 s"),
    ):
        command.wait_for("moving", 0.0)


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--faults=[]", "--faults must be one or more of"),
        ("--faults=[earthquake]", "got ['earthquake']"),
        ("--seed=-1", "--seed must be at least 0"),
    ],
)
def test_flags_out_of_range_are_refused(capsys, flag, message):
    assert main(["faults", flag]) == 1
    assert message in capsys.readouterr().err


def test_a_fault_that_leads_to_what_must_not_be_fails_the_command_after_the_table(monkeypatch, tmp_path, capsys):
    outcomes = {"drop_link": STOPPED, "freeze": replace(STOPPED, fault="freeze", standstill=None)}
    monkeypatch.setattr(faults, "_try", lambda name, seed: outcomes[name])
    output = tmp_path / "new" / "faults.md"
    assert main(["faults", "--faults=[drop_link]", f"--output={output}"]) == 0
    assert main(["faults", "--faults=[drop_link,freeze]", f"--output={output}"]) == 1
    printed = capsys.readouterr()
    assert output.read_text() in printed.out
    assert output.read_text() == to_markdown(list(outcomes.values()))
    assert "faults: freeze led to what must not be\n" in printed.err


def test_a_fault_that_could_not_be_tried_is_said_and_the_others_are_tried(monkeypatch, tmp_path, capsys):
    def try_one(name, seed):
        if name == "freeze":
            raise RuntimeError("the arm did not move")
        return STOPPED

    monkeypatch.setattr(faults, "_try", try_one)
    output = tmp_path / "faults.md"
    assert main(["faults", "--faults=[freeze,drop_link]", f"--output={output}"]) == 1
    assert "faults: freeze could not be tried\n" in capsys.readouterr().err
    assert output.read_text() == to_markdown([STOPPED]) + "\nNot tried, for the arm did not get into motion: freeze.\n"


SEEN = {
    "emergency_stop": "RobotFaultError: The arm was stopped (emergency_stop)",  # and not: the gripper without power
    "servo_paused": "RobotFaultError: The arm was stopped (servo_late): the servo process hangs",
    "command_terminated": "Ending, as asked for by SIGTERM",
    "remote_control_off": "nothing",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEN)
def test_faults_strike_a_real_recording(tmp_path, name):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    output = tmp_path / "faults.md"
    assert main(["faults", f"--faults=[{name}]", f"--output={output}"]) == 0
    row = output.read_text().splitlines()[2]
    assert f"| {SEEN[name]}" in row
    assert row.endswith("| went on, not noticed |" if name == "remote_control_off" else "| stopped |")
