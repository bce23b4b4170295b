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
from dataclasses import replace
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
KINDS_ALLOWED = r"^kinds must be one or more of \['push', 'pull', 'slide'\], each once, got \["


def fake_demonstration(kind, seed):
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    return Demonstration(
        kind=kind,
        seed=seed,
        images=rng.integers(0, 256, (NUM_STEPS, 128, 128, 3), dtype=np.uint8),
        states=rng.normal(size=(NUM_STEPS, 7)).astype(np.float32),
        actions=rng.normal(size=(NUM_STEPS, 7)).astype(np.float32),
        branch_step=2,
        success_step=4,
    )


@pytest.fixture
def expert(monkeypatch):
    """The stand-in, which can be told to fail at some `(kind, seed)` and to raise an error at others."""

    class Expert:
        def __init__(self):
            self.failures, self.crashes = set(), {}

        def __call__(self, env, kind, seed, num_steps, door_offset):
            if (kind, seed) in self.crashes:
                raise self.crashes[kind, seed]
            return None if (kind, seed) in self.failures else fake_demonstration(kind, seed)

    stand_in = Expert()
    monkeypatch.setattr(recording, "demonstrate", stand_in)
    return stand_in


def configure(root, **options):
    defaults = {"repo_id": "tester/door", "root": root, "episodes_per_kind": 3, "num_steps": NUM_STEPS}
    return RecordConfig(**(defaults | options))


def files(root):
    """All files by name: JSON parsed, as LeRobot orders the keys of its statistics differently in each process."""
    return {
        str(path.relative_to(root)): json.loads(path.read_text()) if path.suffix == ".json" else path.read_bytes()
        for path in root.rglob("*")
        if path.is_file()
    }


def load(root):
    dataset = LeRobotDataset("tester/door", root=root, video_backend="pyav")
    for episode in range(dataset.num_episodes):  # every file must be there and readable
        assert dataset[episode * NUM_STEPS + NUM_STEPS - 1]["episode_index"] == episode
    assert len(dataset.hf_dataset) == dataset.num_frames == dataset.num_episodes * NUM_STEPS
    return dataset


def test_interrupted_and_resumed_recording_equals_an_uninterrupted_one(tmp_path, expert, caplog):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    expert.failures = {("slide", 1)}
    record(configure(whole))
    expert.crashes = {("pull", 2): KeyboardInterrupt()}
    with pytest.raises(KeyboardInterrupt):
        record(configure(parts))
    assert "3 of 9 episodes are safe" in caplog.text
    assert sorted(os.listdir(tmp_path)) == ["parts", "whole"]
    assert load(parts).num_episodes == 3
    expert.crashes = {}
    report = record(configure(parts, resume=True))
    assert [episode["episode_index"] for episode in report.episodes] == [3, 4, 5, 6, 7, 8]
    assert (report.total_episodes, report.dropped_seeds) == (9, [1])
    assert files(parts) == files(whole)
    assert load(parts).num_episodes == 9


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("call", ["save_episode", "finalize"])
def test_failure_while_writing_keeps_the_saved_episodes(tmp_path, expert, monkeypatch, error, call):
    root = tmp_path / "door"
    record(configure(root, episodes_per_kind=1))
    before = files(root)
    original, left = getattr(LeRobotDataset, call), [1]

    def fail_at_the_second_call(dataset, *args, **kwargs):
        original(dataset, *args, **kwargs)
        left[0] -= 1
        if left[0] < (0 if call == "save_episode" else 1):
            raise error

    monkeypatch.setattr(LeRobotDataset, call, fail_at_the_second_call)
    with pytest.raises(type(error)):
        record(configure(root, resume=True))
    monkeypatch.undo()
    assert os.listdir(tmp_path) == ["door"]
    assert files(root) == before
    assert load(root).num_episodes == 3


