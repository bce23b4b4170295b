"""A scripted operator: the events of an input device that lead the tool along a given path.

The teleoperator integrates twists; between two poses of the path, `p -> p'` and `R -> R'` within `t` seconds, the
deflections are therefore

    (p' - p) / (t * linear_speed),    log(R' R^T) / (t * angular_speed)

in the frame of the arm's base. Nobody looks at the arm while the events are played, so whatever the teleoperator cuts
short would be missing for good. Hence the path is walked so slowly that no limit takes hold, not even when an action is
a little late, and the gripper is moved for itself, with rests around it. Each event lasts for whole control periods,
because it counts as often as an action is asked for while it lasts: with half a period more, too much or too little.
"""

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from .configuration_twist import TwistTeleoperatorConfig
from .device import CLOSE, OPEN, DeviceState

REST_PERIODS = 3
"""Rest at the start and around each move of the gripper: the arm comes to its target even if an action is late."""

LATE_SECONDS = 0.15
"""Time from one action to the next up to which the targets stay within the teleoperator's `max_lead`."""

TRAIL_SECONDS = 0.1
"""Time by which the arm trails its targets besides: the servo's smoothing and what passes from reading to sending."""

MARGIN = 0.95
"""Share of each limit that is made use of: inverse kinematics and clocks are not exact."""

STANDSTILL = 1e-4
"""Metres and radians below which a step of the path does not move the tool."""


