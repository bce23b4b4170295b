"""What a recording holds, and what it must not tell."""

import json
import os

import numpy as np
import pytest
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import decode_video_frames, encode_video_frames
from PIL import Image

from env_door import recording
from env_door.demonstration import demonstrate, spread
from env_door.env import DoorEnv
from env_door.recording import record
from env_door.recording_config import FrameEncoderConfig, RecordConfig

CAMERA = "observation.images.front"
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper"]


def open_dataset(config, **options):
    return LeRobotDataset(config.repo_id, root=config.root, video_backend="pyav", **options)


@pytest.fixture(scope="module")
def dataset(recording):
    return open_dataset(recording[0], return_uint8=True)


@pytest.fixture(scope="module")
def episodes(dataset, recording):
    """Decoded images `(E, T, H, W, 3)`, states `(E, T, D)` and actions `(E, T, D)`."""
    config, _ = recording
    table = dataset.hf_dataset.with_format("numpy")
    images = []
    for episode in range(config.total_episodes):
        first = dataset.meta.episodes[episode][f"videos/{CAMERA}/from_timestamp"]
        times = [first + step / 10 for step in range(config.num_steps)]
        path = dataset.root / dataset.meta.get_video_file_path(episode, CAMERA)
        images.append(decode_video_frames(path, times, 1e-4, "pyav", return_uint8=True).permute(0, 2, 3, 1).numpy())
    vectors = [np.split(np.stack(table[key]), config.total_episodes) for key in ("observation.state", "action")]
    return tuple(np.stack(values) for values in (images, *vectors))


def test_features_are_those_of_the_real_robot(dataset):
    names = [f"{joint}.pos" for joint in JOINTS]
    for key, shape, parts in (
        ("observation.state", (7,), names),
        ("action", (7,), names),
        (CAMERA, (128, 128, 3), ["height", "width", "channels"]),
    ):
        assert (dataset.features[key]["shape"], dataset.features[key]["names"]) == (shape, parts)
    assert (dataset.fps, dataset.meta.robot_type) == (10, "ur5e_robotiq")
    assert list(dataset.meta.tasks.index) == ["open the door"]


def test_report_and_provenance_describe_the_dataset_and_no_frame_does(dataset, recording):
    config, report = recording
    assert dataset.num_episodes == len(report.episodes) == 9
    assert dataset.num_frames == 9 * config.num_steps
    assert [episode["kind"] for episode in report.episodes] == ["push", "pull", "slide"] * 3
    assert [episode["episode_index"] for episode in report.episodes] == list(range(9))
    assert all(episode["branch_step"] < episode["success_step"] < config.num_steps for episode in report.episodes)
    provenance = json.loads((config.root / "meta" / "door_recording.json").read_text())
    assert provenance["episodes"] == [{"kind": e["kind"], "seed": e["seed"]} for e in report.episodes]
    assert set(dataset[0]) == {CAMERA, "observation.state", "action", "task"} | {
        *("task_index", "timestamp", "frame_index", "episode_index", "index")
    }


def test_dataset_holds_what_the_expert_did(dataset, recording, episodes):
    config, report = recording
    env = DoorEnv()
    images, states, actions = episodes
    for index in (0, 4, 8):
        episode = report.episodes[index]
        run = demonstrate(env, episode["kind"], episode["seed"], config.num_steps)
        np.testing.assert_array_equal(states[index], run.states)
        np.testing.assert_array_equal(actions[index], run.actions)
        error = images[index].astype(float) - run.images
        assert np.abs(error).mean() < 1.5  # of 255; a frame off by one step is off by more
        assert 10 * np.log10(255**2 / np.mean(error**2)) > 40
    env.close()


def test_items_are_single_frames_and_whole_episodes(dataset, recording, episodes):
    config, _ = recording
    item = dataset[config.num_steps + 7]
    assert item["task"] == "open the door"
    np.testing.assert_array_equal(item[CAMERA].permute(1, 2, 0).numpy(), episodes[0][1, 7])
    steps = [step / 10 for step in range(config.num_steps)]
    windows = {CAMERA: steps, "action": steps}
    item = open_dataset(config, delta_timestamps=windows, return_uint8=True)[2 * config.num_steps]
    np.testing.assert_array_equal(item[CAMERA].permute(0, 2, 3, 1).numpy(), episodes[0][2])
    np.testing.assert_array_equal(item["action"].numpy(), episodes[2][2])
    assert not item["action_is_pad"].any()


