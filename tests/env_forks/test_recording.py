"""Recording a task with the recorder of the door; that recordings survive interruption is tested there."""

import json

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from env_forks.demonstrator import demonstrate
from env_forks.env import ForksEnv
from lerobot_ufrnn.commands import main


def record(root, *flags):
    return main(["record", "--env=forks", "--repo_id=me/task", f"--root={root}", *flags])


def recorded(root):
    provenance = json.loads((root / "meta" / "door_recording.json").read_text())
    return [(episode["kind"], episode["seed"]) for episode in provenance["episodes"]]


def test_a_recorded_task_is_a_dataset_of_whole_matched_demonstrations(tmp_path):
    root = tmp_path / "data"
    assert record(root, "--task=two_ways", "--episodes_per_way=1", "--seed=3") == 0
    assert record(root, "--task=two_ways", "--episodes_per_way=2", "--seed=3", "--resume=true") == 0
    assert recorded(root) == [("two_ways_0", 3), ("two_ways_1", 3), ("two_ways_0", 4), ("two_ways_1", 4)]
    dataset = LeRobotDataset("me/task", root=root, video_backend="pyav", return_uint8=True)
    assert (dataset.num_episodes, dataset.fps, list(dataset.meta.tasks.index)) == (4, 10, ["find the way through"])
    assert dataset.features["action"]["names"] == ["x.pos", "y.pos"]
    run = demonstrate(ForksEnv("two_ways"), 1, 3)
    first = dataset.meta.episodes[1]["dataset_from_index"]
    assert dataset.meta.episodes[1]["length"] == len(run.actions)
    item = dataset[first + 25]
    np.testing.assert_array_equal(item["action"], run.actions[25])
    np.testing.assert_array_equal(item["observation.state"], run.states[25])
    assert np.abs(item["observation.images.front"].permute(1, 2, 0).numpy() - run.images[25].astype(float)).mean() < 2


def test_ways_of_unmatched_demonstrations_have_seeds_of_their_own(tmp_path):
    assert record(tmp_path / "data", "--task=unmatched", "--episodes_per_way=1") == 0
    assert recorded(tmp_path / "data") == [("unmatched_0", 0), ("unmatched_1", 1), ("unmatched_2", 2)]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "--env=forks needs a task, such as --task=three_ways"),
        (["--task=four_ways"], "`task` must be one of ['three_ways', "),
        (["--task=two_ways", "--kinds=[two_ways_2]"], "kinds must be of ['two_ways_0', 'two_ways_1'], each once, got"),
        (["--task=two_ways", "--arm=panda"], "there is no --arm: it is a flag of the door"),
        (["--task=two_ways", "--episodes_per_way=0"], "`episodes_per_kind` must be at least 1, got 0"),
        (["--env=door", "--task=two_ways"], "--task=two_ways needs --env=forks; the door has --kinds"),
        (["--env=maze"], "`env` must be one of ['door', 'forks'], got 'maze'"),
    ],
)
def test_flags_that_do_not_fit_are_refused(tmp_path, capsys, flags, message):
    assert record(tmp_path / "data", *flags) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_recording_is_not_gone_on_with_as_another_task(tmp_path, capsys):
    root = tmp_path / "data"
    record(root, "--task=no_fork", "--episodes_per_way=1")
    assert record(root, "--task=lamp", "--resume=true") == 1
    assert "was recorded with" in capsys.readouterr().err