@dataclass(frozen=True)
class ToolPath:
    """A path of the tool, from where it starts.

    Args:
        positions (`NDArray[np.float64]`):
            Positions of the tool in m in the frame of the arm's base, (T, 3).
        rotations (`NDArray[np.float64]`):
            Its orientations, rotation matrices (T, 3, 3).
        closures (`NDArray[np.float64]`):
            Gripper targets, 0 open to 1 closed, (T,).
        joints (`NDArray[np.float64]`):
            Joint angles in rad that belong to the poses, (T, J): they tell how fast the path may be walked.

    Raises:
        ValueError: If there are fewer than two poses, shapes do not agree, or something is not finite.
    """

    positions: NDArray[np.float64]
    rotations: NDArray[np.float64]
    closures: NDArray[np.float64]
    joints: NDArray[np.float64]

    def __post_init__(self) -> None:
        length = len(self.positions)
        if length < 2:
            raise ValueError(f"A path must have two or more poses, the start and where to go, got {length}.")
        shapes = {
            "positions": (self.positions, (length, 3)),
            "rotations": (self.rotations, (length, 3, 3)),
            "closures": (self.closures, (length,)),
            "joints": (self.joints, (length, *np.shape(self.joints)[1:2])),
        }
        for name, (values, shape) in shapes.items():
            if np.shape(values) != shape:
                raise ValueError(f"`{name}` of a path with {length} poses must have shape {shape}, got {values.shape}.")
            if not np.isfinite(values).all():
                first = int(np.argwhere(~np.isfinite(values))[0, 0])
                raise ValueError(f"`{name}` of a path must be finite, got {values[first].tolist()} at pose {first}.")
        if not ((self.closures >= 0) & (self.closures <= 1)).all():
            raise ValueError(f"`closures` must be 0, open, to 1, closed, got {self.closures.tolist()}.")

    def part(self, first: int, last: int) -> "ToolPath":
        """The path from one pose to another.

        Args:
            first (`int`):
                Number of the pose where it begins.
            last (`int`):
                Number of the pose where it ends.

        Returns:
            `ToolPath`: both poses and those between them.
        """
        poses = slice(first, last + 1)
        return ToolPath(self.positions[poses], self.rotations[poses], self.closures[poses], self.joints[poses])

    def at(self, times: NDArray[np.float64], moments: NDArray[np.float64]) -> "ToolPath":
        """The same path with poses at other times.

        Args:
            times (`NDArray[np.float64]`):
                When each of its poses is reached, in s, rising, (T,).
            moments (`NDArray[np.float64]`):
                When to look, in s, within those times, (M,).

        Returns:
            `ToolPath`: M poses; between two of this path the tool moves and turns evenly.
        """

        def interpolated(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.stack([np.interp(moments, times, column) for column in values.T], axis=-1)

        return ToolPath(
            interpolated(self.positions),
            Slerp(times, Rotation.from_matrix(self.rotations))(moments).as_matrix(),
            np.interp(moments, times, self.closures),
            interpolated(self.joints),
        )


@dataclass(frozen=True)
class Event:
    """A state of the device and for how long it lasts.

    Args:
        seconds (`float`):
            Its duration in s.
        state (`DeviceState`):
            Deflections and buttons.
    """

    seconds: float
    state: DeviceState


def events_along(path: ToolPath, period: float, config: TwistTeleoperatorConfig) -> list[Event]:
    """What an operator does so that the tool follows a path.

    Args:
        path (`ToolPath`):
            The path.
        period (`float`):
            Time in s from one action to the next, and from each pose to the next; longer where a limit asks for it.
        config (`TwistTeleoperatorConfig`):
            The teleoperator that the events are for: its speeds and limits.

    Returns:
        `list[Event]`: the events one after the other, from the first read on.

    Raises:
        ValueError: If the period is not positive, the teleoperator does not read deflections in the base's frame, or a
            step of the path moves both the tool and the gripper.
    """
    if not (math.isfinite(period) and period > 0):
        raise ValueError(f"`period` must be a number of seconds above 0, got {period}.")
    if config.frame != "base":
        raise ValueError(f"The scripted operator needs a teleoperator with the frame 'base', got {config.frame!r}.")
    motions = _motions(path)
    directions = np.sign(np.diff(path.closures))  # 1 closing, -1 opening, 0 the tool's turn
    if (at_once := np.flatnonzero((directions != 0) & (np.abs(motions).max(axis=1) > STANDSTILL))).size:
        raise ValueError(f"Step {at_once[0]} of the path moves tool and gripper at once; move one after the other.")
    bounds = [0, *(np.flatnonzero(np.diff(directions)) + 1).tolist(), len(directions)]
    events = _rest(period)
    for begin, end in itertools.pairwise(bounds):
        if directions[begin]:
            events += _grip(path.closures[end] - path.closures[begin], period, config.gripper_speed)
        else:
            events += _move(path.part(begin, end), period, config)
    return events


def _motions(path: ToolPath) -> NDArray[np.float64]:
    """From each pose to the next, in m and rad: (T - 1, 6)."""
    turns = Rotation.from_matrix(path.rotations[1:]) * Rotation.from_matrix(path.rotations[:-1]).inv()
    return np.hstack([np.diff(path.positions, axis=0), turns.as_rotvec()])


def _move(path: ToolPath, period: float, config: TwistTeleoperatorConfig) -> list[Event]:
    speeds = np.repeat([config.linear_speed, config.angular_speed], 3)
    joint_speed = min(config.joint_speed, config.max_lead / (LATE_SECONDS + TRAIL_SECONDS))
    limited = np.maximum(
        np.abs(_motions(path) / speeds).max(axis=1), np.abs(np.diff(path.joints, axis=0)).max(axis=1) / joint_speed
    )
    times = np.concatenate([[0.0], np.cumsum(np.maximum(period, limited / MARGIN))])
    num_periods = math.ceil(times[-1] / period - STANDSTILL)
    twists = _motions(path.at(times, np.linspace(0.0, times[-1], num_periods + 1))) / period
    return [Event(period, DeviceState(twist)) for twist in twists / speeds]


def _grip(closing: float, period: float, gripper_speed: float) -> list[Event]:
    # Rounded up: an action more or less may see the button, and a weak grip is worse than a strong one.
    num_periods = math.ceil(abs(closing) / gripper_speed / period - STANDSTILL)
    button = DeviceState(buttons=frozenset({CLOSE if closing > 0 else OPEN}))
    return [*_rest(period), Event(num_periods * period, button), *_rest(period)]


def _rest(period: float) -> list[Event]:
    return [Event(REST_PERIODS * period, DeviceState())]


def duration(events: Sequence[Event]) -> float:
    """How long events last together.

    Args:
        events (`Sequence[Event]`):
            The events.

    Returns:
        `float`: time in s.
    """
    return math.fsum(event.seconds for event in events)


def write_events(events: Sequence[Event], file: Path) -> None:
    """Writes events so that `EventStreamDevice` plays them.

    Args:
        events (`Sequence[Event]`):
            One or more events.
        file (`Path`):
            File to write.

    Raises:
        ValueError: If there is no event, or one that the device would refuse.
    """
    if not events:
        raise ValueError("There are no events to write; a device that plays none is refused.")
    lines, now = [], 0.0
    # A device is at rest after its last event, whatever that one says.
    for event in (*events, Event(0.0, DeviceState())):
        if (fault := event.state.fault()) is not None or not np.abs(event.state.twist).max() <= 1:
            raise ValueError(f"Event at {now:.2f} s: {fault or f'deflections {event.state.twist} are beyond -1 to 1'}.")
        line = {"time": round(now, 4), "twist": event.state.twist.tolist(), "buttons": sorted(event.state.buttons)}
        lines.append(json.dumps(line) + "\n")
        now += event.seconds
    file.write_text("".join(lines), encoding="utf-8")
