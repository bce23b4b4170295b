"""`ufrnn lerobot-record` with a robot that counts: what is saved survives kills, faults and interruptions."""

import os
import random

import numpy as np
import pytest
from counting_robot import CAMERA, CountingRobot
from kill_recording import (
    IMAGES,
    RECORDERS,
    REPO_ID,
    SESSION,
    STOCK,
    STREAMED,
    check_counts,
    kill,
    read_counts,
    readable_episodes,
    record_and_kill,
    robot_flags,
)
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import StreamingVideoEncoder
from lerobot.scripts import lerobot_record

from env_door.inspection import inspect
from lerobot_ufrnn.commands import main

OURS = [name for name in RECORDERS if name != STOCK]


@pytest.fixture
def root(tmp_path):
    """Where a test records to; nothing else may be left beside it."""
    yield tmp_path / "dataset"
    assert set(os.listdir(tmp_path)) <= {"dataset"}


def record(root, first=0, episodes=2, flags=()):
    return main(["lerobot-record", *robot_flags(root, first, episodes), *flags])


def read_whole(root):
    """Counts of the episodes of a dataset that holds nothing else and has all its counts."""
    assert not inspect(root).faults
    check_counts(episodes := read_counts(root))
    return episodes


@pytest.mark.parametrize("name", OURS)
def test_what_was_saved_survives_kills_as_it_was_recorded(name, tmp_path):
    root, rng, readable = tmp_path / "dataset", random.Random(0), 0
    for session in range(2):  # the second goes on with the first
        before, saved = record_and_kill(name, root, session * SESSION, rng.uniform(0.8, 1.6))
        assert before == readable
        readable = readable_episodes(root)
        assert readable in range(saved, saved + (3 if name == "`ufrnn record`" else 2))  # that records two at a time
    assert readable > 0
    assert not inspect(root).faults


@pytest.mark.slow
@pytest.mark.parametrize("name", OURS)
def test_nothing_is_lost_through_many_kills(name, tmp_path):
    row = kill(name, 12, 2.0, random.Random(1), tmp_path)
    assert (row["episodes lost"], row["unreadable"], row["with leftovers"]) == (0, 0, 0)
    assert row["episodes saved"] > 0


@pytest.mark.parametrize("flags", [(), *(pytest.param(flags, marks=pytest.mark.slow) for flags in (STREAMED, IMAGES))])
def test_recordings_go_on_with_and_without_ours(root, flags, monkeypatch):
    assert record(root, flags=flags) == 0
    assert len(read_whole(root)) == 2
    monkeypatch.setattr("sys.argv", ["lerobot-record", *robot_flags(root, SESSION, 2), *flags])
    lerobot_record.main()
    assert record(root, 2 * SESSION, flags=flags) == 0
    assert len(read_whole(root)) == 6
    means = LeRobotDatasetMetadata(REPO_ID, root=root).stats["observation.state"]["mean"]
    assert means == pytest.approx(np.mean(np.concatenate(read_counts(root))), rel=1e-4)


def test_the_folder_of_another_dataset_is_refused(root, capsys):
    record(root, episodes=1)
    before = read_whole(root)
    flags = [flag for flag in robot_flags(root, SESSION, 1) if not flag.startswith("--resume")]
    assert main(["lerobot-record", *flags]) == 1
    assert f"{root} is not empty. Use --resume=true" in capsys.readouterr().err
    assert read_whole(root) == before


def test_going_on_with_nothing_is_refused(root, capsys):
    assert record(root, flags=["--resume=true"]) == 1
    assert "nothing to go on with" in capsys.readouterr().err


def test_repair_says_what_it_drops_and_a_dry_run_changes_nothing(root, capsys):
    record(root, episodes=3)
    episodes = read_whole(root)
    assert main(["repair", f"--root={root}"]) == 0
    assert f"{root} is whole: 3 episodes (" in capsys.readouterr().out
    os.truncate(damaged := root / "data/chunk-000/file-001.parquet", 1000)
    assert record(root, SESSION) == 1
    assert f"`ufrnn repair --root={root} --dry_run=true`" in capsys.readouterr().err
    for flags, verb in ((["--dry_run=true"], "Would keep"), ([], "Kept")):
        assert os.path.getsize(damaged) == 1000
        assert main(["repair", f"--root={root}", *flags]) == 0
        text = capsys.readouterr().out
        assert "episode 1: data/chunk-000/file-001.parquet has 0 of its" in text
        assert f"{verb} 1 episodes ({len(episodes[0])} frames) of 3 in {root}." in text
    assert read_whole(root) == episodes[:1]


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("error", [RuntimeError("the arm was stopped"), KeyboardInterrupt()])
def test_an_episode_that_fails_leaves_those_before_it(root, monkeypatch, number, error):
    original, saves = CountingRobot.get_observation, []
    save = LeRobotDataset.save_episode
    monkeypatch.setattr(LeRobotDataset, "save_episode", lambda *options: (save(*options), saves.append(1)))

    def fail(robot):
        if len(saves) == number and robot.count % 5 == 4:
            raise error
        return original(robot)

    monkeypatch.setattr(CountingRobot, "get_observation", fail)
    assert record(root, episodes=3) == (1 if isinstance(error, RuntimeError) else 130)
    assert (len(read_whole(root)) if root.exists() else 0) == number


def test_an_episode_of_which_frames_were_lost_is_not_kept(root, monkeypatch, capsys):
    original, fed = StreamingVideoEncoder.feed_frame, []
    record(root, episodes=1, flags=STREAMED)

    def lose_the_third(encoder, key, image):
        fed.append(key)
        if len(fed) != 3:
            original(encoder, key, image)

    monkeypatch.setattr(StreamingVideoEncoder, "feed_frame", lose_the_third)
    assert record(root, SESSION, flags=STREAMED) == 1
    assert f"The encoder of observation.images.{CAMERA} wrote" in capsys.readouterr().err
    assert len(read_whole(root)) == 1


def test_an_episode_is_on_the_disk_when_its_saving_returns(root, monkeypatch):
    synchronized, fsync, checked = set(), os.fsync, []
    observe = CountingRobot.get_observation

    def remember(descriptor):
        fsync(descriptor)
        status = os.fstat(descriptor)
        synchronized.add((status.st_ino, status.st_mtime_ns))

    def begin(robot):
        if root.exists():
            paths = [root, *root.rglob("*")]
            assert all((path.stat().st_ino, path.stat().st_mtime_ns) in synchronized for path in paths)
            checked.append(len(paths))
        return observe(robot)

    monkeypatch.setattr(os, "fsync", remember)
    monkeypatch.setattr(CountingRobot, "get_observation", begin)
    assert record(root, episodes=3) == 0
    assert len(set(checked)) == 2  # after the first and after the second