def test_full_disk_keeps_the_saved_episodes(tmp_path, expert):
    root = tmp_path / "door"
    record(configure(root, episodes_per_kind=1))
    before = files(root)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, hard))  # smaller than the video that comes next
    try:
        with pytest.raises((OSError, RuntimeError), match="too large"):
            record(configure(root, resume=True))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(tmp_path) == ["door"]
    assert files(root) == before


def test_full_disk_at_the_last_file_leaves_nothing_behind(tmp_path, expert, monkeypatch):
    root = tmp_path / "door"
    original = LeRobotDatasetMetadata._flush_metadata_buffer

    def flush_if_there_is_room(metadata):
        if (metadata.root / "videos").exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        original(metadata)

    monkeypatch.setattr(LeRobotDatasetMetadata, "_flush_metadata_buffer", flush_if_there_is_room)
    with pytest.raises(OSError, match="No space left"):
        record(configure(root))
    gc.collect()  # LeRobot writes once more when it is collected
    assert os.listdir(tmp_path) == []


def test_lost_frames_are_noticed(tmp_path, expert, monkeypatch):
    original, fed = StreamingVideoEncoder.feed_frame, []

    def lose_the_fifth(encoder, key, image):
        fed.append(key)
        if len(fed) != 5:
            original(encoder, key, image)

    monkeypatch.setattr(StreamingVideoEncoder, "feed_frame", lose_the_fifth)
    with pytest.raises(RuntimeError, match="wrote 17 of 18 frames"):
        record(configure(tmp_path / "door"))
    assert os.listdir(tmp_path) == []


def test_resuming_a_finished_recording_extends_it_or_does_nothing(tmp_path, expert):
    extended, at_once = tmp_path / "extended", tmp_path / "at_once"
    record(configure(extended, episodes_per_kind=1, resume=True))  # nothing to resume: starts
    before = files(extended)
    assert record(configure(extended, episodes_per_kind=1, resume=True)).episodes == []
    assert files(extended) == before
    record(configure(extended, episodes_per_kind=2, resume=True))
    record(configure(at_once, episodes_per_kind=2))
    assert files(extended) == files(at_once)


def test_a_seed_that_fails_for_one_kind_is_dropped_for_all(tmp_path, expert):
    expert.failures = {("pull", 0), ("push", 2), ("slide", 3)}
    report = record(configure(tmp_path / "door", episodes_per_kind=2))
    assert report.dropped_seeds == [0, 2, 3]
    assert [(e["kind"], e["seed"]) for e in report.episodes] == [(kind, seed) for seed in (1, 4) for kind in KINDS]
    assert load(tmp_path / "door").num_episodes == 6


def test_unmatched_episodes_have_seeds_of_their_own(tmp_path, expert):
    expert.failures = {("pull", 11)}
    report = record(configure(tmp_path / "door", episodes_per_kind=2, kinds=["pull", "push"], matched=False, seed=10))
    assert [(e["kind"], e["seed"]) for e in report.episodes] == [("pull", 10), ("push", 11), ("pull", 12), ("push", 13)]


def test_an_expert_that_never_succeeds_ends_the_recording(tmp_path, expert):
    expert.failures = {("push", seed) for seed in range(100)}
    with pytest.raises(RuntimeError, match="failed at 20 seeds in a row, 19 the last"):
        record(configure(tmp_path / "door"))
    assert os.listdir(tmp_path) == []


def test_an_existing_folder_is_not_overwritten(tmp_path, expert):
    root = tmp_path / "door"
    record(configure(root, episodes_per_kind=1))
    before = files(root)
    with pytest.raises(FileExistsError, match="--resume=true"):
        record(configure(root))
    assert files(root) == before
    assert os.listdir(tmp_path) == ["door"]


@pytest.mark.parametrize(
    ("option", "value"), [("seed", 5), ("kinds", ["push"]), ("door_offset", 0.02), ("matched", False)]
)
def test_resuming_with_other_settings_is_refused(tmp_path, expert, option, value):
    record(configure(tmp_path / "door", episodes_per_kind=1))
    with pytest.raises(ValueError, match=f"was recorded with {option}="):
        record(configure(tmp_path / "door", resume=True, **{option: value}))


