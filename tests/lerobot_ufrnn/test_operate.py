"""The scripted operator: played by its teleoperator it goes its path, opens doors, and only opened doors are kept."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import teleoperators_fakes as fakes
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from scipy.spatial.transform import Rotation

from env_door.recording import record
from env_door.recording_config import RecordConfig
from env_door.twin.live_door import LiveDoor
from lerobot_ufrnn.commands import main, operate
from lerobot_ufrnn.commands.operate import plan
from lerobot_ufrnn.teleoperators import DeviceState, SpaceMouseTwist, SpaceMouseTwistConfig, twist_teleoperator
from lerobot_ufrnn.teleoperators.scripted_operator import (
    REST_PERIODS,
    Event,
    ToolPath,
    duration,
    events_along,
    write_events,
)

CONFIG = SpaceMouseTwistConfig(robot_ip="192.0.2.1")
KINDS = ("push", "pull", "slide")


def path_of(joints, closures=None) -> ToolPath:
    """The path of the tool through joint angles, by the published Denavit-Hartenberg table."""
    joints = np.array(joints)
    poses = [fakes.tool_pose(angles) for angles in joints]
    return ToolPath(
        np.array([position for position, _ in poses]),
        np.array([rotation.as_matrix() for _, rotation in poses]),
        np.zeros(len(joints)) if closures is None else np.array(closures, dtype=np.float64),
        joints,
    )


def wander(steps=40, size=0.4) -> np.ndarray:
    """Joint angles on a smooth way from one rest to another, all joints at once."""
    ease = (1 - np.cos(np.linspace(0, np.pi, steps + 1)))[:, None] / 2
    return fakes.READY + ease * size * np.array([0.5, -0.4, 0.6, 0.3, -0.5, 1.0])


def still(steps) -> np.ndarray:
    return np.repeat(fakes.READY[None], steps, axis=0)


@pytest.fixture
def play(monkeypatch, tmp_path):
    """Plays events with the teleoperator that they are for, on an arm and at times that the test chooses."""

    def play(events, arm, ticks, follow):
        clock = fakes.Clock()
        monkeypatch.setattr(twist_teleoperator, "ArmState", lambda *_: arm)
        monkeypatch.setattr(twist_teleoperator, "monotonic", clock)
        write_events(events, tmp_path / "events.jsonl")
        teleop = SpaceMouseTwist(replace(CONFIG, device=tmp_path / "events.jsonl", calibration_dir=tmp_path))
        teleop.connect()
        actions = []
        for seconds in ticks:
            actions.append(np.array(list(teleop.get_action().values())))
            follow(actions[-1])
            clock.now += seconds
        teleop.disconnect()
        return np.array(actions)

    return play


# ── From a path to events ─────────────────────────────────────────────


@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.1])
def test_played_by_the_teleoperator_the_tool_comes_to_the_end_of_its_path(play, jitter):
    joints = np.concatenate([wander(), np.repeat(wander()[-1:], 8, axis=0)])
    path = path_of(joints, [0.0] * 41 + list(np.linspace(0.1, 0.8, 8)))
    events = events_along(path, 0.1, CONFIG)
    rng = np.random.default_rng(0)
    ticks = 0.1 + rng.uniform(0, jitter, round(duration(events) / 0.1) + 5)
    arm = fakes.FakeArmState()
    before = [arm.measured]

    def trail(action):  # by one action
        arm.measured = before[-1]
        before.append(action[:6])

    actions = play(events, arm, ticks, trail)
    np.testing.assert_array_equal(actions[0], [*fakes.READY, 0.0])
    position, rotation = fakes.tool_pose(actions[-1, :6])
    np.testing.assert_allclose(position, path.positions[-1], atol=1e-4 if jitter == 0 else 2e-3)
    miss = (rotation * Rotation.from_matrix(path.rotations[-1]).inv()).magnitude()
    assert miss < (1e-3 if jitter == 0 else 0.01)
    assert actions[-1, 6] == pytest.approx(0.8, abs=1e-6 if jitter == 0 else 0.1 + jitter)


def test_the_path_is_walked_too_slowly_for_any_limit_of_the_teleoperator():
    path = path_of(wander(steps=4, size=1.0))
    moving = [event for event in events_along(path, 0.1, CONFIG) if event.state.twist.any()]
    assert all(event.seconds == 0.1 for event in moving)
    twists = np.array([event.state.twist for event in moving])
    assert 0.9 < np.abs(twists).max() <= 0.95
    # All of the way, none of it twice: 0.1 m/s at full deflection.
    np.testing.assert_allclose(twists[:, :3].sum(axis=0) * 0.1 * 0.1, path.positions[-1] - path.positions[0], atol=1e-9)
    # A wrist that trails its target by 0.1 s is led by 0.07 rad at most, even by an action after 0.15 s.
    turn = still(5) + np.linspace(0, 1, 5)[:, None] * np.array([0, 0, 0, 0, 0, 1.0])
    turning = duration(events_along(path_of(turn), 0.1, CONFIG)[1:])
    needed = 1.0 * (0.15 + 0.1) / 0.07 / 0.95
    assert needed <= turning <= needed + 0.1
    slow = events_along(path, 20.0, CONFIG)
    assert [event.seconds for event in slow] == [20.0 * REST_PERIODS, 20.0, 20.0, 20.0, 20.0]


def test_the_gripper_moves_for_itself_between_rests_with_one_button_at_a_time():
    closures = [0, 0.2, 0.5, 0.73, 0.73, 0.4, 0.13, 0.3]
    events = events_along(path_of(still(8), closures), 0.1, CONFIG)
    assert not any(event.state.twist.any() for event in events)
    rest = (set(), pytest.approx(0.3))
    # At a stroke a second, in whole periods, rounded up: 0.73 closing, a step without anything, 0.6 opening, 0.17.
    assert [(set(event.state.buttons), event.seconds) for event in events] == [
        rest,
        *(rest, ({"close"}, pytest.approx(0.8)), rest),
        (set(), 0.1),
        *(rest, ({"open"}, pytest.approx(0.6)), rest),
        *(rest, ({"close"}, pytest.approx(0.2)), rest),
    ]


def test_what_is_no_path_is_refused():
    good = path_of(still(3))
    for name, value, message in (
        ("positions", np.full((3, 3), np.nan), "`positions` of a path must be finite, got .* at pose 0"),
        ("joints", np.full((3, 6), np.inf), "`joints` of a path must be finite"),
        ("rotations", np.zeros((3, 9)), r"must have shape \(3, 3, 3\)"),
        ("closures", np.zeros(2), r"must have shape \(3,\)"),
        ("closures", np.array([0.0, 0.5, 1.2]), "0, open, to 1, closed"),
        ("positions", np.zeros((1, 3)), "two or more poses"),
        ("positions", np.zeros((0, 3)), "two or more poses"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(good, **{name: value})


def test_what_no_operator_can_do_is_refused(tmp_path):
    path = path_of(still(3))
    with pytest.raises(ValueError, match="above 0"):
        events_along(path, 0.0, CONFIG)
    with pytest.raises(ValueError, match="above 0"):
        events_along(path, float("nan"), CONFIG)
    with pytest.raises(ValueError, match="frame 'base'"):
        events_along(path, 0.1, replace(CONFIG, frame="tool"))
    with pytest.raises(ValueError, match="Step 0 of the path moves tool and gripper at once"):
        events_along(path_of(wander()[[0, 9]], [0.0, 0.5]), 0.1, CONFIG)
    for events, message in (
        ([], "no events"),
        ([Event(1.0, DeviceState()), Event(1.0, DeviceState(np.full(6, np.nan)))], "Event at 1.00 s: .* not finite"),
        ([Event(1.0, DeviceState(np.full(6, 1.5)))], "beyond -1 to 1"),
    ):
        with pytest.raises(ValueError, match=message):
            write_events(events, tmp_path / "events.jsonl")
        assert not (tmp_path / "events.jsonl").exists()


# ── From the expert's plan to an open door ────────────────────────────


@pytest.fixture(scope="module")
def door() -> LiveDoor:
    return LiveDoor()


def test_the_plan_begins_where_the_arm_starts_and_is_the_same_for_all_doors_until_one_is_tried(door):
    plans = {kind: plan(door, kind, seed=4) for kind in KINDS}
    for kind, path in plans.items():
        door.place(4, kind, keep_arm=False)
        np.testing.assert_array_equal(path.joints[0], door.joints)
        assert path.closures[[0, -1]].tolist() == [0.0, pytest.approx(0.73, abs=0.01)]
        grasped = int(np.argmax(path.closures > 0))
        np.testing.assert_array_equal(path.joints[:grasped], plans["push"].joints[:grasped])
        # Push and pull turn the tool by 0.52 rad about the upright, each its own way, and slide does not.
        turn = Rotation.from_matrix(path.rotations[-1] @ path.rotations[grasped].T)
        twisted = Rotation.from_rotvec([0.95, 0, 0])
        upright = (turn * twisted.inv()).as_rotvec()
        np.testing.assert_allclose(
            upright, [0, 0, {"push": 0.52, "pull": -0.52, "slide": 0}[kind]], atol=2e-3, err_msg=kind
        )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_the_events_open_the_simulated_door(play, door, kind, jitter):
    events = events_along(plan(door, kind, seed=1), 0.1, CONFIG)
    door.place(1, kind, keep_arm=False)
    arm = fakes.FakeArmState(door.joints)

    def follow(action):
        door.advance(action)
        arm.measured = door.joints.copy()

    # The physics takes steps of 0.1 s; an action that is late finds the arm where it was by then.
    ticks = 0.1 + np.random.default_rng(2).uniform(0, jitter, round(15 / (0.1 + jitter / 2)))
    assert duration(events) < 15
    play(events, arm, ticks, follow)
    assert door.latch.is_open
    assert door.latch.attempts == (kind,)


# ── What is kept ──────────────────────────────────────────────────────


FEATURES = {
    OBS_STATE: {"dtype": "float32", "shape": (7,), "names": fakes.FEATURES},
    ACTION: {"dtype": "float32", "shape": (7,), "names": fakes.FEATURES},
    f"{OBS_IMAGES}.front": {"dtype": "video", "shape": (128, 128, 3), "names": ["height", "width", "channels"]},
}


class Stage:
    """A twin and `lerobot-record`, of which a test says how each attempt ends."""

    address = "127.0.0.99"

    def __init__(self, outcomes):
        self.outcomes, self.attempts, self.flags = list(outcomes), [], []
        self.process = self
        self.now, self.returncode = "", 0

    def __call__(self, *arguments, **_):
        if arguments:
            self.flags.append(dict(flag.removeprefix("--").split("=", 1) for flag in arguments[0][1:]))
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def reset(self, kind, seed):
        self.attempts.append((kind, seed))
        return {"lost_seconds": 7.0}

    def state(self):
        is_open = self.now in ("opens", "saves nothing")
        attempts = ["slide", "push"] if self.now == "tries" else [self.attempts[-1][0]]
        return {"is_open": is_open or self.now == "tries", "opening": 0.4, "attempts": attempts, "lost_seconds": 7.5}

    def wait(self, seconds):
        self.now = self.outcomes.pop(0) if self.outcomes else "opens"
        self.returncode = 1 if self.now == "fails" else 0
        flags = self.flags[-1]
        # A file moved into the staged folder from elsewhere would be written into the data set itself.
        assert Path(flags["dataset.root"]).parent in Path(os.environ["TMPDIR"]).parents
        options = {"root": flags["dataset.root"], "streaming_encoding": True}
        if flags["resume"] == "true":
            dataset = LeRobotDataset.resume(flags["dataset.repo_id"], **options)
        else:
            dataset = LeRobotDataset.create(flags["dataset.repo_id"], 10, FEATURES, **options)
        for _ in range(0 if self.now == "saves nothing" else 3):
            values = np.full(7, len(self.attempts), np.float32)
            image = np.zeros((128, 128, 3), np.uint8)
            dataset.add_frame(
                {OBS_STATE: values, ACTION: values, f"{OBS_IMAGES}.front": image, "task": "open the door"}
            )
        if self.now != "saves nothing":
            dataset.save_episode()
        dataset.finalize()

    def stop(self):
        if self.now == "interrupted":
            raise KeyboardInterrupt

    def output(self):
        return "Record loop is running slower (8.0 Hz)\nRobotFaultError: The arm was stopped (stale_data)\n"


@pytest.fixture
def stage(monkeypatch, tmp_path):
    def stage(*outcomes):
        acted = Stage(outcomes)
        monkeypatch.setattr(operate, "TwinProcess", acted)
        monkeypatch.setattr(operate, "StockCommand", acted)
        return acted

    return stage


def flags(tmp_path, *more):
    return ["operate", f"--dataset_dir={tmp_path / 'data'}", "--repo_id=me/door", "--episodes_per_kind=1", *more]


def recorded(tmp_path):
    """Attempt that each episode comes from; the folder beside holds nothing else."""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data"]
    dataset = LeRobotDataset("me/door", root=tmp_path / "data", video_backend="pyav")
    assert dataset.num_episodes == len(json.loads((tmp_path / "data" / operate.LEDGER).read_text()))
    assert dataset[dataset.num_frames - 1][f"{OBS_IMAGES}.front"].shape == (3, 128, 128)
    return [int(dataset[index][ACTION][0]) for index in dataset.meta.episodes["dataset_from_index"]]


def test_only_attempts_that_opened_the_door_at_once_are_kept(stage, tmp_path, capsys):
    acted = stage("opens", "stays shut", "fails", "tries", "saves nothing", "opens", "opens")
    assert main(flags(tmp_path)) == 0
    assert acted.attempts == [("push", 0), *[("pull", 0)] * 5, ("slide", 0)]
    assert recorded(tmp_path) == [1, 6, 7]
    said = capsys.readouterr().out
    for reason in (
        "attempt 1 is not kept, the door did not open (opening 0.40 of 1; 1 late ticks, 0.5 s lost by the twin)",
        "attempt 2 is not kept, lerobot-record ended with status 1: RobotFaultError: The arm was stopped (stale_data)",
        "attempt 3 is not kept, it shows wrong tries: slide, push",
        "attempt 4 is not kept, lerobot-record saved 0 episodes",
        "3 episodes in",
    ):
        assert reason in said


def test_a_run_that_gives_up_or_is_interrupted_keeps_what_it_has_and_is_gone_on_with(stage, tmp_path, capsys):
    stage("opens", "interrupted")
    assert main(flags(tmp_path)) == 130
    assert recorded(tmp_path) == [1]
    stage("stays shut", "stays shut")
    assert main(flags(tmp_path, "--attempts=2")) == 1
    assert "not recorded in 2 attempts. 1 episodes are safe" in capsys.readouterr().err
    assert recorded(tmp_path) == [1]
    acted = stage()
    assert main(flags(tmp_path)) == 0
    assert acted.attempts == [("pull", 0), ("slide", 0)]
    assert [flags["resume"] for flags in acted.flags] == ["true", "true"]
    assert recorded(tmp_path) == [1, 1, 2]
    assert main(flags(tmp_path)) == 0
    assert len(acted.attempts) == 2


def test_the_first_attempt_fails_and_leaves_nothing(stage, tmp_path):
    stage("fails")
    assert main(flags(tmp_path, "--attempts=1")) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_command_is_the_stock_one_with_the_encoder_of_the_simulation(stage, tmp_path):
    acted = stage()
    assert main(flags(tmp_path, "--kinds=[pull]", "--seed=3")) == 0
    (flag,) = acted.flags
    assert acted.attempts == [("pull", 3)]
    assert flag["teleop.type"] == "spacemouse_twist"
    assert flag["teleop.robot_ip"] == flag["robot.ip"] == Stage.address
    assert (flag["dataset.episode_time_s"], flag["dataset.fps"], flag["resume"]) == ("15", "10", "false")
    assert (flag["dataset.push_to_hub"], flag["play_sounds"], flag["dataset.no_stamp"]) == ("false", "false", "true")
    assert (flag["dataset.rgb_encoder.pix_fmt"], flag["dataset.rgb_encoder.crf"]) == ('"yuv444p"', "null")


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--kinds=[up]", "--kinds must be one or more of"),
        ("--kinds=[push,push]", "each once"),
        ("--episodes_per_kind=0", "--episodes_per_kind must be at least 1, got 0"),
        ("--seed=-1", "--seed must be at least 0"),
        ("--attempts=0", "--attempts must be at least 1"),
        ("--episode_seconds=nan", "--episode_seconds must be 12 to 60"),
        ("--episode_seconds=12", "--episode_seconds=12 is too short for the push door with seed 0"),
        ("--repo_id=door", "--repo_id must read"),
        ("--repo_id=me/eval_door", "for evaluations"),
    ],
)
def test_flags_out_of_range_are_refused(stage, tmp_path, capsys, flag, message):
    stage()
    assert main(flags(tmp_path, flag)) == 1
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_else_is_left_alone(stage, tmp_path, capsys):
    acted = stage()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "notes.txt").write_text("mine")
    assert main(flags(tmp_path)) == 1
    assert "is not empty and was not made by this command" in capsys.readouterr().err
    assert acted.attempts == []
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["notes.txt"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_door_opened_on_the_twin_is_recorded_like_a_simulated_one(tmp_path, capsys):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    assert main(flags(tmp_path, "--kinds=[pull]")) == 0
    assert "pull door, seed 0: opened" in capsys.readouterr().out
    record(RecordConfig("me/simulated", root=tmp_path / "simulated", kinds=["pull"], episodes_per_kind=1))
    operated = LeRobotDataset("me/door", root=tmp_path / "data", video_backend="pyav")
    simulated = LeRobotDataset("me/simulated", root=tmp_path / "simulated", video_backend="pyav")
    assert (operated.features, operated.fps) == (simulated.features, simulated.fps)
    assert operated.meta.robot_type == simulated.meta.robot_type
    assert 130 <= operated.num_frames <= simulated.num_frames == 150
    for name in (OBS_STATE, ACTION):
        ends = [
            np.array([dataset[index][name].numpy() for index in (0, dataset.num_frames - 1)])
            for dataset in (operated, simulated)
        ]
        # The same start, and the same open door at the end.
        np.testing.assert_allclose(ends[0][0], ends[1][0], atol=0.02)
        np.testing.assert_allclose(ends[0][1, :-1], ends[1][1, :-1], atol=0.1)
    frame = operated[operated.num_frames - 1]
    assert frame["task"] == "open the door"
    assert frame[f"{OBS_IMAGES}.front"].std() > 0.05
