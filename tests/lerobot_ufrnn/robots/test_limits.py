"""What may be sent to the arm."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from teleoperators_fakes import FEATURES, JOINTS
from teleoperators_fakes import READY as HOME

from env_door.scene import load_model
from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.robots.ur5e_robotiq.limits import Limits, flange_position


def joints(bound):
    return st.lists(st.floats(-bound, bound), min_size=6, max_size=6).map(np.array)


def limits(**overrides) -> Limits:
    return Limits(UR5eRobotiqConfig(ip="127.0.0.9", **overrides))


ACTION = dict(zip(FEATURES, [*HOME, 0.5], strict=True))


@pytest.mark.parametrize(
    ("action", "reason"),
    [
        *(
            (ACTION | {name: value}, rf"must be finite, got \{{'{name}'.*nothing was sent")
            for name in ("elbow.pos", "gripper.pos")
            for value in (float("nan"), float("inf"), -float("inf"))
        ),
        (dict(list(ACTION.items())[:4]), r"must have exactly .*nothing was sent"),
        (ACTION | {"joint_7.pos": 0.0}, "joint_7"),
        (ACTION | {"elbow.pos": "1.5"}, r"must be numbers, got \{'elbow.pos': '1.5'\}; nothing was sent"),
        (ACTION | {"gripper.pos": None}, r"must be numbers, got \{'gripper.pos': None\}; nothing was sent"),
    ],
)
def test_what_is_no_action_is_refused_by_name(action, reason):
    with pytest.raises(ValueError, match=reason):
        limits().check(action)


@pytest.mark.parametrize(("gripper", "expected"), [(-0.5, 0.0), (0.3, 0.3), (7.0, 1.0)])
def test_an_action_is_read_in_the_order_of_the_joints(gripper, expected):
    target, closure = limits().check(dict(reversed((ACTION | {"gripper.pos": gripper}).items())))
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


def test_the_flange_is_where_the_simulated_arm_has_it():
    model = load_model("ur5e")
    data = mujoco.MjData(model)
    base, flange = data.body("base"), data.body("flange")
    for pose in np.random.default_rng(0).uniform(-2, 2, (5, 6)):
        data.qpos[[model.joint(name).qposadr[0] for name in JOINTS]] = pose
        mujoco.mj_kinematics(model, data)
        expected = base.xmat.reshape(3, 3).T @ (flange.xpos - base.xpos)
        np.testing.assert_allclose(flange_position(pose), expected, atol=1e-6)
