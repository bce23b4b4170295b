import itertools

import numpy as np
import pytest

from env_door.env import DoorEnv
from env_door.expert import GRASP_CLOSURE, DoorExpert, Waypoint, ease
from env_door.latch import EIGHT_KINDS, KINDS, OPENINGS, TURNS

WRONG_THEN_RIGHT = [order for length in (2, 3) for order in itertools.permutations(KINDS, length)]
# Of the eight: each after a wrong turn, each after a wrong try with the right turn, and all of them.
OTHER_TURN = [*zip(EIGHT_KINDS, EIGHT_KINDS[4:] + EIGHT_KINDS[:4], strict=True)]
SAME_TURN = [(kind, EIGHT_KINDS[i // 4 * 4 + (i + 1) % 4]) for i, kind in enumerate(EIGHT_KINDS)]
OF_EIGHT = [*OTHER_TURN, *SAME_TURN, EIGHT_KINDS, EIGHT_KINDS[::-1], ("pull", "push_ccw", "slide_ccw", "slide_right")]


class Slowest:
    """A random generator that draws the longest durations."""

    def integers(self, low, high):
        return high - 1


def planned(env, directions, rng):
    expert = DoorExpert(env, directions)
    expert.reset(np.random.default_rng(rng) if isinstance(rng, int) else rng)
    return expert


def tries(directions):
    """What a door that opens in the last direction notes, when the expert goes through all of them."""
    turn = OPENINGS[directions[-1]].turn
    noted = [name if OPENINGS[name].turn == turn else TURNS[OPENINGS[name].turn] for name in directions]
    return tuple(name for name, _ in itertools.groupby(noted))


def open_door(env, directions, seed, offset=None, num_steps=140):
    """Steps after which the door was open, if it was."""
    env.reset(seed=seed, options={"kind": directions[-1]} | ({} if offset is None else {"door_offset": offset}))
    expert = planned(env, directions, seed)
    for step in range(1, num_steps + 1):
        env.advance(expert.act())
        if env.latch.is_open:
            assert env.latch.attempts == tries(directions)
            return step
    return None


@pytest.mark.parametrize("offset", [-0.05, 0.0, 0.05])
@pytest.mark.parametrize("kind", EIGHT_KINDS)
def test_opens_every_kind_at_every_offset(eight, kind, offset):
    for seed in range(2):
        assert 82 <= open_door(eight, (kind,), seed, offset) <= 111


@pytest.mark.parametrize("kind", EIGHT_KINDS)
def test_panda_opens_every_kind(kind):
    assert open_door(DoorEnv(arm="panda", door_offset=0.05, eight=True), (kind,), 0)


@pytest.mark.parametrize("order", WRONG_THEN_RIGHT, ids=" then ".join)
def test_opens_after_wrong_tries(env, order):
    assert open_door(env, order, 3, num_steps=200)


@pytest.mark.parametrize("order", OF_EIGHT, ids=" then ".join)
def test_opens_one_of_eight_after_wrong_tries_and_turns(eight, order):
    assert open_door(eight, order, 3, num_steps=110 + 30 * len(order))


@pytest.mark.parametrize("offset", [-0.05, 0.05])
@pytest.mark.parametrize("kind", ["push", "pull"])
def test_hinged_doors_open_within_a_hundred_steps_at_the_slowest_timing(env, kind, offset):
    """So that demonstrations of 100 steps, as the paper recorded with the real robot, drop no seed."""
    env.reset(seed=0, options={"kind": kind, "door_offset": offset})
    expert = planned(env, (kind,), Slowest())
    for _ in range(99):
        env.advance(expert.act())
    assert env.latch.is_open


@pytest.mark.parametrize("right", ["pull", "slide"])
def test_grip_survives_thirty_steps_against_a_shut_door(env, right):
    """As a learned policy might, push as hard as the controller allows; then go back and open the door properly."""
    env.reset(seed=0, options={"kind": right})
    expert = planned(env, ("push",), 0)
    actions = [expert.act() for _ in range(expert.branch_step + 30)]
    for action in actions:
        env.advance(action)
    assert np.linalg.norm(env.data.site("tool").xpos - env.data.site("knob").xpos) < 0.012, "the grip slipped off"
    blocked, back = env.measured_joints(), actions[expert.branch_step - 1]
    for fraction in np.linspace(0, 1, 13)[1:]:
        env.advance(blocked + fraction * (back - blocked))
    joints, closed = back[:-1].astype(float), Waypoint(twist=0.95, gripper=GRASP_CLOSURE, direction=right)
    opened = Waypoint(twist=0.95, gripper=GRASP_CLOSURE, direction=right, travel=0.19 if right == "slide" else 0.52)
    knob = np.array([0.66, env.current_offset, 0.95])
    for step in range(60):
        joints = env.kinematics.solve(*closed.towards(opened, min(1.0, step / 45)).pose(knob), joints)
        env.advance(np.append(joints, GRASP_CLOSURE))
    assert env.latch.is_open


@pytest.mark.parametrize(("wrong", "right"), [("push_ccw", "slide"), ("push", "slide_ccw")])
def test_grip_survives_a_whole_twist_against_the_stop(eight, wrong, right):
    phases = phases_of(eight, (wrong,))
    eight.reset(seed=0, options={"kind": right})
    stopped, opening = planned(eight, (wrong,), 0), planned(eight, (right,), 0)
    actions = [stopped.act() for _ in range(stopped.branch_step)]
    there = [action for action, phase in zip(actions, phases, strict=False) if phase in ("press", "twist")]
    for action in [*actions, *[actions[-1]] * 10, *there[::-1]]:
        eight.advance(action)
    assert eight.latch.attempts == (TURNS[OPENINGS[wrong].turn],)
    for _ in range(130):
        is_past_grasp = opening.phase not in ("approach", "advance", "grasp")
        action = opening.act()
        if is_past_grasp:
            eight.advance(action)
    assert eight.latch.is_open


def test_plans_part_at_the_branch_and_not_before(env):
    plans = []
    for directions in [(kind,) for kind in KINDS] + WRONG_THEN_RIGHT:
        env.reset(seed=4, options={"kind": directions[-1]})
        expert = planned(env, directions, 4)
        plans.append([expert.act() for _ in range(expert.branch_step + 1)])
    for plan in plans[1:]:
        np.testing.assert_array_equal(plan[:-1], plans[0][:-1])
    for plan in plans[1:3]:
        assert np.abs(plan[-1] - plans[0][-1]).max() > 1e-4


def test_plans_of_the_eight_part_at_the_twist_and_those_with_the_same_turn_at_the_branch(env):
    plans = {}
    for kind in EIGHT_KINDS:
        env.reset(seed=4, options={"kind": kind})
        expert = planned(env, (kind,), 4)
        plans[kind] = [expert.act() for _ in range(expert.branch_step + 1)]
    twist = phases_of(env, ("push",), seed=4).index("twist")  # pressing, where the knob turns counter-clockwise
    for kind, plan in plans.items():
        np.testing.assert_array_equal(plan[:twist], plans["push"][:twist])
        same_turn = plans["push" if OPENINGS[kind].turn > 0 else "push_ccw"]
        np.testing.assert_array_equal(plan[:-1], same_turn[:-1])
        assert plan is same_turn or np.abs(plan[-1] - same_turn[-1]).max() > 1e-4
    assert np.abs(plans["push"][twist] - plans["push_ccw"][twist]).max() > 1e-4


def phases_of(env, directions, seed=0):
    """Phase of each of 400 steps."""
    env.reset(seed=seed, options={"kind": directions[-1]})
    expert = planned(env, directions, seed)
    phases = []
    for _ in range(400):
        phases.append(expert.phase)
        expert.act()
    assert [phase.startswith(("try", "open")) for phase in phases].index(True) == expert.branch_step
    return phases


@pytest.mark.parametrize(
    ("directions", "after_grasp"),
    [
        (("slide", "pull", "push"), "twist try_slide return try_pull return open hold"),
        (("slide_right_ccw",), "press twist open hold"),
        (("pull", "slide_ccw", "push_ccw"), "try_turn_cw return press twist try_slide_ccw return open hold"),
        (("pull", "slide_ccw", "push"), "twist try_pull return untwist try_turn_ccw return twist open hold"),
    ],
)
def test_phases_come_in_order(env, directions, after_grasp):
    phases = [phase for phase, _ in itertools.groupby(phases_of(env, directions))]
    assert phases == ["approach", "advance", "grasp", *after_grasp.split()]


def test_timing_varies_with_the_rng_only(env):
    env.reset(seed=0)
    lengths = {planned(env, ("push",), seed).branch_step for seed in range(8)}
    assert len(lengths) > 2
    assert min(lengths) >= 55
    assert max(lengths) <= 64


def test_commands_stay_within_what_the_controller_follows_and_near_what_is_measured(env):
    """Recorded actions are the executed ones only if the controller never had to limit them."""
    for kind in EIGHT_KINDS:
        env.reset(seed=1, options={"kind": kind})
        expert, gaps = planned(env, (kind,), 1), []
        for _ in range(130):
            holding = expert.phase in ("press", "twist", "open", "hold")
            action = expert.act()
            np.testing.assert_allclose(env.limit_action(action), action, atol=1e-6)
            env.advance(action)
            if holding:
                gaps.append(action[-1] - env.measured_joints()[-1])
        assert min(gaps) > 0.02, "the pads must press"
        assert max(gaps) < 0.12


def test_blocked_try_shows_in_the_joints(env):
    env.reset(seed=2, options={"kind": "slide"})
    expert, gaps = planned(env, ("push", "slide"), 2), []
    for _ in range(expert.branch_step + 7):  # the shortest try
        action = expert.act()
        env.advance(action)
        gaps.append(np.abs(action - env.measured_joints())[:-1].max())
    assert max(gaps[expert.branch_step :]) > 5 * max(gaps[: expert.branch_step])


@pytest.mark.parametrize("directions", [(), ("up",), ("push", "up")])
def test_bad_directions_and_acting_before_a_plan_are_refused(env, directions):
    with pytest.raises(ValueError, match="directions"):
        DoorExpert(env, directions)
    with pytest.raises(RuntimeError, match="reset"):
        DoorExpert(env, ("push",)).act()


def test_ease_is_monotonous_and_symmetric():
    values = np.array([ease(fraction) for fraction in np.linspace(0, 1, 201)])
    assert (values[0], values[-1]) == (0.0, 1.0)
    assert (np.diff(values) > 0).all()
    np.testing.assert_allclose(values + values[::-1], 1.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(values).max() * 200, 1 / 0.75, rtol=1e-6)
