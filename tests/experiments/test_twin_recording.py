"""Only opened doors are recorded, and whatever stops the script, the data set is readable and can be gone on with."""

import json
from pathlib import Path

import numpy as np
import pytest
import teleoperators_fakes as fakes
import twin_recording
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from twin_recording import LEDGER, RecordingConfig

from env_door.recording import record
from env_door.recording_config import RecordConfig

FEATURES = {
    OBS_STATE: {"dtype": "float32", "shape": (7,), "names": fakes.FEATURES},
    ACTION: {"dtype": "float32", "shape": (7,), "names": fakes.FEATURES},
    f"{OBS_IMAGES}.front": {"dtype": "video", "shape": (128, 128, 3), "names": ["height", "width", "channels"]},
}


class Stage:
    """A twin and `lerobot-record`, of which a test says how each take ends."""

    address = "127.0.0.99"

    def __init__(self, *ends):
        self.ends, self.takes, self.flags = list(ends), [], []
        self.now, self.returncode = "", 0

    def __call__(self, *arguments, TMPDIR=None, **_):  # noqa: N803
        if TMPDIR:
            assert arguments[0] == "lerobot-record"
            self.flags.append(dict(flag.removeprefix("--").split("=", 1) for flag in arguments[1:]))
            # A file moved into the staged folder from elsewhere would be written into the data set itself.
            assert Path(self.flags[-1]["dataset.root"]).parent in Path(TMPDIR).parents
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def reset(self, kind, seed):
        self.takes.append((kind, seed))
        return {"lost_seconds": 7.0}

    def state(self):
        is_open = self.now in ("opens", "tries", "saves nothing", "drops a frame")
        attempts = ["slide", "push"] if self.now == "tries" else [self.takes[-1][0]]
        return {"is_open": is_open, "opening": 0.4, "attempts": attempts, "lost_seconds": 7.5}

    def wait(self, seconds):
        self.now = self.ends.pop(0) if self.ends else "opens"
        self.returncode = 1 if self.now == "fails" else 0
        flags = self.flags[-1]
        options = {"root": flags["dataset.root"], "streaming_encoding": True}
        if flags["resume"] == "true":
            dataset = LeRobotDataset.resume(flags["dataset.repo_id"], **options)
        else:
            dataset = LeRobotDataset.create(flags["dataset.repo_id"], 10, FEATURES, **options)
        if self.now != "saves nothing":
            for _ in range(3):
                values, image = np.full(7, len(self.takes), np.float32), np.zeros((128, 128, 3), np.uint8)
                frame = {OBS_STATE: values, ACTION: values, f"{OBS_IMAGES}.front": image, "task": "open the door"}
                dataset.add_frame(frame)
            dataset.save_episode()
        dataset.finalize()

    def stop(self):
        if self.now == "interrupted":
            raise KeyboardInterrupt

    def output(self):
        return "Record loop is running slower (8.0 Hz)\nRobotFaultError: The arm was stopped (stale_data)\n"


@pytest.fixture
def perform(monkeypatch, tmp_path):
    """Runs the script with takes that end as the test says."""

    def perform(*ends, **settings):
        stage = Stage(*ends)
        monkeypatch.setattr(twin_recording, "TwinProcess", stage)
        monkeypatch.setattr(twin_recording, "StockCommand", stage)
        config = RecordingConfig(tmp_path / "data", **{"repo_id": "me/door", "episodes_per_kind": 1, **settings})
        stage.run = lambda: twin_recording.main(config)
        return stage

    return perform


def recorded(tmp_path):
    """Take that each episode comes from; the folder beside holds nothing else."""
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    dataset = LeRobotDataset("me/door", root=tmp_path / "data", video_backend="pyav")
    assert dataset.num_episodes == len(json.loads((tmp_path / "data" / LEDGER).read_text()))
    assert dataset[dataset.num_frames - 1][f"{OBS_IMAGES}.front"].shape == (3, 128, 128)
    return [int(dataset[index][ACTION][0]) for index in dataset.meta.episodes["dataset_from_index"]]


