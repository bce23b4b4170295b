"""Recordings that stop, go on, fail or are refused. The expert is replaced by a quick stand-in."""

import contextlib
import errno
import gc
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import draccus
import numpy as np
import pytest
from draccus.utils import ParsingError
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import StreamingVideoEncoder

from env_door import recording
from env_door.demonstration import Demonstration
from env_door.env import DoorEnv
from env_door.recording import record
from env_door.recording_config import RecordConfig

NUM_STEPS = 6
KINDS = ("push", "pull", "slide")
KINDS_ALLOWED = r"^kinds must be one or more of \['push', 'pull', 'slide', .*\], each once, got \["


def fake_demonstration(kind, seed):
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    images = rng.integers(0, 256, (NUM_STEPS, 128, 128, 3), dtype=np.uint8)
    states, actions = rng.normal(size=(2, NUM_STEPS, 7)).astype(np.float32)
    return Demonstration(kind, seed, images, states, actions, branch_step=2, success_step=4)


class Expert:
    """The stand-in, which can be told to fail at some `(kind, seed)` and to be interrupted at others."""

    failures = interruptions = frozenset()

    def __call__(self, env, kind, seed, num_steps, door_offset):
        if (kind, seed) in self.interruptions:
            raise KeyboardInterrupt
        return None if (kind, seed) in self.failures else fake_demonstration(kind, seed)


@pytest.fixture
def expert(monkeypatch):
    stand_in = Expert()
    monkeypatch.setattr(recording, "demonstrate", stand_in)
    return stand_in


@pytest.fixture
def root(tmp_path):
    """Where a test records to; nothing else may be left beside it."""
    yield tmp_path / "door"
    assert set(os.listdir(tmp_path)) <= {"door", "other"}


def configure(root, episodes_per_kind=3, **options):
    defaults = {"repo_id": "tester/door", "root": root, "num_steps": NUM_STEPS}
    return RecordConfig(**(defaults | options), episodes_per_kind=episodes_per_kind)


def record_door(root, episodes_per_kind=3, **options):
    return record(configure(root, episodes_per_kind, **options))


def files(root):
    """All files by name: JSON parsed, as LeRobot orders the keys of its statistics differently in each process."""
    return {
        str(path.relative_to(root)): json.loads(path.read_text()) if path.suffix == ".json" else path.read_bytes()
        for path in root.rglob("*")
        if path.is_file()
    }


def count_readable(root):
    """Number of episodes; every file must be there and readable."""
    dataset = LeRobotDataset("tester/door", root=root, video_backend="pyav")
    for episode in range(dataset.num_episodes):
        assert dataset[episode * NUM_STEPS + NUM_STEPS - 1]["episode_index"] == episode
    assert len(dataset.hf_dataset) == dataset.num_frames == dataset.num_episodes * NUM_STEPS
    return dataset.num_episodes


@contextlib.contextmanager
def nothing_changes(root):
    """Three episodes are recorded before, and are there as they were after whatever happens in the block."""
    record_door(root, 1)
    before = files(root)
    yield
    assert files(root) == before
    assert count_readable(root) == 3


def test_interrupted_and_resumed_recording_equals_an_uninterrupted_one(tmp_path, root, expert, caplog):
    whole = tmp_path / "other"
    expert.failures = {("slide", 1)}
    record_door(whole)
    expert.interruptions = {("pull", 2)}
    with pytest.raises(KeyboardInterrupt):
        record_door(root)
    assert "3 of 9 episodes are safe" in caplog.text
    assert count_readable(root) == 3
    expert.interruptions = {}
    report = record_door(root, resume=True)
    assert [episode["episode_index"] for episode in report.episodes] == [3, 4, 5, 6, 7, 8]
    assert (len(report.provenance.episodes), report.provenance.dropped_seeds) == (9, [1])
    assert files(root) == files(whole)
    assert count_readable(root) == 9


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize(("method", "number"), [("save_episode", 2), ("finalize", 1)])
def test_failure_while_writing_keeps_the_saved_episodes(root, expert, monkeypatch, error, method, number):
    original, calls = getattr(LeRobotDataset, method), []

    def fail_in_the_end(dataset):
        original(dataset)
        calls.append(method)
        if len(calls) == number:
            raise error

    with nothing_changes(root):
        monkeypatch.setattr(LeRobotDataset, method, fail_in_the_end)
        with pytest.raises(type(error)):
            record_door(root, resume=True)
        monkeypatch.undo()


