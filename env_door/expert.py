"""The scripted demonstrator: plans tool poses from the knob's place and turns them into joint targets.

The plan is approach, advance, grasp, twist, then for every direction but the last a short try and the way
back, then the opening motion. Everything before the first try depends on the seed and the door's place only,
never on its kind.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from env_door.env import GRASP_ROTATION, DoorEnv
from env_door.kinematics import rotation_about
from env_door.latch import EIGHT_KINDS, OPENINGS, TURNS
from env_door.scene import GRIPPER_STROKE

TWIST_ANGLE = 0.95  # of the knob in rad
PROBE_ANGLE = 0.3  # twist of the tool in rad when a turn of the knob is only tried
PRESS_ANGLE = 0.08  # twist of the tool in rad that presses the knob against its stop until that gives way
GRASP_CLOSURE = 1.0 - (0.028 - 0.005) / GRIPPER_STROKE
"""Gripper target on the knob's 28 mm bar: 5 mm tighter gives full grip force, yet stays near what is measured."""

STANDOFF = 0.08  # distance in m from the knob at which the approach ends and the straight advance begins
HINGE_FROM_KNOB = np.array([0.086, 0.34, 0.0])  # from the knob to the hinge's axis, in m
OPEN_TRAVEL = {"hinge": 0.52, "slide": 0.19}  # of the door at the end of the opening motion, in rad or m
PROBE_DISTANCE = 0.03  # travel of the tool in m when a direction is only tried

TRY_AXES = {"hinge": np.array([1.0, 0.0, 0.0]), "slide": np.array([0.0, 1.0, 0.0])}
"""Along which axis a try moves the tool. Unlike the opening motion a try does not turn the tool with the door: turned
against a door that stays shut, the pads would slip on the knob and load it the other way on the return."""

PHASE_STEPS = {
    "approach": (20, 24),
    "advance": (9, 11),
    "grasp": (7, 8),
    "twist": (19, 21),
    "untwist": (19, 21),
    "press": (5, 6),
    "try": (7, 9),
    "return": (8, 10),
    "open": (42, 48),
}
"""Shortest and longest duration of each phase in control steps; the rng draws between them."""


