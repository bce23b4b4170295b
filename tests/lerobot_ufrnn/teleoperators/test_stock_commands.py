"""LeRobot's own commands, unchanged, with an operator whose events are played."""

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
from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig, robot
from lerobot_ufrnn.teleoperators import SpaceMouseTwistConfig, twist_teleoperator

STEPS, PERIOD = 40, 0.1


def write(path, *events):
    """Events as (time, twist, buttons)."""
    lines = (json.dumps({"time": time, "twist": twist, "buttons": buttons}) for time, twist, *buttons in events)
    path.write_text("\n".join(lines))
    return path


class World:
    """The arm, and in place of the robot's servo what brings it at once where it is sent; a period passes with each."""

    fault, speed_scaling = None, 1.0

    def __init__(self):
        self.arm, self.clock, self.sent, self.leads, self.order = fakes.FakeArmState(), fakes.Clock(), [], [], []
        self.controls = {"exit_early": False, "rerecord_episode": False, "stop_recording": False}

    def open(self):
        self.order.append("teleoperator connected")
        self.arm.is_open = True

    def start(self):
        self.order.append("robot connected")

    def stop(self):
        self.order.append("robot disconnected")

    def read(self):
        return self.arm.measured, self.arm.measured

    def move_to(self, target):
        self.leads.append(np.abs(target - self.arm.measured).max())
        self.sent.append(target)
        self.arm.measured = target
        self.clock.now += PERIOD
        self.controls["exit_early"] = len(self.sent) == STEPS


@pytest.fixture
def world(monkeypatch):
    world = World()
    monkeypatch.setattr(world.arm, "open", world.open)
    monkeypatch.setattr(twist_teleoperator, "ArmState", lambda *_: world.arm)
    monkeypatch.setattr(twist_teleoperator, "monotonic", world.clock)
    monkeypatch.setattr(lerobot_record, "init_keyboard_listener", lambda: (None, world.controls))
    monkeypatch.setattr(robot, "Servo", lambda _: world)
    monkeypatch.setattr(robot, "check_ready", lambda _: None)
    return world


def test_lerobot_record_writes_what_the_robot_was_sent(world, tmp_path):
    # Changes lie between the periods: each state lasts for a whole number of them.
    device = write(
        tmp_path / "events.jsonl",
        (0.0, [0, 0, 0, 0, 0, 0]),
        (0.05, [0, 0, 0.5, 0, 0, 0]),
        (1.05, [0, 0, 0, 0.6, 0, 0]),
        (2.05, [0, 0, 0, 0, 0, 0], "close"),
        (2.55, [0, 0, 0, 0, 0, 0]),
    )
    lerobot_record.record(
        lerobot_record.RecordConfig(
            robot=UR5eRobotiqConfig(ip="192.0.2.1", gripper_port=0, calibration_dir=tmp_path),
            teleop=SpaceMouseTwistConfig(robot_ip="192.0.2.1", device=device, calibration_dir=tmp_path),
            dataset=DatasetRecordConfig(
                repo_id="me/rehearsal",
                single_task="open the door",
                root=tmp_path / "dataset",
                fps=200,
                episode_time_s=120,
                num_episodes=1,
                push_to_hub=False,
            ),
            play_sounds=False,
        )
    )
    # The order is LeRobot's: it is why the teleoperator must not look where the arm is before the first action.
    assert world.order == ["teleoperator connected", "robot connected", "robot disconnected"]
    assert not world.arm.is_open
    dataset = LeRobotDataset("me/rehearsal", root=tmp_path / "dataset")
    assert dataset.features[ACTION]["names"] == dataset.features[OBS_STATE]["names"] == fakes.FEATURES
    assert [f"{joint}.pos" for joint in (*UR5E.joints, "gripper")] == fakes.FEATURES
    actions = np.array(dataset.hf_dataset.with_format("numpy")[ACTION])
    joints = np.array(world.sent)
    np.testing.assert_allclose(actions[:, :6], joints, atol=1e-6)

    np.testing.assert_array_equal(joints[0], fakes.READY)
    assert (actions[0, 6], actions[-1, 6]) == (0.0, pytest.approx(0.5))
    start, start_rotation = fakes.tool_pose(fakes.READY)
    position, rotation = fakes.tool_pose(joints[-1])
    np.testing.assert_allclose(position - start, [0, 0, 1.0 * 0.5 * 0.1], atol=5e-5)
    turned = (rotation * start_rotation.inv()) * Rotation.from_rotvec([1.0 * 0.6 * 0.5, 0, 0]).inv()
    assert turned.magnitude() < 5e-4
    assert max(world.leads) <= 0.07
    assert np.abs(np.diff(joints, axis=0)).max() <= 0.6 * PERIOD + 1e-9


def test_lerobot_teleoperate_moves_the_twin_along_and_nothing_else(tmp_path, monkeypatch):
    """The real client of the controller, the robot and its twin: nothing stands in for anything here."""
    pytest.importorskip("rtde_control", reason="needs the extra `ur5e`")
    from env_door.twin import TwinProcess

    device = write(
        tmp_path / "events.jsonl",
        (0.0, [0, 0, 0, 0, 0, 0]),
        (0.5, [-0.6, 0, 0, 0, 0, 0]),
        (1.3, [0, 0, 0.6, 0, 0, 0], "close"),
        (2.1, [0, 0, 0, 0, 0, 0]),
    )
    with TwinProcess(kind="push", seed=3) as twin:
        before = twin.state()["joints"]
        flags = [
            "--robot.type=ur5e_robotiq",
            f"--robot.ip={twin.address}",
            f"--robot.calibration_dir={tmp_path}",
            "--teleop.type=spacemouse_twist",
            f"--teleop.robot_ip={twin.address}",
            f"--teleop.device={device}",
            f"--teleop.calibration_dir={tmp_path}",
            "--fps=10",
            "--teleop_time_s=3",
        ]
        monkeypatch.setattr(sys, "argv", ["lerobot-teleoperate", *flags])
        lerobot_teleoperate.teleoperate()
        after = twin.state()["joints"]
    (start, start_rotation), (position, rotation) = (
        fakes.tool_pose([joints[name] for name in fakes.JOINTS]) for joints in (before, after)
    )
    # How far depends on how evenly the loop ran; the way does not.
    back, aside, up = position - start
    assert -0.06 < back < -0.02
    assert 0.02 < up < 0.06
    assert abs(aside) < 0.002
    assert (rotation * start_rotation.inv()).magnitude() < 0.01
    assert before["gripper"] < 0.05
    assert after["gripper"] > 0.4
