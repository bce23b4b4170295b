"""The lock on its own: the arm is left out of it and loads are applied to the panel directly."""

import mujoco
import pytest

from env_door.latch import EIGHT_KINDS, KNOB_PLAY, LOAD_STEPS, OPENINGS, STOP_GIVE, TURNS, Latch
from env_door.scene import load_model

every_kind = pytest.mark.parametrize("kind", EIGHT_KINDS)
KIND_AND_DIRECTION = [
    (kind, direction)
    for kind in EIGHT_KINDS
    for direction in EIGHT_KINDS
    if OPENINGS[kind].turn == OPENINGS[direction].turn
]


class Door(Latch):
    """A door of one kind, whose knob is fixed at a twist while it is pressed."""

    def __init__(self, kind):
        self.model = load_model("ur5e")
        self.data = mujoco.MjData(self.model)
        super().__init__(self.model, self.data)
        self.reset(kind, eight=True)
        self.turn = OPENINGS[kind].turn

    def press(self, direction, load, steps=LOAD_STEPS + 60, twist=0.9):
        """Applies a generalised force to the panel's joint, in units of the load that frees such a door."""
        opening = OPENINGS[direction]
        for _ in range(steps):
            self.data.joint("knob").qpos, self.data.joint("knob").qvel = self.turn * twist, 0.0
            self.data.joint(opening.joint).qfrc_applied = opening.sign * load * opening.break_load
            mujoco.mj_step(self.model, self.data)
            self.update()
        self.data.joint(opening.joint).qfrc_applied = 0.0

    def twist(self, torque, steps=LOAD_STEPS + 100):
        """Applies a torque in N m to the knob, positive clockwise; returns where it was at each step."""
        angles = []
        for _ in range(steps):
            self.data.joint("knob").qfrc_applied = torque
            mujoco.mj_step(self.model, self.data)
            self.update()
            angles.append(float(self.data.joint("knob").qpos[0]))
        self.data.joint("knob").qfrc_applied = 0.0
        return angles

    def rest(self):
        self.press("push", 0.0, steps=50)


@pytest.mark.parametrize(("kind", "direction"), KIND_AND_DIRECTION)
def test_opens_in_its_own_direction_only(kind, direction):
    door = Door(kind)
    door.press(direction, 1.2)
    assert door.freed == (kind == direction)
    assert door.attempts == (direction,)
    assert (door.travel > 0.01) == (kind == direction)


@every_kind
def test_knob_turns_its_own_way_only_and_a_wrong_turn_leaves_nothing_behind(kind):
    door = Door(kind)
    wrong = door.twist(-door.turn * 8.0)
    assert max(map(abs, wrong)) < 0.35
    assert not door.unlatched
    back = door.twist(0.0, steps=400)
    assert back[-1] == pytest.approx(0.0, abs=2e-3)
    assert max(map(abs, door.twist(door.turn * 8.0))) > 0.9
    assert (door.unlatched, door.freed, door.attempts) == (True, False, (TURNS[-door.turn],))
    assert door.twist(0.0, steps=400)[-1] == pytest.approx(0.0, abs=2e-3), "its spring turns it back"
    assert max(map(abs, door.twist(-door.turn * 8.0))) < 0.35, "still the wrong way"


@pytest.mark.parametrize("turn", TURNS)
def test_all_kinds_feel_the_same_while_the_knob_is_turned_the_same_way(turn):
    """Those that turn so all alike, those that do not all alike, and all of them up to the stop."""
    angles = {kind: Door(kind).twist(turn * 8.0) for kind in EIGHT_KINDS}
    own = [angles[kind] for kind in EIGHT_KINDS if OPENINGS[kind].turn == turn]
    other = [angles[kind] for kind in EIGHT_KINDS if OPENINGS[kind].turn != turn]
    assert own == own[:1] * 4
    assert other == other[:1] * 4
    parted = [mine == others for mine, others in zip(own[0], other[0], strict=True)].index(False)
    if turn > 0:
        assert KNOB_PLAY <= own[0][parted - 1] < 0.15
    else:
        assert parted > LOAD_STEPS
        assert -0.1 < own[0][parted - 1] < -STOP_GIVE


def test_a_short_or_weak_twist_against_the_stop_is_no_try():
    for kind in ("push", "push_ccw"):
        door = Door(kind)
        for torque, steps in ((-8.0, LOAD_STEPS - 20), (0.0, 200), (-2.0, 3 * LOAD_STEPS), (0.0, 200)):
            door.twist(torque, steps)
        assert door.attempts == ()
        assert max(map(abs, door.twist(-2.0))) < 0.03, "it does not turn yet"


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


def test_a_door_that_is_one_of_three_notes_no_tries_of_the_others():
    door = Door("pull")
    door.reset("pull")
    door.twist(-8.0)
    door.press("slide_right", 3.0)
    assert door.attempts == ()
    door.press("slide", 1.5)
    door.press("pull", 1.5)
    assert door.attempts == ("slide", "pull")


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
    others = [direction for own, direction in KIND_AND_DIRECTION if own == kind != direction]
    for direction in (kind, *others, kind, others[-1]):
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
