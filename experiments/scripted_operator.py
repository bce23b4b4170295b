"""A scripted operator: what the expert of the simulated door plans, as the events of a SpaceMouse.

The teleoperator integrates twists; between two poses of a path, `p -> p'` and `R -> R'` within `t` seconds, the
deflections are therefore

    (p' - p) / (t * linear_speed),    log(R' R^T) / (t * angular_speed)

in the frame of the arm's base. Nobody looks at the arm while the events are played, so whatever the teleoperator cuts
short would be missing for good. Hence the path is followed so slowly that no limit takes hold, not even when an action
is a little late, and the gripper is moved for itself, with rests around it. Each event lasts for whole control periods,
because it counts as often as an action is asked for while it lasts: with half a period more, too much or too little.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp
from twin import Event

from env_door.demonstration import TIMING_STREAM
from env_door.env import DoorEnv
from env_door.expert import DoorExpert
from lerobot_ufrnn.teleoperators import SpaceMouseTwistConfig

PERIOD = 0.1  # s from one action to the next, and from pose to pose of a path unless a limit asks for more
REST_PERIODS = 3  # rest at the start and around each grip: the arm comes to its target even if an action is late
LATE_SECONDS = 0.15  # time from one action to the next up to which targets stay within the teleoperator's `max_lead`
TRAIL_SECONDS = 0.1  # by which the arm trails its targets besides: smoothing, and what passes from reading to sending
MARGIN = 0.95  # share of each limit that is made use of: inverse kinematics and clocks are not exact
STANDSTILL = 1e-4  # metres and radians below which a step of the path does not move the tool
TELEOPERATOR = SpaceMouseTwistConfig(robot_ip="twin")  # that the events are for; its frame is the base's


@dataclass(frozen=True)
class ToolPath:
    """Poses of the tool in the frame of the arm's base, the first one where it starts."""

    positions: NDArray[np.float64]  # (T, 3) in m
    rotations: Rotation  # (T,)
    closures: NDArray[np.float64]  # (T,) targets of the gripper, 0 open to 1 closed
    joints: NDArray[np.float64]  # (T, J) in rad: they say how fast the tool may move

    def __getitem__(self, poses: slice) -> "ToolPath":
        return ToolPath(self.positions[poses], self.rotations[poses], self.closures[poses], self.joints[poses])


def plan(door: DoorEnv, kind: str, seed: int) -> ToolPath:
    """The path of the tool that the expert of the simulation plans for a door.

    Raises:
        UnreachableError: If the arm cannot reach a pose.
    """
    door.reset(seed=seed, options={"kind": kind})
    expert = DoorExpert(door, directions=(kind,))
    expert.reset(np.random.default_rng([seed, TIMING_STREAM]))
    targets = [door.measured_joints()]
    while expert.phase != "hold":
        targets.append(expert.act().astype(np.float64))
    joints, closures = np.array(targets)[:, :-1], np.array(targets)[:, -1]
    positions, rotations = zip(*map(door.kinematics.forward, joints), strict=True)
    return ToolPath(np.array(positions), Rotation.from_matrix(rotations), closures, joints)


def events_along(path: ToolPath) -> list[Event]:
    """What an operator does, one event after the other from the first read on, so that the tool follows a path.

    Raises:
        ValueError: If a step of the path moves both the tool and the gripper.
    """
    directions = np.sign(np.diff(path.closures))  # 1 closing, -1 opening, 0 the tool's turn
    moves = np.abs(_motions(path.positions, path.rotations)).max(axis=1) > STANDSTILL
    if (both := np.flatnonzero(moves & (directions != 0))).size:
        raise ValueError(f"Step {both[0]} of the path moves tool and gripper at once; move one after the other.")
    bounds = [0, *(np.flatnonzero(np.diff(directions)) + 1).tolist(), len(directions)]
    events = [_rest()]
    for begin, end in itertools.pairwise(bounds):
        if directions[begin]:
            events += _grip(path.closures[end] - path.closures[begin])
        else:
            events += _move(path[begin : end + 1])
    return events


def _motions(positions: NDArray[np.float64], rotations: Rotation) -> NDArray[np.float64]:
    """From each pose to the next, in m and rad: (T - 1, 6)."""
    turns = rotations[1:] * rotations[:-1].inv()
    return np.hstack([np.diff(positions, axis=0), turns.as_rotvec()])


def _move(path: ToolPath) -> list[Event]:
    speeds = np.repeat([TELEOPERATOR.linear_speed, TELEOPERATOR.angular_speed], 3)
    joint_speed = min(TELEOPERATOR.joint_speed, TELEOPERATOR.max_lead / (LATE_SECONDS + TRAIL_SECONDS))
    tool = np.abs(_motions(path.positions, path.rotations) / speeds).max(axis=1)
    arm = np.abs(np.diff(path.joints, axis=0)).max(axis=1) / joint_speed
    times = np.concatenate([[0.0], np.cumsum(np.maximum(PERIOD, np.maximum(tool, arm) / MARGIN))])
    moments = np.linspace(0.0, times[-1], math.ceil(times[-1] / PERIOD - STANDSTILL) + 1)
    positions = make_interp_spline(times, path.positions, k=1)(moments)
    twists = _motions(positions, Slerp(times, path.rotations)(moments)) / PERIOD / speeds
    return [Event(PERIOD, twist) for twist in twists]


def _grip(closing: float) -> list[Event]:
    # Rounded up: an action more or less may see the button, and a weak grip is worse than a strong one.
    num_periods = math.ceil(abs(closing) / TELEOPERATOR.gripper_speed / PERIOD - STANDSTILL)
    press = Event(num_periods * PERIOD, np.zeros(6), ("close" if closing > 0 else "open",))
    return [_rest(), press, _rest()]


def _rest() -> Event:
    return Event(REST_PERIODS * PERIOD, np.zeros(6))
