"""What is measured when something fails, what counts as a failure, and four injections from end to end."""

import json
import signal
from dataclasses import replace

import numpy as np
import pytest
import twin_faults
from small import make_dataset
from twin import write_events
from twin_faults import INJECTIONS, FaultsConfig, Outcome, Sample, movement, readable_episodes, stop_after

from env_door.twin import injections


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


@pytest.mark.parametrize(
    ("samples", "stop"),
    [
        pytest.param(braking(stops_at=1.25), (0.25, False, 0.4 * 0.25), id="stops"),
        pytest.param(braking(stops_at=0.5), (0.0, False, 0.0), id="already stood"),
        pytest.param(braking(1.2, again=(1.6, 2.0)), (1.0, False, 0.4 * 0.6), id="a moment of rest is no standstill"),
        pytest.param(braking(stops_at=99.0), (None, False, 0.4 * 2.0), id="goes on"),
        pytest.param(braking(stops_at=2.8), (None, False, 0.4 * 1.8), id="stands too briefly to tell"),
        pytest.param(braking(1.2, again=(2.2, 2.4)), (0.2, True, 0.4 * 0.2), id="moves again"),
    ],
)
def test_a_stop_is_counted_to_the_first_moment_of_a_rest_that_lasts(samples, stop):
    standstill, moved_again, travel = stop_after(samples, 1.0)
    assert (standstill, moved_again) == (None if stop[0] is None else pytest.approx(stop[0]), stop[1])
    assert travel == pytest.approx(stop[2])


def test_travel_goes_by_the_farthest_joint_in_either_direction():
    samples = [Sample(0.0, 1.0, (0.0, 0.0)), Sample(1.0, 1.0, (0.1, -0.3)), Sample(2.0, 1.0, (0.2, 0.0))]
    assert stop_after(samples, 0.0) == (None, False, 0.3)
    assert stop_after(samples, 1.5)[2] == pytest.approx(0.3)


STOPPED = Outcome(
    name="drop_link",
    speed=0.2,
    standstill=0.31,
    moved_again=False,
    travel=0.0456,
    ended=2.84,
    status=1,
    message="RobotFaultError: the link | broke",
    still_when_cleared=True,
    left_running=(),
    episodes=(58,),
)
UNNOTICED = replace(STOPPED, name="dashboard_gone", status=0, message="", episodes=(60, 60))


@pytest.mark.parametrize(
    ("name", "changes", "verdict"),
    [
        # What must not be.
        ("drop_link", {"standstill": None}, "**FAILED**: the arm moved on"),
        ("drop_link", {"standstill": 3.5}, "**FAILED**: the arm moved on"),
        ("drop_link", {"moved_again": True}, "**FAILED**: the arm moved again"),
        ("drop_link", {"status": 0}, "**FAILED**: nobody was told"),
        ("drop_link", {"ended": None, "status": None}, "**FAILED**: the command hung"),
        ("drop_link", {"status": -signal.SIGABRT}, "**FAILED**: the command crashed (SIGABRT)"),
        ("command_interrupted", {"status": -signal.SIGSEGV}, "**FAILED**: the command crashed (SIGSEGV)"),
        ("drop_link", {"left_running": ("servo",)}, "**FAILED**: left running: servo"),
        ("drop_link", {"still_when_cleared": False}, "**FAILED**: the arm moved when the injection was cleared"),
        ("drop_link", {"episodes": ()}, "**FAILED**: recorded episode lost"),
        ("drop_link", {"episodes": (0,)}, "**FAILED**: recorded episode lost"),
        # What may be.
        ("drop_link", {}, "stopped"),
        ("dashboard_gone", {"status": 0, "standstill": None, "message": ""}, "went on, not noticed"),
        ("dashboard_gone", {"status": 1}, "stopped"),
        ("speed_slider", {"status": 0, "message": "The controller scales"}, "went on"),
        ("command_interrupted", {"status": -signal.SIGINT}, "stopped"),
        ("command_killed", {"status": -signal.SIGKILL, "episodes": ()}, "stopped; the recording cannot be read"),
        ("command_paused", {"status": 0, "moved_again": True, "episodes": (60, 40)}, "stopped, then went on"),
    ],
)
def test_the_verdict_says_what_must_not_be_and_what_an_injection_allows(name, changes, verdict):
    assert replace(STOPPED, name=name, **changes).verdict == verdict


