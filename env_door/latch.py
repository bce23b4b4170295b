"""When the door moves, and which way: the secret of the task.

Three rules make the doors indistinguishable until somebody tries them:

1. One model serves every kind of door. The panel has a slide and a hinge joint, both locked by the same two equality
   constraints, with the same ranges, so the physics before the first try is bit-identical.
2. Twisting the knob past `UNLATCH_ANGLE` frees nothing. It only permits rule 3.
3. A lock opens once the unlatched panel has been loaded in the direction that its kind opens, past a threshold, for
   0.2 s. The load is the force with which the lock's constraint holds the panel against the robot.

The knob keeps its secret in the same way: untouched, it lies at one soft stop in all doors. Clockwise it turns on, or
meets another stop past some play. Counter-clockwise the stop stays, or gives way once pressed for 0.2 s.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from draccus.utils import ParsingError

if TYPE_CHECKING:
    import mujoco

UNLATCH_ANGLE = 0.7  # twist of the knob in rad, in its own turn, beyond which the latch lets go
KNOB_PLAY = 0.1  # in rad, clockwise, of a knob that turns counter-clockwise
STOP_GIVE = 0.03  # in rad by which the soft stop of the knob gives way under some 4.5 N m: to press so hard is a try
TURNS = {+1: "turn_cw", -1: "turn_ccw"}  # tries to turn the knob, clockwise and counter-clockwise as the robot sees it
LOAD_STEPS = 100
"""Physics steps (of 2 ms) for which a load must last: a robot that trembles tries nothing, one that pushes does."""


@dataclass(frozen=True)
class Opening:
    """How one kind of door opens: by which joint of the panel, and which way. Hinges count in rad, slides in m.

    Hinges push at +1 and pull at -1, slides go to the robot's left at +1 and to its right at -1.
    """

    joint: str
    sign: int
    break_load: float  # that frees it, in N m (hinge) or N (slide)
    threshold: float  # travel that counts as open
    limit: float  # travel at which the door meets its stop
    still_speed: float  # below which the door counts as nearly still
    turn: int = +1  # of the knob, before: +1 clockwise, -1 counter-clockwise


OPENINGS = {
    "push": Opening("hinge", +1, break_load=10.0, threshold=0.40, limit=0.8, still_speed=0.15),
    "pull": Opening("hinge", -1, break_load=10.0, threshold=0.40, limit=0.8, still_speed=0.15),
    "slide": Opening("slide", +1, break_load=12.0, threshold=0.14, limit=0.24, still_speed=0.05),
    # Coming back from a wrong try, an arm loads the slide to the right, or once turned ccw either way, with up to 15 N;
    # sliding to the right, it pushes with up to half as many N m.
    "slide_right": Opening("slide", -1, break_load=16.0, threshold=0.14, limit=0.24, still_speed=0.05),
    "push_ccw": Opening("hinge", +1, break_load=14.0, threshold=0.40, limit=0.8, still_speed=0.15, turn=-1),
    "pull_ccw": Opening("hinge", -1, break_load=14.0, threshold=0.40, limit=0.8, still_speed=0.15, turn=-1),
    "slide_ccw": Opening("slide", +1, break_load=20.0, threshold=0.14, limit=0.24, still_speed=0.05, turn=-1),
    "slide_right_ccw": Opening("slide", -1, break_load=20.0, threshold=0.14, limit=0.24, still_speed=0.05, turn=-1),
}

KINDS = ("push", "pull", "slide")
"""Kinds of door by default. A kind is also a direction in which a robot can try to open one."""
EIGHT_KINDS = tuple(OPENINGS)
"""All kinds: four directions, each with the knob turned clockwise or counter-clockwise (`_ccw`) first."""


def beyond_three(kinds: Sequence[str]) -> bool:
    """Whether doors of these kinds, which may be `random`, must be told from all eight instead of from three."""
    return not {*kinds} <= {*KINDS, "random"}


def check_kinds(kinds: Sequence[str], option: str) -> None:
    """Raises ParsingError unless the names are those of kinds of door, each once; `option` is what the user set."""
    if not kinds or sorted(kinds) != sorted(set(kinds) & set(EIGHT_KINDS)):
        raise ParsingError(f"{option} must be one or more of {list(EIGHT_KINDS)}, each once, got {list(kinds)}.")


class Latch:
    """Locks of the panel of one scene.

    Freeing the door changes the ranges of its joints in the model; `reset` restores them.
    """

    def __init__(self, model: "mujoco.MjModel", data: "mujoco.MjData"):
        self._model = model
        self._data = data
        joints = {opening.joint for opening in OPENINGS.values()}
        self._lock = {joint: int(model.equality(f"lock_{joint}").id) for joint in joints}
        self._joint = {joint: int(model.joint(joint).id) for joint in joints}
        self._qpos = {joint: int(model.joint(joint).qposadr[0]) for joint in joints}
        self._qvel = {joint: int(model.joint(joint).dofadr[0]) for joint in joints}
        self._knob = int(model.joint("knob").qposadr[0])
        self._knob_joint = int(model.joint("knob").id)
        self._knob_end = float(model.jnt_range[self._knob_joint, 1])
        self._knob_spring = float(model.qpos_spring[self._knob])
        self._closed_ranges = {joint: model.jnt_range[i].copy() for joint, i in self._joint.items()}
        self.reset("push")

    def reset(self, kind: str, eight: bool = False) -> None:
        """Closes and locks the door, and makes it one of the given kind. Call after `mujoco.mj_resetData`.

        `eight`, or a kind beyond the three, tells tries of all eight kinds apart and notes wrong turns of the knob.
        """
        self.kind = kind
        self._is_one_of_eight = eight or kind not in KINDS
        self.freed = False
        self.attempts: tuple[str, ...] = ()
        self.tried_while_held: tuple[str, ...] = ()
        self._turn = OPENINGS[kind].turn
        among = EIGHT_KINDS if self._is_one_of_eight else KINDS
        self._directions = [name for name in among if OPENINGS[name].turn == self._turn]
        self._loaded_steps = dict.fromkeys(self._directions, 0)
        self._pressed_steps = 0
        self._held_steps = 0
        self._set_knob(+1, self._knob_end if self._turn > 0 else KNOB_PLAY)
        for joint, index in self._joint.items():
            self._model.jnt_range[index] = self._closed_ranges[joint]
            self._lock_at(joint, 0.0)

    @property
    def unlatched(self) -> bool:
        """Whether the knob is twisted far enough for the door to open."""
        return bool(self._turn * self._data.qpos[self._knob] > UNLATCH_ANGLE)

    @property
    def travel(self) -> float:
        """How far the door has moved its own way, in rad (hinge) or m (slide)."""
        opening = OPENINGS[self.kind]
        return opening.sign * float(self._data.qpos[self._qpos[opening.joint]])

    @property
    def opening(self) -> float:
        """Travel as a fraction of the threshold: 0 closed, 1 far enough to count as open, more beyond it."""
        # A locked panel gives way by some 1e-5 rad, of which each kind would tell another part.
        return max(0.0, self.travel) / OPENINGS[self.kind].threshold if self.freed else 0.0

    @property
    def is_open(self) -> bool:
        """Whether the door has opened past its threshold and is nearly still."""
        opening = OPENINGS[self.kind]
        speed = abs(float(self._data.qvel[self._qvel[opening.joint]]))
        return self.opening >= 1.0 and speed <= opening.still_speed

    @property
    def held(self) -> bool:
        """Whether somebody holds the panel where it is."""
        return self._held_steps > 0

    def load(self, direction: str) -> float:
        """Load on a lock as a fraction of what would free such a door: negative the other way, 0 if not locked."""
        opening = OPENINGS[direction]
        equality = self._lock[opening.joint]
        if not self._data.eq_active[equality]:
            return 0.0
        # Every equality of the scene couples joints, which makes one constraint row each, in the order of their ids.
        row = int(np.count_nonzero(self._data.eq_active[:equality]))
        return -opening.sign * float(self._data.efc_force[row]) / opening.break_load

    def hold(self, num_steps: int) -> None:
        """Holds the panel where it is: interference by a person at the other side of the door.

        `attempts` stays the directions in which the shut door was tried. The ways other than its own in which a freed
        door is loaded meanwhile, as strongly and as long as a try, go to `tried_while_held`. `num_steps` physics steps
        replace a hold that still lasts; 0 ends it.
        """
        self._held_steps = num_steps
        if self.freed:
            joint = OPENINGS[self.kind].joint
            if num_steps > 0:
                self._lock_at(joint, float(self._data.qpos[self._qpos[joint]]))
            else:
                self._unlock()

    def update(self) -> None:
        """Looks at the loads after one physics step; frees the door when it is loaded its own way."""
        held = self.held
        self._held_steps = max(0, self._held_steps - 1)
        self._update_knob()
        # Only a shut or held panel resists in every direction; while the latch is in, loads are no tries.
        if not (held if self.freed else self.unlatched):
            self._loaded_steps = dict.fromkeys(self._directions, 0)
            return
        tried = self._tried()
        if self.freed:
            if tried is not None and tried != self.kind:
                self.tried_while_held = _with(self.tried_while_held, tried)
            if not self.held:
                self._unlock()
        elif tried is not None:
            self.attempts = _with(self.attempts, tried)
            if tried == self.kind and not held:
                self._free()

    def _update_knob(self) -> None:
        """Notes a turn the wrong way; lets the knob turn once it is pressed its own way."""
        angle = self._data.qpos[self._knob]
        pressed = int(angle > self._knob_range[1] + STOP_GIVE) - int(angle < self._knob_range[0] - STOP_GIVE)
        self._pressed_steps = self._pressed_steps + 1 if pressed else 0
        if self._pressed_steps < LOAD_STEPS:
            return
        if pressed == self._turn:
            self._set_knob(self._turn, self._knob_end)
        elif self._is_one_of_eight and not self.freed:
            self.attempts = _with(self.attempts, TURNS[pressed])

    def _set_knob(self, turn: int, end: float) -> None:
        """Lets the knob turn from 0 to an end, and its spring turn it back."""
        self._knob_range = (0.0, end) if turn > 0 else (-end, 0.0)
        self._model.jnt_range[self._knob_joint] = self._knob_range
        self._model.qpos_spring[self._knob] = turn * self._knob_spring

    def _tried(self) -> str | None:
        """The direction in which the panel has been loaded past the threshold for long enough, if there is one."""
        loads = {direction: self.load(direction) for direction in self._directions}
        # A sideways load on the knob also turns the hinge a little: the strongest load shows what is being tried.
        strongest = max(self._directions, key=loads.__getitem__)
        for direction in self._directions:
            tried = direction == strongest and loads[direction] >= 1.0
            self._loaded_steps[direction] = self._loaded_steps[direction] + 1 if tried else 0
        return strongest if self._loaded_steps[strongest] >= LOAD_STEPS else None

    def _free(self) -> None:
        opening = OPENINGS[self.kind]
        self.freed = True
        self._unlock()
        limits = (0.0, opening.limit) if opening.sign > 0 else (-opening.limit, 0.0)
        self._model.jnt_range[self._joint[opening.joint]] = limits

    def _lock_at(self, joint: str, position: float) -> None:
        self._model.eq_data[self._lock[joint], 0] = position
        self._data.eq_active[self._lock[joint]] = 1

    def _unlock(self) -> None:
        self._data.eq_active[self._lock[OPENINGS[self.kind].joint]] = 0


def _with(directions: tuple[str, ...], direction: str) -> tuple[str, ...]:
    return directions if directions[-1:] == (direction,) else (*directions, direction)
