"""What may be sent to the arm."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from env_door.scene import load_model
from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.robots.ur5e_robotiq.configuration import FEATURES, JOINTS
from lerobot_ufrnn.robots.ur5e_robotiq.limits import Limits, flange_position

HOME = np.array([2.80, -1.60, 1.57, 0.03, 1.23, 1.57])


def joints(bound):
    return st.lists(st.floats(-bound, bound), min_size=6, max_size=6).map(np.array)


def action_of(target, gripper=0.5) -> dict[str, float]:
    return dict(zip(FEATURES, [*target, gripper], strict=True))


def limits(**overrides) -> Limits:
    return Limits(UR5eRobotiqConfig(ip="127.0.0.9", **overrides))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["elbow.pos", "gripper.pos"])
def test_what_is_not_finite_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"must be finite, got \{{'{name}'.*nothing was sent"):
        limits().check({**action_of(HOME), name: value})


def test_other_joints_are_refused():
    action = action_of(HOME)
    with pytest.raises(ValueError, match=r"must have exactly .*nothing was sent"):
        limits().check(dict(list(action.items())[:4]))
    with pytest.raises(ValueError, match="joint_7"):
        limits().check({**action, "joint_7.pos": 0.0})


@pytest.mark.parametrize(("gripper", "expected"), [(-0.5, 0.0), (0.3, 0.3), (7.0, 1.0)])
def test_an_action_is_read_in_the_order_of_the_joints(gripper, expected):
    target, closure = limits().check(dict(reversed(action_of(HOME, gripper).items())))
    np.testing.assert_array_equal(target, HOME)
    assert closure == expected


@settings(max_examples=200)
@given(target=joints(6), shift=joints(0.08))
def test_whatever_is_asked_for_stays_near_the_measured_joints_within_speed_and_range(target, shift):
    measured = HOME + shift
    sent = limits(joint_speed=0.5).limit(target, HOME, measured)
    assert (np.abs(sent - HOME) <= 0.05 + 1e-9).all()
    assert (np.abs(sent - measured) <= 0.08 + 0.05 + 1e-9).all()
    assert (np.abs(sent) <= 2 * np.pi).all()


@pytest.mark.parametrize(
    ("settings", "step", "sent"),
    [
        ({}, [0.05, -0.05, 0.02, 0.0, 0.07, -0.07], [0.05, -0.05, 0.02, 0.0, 0.07, -0.07]),
        ({}, [1.0] * 6, [0.08] * 6),
        ({"joint_speed": 0.3}, [-1.0] * 6, [-0.03] * 6),
        ({"joint_high": tuple(HOME + 0.01)}, [0.05] * 6, [0.01] * 6),
    ],
    ids=["within all limits", "command limit", "joint speed", "joint range"],
)
def test_a_step_from_rest_is_cut_to_the_tightest_limit(settings, step, sent):
    np.testing.assert_allclose(limits(**settings).limit(HOME + step, HOME, HOME), HOME + sent, atol=1e-12)


def test_the_flange_does_not_leave_the_workspace_but_may_return_to_it():
    turn = np.array([0.05, 0, 0, 0, 0, 0])
    outward = max((turn, -turn), key=lambda step: flange_position(HOME + step)[1])
    y = float(flange_position(HOME)[1])
    guarded = limits(workspace_high=(0.95, y + 0.02, 1.1))
    for step in (outward, -outward):
        commanded, furthest = HOME.copy(), y
        for _ in range(40):
            commanded = guarded.limit(commanded + step, commanded, commanded)
            furthest = max(furthest, flange_position(commanded)[1])
        assert furthest <= y + 0.02 + 1e-9
        assert furthest > y or step is not outward  # it was the wall that stopped it
    outside = limits(workspace_high=(0.95, y - 0.1, 1.1))
    np.testing.assert_allclose(outside.limit(HOME - outward, HOME, HOME), HOME - outward)
    np.testing.assert_allclose(outside.limit(HOME + outward, HOME, HOME), HOME)


@pytest.mark.parametrize("seed", range(5))
def test_the_flange_is_where_the_simulated_arm_has_it(seed):
    model = load_model("ur5e")
    data = mujoco.MjData(model)
    pose = np.random.default_rng(seed).uniform(-2, 2, 6)
    data.qpos[[model.joint(name).qposadr[0] for name in JOINTS]] = pose
    mujoco.mj_kinematics(model, data)
    base, flange = data.body("base"), data.body("flange")
    expected = base.xmat.reshape(3, 3).T @ (flange.xpos - base.xpos)
    np.testing.assert_allclose(flange_position(pose), expected, atol=1e-6)