def test_only_takes_that_opened_the_door_at_once_are_kept(perform, tmp_path, capsys):
    stage = perform("opens", "stays shut", "fails", "tries", "saves nothing", "opens", "opens")
    stage.run()
    assert stage.takes == [("push", 0), *[("pull", 0)] * 5, ("slide", 0)]
    assert recorded(tmp_path) == [1, 6, 7]
    said = capsys.readouterr().out
    for reason in (
        "take 1 is not kept, the door did not open (opening 0.40 of 1; 1 late ticks, 0.5 s lost by the twin)",
        "take 2 is not kept, lerobot-record ended with status 1: RobotFaultError: The arm was stopped (stale_data)",
        "take 3 is not kept, it shows wrong tries: slide, push",
        "take 4 is not kept, lerobot-record saved 0 episodes",
        "3 episodes in",
    ):
        assert reason in said


def test_a_run_that_gives_up_or_is_interrupted_keeps_what_it_has_and_is_gone_on_with(perform, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        perform("opens", "interrupted").run()
    assert recorded(tmp_path) == [1]
    with pytest.raises(RuntimeError, match=r"pull door, seed 0 was not recorded in 2 takes. 1 episodes are safe"):
        perform("stays shut", "stays shut", takes=2).run()
    assert recorded(tmp_path) == [1]
    stage = perform()
    stage.run()
    assert stage.takes == [("pull", 0), ("slide", 0)]
    assert [flags["resume"] for flags in stage.flags] == ["true", "true"]
    assert recorded(tmp_path) == [1, 1, 2]
    stage.run()
    assert len(stage.takes) == 2


@pytest.mark.parametrize(
    ("ends", "settings", "message"),
    [
        (["fails"], {"takes": 1}, "not recorded in 1 takes"),
        ([], {"episode_seconds": 12}, "--episode_seconds=12 is too short: push door, seed 0 takes"),
    ],
)
def test_without_a_first_episode_nothing_is_left(perform, tmp_path, ends, settings, message):
    with pytest.raises((RuntimeError, ValueError), match=message):
        perform(*ends, **settings).run()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_else_is_left_alone(perform, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "notes.txt").write_text("mine")
    stage = perform()
    with pytest.raises(ValueError, match="is not empty and was not made by this script"):
        stage.run()
    assert stage.takes == []
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["notes.txt"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_door_opened_on_the_twin_is_recorded_like_a_simulated_one(tmp_path, capsys):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    twin_recording.main(RecordingConfig(tmp_path / "data", "me/door", kinds=("pull",), episodes_per_kind=1))
    assert "pull door, seed 0: opened" in capsys.readouterr().out
    record(RecordConfig("me/simulated", root=tmp_path / "simulated", kinds=["pull"], episodes_per_kind=1))
    operated = LeRobotDataset("me/door", root=tmp_path / "data", video_backend="pyav")
    simulated = LeRobotDataset("me/simulated", root=tmp_path / "simulated", video_backend="pyav")
    assert (operated.features, operated.fps) == (simulated.features, simulated.fps)
    assert operated.meta.robot_type == simulated.meta.robot_type
    assert 130 <= operated.num_frames <= simulated.num_frames == 150
    for name in (OBS_STATE, ACTION):
        (start, end), (simulated_start, simulated_end) = (
            np.array([dataset[index][name].numpy() for index in (0, dataset.num_frames - 1)])
            for dataset in (operated, simulated)
        )
        # The same start, and the same open door at the end.
        np.testing.assert_allclose(start, simulated_start, atol=0.02)
        np.testing.assert_allclose(end[:-1], simulated_end[:-1], atol=0.1)
    frame = operated[operated.num_frames - 1]
    assert frame["task"] == "open the door"
    assert frame[f"{OBS_IMAGES}.front"].std() > 0.05