def test_decoded_dataset_is_bit_identical_for_every_kind_before_the_branch_and_not_after(recording, episodes):
    _, report = recording
    images, states, actions = episodes
    for index, episode in enumerate(report.episodes):
        twin, branch = index - index % 3, episode["branch_step"]
        np.testing.assert_array_equal(actions[index, :branch], actions[twin, :branch])
        np.testing.assert_array_equal(states[index, : branch + 1], states[twin, : branch + 1])
        np.testing.assert_array_equal(images[index, : branch + 1], images[twin, : branch + 1])
        opening = images[[index, twin], branch + 20].astype(int)
        assert index == twin or (np.abs(opening[0] - opening[1]).max(axis=-1) > 30).mean() > 0.02


def test_later_frames_leave_no_trace_in_the_video_of_earlier_ones(tmp_path, recording):
    _, report = recording
    env = DoorEnv()
    push, pull = (demonstrate(env, kind, report.episodes[0]["seed"], 110) for kind in ("push", "pull"))
    env.close()
    branch = push.branch_step

    def decoded_difference(encoder):
        decoded = []
        for run in (push, pull):
            folder = tmp_path / run.kind
            folder.mkdir(exist_ok=True)
            for step, image in enumerate(run.images):
                Image.fromarray(image).save(folder / f"frame-{step:06d}.png")
            path = tmp_path / f"{run.kind}.mp4"
            encode_video_frames(folder, path, 10, encoder, overwrite=True, log_level=None)
            times = [step / 10 for step in range(branch)]
            decoded.append(decode_video_frames(path, times, 1e-4, "pyav", return_uint8=True).int())
        return (decoded[0] - decoded[1]).abs().max()

    assert decoded_difference(FrameEncoderConfig()) == 0
    # The test itself is sharp enough to see what an ordinary encoder, which looks ahead, gives away.
    assert decoded_difference(RGBEncoderConfig(vcodec="h264", g=50, crf=23)) > 10


def test_kinds_that_turn_the_knob_unlike_are_matched_up_to_the_twist(tmp_path):
    kinds, num_steps = ["slide_right", "push_ccw", "pull_ccw"], 120
    config = RecordConfig("tester/door", root=tmp_path / "door", episodes_per_kind=1, kinds=kinds, num_steps=num_steps)
    report = record(config)
    assert [episode["kind"] for episode in report.episodes] == kinds
    dataset = open_dataset(config)
    states = np.stack([dataset[i]["observation.state"] for i in range(3 * num_steps)]).reshape(3, num_steps, -1)
    grasped = int((states[0, :, -1] > 0.6).argmax())
    np.testing.assert_array_equal(states[0, : grasped + 1], states[1, : grasped + 1])
    assert np.abs(states[0, grasped + 20] - states[1, grasped + 20]).max() > 0.5
    branch = report.episodes[1]["branch_step"]
    np.testing.assert_array_equal(states[1, : branch + 1], states[2, : branch + 1])
    assert np.abs(states[1, branch + 20] - states[2, branch + 20]).max() > 0.1


def test_panda_has_its_own_joints(tmp_path):
    config = RecordConfig("tester/panda", root=tmp_path / "door", episodes_per_kind=1, kinds=["pull"], arm="panda")
    record(config)
    dataset = open_dataset(config)
    names = [f"joint_{number}.pos" for number in range(1, 8)] + ["gripper.pos"]
    assert dataset.features["action"]["names"] == dataset.features["observation.state"]["names"] == names
    assert dataset.meta.robot_type == "panda"
    assert dataset[149]["action"].shape == (8,)


@pytest.mark.parametrize("matched", [True, False])
def test_matched_demonstrations_spread_the_door_and_others_draw_it(tmp_path, monkeypatch, matched):
    asked = []

    def fail(env, kind, seed, num_steps, door_offset):
        asked.append((seed, door_offset))

    monkeypatch.setattr(recording, "demonstrate", fail)
    config = RecordConfig("me/door", root=tmp_path / "data", door_offset=0.02, matched=matched)
    with pytest.raises(RuntimeError, match="failed at 20 seeds in a row, 19 the last"):
        record(config)
    assert asked == [(seed, 0.02 * spread(seed) if matched else None) for seed in range(20)]
    assert os.listdir(tmp_path) == [], "nothing is left of a recording in which the expert never succeeds"