def test_resuming_a_folder_that_is_no_recording_is_refused(tmp_path, expert):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="no recording of the door"):
        record(configure(tmp_path, resume=True))
    assert (tmp_path / "notes.txt").read_text() == "mine"


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
def test_bad_options_are_refused_before_anything_is_written(tmp_path, option, value, message):
    with pytest.raises(ParsingError, match=message):
        record(configure(tmp_path / "door", **{option: value}))
    assert os.listdir(tmp_path) == []


def test_too_few_steps_are_refused(tmp_path):
    with pytest.raises(ValueError, match="num_steps=40 ends before the door is tried"):
        record(configure(tmp_path / "door", num_steps=40))
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


def test_upload_uses_the_options_of_lerobot(tmp_path, expert, monkeypatch):
    uploads = []
    monkeypatch.setattr(LeRobotDataset, "push_to_hub", lambda self, **options: uploads.append((self.repo_id, options)))
    record(configure(tmp_path / "door", episodes_per_kind=1, push_to_hub=True, private=True, tags=["door"]))
    assert uploads == [("tester/door", {"tags": ["door"], "private": True})]


def test_failed_upload_keeps_the_dataset_and_can_be_repeated(tmp_path, expert, monkeypatch):
    config = configure(tmp_path / "door", episodes_per_kind=1, push_to_hub=True)

    def fail(self, **options):
        raise ConnectionError("no network")

    monkeypatch.setattr(LeRobotDataset, "push_to_hub", fail)
    with pytest.raises(RuntimeError, match=r"no network[\s\S]*--resume=true"):
        record(config)
    before = files(config.path)
    monkeypatch.setattr(LeRobotDataset, "push_to_hub", lambda self, **options: None)
    assert record(replace(config, resume=True)).episodes == []
    assert files(config.path) == before


class FakeDoor:
    """Door without a renderer, whose threads would not survive a fork."""

    metadata = DoorEnv.metadata
    task_description = DoorEnv.task_description
    joint_names = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper")
    observation_size = 128

    def __init__(self, **options):
        pass

    def close(self):
        pass


KILLABLE = """
import os, sys
from env_door import recording
sys.path.insert(0, {tests!r})
from test_recording_interrupted import FakeDoor, configure, fake_demonstration
recording.DoorEnv = FakeDoor
recording.demonstrate = lambda env, kind, seed, num_steps, door_offset: fake_demonstration(kind, seed)
for _ in sys.stdin:
    process = os.fork()
    if process == 0:
        recording.record(configure({root!r}, episodes_per_kind={episodes}, resume=True))
        os._exit(0)
    print(process, flush=True)
    print(os.waitpid(process, 0)[1], flush=True)
"""


@pytest.mark.slow
def test_killed_recording_is_readable_and_goes_on(tmp_path, expert):
    """Kill at random moments, most of them while writing, as the stand-in for the expert takes no time."""
    rng = random.Random(0)
    root, whole, episodes = tmp_path / "door", tmp_path / "whole", 6
    script = KILLABLE.format(tests=str(Path(__file__).parent), root=str(root), episodes=episodes)
    saved = [0]
    with subprocess.Popen(
        [sys.executable, "-c", script],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as launcher:
        while saved[-1] < 3 * episodes:
            print(file=launcher.stdin, flush=True)
            process = int(launcher.stdout.readline())
            # Longer and longer, so that a slow machine gets through as well.
            time.sleep(rng.uniform(0.1, 0.5 + 0.3 * len(saved)))
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            launcher.stdout.readline()
            saved.append(load(root).num_episodes if root.exists() else 0)
            assert saved[-1] % 3 == 0
            assert saved[-1] >= saved[-2]
        launcher.stdin.close()
    assert len(saved) > 4
    record(configure(root, episodes_per_kind=episodes, resume=True))
    record(configure(whole, episodes_per_kind=episodes))
    assert files(root) == files(whole)
    assert sorted(os.listdir(tmp_path)) == ["door", "whole"]