@dataclass(frozen=True)
class Waypoint:
    """A tool pose told by how far each part of the task has gone."""

    shift: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """Tool position relative to the closed door's knob in m, before any opening motion, shape `(3,)`."""
    twist: float = 0.0  # of the gripper about the knob's axis in rad
    gripper: float = 0.0  # target, 0 open to 1 closed
    travel: float = 0.0  # of the door its own way, in rad (hinge) or m (slide)
    direction: str = "push"

    def towards(self, end: "Waypoint", fraction: float) -> "Waypoint":
        """The waypoint at a fraction of the way to another one."""
        return Waypoint(
            shift=self.shift + fraction * (end.shift - self.shift),
            twist=self.twist + fraction * (end.twist - self.twist),
            gripper=self.gripper + fraction * (end.gripper - self.gripper),
            travel=self.travel + fraction * (end.travel - self.travel),
            direction=end.direction,
        )

    def pose(self, knob: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position `(3,)` and rotation matrix `(3, 3)` of the tool, given the position of the closed door's knob."""
        position = knob + self.shift
        rotation = rotation_about(np.array([1.0, 0.0, 0.0]), self.twist) @ GRASP_ROTATION
        opening = OPENINGS[self.direction]
        travel = opening.sign * self.travel
        if opening.joint == "slide":
            return position + np.array([0.0, travel, 0.0]), rotation
        turn = rotation_about(np.array([0.0, 0.0, 1.0]), travel)
        hinge = knob + HINGE_FROM_KNOB
        return hinge + turn @ (position - hinge), turn @ rotation


class DoorExpert:
    """Opens the door of an unwrapped environment; knows the knob's place, but not the kind.

    Tries the `directions` in order, each one of `EIGHT_KINDS`, and carries the last one through. Of a direction that
    wants the knob turned other than the last one does, only the turn can be tried.
    """

    def __init__(self, env: DoorEnv, directions: Sequence[str] = ("push",)):
        if not directions or any(direction not in OPENINGS for direction in directions):
            raise ValueError(f"directions={tuple(directions)} must name at least one of {EIGHT_KINDS} and nothing else")
        self._env = env
        self.directions = tuple(directions)
        self._plan: list[tuple[str, NDArray[np.float32]]] = []
        self._step = 0
        self.branch_step = 0

    def reset(self, rng: np.random.Generator) -> None:
        """Plans for the present start pose and door place; call after the environment's `reset`.

        The duration of every phase is drawn from `rng`: as many draws before the first try whatever the directions, so
        equal seeds give equal actions up to the twist, and with the same turn up to `branch_step`, the first try.

        Raises:
            UnreachableError: If the arm cannot reach a pose of the plan.
        """
        kinematics = self._env.kinematics
        knob = self._env.data.site("knob").xpos.copy()
        joints = self._env.measured_joints()[:-1]
        start = Waypoint(shift=kinematics.forward(joints)[0] - knob)
        self._plan = []
        self._step = self.branch_step = 0
        for phase, begin, end in self._stages(start):
            if phase.startswith(("try", "open")) and not self.branch_step:
                self.branch_step = len(self._plan)
            low, high = PHASE_STEPS[phase.split("_")[0]]
            num_steps = int(rng.integers(low, high + 1))
            for step in range(1, num_steps + 1):
                waypoint = begin.towards(end, ease(step / num_steps))
                joints = kinematics.solve(*waypoint.pose(knob), joints)
                self._plan.append((phase, np.append(joints, waypoint.gripper).astype(np.float32)))

    def act(self) -> NDArray[np.float32]:
        """Action for this control step; the last one again once the plan is done."""
        if not self._plan:
            raise RuntimeError("the expert has no plan yet; call reset(rng) after the environment's reset")
        action = self._plan[min(self._step, len(self._plan) - 1)][1]
        self._step += 1
        return action.copy()

    @property
    def phase(self) -> str:
        """What `act` does next: approach, advance, grasp, twist, try_<direction>, return, open; hold after the plan.

        Where the knob may have to be turned counter-clockwise also press, untwist, try_turn_cw and try_turn_ccw.
        """
        return self._plan[self._step][0] if self._step < len(self._plan) else "hold"

    def _stages(self, start: Waypoint) -> list[tuple[str, Waypoint, Waypoint]]:
        standoff = Waypoint(shift=np.array([-STANDOFF, 0.0, 0.0]))
        around = Waypoint()
        grasped = replace(around, gripper=GRASP_CLOSURE)
        last = OPENINGS[self.directions[-1]]
        twisted = replace(grasped, twist=last.turn * TWIST_ANGLE)
        stages = [("approach", start, standoff), ("advance", standoff, around), ("grasp", around, grasped)]
        twist = [("twist", grasped, twisted)]
        if last.turn < 0:  # more slowly as long as it may be blocked, so that the commands stay near what is measured
            pressed = replace(grasped, twist=-PRESS_ANGLE)
            twist = [("press", grasped, pressed), ("twist", pressed, twisted)]
        here = grasped
        for direction in self.directions[:-1]:
            opening = OPENINGS[direction]
            if opening.turn == last.turn:
                ready, name = twisted, direction
                tried = replace(twisted, shift=PROBE_DISTANCE * opening.sign * TRY_AXES[opening.joint])
            else:
                ready, name = grasped, TURNS[opening.turn]
                tried = replace(grasped, twist=opening.turn * PROBE_ANGLE)
            if here is not ready:
                stages += twist if ready is twisted else [("untwist", twisted, grasped)]
            stages += [(f"try_{name}", ready, tried), ("return", tried, ready)]
            here = ready
        if here is not twisted:
            stages += twist
        shut = replace(twisted, direction=self.directions[-1])
        opened = replace(shut, travel=OPEN_TRAVEL[last.joint])
        return [*stages, ("open", shut, opened)]


def ease(fraction: float, ramp: float = 0.25) -> float:
    """Covered part of the way after a part of the duration: even acceleration for `ramp`, cruise, even braking."""
    cruise = 1.0 / (1.0 - ramp)
    if fraction < ramp:
        return 0.5 * cruise * fraction**2 / ramp
    if fraction > 1.0 - ramp:
        return 1.0 - 0.5 * cruise * (1.0 - fraction) ** 2 / ramp
    return cruise * (fraction - 0.5 * ramp)
