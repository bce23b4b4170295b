"""A robot and an arm state without hardware, a clock that a test moves, and the UR5e's kinematics without MuJoCo."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
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
    """Stands in for `ArmState`: the arm of a `FakeUR5e`."""

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


@dataclass
class World:
    """What a `FakeUR5e` and its test share."""

    arm: FakeArmState = field(default_factory=FakeArmState)
    clock: Clock = field(default_factory=Clock)
    steps: int = 40
    tick: float = 0.1
    actions: list = field(default_factory=list)
    leads: list = field(default_factory=list)
    order: list = field(default_factory=list)
    on_end: Any = None


WORLD: list[World] = []
"""The world that the next robot is born into; LeRobot's factory hands it nothing but its configuration."""


@RobotConfig.register_subclass("fake_ur5e")
@dataclass(kw_only=True)
class FakeUR5eConfig(RobotConfig):
    """Nothing to configure."""


class FakeUR5e(Robot):
    """Has the features of the real one and is always where it was sent; each observation lets a tick pass."""

    config_class = FakeUR5eConfig
    name = "fake_ur5e"

    def __init__(self, config):
        super().__init__(config)
        self.world = WORLD[-1]
        self.cameras = {}
        self._connected = False

    @property
    def observation_features(self):
        return dict.fromkeys(FEATURES, float)

    @property
    def action_features(self):
        return dict.fromkeys(FEATURES, float)

    @property
    def is_connected(self):
        return self._connected

    @property
    def is_calibrated(self):
        return True

    def calibrate(self):
        pass

    def configure(self):
        pass

    def connect(self, calibrate=True):
        self._connected = True
        self.world.order.append("robot connected")

    def get_observation(self):
        self.world.clock.now += self.world.tick
        return dict(zip(FEATURES, (*self.world.arm.measured, self.world.arm.gripper), strict=True))

    def send_action(self, action):
        target = np.array([action[name] for name in FEATURES[:-1]])
        self.world.actions.append([action[name] for name in FEATURES])
        self.world.leads.append(np.abs(target - self.world.arm.measured).max())
        self.world.arm.measured = target
        self.world.arm.gripper = action["gripper.pos"]
        if len(self.world.actions) == self.world.steps and self.world.on_end is not None:
            self.world.on_end()
        return action

    def disconnect(self):
        self._connected = False
        self.world.order.append("robot disconnected")