def test_full_disk_keeps_the_saved_episodes(root, expert):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with nothing_changes(root):
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, hard))  # smaller than the video that comes next
        try:
            with pytest.raises((OSError, RuntimeError), match="too large"):
                record_door(root, resume=True)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_disk_at_the_last_file_leaves_nothing_behind(tmp_path, root, expert, monkeypatch):
    original = LeRobotDatasetMetadata._flush_metadata_buffer

    def flush_if_there_is_room(metadata):
        if (metadata.root / "videos").exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        original(metadata)

    monkeypatch.setattr(LeRobotDatasetMetadata, "_flush_metadata_buffer", flush_if_there_is_room)
    with pytest.raises(OSError, match="No space left"):
        record_door(root)
    gc.collect()  # LeRobot writes once more when it is collected
    assert os.listdir(tmp_path) == []


def test_lost_frames_are_noticed(tmp_path, root, expert, monkeypatch):
    original, fed = StreamingVideoEncoder.feed_frame, []

    def lose_the_fifth(encoder, key, image):
        fed.append(key)
        if len(fed) != 5:
            original(encoder, key, image)

    monkeypatch.setattr(StreamingVideoEncoder, "feed_frame", lose_the_fifth)
    with pytest.raises(RuntimeError, match="wrote 17 of 18 frames"):
        record_door(root)
    assert os.listdir(tmp_path) == []


def test_resuming_a_finished_recording_extends_it_or_does_nothing(tmp_path, root, expert):
    record_door(root, 1, resume=True)  # nothing to resume: starts
    before = files(root)
    assert record_door(root, 1, resume=True).episodes == []
    assert files(root) == before
    record_door(root, 2, resume=True)
    record_door(tmp_path / "other", 2)
    assert files(root) == files(tmp_path / "other")


@pytest.mark.parametrize(
    ("failures", "options", "recorded", "dropped"),
    [
        # A seed that fails for one kind is dropped for all; unmatched episodes have seeds of their own.
        ({("pull", 0), ("push", 2), ("slide", 3)}, {}, [(kind, seed) for seed in (1, 4) for kind in KINDS], [0, 2, 3]),
        (
            {("pull", 11)},
            {"kinds": ["pull", "push"], "matched": False, "seed": 10},
            [("pull", 10), ("push", 11), ("pull", 12), ("push", 13)],
            [],
        ),
    ],
)
def test_seeds_at_which_the_expert_fails_are_dropped(root, expert, failures, options, recorded, dropped):
    expert.failures = failures
    report = record_door(root, 2, **options)
    assert [(episode["kind"], episode["seed"]) for episode in report.episodes] == recorded
    assert report.provenance.dropped_seeds == dropped
    assert count_readable(root) == len(recorded)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({}, FileExistsError, "--resume=true"),
        ({"resume": True, "seed": 5}, ValueError, "was recorded with seed=0, now seed=5"),
        ({"resume": True, "kinds": ["push"]}, ValueError, "was recorded with kinds="),
        ({"resume": True, "door_offset": 0.02}, ValueError, "was recorded with door_offset="),
        ({"resume": True, "matched": False}, ValueError, "was recorded with matched="),
    ],
)
def test_a_dataset_is_neither_overwritten_nor_resumed_with_other_settings(root, expert, options, error, message):
    with nothing_changes(root), pytest.raises(error, match=message):
        record_door(root, **options)


