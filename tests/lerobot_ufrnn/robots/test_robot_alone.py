"""Parts of the robot that need no arm: images that show nothing are noticed, and the program ends in order."""

import os
import signal
import threading

import numpy as np
import pytest

from lerobot_ufrnn.robots.ur5e_robotiq import Fault, RobotFaultError
from lerobot_ufrnn.robots.ur5e_robotiq.robot import PictureCheck, ending_in_order, fit_image

IMAGE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
BLACK = np.random.default_rng(1).integers(0, 4, (48, 64, 3), dtype=np.uint8)  # with the noise of a covered lens
LIVE = [IMAGE ^ (index % 2) for index in range(50)]


def watch(images, speed):
    """Shows 50 images, ten a second, while a joint moves; at which one it complains, and how."""
    check = PictureCheck("front")
    for index, image in enumerate(images):
        try:
            check.check(image, np.array([0, 0, 0, 0, 0, speed * 0.1 * index]), now=index * 0.1)
        except RobotFaultError as error:
            return index, error.fault, str(error)
    return None


@pytest.mark.parametrize(
    ("images", "speed"),
    [
        (LIVE, 0.1),
        (LIVE, 0),
        ([IMAGE] * 50, 0),
        ([IMAGE ^ (index // 9 % 2) for index in range(50)], 0.1),
        ([BLACK if index % 5 else IMAGE for index in range(50)], 0),
        *(([np.full((48, 64, 3), shade, np.uint8)] * 50, 0) for shade in (4, 128, 255)),
    ],
    ids=["live, moving", "live, at rest", "same, at rest", "late for 0.9 s", "flicker", "dark", "gray", "white"],
)
def test_these_are_good(images, speed):
    assert watch(images, speed) is None


@pytest.mark.parametrize(("speed", "noticed"), [(0.1, 10), (0.02, 25)])
def test_the_same_image_is_not_good_once_the_arm_has_moved_for_a_second_and_far_enough_to_show(speed, noticed):
    index, fault, told = watch([IMAGE] * 50, speed)
    assert (index, fault) == (noticed, Fault.CAMERA)  # a second, 0.05 rad
    moved = f"{speed * noticed / 10:.2f}"
    assert f"camera 'front' has sent the same picture for {noticed / 10} s, in which the arm moved by {moved}" in told


def test_a_second_of_black_images_is_noticed():
    noise = np.random.default_rng(2)
    index, fault, told = watch([BLACK ^ noise.integers(0, 2, dtype=np.uint8) for _ in range(50)], 0)
    assert (index, fault) == (10, Fault.CAMERA)
    assert "camera 'front' has been black for 1.0 s" in told


def test_an_image_is_cut_to_its_middle_square_and_resized():
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, 8:56] = 200
    assert fit_image(image, 0) is image
    np.testing.assert_array_equal(fit_image(image, 16), np.full((16, 16, 3), 200))


ENDING = (signal.SIGTERM, signal.SIGHUP)


@pytest.fixture
def signals():
    """Signals as Python has them when it starts."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def restored():
    return [number for number in ENDING if signal.getsignal(number) == signal.SIG_DFL]


@pytest.mark.parametrize("number", ENDING)
def test_a_program_that_is_told_to_end_closes_what_it_has_open_undisturbed(signals, number):
    closed = []

    @ending_in_order()
    def work():
        try:
            os.kill(os.getpid(), number)
        finally:
            for impatient in ENDING:
                os.kill(os.getpid(), impatient)
            closed.append("all")

    with pytest.raises(SystemExit) as end:
        work()
    assert closed == ["all"]
    assert end.value.code == 128 + number
    assert restored() == list(ENDING)


def test_what_a_program_does_on_a_signal_by_itself_it_goes_on_doing(signals):
    told = []
    signal.signal(signal.SIGTERM, lambda *_: told.append("before"))
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    with ending_in_order():
        for number in ENDING:
            os.kill(os.getpid(), number)
    os.kill(os.getpid(), signal.SIGTERM)
    assert told == ["before", "before"]
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def test_a_signal_that_somebody_takes_over_later_stays_with_them(signals):
    with ending_in_order():
        signal.signal(signal.SIGTERM, later := lambda *_: None)
    assert signal.getsignal(signal.SIGTERM) is later
    assert restored() == [signal.SIGHUP]


def test_in_another_thread_signals_are_left_alone(signals):
    seen = []
    thread = threading.Thread(target=ending_in_order()(lambda: seen.extend(restored())))
    thread.start()
    thread.join()
    assert seen == restored() == list(ENDING)
