"""The way between targets: what is sent, and what an arm that smooths set-points makes of it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from env_door.twin.motion import TIME_STEP, JointMotion
from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.robots.ur5e_robotiq.approach import FADE, Approach

SPEED = 0.4
"""rad/s of the fastest joint in these tests."""

LOOKAHEAD = 0.1
DIRECTION = np.array([1.0, -0.5, 0.25, 0.0, -1.0, 0.1])


def config(**fields) -> UR5eRobotiqConfig:
    return UR5eRobotiqConfig(ip="127.0.0.9", servo_lookahead=LOOKAHEAD, servo_gain=300.0, **fields)


def follow(seconds, moving, lead, delay=0.0):
    """An arm that goes along a ramp which ends after `moving` s, its targets `delay` s late in turns.

    Returns the time, the set-points and the positions of the first joint, and where the ramp is, every 2 ms.
    """
    approach = Approach(np.zeros(6), config(servo_lead=lead))
    arm = JointMotion(np.full(6, -6.0), np.full(6, 6.0), np.full(6, 3.0))
    times = np.arange(round(seconds / TIME_STEP)) * TIME_STEP
    ramp = SPEED * np.minimum(times, moving)
    targets = [(0.1 * number + delay * (number % 2), 0.1 * (number + 1)) for number in range(round(moving / 0.1))]
    sent, positions = [], []
    for tick, now in enumerate(times):
        if targets and now >= targets[0][0] - 1e-9:
            approach.aim(SPEED * targets.pop(0)[1] * DIRECTION, arm.position, now)
        if tick % 4 == 0:  # 125 set-points a second
            set_point = approach.set_point(arm.position, now)
            arm.servo(set_point, LOOKAHEAD, 300.0)
        arm.step()
        sent.append(set_point[0])
        positions.append(arm.position[0])
    return times, np.array(sent), np.array(positions), ramp


def test_without_a_lead_set_points_lie_on_the_line():
    approach, begin = Approach(np.full(6, 0.5), config(servo_lead=0.0)), np.full(6, 0.5)
    assert (approach.set_point(begin, 3.0) == begin).all()
    approach.aim(begin + 0.04 * DIRECTION, begin, 4.0)
    for now, part in ((4.0, 0.0), (4.025, 0.25), (4.1, 1.0), (7.0, 1.0)):
        expected = begin + 0.04 * part * DIRECTION
        np.testing.assert_allclose(approach.set_point(begin, now), expected, atol=1e-12)
        np.testing.assert_allclose(approach.position, expected, atol=1e-12)


def test_a_new_target_before_the_end_of_the_line_bends_it_there():
    approach = Approach(np.zeros(6), config())
    approach.aim(np.full(6, 0.04), np.zeros(6), 0.0)
    approach.aim(np.zeros(6), np.zeros(6), 0.05)
    approach.set_point(np.zeros(6), 0.1)
    np.testing.assert_allclose(approach.position, 0.01, atol=1e-12)


def test_an_arm_that_smooths_set_points_trails_the_line_only_without_a_lead():
    times, _, positions, ramp = follow(1.0, moving=1.0, lead=0.0)
    settled = times > 0.6
    np.testing.assert_allclose((ramp - positions)[settled], SPEED * LOOKAHEAD, atol=0.004)
    _, _, positions, ramp = follow(1.0, moving=1.0, lead=LOOKAHEAD)
    np.testing.assert_allclose((ramp - positions)[settled], 0.0, atol=0.004)


def test_an_arm_whose_next_target_does_not_come_rests_at_the_last_one():
    times, sent, positions, ramp = follow(2.0, moving=1.0, lead=LOOKAHEAD)
    assert sent[times > 1.0 + 0.1 * FADE + 0.01] == pytest.approx(ramp[-1])
    assert positions[-1] == pytest.approx(ramp[-1], abs=1e-4)
    assert (positions - ramp[-1]).max() < 0.04 * SPEED  # it runs past for some hundredths of a second's way


def test_a_target_that_comes_late_gives_no_jerk():
    times, on_time, steady, _ = follow(1.0, moving=1.0, lead=LOOKAHEAD)
    _, late, uneven, _ = follow(1.0, moving=1.0, lead=LOOKAHEAD, delay=0.008)
    settled = times > 0.4
    np.testing.assert_allclose(np.diff(on_time[settled][::4]), 0.008 * SPEED, rtol=1e-9)
    assert np.abs(np.diff(steady[settled]) / TIME_STEP - SPEED).max() < 0.01 * SPEED
    # Within 8 ms only a part of the lead is taken back; all of it would be 0.04 rad and twice as much of a jerk.
    assert np.diff(late[settled][::4]).min() > -0.4 * SPEED * LOOKAHEAD
    assert np.abs(np.diff(uneven[settled]) / TIME_STEP - SPEED).max() < 0.1 * SPEED


@given(st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.0, 0.2)), min_size=1, max_size=20))
def test_an_arm_is_never_leant_against_harder_than_agreed(moments):
    limit, now = 0.08, 0.0
    approach = Approach(np.zeros(6), config(command_limit=limit))
    for target, pushed_to, elapsed in moments:
        measured = np.full(6, pushed_to)
        approach.aim(np.full(6, target), measured, now)
        now += elapsed
        assert np.abs(approach.set_point(measured, now) - measured).max() <= limit + 1e-12
        assert np.abs(approach.position - measured).max() <= limit + 1e-12
