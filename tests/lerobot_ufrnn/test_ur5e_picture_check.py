"""Pictures that show nothing are noticed, and good ones never are."""

import numpy as np
import pytest

from lerobot_ufrnn.robots.ur5e_robotiq.errors import Fault, RobotFaultError
from lerobot_ufrnn.robots.ur5e_robotiq.picture_check import PictureCheck

STILL = np.zeros(6)
PICTURE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
BLACK = np.random.default_rng(1).integers(0, 4, (48, 64, 3), dtype=np.uint8)  # with the noise of a covered lens


def watch(pictures, joints, seconds_each=0.1):
    """Shows pictures one after the other; at which one it complains, and how."""
    now = 0.0
    check = PictureCheck("front", clock=lambda: now)
    for index, (picture, pose) in enumerate(zip(pictures, joints, strict=True)):
        now = index * seconds_each
        try:
            check.check(picture, pose)
        except RobotFaultError as error:
            return index, error
    return None


def moving(count, speed=0.1):
    return [np.array([0, 0, 0, 0, 0, speed * 0.1 * index]) for index in range(count)]


def test_pictures_that_change_are_good_whatever_the_arm_does():
    noisy = [PICTURE ^ (index % 2) for index in range(50)]
    assert watch(noisy, moving(50)) is None
    assert watch(noisy, [STILL] * 50) is None


def test_the_same_picture_is_good_while_the_arm_rests():
    assert watch([PICTURE] * 50, [STILL] * 50) is None


def test_the_same_picture_while_the_arm_moves_is_not():
    index, error = watch([PICTURE] * 50, moving(50))
    assert index == 10  # a second; the arm has moved by 0.1 rad
    assert "camera 'front' has sent the same picture for 1.0 s, in which the arm moved by 0.10 rad" in str(error)
    assert error.fault is Fault.CAMERA


def test_a_slow_arm_gets_the_time_that_it_needs_to_show():
    index, _ = watch([PICTURE] * 50, moving(50, speed=0.02))
    assert index == 25  # 0.05 rad


def test_a_picture_that_is_late_for_less_than_a_second_is_good():
    assert watch([PICTURE ^ (index // 9 % 2) for index in range(50)], moving(50)) is None


def test_black_pictures_are_noticed_and_a_single_one_is_not():
    noise = np.random.default_rng(2)
    black = [BLACK ^ noise.integers(0, 2, dtype=np.uint8) for _ in range(50)]
    index, error = watch(black, [STILL] * 50)
    assert index == 10
    assert "camera 'front' has been black for 1.0 s" in str(error)
    flicker = [BLACK if index % 5 else PICTURE for index in range(50)]
    assert watch(flicker, [STILL] * 50) is None


@pytest.mark.parametrize("shade", [4, 128, 255])
def test_a_plain_wall_is_not_black(shade):
    assert watch([np.full((48, 64, 3), shade, np.uint8)] * 50, [STILL] * 50) is None
