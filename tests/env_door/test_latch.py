"""The lock on its own: the arm is left out of it and loads are applied to the panel directly."""

import mujoco
import pytest

from env_door.latch import KINDS, LOAD_STEPS, OPENINGS, Latch
from env_door.scene import load_model

every_kind = pytest.mark.parametrize("kind", KINDS)


class Door(Latch):
    """A door of one kind, whose knob is fixed at a twist while it is pressed."""

    def __init__(self, kind):
        self.model = load_model("ur5e")
        self.data = mujoco.MjData(self.model)
        super().__init__(self.model, self.data)
        self.reset(kind)

    def press(self, direction, load, steps=LOAD_STEPS + 60, twist=0.9):
        """Applies a generalised force to the panel's joint, in units of the load that frees such a door."""
        opening = OPENINGS[direction]
        for _ in range(steps):
            self.data.joint("knob").qpos, self.data.joint("knob").qvel = twist, 0.0
            self.data.joint(opening.joint).qfrc_applied = opening.sign * load * opening.break_load
            mujoco.mj_step(self.model, self.data)
            self.update()
        self.data.joint(opening.joint).qfrc_applied = 0.0

    def rest(self):
        self.press("push", 0.0, steps=50)


@every_kind
@pytest.mark.parametrize("direction", KINDS)
def test_opens_in_its_own_direction_only(kind, direction):
    door = Door(kind)
    door.press(direction, 1.2)
    assert door.freed == (kind == direction)
    assert door.attempts == (direction,)
    assert (door.travel > 0.01) == (kind == direction)


@every_kind
def test_latched_door_stays_shut_however_hard_it_is_loaded(kind):
    door = Door(kind)
    door.press(kind, 5.0, twist=0.65)
    assert (door.freed, door.attempts) == (False, ())
    assert abs(door.travel) < 2e-3


@every_kind
def test_load_is_what_was_applied(kind):
    """The load read from the constraint equals the applied one in rest, and below the threshold nothing happens."""
    door, opening = Door(kind), OPENINGS[kind]
    door.press(kind, 0.8, steps=2 * LOAD_STEPS)
    assert (door.freed, door.attempts) == (False, ())
    door.data.joint(opening.joint).qfrc_applied = opening.sign * 0.8 * opening.break_load
    mujoco.mj_step(door.model, door.data)
    assert door.load(kind) == pytest.approx(0.8, rel=0.05)


def test_short_shock_does_not_free():
    door = Door("push")
    door.press("push", 5.0, steps=LOAD_STEPS - 10)
    door.rest()
    assert (door.freed, door.attempts) == (False, ())


def test_attempts_keep_their_order_and_merge_repeats():
    door = Door("slide")
    for direction in ("push", "push", "pull", "push", "slide"):
        door.press(direction, 1.5)
        door.rest()
    assert door.attempts == ("push", "pull", "push", "slide")
    assert door.freed


@every_kind
def test_freed_door_does_not_swing_the_other_way(kind):
    door = Door(kind)
    door.press(kind, 1.2, steps=LOAD_STEPS + 20)
    assert door.freed
    door.press(kind, -1.0, steps=400)
    assert -5e-3 < door.travel < 0.02


def test_held_door_is_not_freed_until_let_go():
    door = Door("pull")
    door.hold(150)
    door.press("pull", 3.0, steps=149)
    assert not door.freed
    door.press("pull", 3.0, steps=10)
    assert door.freed


@every_kind
def test_a_held_open_door_stays_and_notes_the_other_ways_that_are_tried(kind):
    door = Door(kind)
    door.press(kind, 1.2)
    door.hold(2000)
    held_at = door.travel
    assert held_at > 0.002
    others = [direction for direction in KINDS if direction != kind]
    for direction in (kind, *others, kind, others[1]):
        door.press(direction, 1.5)
        door.rest()
    assert door.held
    assert door.travel == pytest.approx(held_at, abs=2e-3)
    assert door.tried_while_held == tuple(others)
    assert door.attempts == (kind,), "those of the shut door"
    door.reset(kind)
    assert (door.held, door.tried_while_held) == (False, ())


def test_weak_or_short_loads_on_a_held_door_are_no_tries():
    door = Door("pull")
    door.press("pull", 1.2)
    door.hold(2000)
    door.press("push", 0.8)
    door.press("slide", 2.0, steps=LOAD_STEPS - 10)
    door.rest()
    assert door.tried_while_held == ()


@pytest.mark.parametrize("steps", [0, 1])
def test_a_held_door_moves_on_once_let_go(steps):
    door = Door("slide")
    door.press("slide", 1.7)
    door.hold(500)
    door.press("slide", 1.7, steps=100)
    held_at = door.travel
    door.hold(steps)
    door.press("slide", 1.7, steps=100)
    assert not door.held
    assert door.travel > held_at + 0.01
    door.press("push", 3.0)
    assert door.tried_while_held == (), "nobody holds it any more"


def test_open_means_far_enough_and_nearly_still():
    door = Door("push")
    door.press("push", 2.5, steps=LOAD_STEPS + 10)
    for position, speed, is_open in ((0.45, 0.5, False), (0.45, 0.05, True), (0.35, 0.05, False)):
        door.data.joint("hinge").qpos, door.data.joint("hinge").qvel = position, speed
        assert door.is_open == is_open
