import numpy as np
import pytest
import teleoperators_fakes as fakes
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_ufrnn.teleoperators import SpaceMouseTwistConfig
from lerobot_ufrnn.teleoperators.tool_target import Hindrance, ToolTarget

STRETCHED = np.array([0.0, -0.6, 0.02, -1.0, 1.2, 0.0])


def make_target(**limits):
    return ToolTarget(SpaceMouseTwistConfig(robot_ip="192.0.2.1", **limits))


def drive(target, twist, steps, seconds=0.1, start=fakes.READY, follow=True):
    """Joints after some steps, with an arm that follows at once or not at all."""
    joints = target.start(np.array(start))
    for _ in range(steps):
        measured = joints if follow else np.array(start)
        joints = target.step(np.array(twist, dtype=np.float64), seconds, measured)
    return joints


def test_at_rest_the_target_is_the_start_for_ever():
    np.testing.assert_array_equal(drive(make_target(), np.zeros(6), 1000), fakes.READY)


def test_going_there_and_back_leads_back_without_drift():
    target = make_target()
    joints = target.start(fakes.READY)
    for _ in range(20):
        for sign in (1, 1, -1, -1):
            joints = target.step(sign * np.array([0.05, 0.02, 0.03, 0.2, -0.1, 0.1]), 0.1, joints)
    np.testing.assert_allclose(joints, fakes.READY, atol=2e-4)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    twists=st.lists(st.tuples(*[st.floats(-0.5, 0.5)] * 3, *[st.floats(-2, 2)] * 3), min_size=1, max_size=12),
    lags=st.lists(st.floats(0.0, 1.0), min_size=12, max_size=12),
    kicks=st.lists(st.sampled_from([0.0, 0.0, 0.3, -0.8]), min_size=12, max_size=12),
    seconds=st.floats(0.001, 0.25),
)
def test_no_target_leaves_the_lead_or_is_too_fast_whatever_the_arm_does(twists, lags, kicks, seconds):
    target = make_target(joint_speed=0.6, max_lead=0.07)
    measured = fakes.READY.copy()
    before = target.start(measured)
    for twist, lag, kick in zip(twists, lags, kicks, strict=False):
        measured = measured + kick  # by somebody else, after whom the target goes at once
        joints = target.step(np.array(twist), seconds, measured)
        assert np.isfinite(joints).all()
        assert np.abs(joints - measured).max() <= 0.07 + 1e-12
        assert kick or np.abs(joints - before).max() <= 0.6 * seconds + 1e-9
        before, measured = joints, measured + lag * (joints - measured)


def test_a_joint_that_would_be_too_fast_slows_the_tool_down_on_its_way():
    twist = np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
    slow = make_target(joint_speed=0.1)
    joints = drive(slow, twist, 5, seconds=0.02)
    moved = fakes.tool_pose(joints)[0] - fakes.tool_pose(fakes.READY)[0]
    assert 0 < moved[2] < 0.3 * 5 * 0.02
    assert np.abs(moved[:2]).max() < 2e-2 * moved[2]


def test_a_blocked_arm_is_told_and_may_be_led_back_at_once():
    target = make_target(max_lead=0.07)
    ahead = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    joints = drive(target, ahead, 30, follow=False)
    assert target.hindrance is Hindrance.BLOCKED
    assert np.abs(joints - fakes.READY).max() <= 0.07 + 1e-12
    back = target.step(-ahead, 0.1, fakes.READY)
    assert target.hindrance is None
    assert np.abs(back - fakes.READY).max() < np.abs(joints - fakes.READY).max()


def test_the_target_follows_an_arm_that_something_else_moves():
    target = make_target(max_lead=0.07)
    target.start(fakes.READY)
    elsewhere = fakes.READY + np.array([0.5, 0, 0, 0, 0, 0])
    joints = target.step(np.zeros(6), 0.1, elsewhere)
    assert target.hindrance is Hindrance.MOVED
    np.testing.assert_allclose(joints, elsewhere - [0.07, 0, 0, 0, 0, 0])
    # And the tool is led on from there, not from where it was to be.
    joints = target.step(np.array([0, 0, 0.1, 0, 0, 0]), 0.1, joints)
    expected = fakes.tool_pose(elsewhere - [0.07, 0, 0, 0, 0, 0])[0] + [0, 0, 0.01]
    np.testing.assert_allclose(fakes.tool_pose(joints)[0], expected, atol=5e-5)


def test_out_of_reach_the_target_stays_inside_and_can_be_led_back():
    target = make_target()
    up = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    joints = drive(target, up, 200)
    assert target.hindrance in (Hindrance.UNREACHABLE, Hindrance.NEAR_SINGULAR)
    stayed = target.step(up, 0.1, joints)
    np.testing.assert_array_equal(stayed, joints)
    back = target.step(-up, 0.1, joints)
    assert target.hindrance is None
    # Slower than asked, as the joints are fast there.
    assert fakes.tool_pose(back)[0][2] < fakes.tool_pose(joints)[0][2] - 0.002


def manipulability(joints):
    """|det J| with a Jacobian from the Denavit-Hartenberg table by differences."""
    jacobian = np.empty((6, 6))
    position, rotation = fakes.tool_pose(joints)
    for index in range(6):
        ahead, ahead_rotation = fakes.tool_pose(joints + 1e-6 * np.eye(6)[index])
        jacobian[:3, index] = (ahead - position) / 1e-6
        jacobian[3:, index] = (ahead_rotation * rotation.inv()).as_rotvec() / 1e-6
    return abs(np.linalg.det(jacobian))


def test_the_tool_is_not_led_into_a_singular_pose_but_out_of_one():
    assert manipulability(STRETCHED) < 0.01
    target = make_target(min_manipulability=0.01)
    joints = target.start(STRETCHED)
    position, _ = fakes.tool_pose(STRETCHED)
    outward = (position - [0, 0, 0.1625]) / np.linalg.norm(position - [0, 0, 0.1625])
    np.testing.assert_array_equal(target.step(np.append(0.05 * outward, np.zeros(3)), 0.1, joints), joints)
    assert target.hindrance in (Hindrance.NEAR_SINGULAR, Hindrance.UNREACHABLE)
    for _ in range(10):
        joints = target.step(np.append(-0.05 * outward, np.zeros(3)), 0.1, joints)
    assert manipulability(joints) > manipulability(STRETCHED)


def test_a_walk_never_falls_below_the_least_manipulability():
    rng = np.random.default_rng(0)
    target = make_target(min_manipulability=0.02)
    joints = target.start(fakes.READY)
    for _ in range(30):
        twist = np.append(rng.uniform(-0.3, 0.3, 3), rng.uniform(-1, 1, 3))
        for _ in range(10):
            joints = target.step(twist, 0.05, joints)
            assert manipulability(joints) > 0.02 * 0.98


def test_joints_beyond_their_range_are_refused_by_name():
    outside = fakes.READY.copy()
    outside[2] = 3.3
    with pytest.raises(ValueError, match=r"elbow are at \[3\.3\] rad.*pendant"):
        make_target().start(outside)