def test_resuming_a_folder_that_is_no_recording_is_refused(root, expert):
    root.mkdir()
    (root / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="no recording that can go on"):
        record_door(root, resume=True)
    assert (root / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("repo_id", "door", "hf_username"),
        ("repo_id", "a/b/c", "hf_username"),
        ("repo_id", "me/my door", "hf_username"),
        ("repo_id", "me/eval_door", "reserved"),
        ("episodes_per_kind", 0, "`episodes_per_kind` must be at least 1, got 0"),
        ("kinds", ["push", "lift"], KINDS_ALLOWED),
        ("kinds", [], KINDS_ALLOWED),
        ("kinds", ["push", "push"], KINDS_ALLOWED),
        ("arm", "ur10", r"`arm` must be one of \['ur5e', 'panda'\], got 'ur10'"),
        ("seed", -1, "`seed` must be at least 0, got -1"),
        ("num_steps", 0, "`num_steps` must be at least 1, got 0"),
        ("door_offset", 0.2, "`door_offset` must be at least 0 and at most 0.05 m, got 0.2"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(tmp_path, root, option, value, message):
    with pytest.raises(ParsingError, match=message):
        record_door(root, **{option: value})
    assert os.listdir(tmp_path) == []


def test_too_few_steps_are_refused(tmp_path, root):
    with pytest.raises(ValueError, match="num_steps=40 ends before the door is tried"):
        record_door(root, num_steps=40)
    assert os.listdir(tmp_path) == []


def test_options_are_read_from_a_command_line():
    arguments = (
        "--repo_id=me/door --root=/some/where --episodes_per_kind=2 --kinds=[push,slide] --arm=panda --matched=false "
        "--door_offset=0.05 --seed=3 --num_steps=120 --push_to_hub=true --private=true --tags=[door] --resume=true "
        "--rgb_encoder.pix_fmt=yuv420p"
    )
    config = draccus.parse(RecordConfig, args=arguments.split())
    assert (config.kinds, config.arm, config.matched, config.private) == (["push", "slide"], "panda", False, True)
    assert (config.tags, config.rgb_encoder.pix_fmt, config.rgb_encoder.g) == (["door"], "yuv420p", 1)
    assert config.total_episodes == 4


def test_failed_upload_keeps_the_dataset_and_can_be_repeated_with_the_options_of_lerobot(root, expert, monkeypatch):
    uploads = []

    def fail(self, **options):
        raise ConnectionError("no network")

    upload = {"push_to_hub": True, "private": True, "tags": ["door"], "resume": True}
    with nothing_changes(root):
        monkeypatch.setattr(LeRobotDataset, "push_to_hub", fail)
        with pytest.raises(RuntimeError, match=r"no network[\s\S]*--resume=true"):
            record_door(root, 1, **upload)
        monkeypatch.setattr(
            LeRobotDataset, "push_to_hub", lambda self, **options: uploads.append((self.repo_id, options))
        )
        assert record_door(root, 1, **upload).episodes == []
    assert uploads == [("tester/door", {"tags": ["door"], "private": True})]


class FakeDoor:
    """Door without a renderer, whose threads would not survive a fork."""

    task_description = DoorEnv.task_description
    joint_names = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper")

    def __init__(self, *options):
        pass

    def close(self):
        pass


KILLABLE = """
import os, sys
from env_door import recording
sys.path.insert(0, {tests!r})
from test_recording_interrupted import Expert, FakeDoor, record_door
recording.DoorEnv, recording.demonstrate = FakeDoor, Expert()
for _ in sys.stdin:
    process = os.fork()
    if process == 0:
        record_door({root!r}, {episodes}, resume=True)
        os._exit(0)
    print(process, flush=True)
    print(os.waitpid(process, 0)[1], flush=True)
"""


@pytest.mark.slow
def test_killed_recording_is_readable_and_goes_on(tmp_path, root, expert):
    """Kill at random moments, most of them while writing, as the stand-in for the expert takes no time."""
    rng, saved, episodes = random.Random(0), [0], 6
    script = KILLABLE.format(tests=str(Path(__file__).parent), root=str(root), episodes=episodes)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([sys.executable, "-c", script], **pipes) as launcher:
        while saved[-1] < 3 * episodes:
            print(file=launcher.stdin, flush=True)
            process = int(launcher.stdout.readline())
            # Longer and longer, so that a slow machine gets through as well.
            time.sleep(rng.uniform(0.1, 0.5 + 0.3 * len(saved)))
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            launcher.stdout.readline()
            saved.append(count_readable(root) if root.exists() else 0)
            assert saved[-1] % 3 == 0
            assert saved[-1] >= saved[-2]
        launcher.stdin.close()
    assert len(saved) > 4
    record_door(root, episodes, resume=True)
    record_door(tmp_path / "other", episodes)
    assert files(root) == files(tmp_path / "other")
