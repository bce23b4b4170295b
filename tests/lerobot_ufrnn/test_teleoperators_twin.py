"""The stock command, the real client of the controller, the robot and its twin: nothing stands in for anything here."""

import json
import sys

import pytest
import teleoperators_fakes as fakes
from lerobot.scripts import lerobot_teleoperate

pytest.importorskip("rtde_control", reason="needs the extra `ur5e`")
twin_package = pytest.importorskip("env_door.twin")
pytest.importorskip("lerobot_ufrnn.robots.ur5e_robotiq")

EVENTS = [
    {"time": 0.0, "twist": [0, 0, 0, 0, 0, 0]},
    {"time": 0.5, "twist": [-0.6, 0, 0, 0, 0, 0]},
    {"time": 1.3, "twist": [0, 0, 0.6, 0, 0, 0], "buttons": ["close"]},
    {"time": 2.1, "twist": [0, 0, 0, 0, 0, 0]},
]


def test_the_operator_moves_the_twin_along_and_nothing_else(tmp_path, monkeypatch):
    events = tmp_path / "events.jsonl"
    events.write_text("".join(json.dumps(event) + "\n" for event in EVENTS))
    with twin_package.TwinProcess(address=twin_package.free_address(), kind="push", seed=3) as twin:
        before = twin.state()["joints"]
        flags = [
            "--robot.type=ur5e_robotiq",
            f"--robot.ip={twin.address}",
            f"--robot.calibration_dir={tmp_path}",
            "--teleop.type=spacemouse_twist",
            f"--teleop.robot_ip={twin.address}",
            f"--teleop.device={events}",
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
