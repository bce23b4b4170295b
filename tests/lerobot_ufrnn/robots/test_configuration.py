"""Settings that are refused, and how little their import takes along."""

import subprocess
import sys

import pytest
from draccus.utils import ParsingError

from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.teleoperators import KeyboardTwistConfig, SpaceMouseTwistConfig


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ip", ""),
        ("command_limit", 0.0),
        ("command_limit", 2.0),
        ("joint_speed", 4.0),
        ("servo_gain", 50.0),
        ("servo_lookahead", 0.5),
        ("stale_after", float("nan")),
        ("joint_low", (0.0,) * 5),
        ("joint_low", (7.0,) * 6),
        ("workspace_low", (2.0, -1.0, 0.0)),
        ("gripper_range", (230, 3)),
        ("gripper_range", (3, 256)),
        ("image_size", -1),
    ],
)
def test_settings_of_the_robot_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ParsingError, match=f"`{name}`"):
        UR5eRobotiqConfig(**{"ip": "127.0.0.9", name: value})


@pytest.mark.parametrize(
    ("config_class", "name", "value", "allowed"),
    [
        (SpaceMouseTwistConfig, "robot_ip", "", "address"),
        (SpaceMouseTwistConfig, "frame", "world", "'base', 'tool'"),
        (SpaceMouseTwistConfig, "linear_speed", 5.0, r"at least 0.001 and at most 0.5 m/s, got 5.0"),
        (SpaceMouseTwistConfig, "deadzone", 1.0, "at most 0.9"),
        (KeyboardTwistConfig, "max_lead", float("nan"), "at most 0.5 rad"),
        (KeyboardTwistConfig, "gripper_range", (230, 3), "low < high"),
    ],
)
def test_settings_of_a_teleoperator_out_of_range_are_refused_by_name(config_class, name, value, allowed):
    with pytest.raises(ParsingError, match=f"`{name}` must .*{allowed}"):
        config_class(**{"robot_ip": "192.0.2.1", name: value})


def test_configurations_import_neither_mujoco_nor_opencv_nor_a_keyboard():
    code = (
        "import sys, lerobot_ufrnn.robots.ur5e_robotiq, lerobot_ufrnn.teleoperators;"
        "print({'mujoco', 'cv2', 'pynput', 'pyspacemouse', 'rtde_control'} & set(sys.modules))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert loaded.strip() == "set()"
