"""The servo loop with a client that is played: what set-points it sends."""

import multiprocessing
import os
import time

import numpy as np
import pytest

from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.robots.ur5e_robotiq.limits import Limits
from lerobot_ufrnn.robots.ur5e_robotiq.servo import _Driver, _Shared

WAY = 0.6  # rad of the last joint that is asked for at once


class PlayedArm:
    """Both interfaces of the client: an arm that is where it was sent to, and asks for more after some set-points."""

    def __init__(self, config, every: int, count: int, late_at: int):
        self.shared = _Shared(multiprocessing.get_context("spawn"))
        self.sent: list[np.ndarray] = []
        self._limits, self._every, self._count, self._late_at = Limits(config), every, count, late_at
        self._joints = np.array([2.8, -1.6, 1.57, 0.0, 1.2, 0.0])
        self._goal = self._joints + np.array([0, 0, 0, 0, 0, WAY])

    def servoJ(self, joints, *_):  # noqa: N802
        self._joints = np.array(joints)
        self.sent.append(self._joints)
        if len(self.sent) % self._every == 0:
            self.shared.targets.write(self._limits.limit(self._goal, self._joints, self._joints))
        if len(self.sent) == self._late_at:
            time.sleep(0.15)
        self.shared.stop.value = len(self.sent) >= self._count
        return True

    def getActualQ(self):  # noqa: N802
        return self._joints.tolist()

    def getTimestamp(self):  # noqa: N802
        return time.monotonic()

    def __getattr__(self, name):
        answers = {"getSafetyMode": 1, "getRobotMode": 7, "getTargetSpeedFraction": 1.0, "getSpeedScaling": 1.0}
        return lambda *_: answers.get(name, True)  # connected, the program runs


@pytest.mark.real_time
@pytest.mark.parametrize("every", [1, 2, 13], ids=["125 Hz", "60 Hz", "10 Hz"])
@pytest.mark.parametrize("late_at", [0, 30], ids=["in time", "late once"])
def test_all_motion_is_made_and_never_faster_than_the_joint_speed(every, late_at):
    config = UR5eRobotiqConfig(ip="127.0.0.9", joint_speed=0.7)
    arm = PlayedArm(config, every, count=200, late_at=late_at)
    driver = _Driver(config, os.getppid(), arm.shared)
    driver._control = driver._receive = arm
    driver.drive()
    sent = np.array(arm.sent)
    assert sent[-1, -1] == pytest.approx(WAY, abs=1e-3)
    assert np.abs(np.diff(sent, axis=0)).max() <= 0.7 / config.servo_frequency + 1e-9
