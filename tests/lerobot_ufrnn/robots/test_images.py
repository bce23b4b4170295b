"""Images that show nothing are noticed, and good ones never are."""

import numpy as np
import pytest

from lerobot_ufrnn.robots.ur5e_robotiq import Fault, RobotFaultError
from lerobot_ufrnn.robots.ur5e_robotiq.robot import PictureCheck, fit_image

STILL = [np.zeros(6)] * 50
IMAGE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
BLACK = np.random.default_rng(1).integers(0, 4, (48, 64, 3), dtype=np.uint8)  # with the noise of a covered lens


def moving(speed=0.1):
    return [np.array([0, 0, 0, 0, 0, speed * 0.1 * index]) for index in range(50)]


def watch(images, joints):
    """Shows 50 images, ten a second; at which one it complains, and how."""
    now = 0.0
    check = PictureCheck("front", clock=lambda: now)
    for index, (image, pose) in enumerate(zip(images, joints, strict=True)):
        now = index * 0.1
        try:
            check.check(image, pose)
        except RobotFaultError as error:
            return index, error
    return None


@pytest.mark.parametrize(
    ("images", "joints"),
    [
        ([IMAGE ^ (index % 2) for index in range(50)], moving()),
        ([IMAGE ^ (index % 2) for index in range(50)], STILL),
        ([IMAGE] * 50, STILL),
        ([IMAGE ^ (index // 9 % 2) for index in range(50)], moving()),
        ([BLACK if index % 5 else IMAGE for index in range(50)], STILL),
        *(([np.full((48, 64, 3), shade, np.uint8)] * 50, STILL) for shade in (4, 128, 255)),
    ],
    ids=["live, moving", "live, at rest", "same, at rest", "late for 0.9 s", "flicker", "dark", "gray", "white"],
)
def test_these_are_good(images, joints):
    assert watch(images, joints) is None


@pytest.mark.parametrize(("speed", "noticed"), [(0.1, 10), (0.02, 25)])
def test_the_same_image_is_not_good_once_the_arm_has_moved_for_a_second_and_far_enough_to_show(speed, noticed):
    index, error = watch([IMAGE] * 50, moving(speed))
    assert index == noticed  # a second, 0.05 rad
    assert error.fault is Fault.CAMERA
    moved = f"{speed * noticed / 10:.2f}"
    assert f"camera 'front' has sent the same picture for {noticed / 10} s, in which the arm moved by {moved}" in str(
        error
    )


def test_a_second_of_black_images_is_noticed():
    noise = np.random.default_rng(2)
    index, error = watch([BLACK ^ noise.integers(0, 2, dtype=np.uint8) for _ in range(50)], STILL)
    assert index == 10
    assert error.fault is Fault.CAMERA
    assert "camera 'front' has been black for 1.0 s" in str(error)


def test_an_image_is_cut_to_its_middle_square_and_resized():
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, 8:56] = 200
    assert fit_image(image, 0) is image
    np.testing.assert_array_equal(fit_image(image, 16), np.full((16, 16, 3), 200))
