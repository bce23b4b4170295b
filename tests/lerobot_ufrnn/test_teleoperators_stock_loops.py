"""LeRobot's own commands, unchanged, with a recorded operator and a robot of the right features."""

import json
import sys

import numpy as np
import pytest
import teleoperators_fakes as fakes
from lerobot.configs.dataset import DatasetRecordConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_record, lerobot_teleoperate
from lerobot.utils.constants import ACTION, OBS_STATE
from scipy.spatial.transform import Rotation

from env_door.scene import UR5E
from lerobot_ufrnn.teleoperators import SpaceMouseTwistConfig, twist_teleoperator

# Changes lie between the ticks of 0.1 s: each state lasts for a whole number of them.
EVENTS = [
    {"time": 0.0, "twist": [0, 0, 0, 0, 0, 0]},
    {"time": 0.05, "twist": [0, 0, 0.5, 0, 0, 0]},
    {"time": 1.05, "twist": [0, 0, 0, 0.6, 0, 0]},
    {"time": 2.05, "twist": [0, 0, 0, 0, 0, 0], "buttons": ["close"]},
    {"time": 2.55, "twist": [0, 0, 0, 0, 0, 0]},
]
LIFT, ROLL, CLOSURE = 1.0 * 0.5 * 0.1, 1.0 * 0.6 * 0.5, 0.5


@pytest.fixture
def world(monkeypatch):
    world = fakes.World()
    fakes.WORLD.append(world)

    def connect_arm(*_):
        world.order.append("teleoperator connected")
        return world.arm

    monkeypatch.setattr(twist_teleoperator, "ArmState", connect_arm)
    monkeypatch.setattr(twist_teleoperator, "monotonic", world.clock)
    yield world
    fakes.WORLD.pop()


@pytest.fixture
def events(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_text("".join(json.dumps(event) + "\n" for event in EVENTS))
    return path


def check_motion(world):
    actions = np.array(world.actions)
    np.testing.assert_array_equal(actions[0], [*fakes.READY, 0.0])
    start, start_rotation = fakes.tool_pose(fakes.READY)
    position, rotation = fakes.tool_pose(actions[-1, :6])
    np.testing.assert_allclose(position, start + np.array([0, 0, LIFT]), atol=5e-5)
    expected = Rotation.from_rotvec([ROLL, 0, 0]) * start_rotation
    assert (rotation * expected.inv()).magnitude() < 5e-4
    assert actions[-1, 6] == pytest.approx(CLOSURE)
    assert max(world.leads) <= 0.07
    assert np.abs(np.diff(actions[:, :6], axis=0)).max() <= 0.6 * world.tick + 1e-9


def test_lerobot_teleoperate_from_its_command_line(world, events, tmp_path, monkeypatch):
    def interrupt():
        raise KeyboardInterrupt

    world.on_end = interrupt
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "lerobot-teleoperate",
            "--robot.type=fake_ur5e",
            f"--robot.calibration_dir={tmp_path}",
            "--teleop.type=spacemouse_twist",
            f"--teleop.calibration_dir={tmp_path}",
            "--teleop.robot_ip=192.0.2.1",
            f"--teleop.device={events}",
            "--fps=500",
        ],
    )
    lerobot_teleoperate.teleoperate()
    check_motion(world)
    # The stock order: it is why the teleoperator must not look where the arm is before the first action.
    assert world.order == ["teleoperator connected", "robot connected", "robot disconnected"]
    assert not world.arm.is_open


def test_lerobot_record_writes_what_the_robot_was_sent(world, events, tmp_path, monkeypatch):
    controls = {"exit_early": False, "rerecord_episode": False, "stop_recording": False}
    monkeypatch.setattr(lerobot_record, "init_keyboard_listener", lambda: (None, controls))
    world.on_end = lambda: controls.update(exit_early=True)
    root = tmp_path / "dataset"
    lerobot_record.record(
        lerobot_record.RecordConfig(
            robot=fakes.FakeUR5eConfig(calibration_dir=tmp_path),
            teleop=SpaceMouseTwistConfig(robot_ip="192.0.2.1", device=events, calibration_dir=tmp_path),
            dataset=DatasetRecordConfig(
                repo_id="me/rehearsal",
                single_task="open the door",
                root=root,
                fps=200,
                episode_time_s=120,
                num_episodes=1,
                push_to_hub=False,
            ),
            play_sounds=False,
        )
    )
    check_motion(world)
    dataset = LeRobotDataset("me/rehearsal", root=root)
    assert dataset.features[ACTION]["names"] == dataset.features[OBS_STATE]["names"] == fakes.FEATURES
    assert [f"{joint}.pos" for joint in (*UR5E.joints, "gripper")] == fakes.FEATURES
    recorded = np.array(dataset.hf_dataset.with_format("numpy")[ACTION])
    np.testing.assert_allclose(recorded, world.actions, atol=1e-6)


def test_an_operator_may_be_recorded_and_played_again(world, events, tmp_path):
    again = tmp_path / "again.jsonl"

    def run(**fields):
        world.actions.clear()
        world.arm.measured, world.arm.gripper = fakes.READY.copy(), 0.0
        config = SpaceMouseTwistConfig(robot_ip="192.0.2.1", calibration_dir=tmp_path, **fields)
        teleop = lerobot_teleoperate.make_teleoperator_from_config(config)
        robot = fakes.FakeUR5e(fakes.FakeUR5eConfig(calibration_dir=tmp_path))
        processors = lerobot_teleoperate.make_default_processors()
        teleop.connect()
        # An iteration a call: the loop looks at its duration after each.
        for _ in range(world.steps):
            lerobot_teleoperate.teleop_loop(teleop, robot, 10_000, *processors, duration=0.0)
        teleop.disconnect()
        return np.array(world.actions)

    first = run(device=events, record_events=again)
    np.testing.assert_allclose(run(device=again), first, atol=1e-9)
