"""An arm state and a device without hardware, a clock that a test moves, and the UR5e's kinematics without MuJoCo."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_ufrnn.teleoperators import DeviceState, TwistDevice

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
FEATURES = [f"{name}.pos" for name in (*JOINTS, "gripper")]
READY = np.array([2.80, -1.60, 1.57, 0.03, 1.23, 1.57])
LEVEL = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""Orientation of a level tool: z ahead, x up."""


def tool_pose(joints):
    """Position and rotation of the tool by Universal Robots' published Denavit-Hartenberg table."""
    table = zip(
        joints,
        (0.1625, 0, 0, 0.1333, 0.0997, 0.0996 + 0.15),
        (0, -0.425, -0.3922, 0, 0, 0),
        (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0),
        strict=True,
    )
    position, rotation = np.zeros(3), Rotation.identity()
    for angle, offset, length, twist in table:
        turn = rotation * Rotation.from_euler("z", angle)
        position = position + turn.apply([length, 0, offset])
        rotation = turn * Rotation.from_euler("x", twist)
    return position, rotation


class Clock:
    """Seconds that pass when a test says so."""

    def __init__(self):
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class FakeArmState:
    """Stands in for `ArmState`."""

    def __init__(self, joints=READY, gripper=0.0):
        self.measured = np.array(joints, dtype=np.float64)
        self.gripper = gripper
        self.is_open = False
        self.fault: Exception | None = None

    def open(self):
        self.is_open = True

    def joints(self):
        if self.fault is not None:
            raise self.fault
        return self.measured.copy()

    def gripper_target(self):
        return self.gripper

    def close(self):
        self.is_open = False


class ScriptedDevice(TwistDevice):
    """Gives what a test put into `state`; raises it if it is an exception."""

    def __init__(self, state: Any = None):
        self.state = state or DeviceState()
        self.is_open = False

    def open(self):
        self.is_open = True

    def read(self):
        if isinstance(self.state, Exception):
            raise self.state
        return self.state

    def close(self):
        self.is_open = False


def fail(error):
    """Raises, where a lambda stands in for something that fails."""
    raise error
