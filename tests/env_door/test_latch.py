"""The lock on its own: the arm is left out of it and loads are applied to the panel directly."""

import mujoco
import numpy as np
import pytest

from env_door.latch import KINDS, LOAD_STEPS, OPENINGS, Latch
from env_door.scene import load_model


@pytest.fixture
def model():
    return load_model("ur5e")


def press(model, data, latch, direction, load, steps=LOAD_STEPS + 60, twist=0.9):
    """Applies a generalised force to the panel's joint with the knob fixed at a twist."""
    opening = OPENINGS[direction]
    for _ in range(steps):
        data.joint("knob").qpos = twist
        data.joint("knob").qvel = 0.0
        data.joint(opening.joint).qfrc_applied = opening.sign * load
        mujoco.mj_step(model, data)
        latch.update()
    data.joint(opening.joint).qfrc_applied = 0.0


def fresh(model, kind):
    data = mujoco.MjData(model)
    latch = Latch(model, data)
    latch.reset(kind)
    return data, latch


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("direction", KINDS)
def test_opens_in_its_own_direction_only(model, kind, direction):
    data, latch = fresh(model, kind)
    press(model, data, latch, direction, 1.2 * OPENINGS[direction].break_load)
    assert latch.freed == (kind == direction)
    assert latch.attempts == (direction,)
    assert (latch.travel > 0.01) == (kind == direction)


@pytest.mark.parametrize("kind", KINDS)
def test_latched_door_stays_shut_however_hard_it_is_loaded(model, kind):
    data, latch = fresh(model, kind)
    press(model, data, latch, kind, 5 * OPENINGS[kind].break_load, twist=0.65)
    assert not latch.freed
    assert latch.attempts == ()
    assert abs(latch.travel) < 2e-3


@pytest.mark.parametrize("kind", KINDS)
def test_load_is_what_was_applied(model, kind):
    """The load read from the constraint equals the applied one in rest, and below the threshold nothing happens."""
    data, latch = fresh(model, kind)
    press(model, data, latch, kind, 0.8 * OPENINGS[kind].break_load, steps=2 * LOAD_STEPS)
    assert not latch.freed
    assert latch.attempts == ()
    data.joint(OPENINGS[kind].joint).qfrc_applied = OPENINGS[kind].sign * 0.8 * OPENINGS[kind].break_load
    mujoco.mj_step(model, data)
    assert latch.load(kind) == pytest.approx(0.8, rel=0.05)


def test_short_shock_does_not_free(model):
    data, latch = fresh(model, "push")
    press(model, data, latch, "push", 5 * OPENINGS["push"].break_load, steps=LOAD_STEPS - 10)
    press(model, data, latch, "push", 0.0, steps=50)
    assert not latch.freed
    assert latch.attempts == ()


def test_attempts_keep_their_order_and_merge_repeats(model):
    data, latch = fresh(model, "slide")
    for direction in ("push", "push", "pull", "push", "slide"):
        press(model, data, latch, direction, 1.5 * OPENINGS[direction].break_load)
        press(model, data, latch, direction, 0.0, steps=50)
    assert latch.attempts == ("push", "pull", "push", "slide")
    assert latch.freed


@pytest.mark.parametrize("kind", KINDS)
def test_freed_door_does_not_swing_the_other_way(model, kind):
    data, latch = fresh(model, kind)
    press(model, data, latch, kind, 1.2 * OPENINGS[kind].break_load, steps=LOAD_STEPS + 20)
    assert latch.freed
    press(model, data, latch, kind, -OPENINGS[kind].break_load, steps=400)
    assert -5e-3 < latch.travel < 0.02


def test_held_door_is_not_freed_until_let_go(model):
    data, latch = fresh(model, "pull")
    latch.hold(150)
    press(model, data, latch, "pull", 30.0, steps=149)
    assert not latch.freed
    press(model, data, latch, "pull", 30.0, steps=10)
    assert latch.freed


@pytest.mark.parametrize("kind", KINDS)
def test_a_held_open_door_stays_and_notes_the_other_ways_that_are_tried(model, kind):
    data, latch = fresh(model, kind)
    press(model, data, latch, kind, 1.2 * OPENINGS[kind].break_load, steps=LOAD_STEPS + 60)
    latch.hold(2000)
    held_at = latch.travel
    assert held_at > 0.002
    others = [direction for direction in KINDS if direction != kind]
    for direction in (kind, *others, kind, others[1]):
        press(model, data, latch, direction, 1.5 * OPENINGS[direction].break_load)
        press(model, data, latch, direction, 0.0, steps=50)
    assert latch.held
    assert latch.travel == pytest.approx(held_at, abs=2e-3)
    assert latch.tried_while_held == tuple(others)
    assert latch.attempts == (kind,), "those of the shut door"
    latch.reset(kind)
    assert (latch.held, latch.tried_while_held) == (False, ())


def test_weak_or_short_loads_on_a_held_door_are_no_tries(model):
    data, latch = fresh(model, "pull")
    press(model, data, latch, "pull", 12.0)
    latch.hold(2000)
    press(model, data, latch, "push", 0.8 * OPENINGS["push"].break_load)
    press(model, data, latch, "slide", 2 * OPENINGS["slide"].break_load, steps=LOAD_STEPS - 10)
    press(model, data, latch, "push", 0.0, steps=50)
    assert latch.tried_while_held == ()


@pytest.mark.parametrize("end", [lambda latch: latch.hold(1), lambda latch: latch.hold(0)])
def test_a_held_door_moves_on_once_let_go(model, end):
    data, latch = fresh(model, "slide")
    press(model, data, latch, "slide", 20.0)
    latch.hold(500)
    press(model, data, latch, "slide", 20.0, steps=100)
    held_at = latch.travel
    end(latch)
    press(model, data, latch, "slide", 20.0, steps=100)
    assert not latch.held
    assert latch.travel > held_at + 0.01
    press(model, data, latch, "push", 30.0)
    assert latch.tried_while_held == (), "nobody holds it any more"


def test_open_means_far_enough_and_nearly_still(model):
    data, latch = fresh(model, "push")
    press(model, data, latch, "push", 25.0, steps=LOAD_STEPS + 10)
    hinge = data.joint("hinge")
    hinge.qpos, hinge.qvel = 0.45, 0.5
    assert not latch.is_open, "too fast"
    hinge.qvel = 0.05
    assert latch.is_open
    hinge.qpos = 0.35
    assert not latch.is_open, "not far enough"


def test_reset_closes_a_freed_door(model):
    data, latch = fresh(model, "slide")
    ranges = model.jnt_range.copy()
    press(model, data, latch, "slide", 30.0)
    assert not np.array_equal(model.jnt_range, ranges)
    mujoco.mj_resetData(model, data)
    latch.reset("slide")
    np.testing.assert_array_equal(model.jnt_range, ranges)
    assert not latch.freed
    assert latch.attempts == ()
    assert data.eq_active.all()


def test_bad_arguments(model):
    _, latch = fresh(model, "push")
    with pytest.raises(ValueError, match="kind='up'"):
        latch.reset("up")
    with pytest.raises(ValueError, match="num_steps=-1"):
        latch.hold(-1)
