"""What may be sent to the arm, and the mailbox that carries it."""

import multiprocessing
import sys
import threading

import mujoco
import numpy as np
import pytest
from draccus.utils import ParsingError
from hypothesis import given, settings
from hypothesis import strategies as st

from env_door.scene import load_model
from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.robots.ur5e_robotiq.configuration_ur5e_robotiq import JOINTS
from lerobot_ufrnn.robots.ur5e_robotiq.limits import Limits, flange_position
from lerobot_ufrnn.robots.ur5e_robotiq.mailbox import Mailbox

HOME = np.array([2.80, -1.60, 1.57, 0.03, 1.23, 1.57])
joints = st.lists(st.floats(-6, 6), min_size=6, max_size=6).map(np.array)


def action_of(target, gripper=0.5) -> dict[str, float]:
    return {f"{name}.pos": value for name, value in zip((*JOINTS, "gripper"), [*target, gripper], strict=True)}


def limits(**overrides) -> Limits:
    return Limits(UR5eRobotiqConfig(ip="127.0.0.9", **overrides))


# ── What is refused ───────────────────────────────────────────────────


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
    action = dict(reversed(action_of(HOME, gripper).items()))
    target, closure = limits().check(action)
    np.testing.assert_array_equal(target, HOME)
    assert closure == expected


# ── What is limited ───────────────────────────────────────────────────


@settings(max_examples=200)
@given(target=joints, shift=st.lists(st.floats(-0.08, 0.08), min_size=6, max_size=6).map(np.array))
def test_whatever_is_asked_for_stays_near_the_measured_joints_within_speed_and_range(target, shift):
    measured = HOME + shift
    sent = limits(joint_speed=0.5).limit(target, HOME, measured)
    assert (np.abs(sent - HOME) <= 0.05 + 1e-9).all()
    assert (np.abs(sent - measured) <= 0.08 + 0.05 + 1e-9).all()
    assert (np.abs(sent) <= 2 * np.pi).all()


def test_what_is_within_all_limits_is_sent_as_it_is():
    target = HOME + np.array([0.05, -0.05, 0.02, 0.0, 0.07, -0.07])
    np.testing.assert_array_equal(limits().limit(target, HOME, HOME), target)


def test_a_jump_of_a_radian_becomes_a_step():
    np.testing.assert_allclose(limits().limit(HOME + 1.0, HOME, HOME), HOME + 0.08)
    np.testing.assert_allclose(limits(joint_speed=0.3).limit(HOME - 1.0, HOME, HOME), HOME - 0.03)


def test_joint_ranges_hold():
    high = tuple(HOME + 0.01)
    sent = limits(joint_high=high, joint_low=(-6.0,) * 6).limit(HOME + 0.05, HOME, HOME)
    np.testing.assert_allclose(sent, HOME + 0.01)


def test_the_flange_does_not_leave_the_workspace_but_may_return_to_it():
    position = flange_position(HOME)
    wall = (0.95, float(position[1]) + 0.02, 1.1)
    guarded = limits(workspace_high=wall)
    commanded = HOME.copy()
    furthest = -np.inf
    for _ in range(40):  # turns the base so that the flange moves to larger y
        step = np.array([-0.05 * np.sign(position[0]) * -1, 0, 0, 0, 0, 0])
        commanded = guarded.limit(commanded + step, commanded, commanded)
        furthest = max(furthest, flange_position(commanded)[1])
    other = HOME.copy()
    for _ in range(40):
        other = guarded.limit(other - step, other, other)
        furthest = max(furthest, flange_position(other)[1])
    assert furthest <= wall[1] + 1e-9
    assert furthest > wall[1] - 0.02  # it was the wall that stopped it
    inside = limits(workspace_high=(0.95, float(position[1]) - 0.1, 1.1))  # now it is outside
    towards = [step, -step]
    back = max(towards, key=lambda move: -flange_position(HOME + move)[1])
    np.testing.assert_allclose(inside.limit(HOME + back, HOME, HOME), HOME + back)
    np.testing.assert_allclose(inside.limit(HOME - back, HOME, HOME), HOME)


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


# ── Configuration ─────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ip", ""),
        ("command_limit", 0.0),
        ("command_limit", 2.0),
        ("joint_speed", 4.0),
        ("servo_gain", 50.0),
        ("servo_lookahead", 0.5),
        ("stale_after", float("nan")),
        ("joint_low", (0.0,) * 5),
        ("joint_low", (7.0,) * 6),
        ("workspace_low", (2.0, -1.0, 0.0)),
        ("gripper_range", (230, 3)),
        ("image_size", -1),
    ],
)
def test_settings_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ParsingError, match=f"`{name}`"):
        UR5eRobotiqConfig(**{"ip": "127.0.0.9", name: value})


# ── The mailbox ───────────────────────────────────────────────────────


def test_a_reader_never_sees_half_a_vector():
    mailbox = Mailbox(multiprocessing.get_context("spawn"), 5)
    assert mailbox.read()[0] == 0
    last = 20_000

    def write_often():
        for number in range(1, last + 1):
            mailbox.write(np.full(5, float(number)))

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    writer = threading.Thread(target=write_often)
    writer.start()
    try:
        seen, is_running = 0, True
        while is_running:
            is_running = writer.is_alive()
            count, values = mailbox.read()
            assert count >= seen
            assert (values == count).all()
            seen = count
    finally:
        writer.join()
        sys.setswitchinterval(before)
    assert seen == last


def test_a_writer_that_stops_half_way_leaves_the_last_whole_vector():
    mailbox = Mailbox(multiprocessing.get_context("spawn"), 2)
    for value in (1.0, 2.0):
        mailbox.write(np.full(2, value))
        before = bytes(mailbox._shared)
        mailbox.write(np.full(2, 7.0))
        after = np.frombuffer(bytes(mailbox._shared))
        for written in np.flatnonzero(after != np.frombuffer(before))[1:]:  # the count, at the front, comes last
            np.frombuffer(mailbox._shared)[:] = np.frombuffer(before)
            np.frombuffer(mailbox._shared)[written] = after[written]
            count, values = mailbox.read()
            assert (count, values.tolist()) == (int(np.frombuffer(before)[0]), [value, value])
        np.frombuffer(mailbox._shared)[:] = np.frombuffer(before)