def test_a_row_has_what_was_measured():
    message = "RobotFaultError: the link \\| broke"
    assert [*STOPPED.row().values()] == [
        *("drop_link", "0.20", "0.31", "0.046", "2.8", "1", message, "at rest", "1 (58)", "stopped")
    ]
    # The arm stood when the recording was over, which says nothing of the injection.
    assert [*UNNOTICED.row().values()] == [
        *("dashboard_gone", "0.20", "-", "-", "2.8", "0", "nothing", "at rest", "2 (60, 60)", "went on, not noticed")
    ]


@pytest.fixture
def recording(tmp_path):
    make_dataset(tmp_path / "dataset", (5, 7), use_videos=True)
    return tmp_path / "dataset"


def test_all_frames_of_a_recording_are_read_and_one_that_was_never_begun_has_no_episodes(recording, tmp_path):
    assert readable_episodes(recording) == (5, 7)
    assert readable_episodes(tmp_path / "nothing") == ()


@pytest.mark.parametrize("folder", ["data", "meta/episodes"])
def test_a_recording_without_the_end_of_a_file_cannot_be_read(recording, folder):
    (file,) = (recording / folder).rglob("*.parquet")
    file.write_bytes(file.read_bytes()[:-8])
    assert readable_episodes(recording) == ()


def test_an_episode_whose_images_are_missing_counts_as_lost(recording):
    (video,) = (recording / "videos").rglob("*.mp4")
    video.write_bytes(b"")
    assert readable_episodes(recording) == (0, 0)


def test_everything_that_the_twin_offers_is_tried():
    assert set(injections.INJECTIONS) <= set(INJECTIONS)


def test_the_arm_never_rests_and_keeps_away_from_the_door_wherever_a_pause_cuts_its_way(tmp_path):
    write_events(movement(), tmp_path / "events.jsonl")
    events = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
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


def test_what_must_not_be_fails_the_script_after_the_table(monkeypatch, tmp_path, capsys):
    outcomes = {"drop_link": STOPPED, "delay": replace(STOPPED, name="delay", standstill=None)}

    monkeypatch.setattr(twin_faults, "inject", lambda name, seed: outcomes[name])
    output = tmp_path / "new" / "faults.md"
    twin_faults.main(FaultsConfig(("drop_link",), output))
    assert output.read_text() in capsys.readouterr().out
    with pytest.raises(RuntimeError, match="delay led to what must not be"):
        twin_faults.main(FaultsConfig(("drop_link", "delay"), output))
    assert output.read_text() in capsys.readouterr().out
    assert [line.split(" | ")[0] for line in output.read_text().splitlines()[2:]] == ["| drop_link", "| delay"]


def test_a_warning_of_the_robot_is_seen_where_there_is_no_error():
    output = "WARNING 12:00 robot.py:1 The controller scales the arm's speed to 20 %: slow.\nINFO 12:01 x.py:2 Done\n"
    assert twin_faults.last_warning(output) == "The controller scales the arm's speed to 20 %: slow."
    assert twin_faults.last_warning("WARNING 12:00 other.py:1 The camera is late") == ""


SEEN = {
    "close_control": "RobotFaultError: The arm was stopped (link_lost)",
    "servo_terminated": "RobotFaultError: The arm was stopped (servo_died): somebody told",
    "emergency_stop": "RobotFaultError: The arm was stopped (emergency_stop)",  # and not: the gripper without power
    "servo_paused": "RobotFaultError: The arm was stopped (servo_late): the servo process hangs",
    "command_terminated": "Ending, as asked for by SIGTERM",
    "remote_control_off": "nothing",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEN)
def test_an_injection_strikes_a_real_recording(tmp_path, name):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    output = tmp_path / "faults.md"
    twin_faults.main(FaultsConfig((name,), output))
    row = output.read_text().splitlines()[2]
    assert f"| {SEEN[name]}" in row
    assert row.endswith("| went on, not noticed |" if name == "remote_control_off" else "| stopped |")
