"""What became of the arm, the program and the recording when something failed, as a table.

| fault | arm moved before | at a standstill after | farthest joint went on | ... | verdict |
"""

import signal
from collections.abc import Sequence
from dataclasses import dataclass

STILL = 0.01
"""Speed of the fastest joint in rad/s below which the arm stands."""

REST_SECONDS = 0.5
"""How long it must stand to have come to a standstill."""

MAX_STOP_SECONDS = 3.0
"""Longest time until the standstill; the slowest fault to be noticed, a silent gripper, takes a second."""

HEADER = (
    "fault",
    "speed before, rad/s",
    "standstill after, s",
    "farthest joint went on, rad",
    "command ended after, s",
    "exit status",
    "what the user saw",
    "after clearing",
    "episodes readable (frames)",
    "verdict",
)


@dataclass(frozen=True)
class Sample:
    """The arm at one moment.

    Args:
        time (`float`):
            Seconds on any clock.
        speed (`float`):
            Speed of its fastest joint in rad/s.
        joints (`tuple[float, ...]`):
            Joint angles in rad.
    """

    time: float
    speed: float
    joints: tuple[float, ...]


def standstill(samples: Sequence[Sample], begin: float) -> float | None:
    """When the arm came to a standstill, and stood for `REST_SECONDS` at least.

    Args:
        samples (`Sequence[Sample]`):
            In the order of time.
        begin (`float`):
            Moment from which one looks, in s.

    Returns:
        `float | None`: seconds since `begin`; `None` if it did not.
    """
    since = None
    for sample in samples:
        if sample.time < begin or sample.speed >= STILL:
            since = None
            continue
        since = sample.time if since is None else since
        if sample.time - since >= REST_SECONDS:
            return since - begin
    return None


def moves_again(samples: Sequence[Sample], begin: float) -> bool:
    """Whether the arm moved after it had come to a standstill.

    Args:
        samples (`Sequence[Sample]`):
            In the order of time.
        begin (`float`):
            As for `standstill`, in s.

    Returns:
        `bool`: whether it did; `False` if it never stood.
    """
    after = standstill(samples, begin)
    return after is not None and any(sample.time > begin + after and sample.speed >= STILL for sample in samples)


def travel(samples: Sequence[Sample], begin: float, seconds: float | None) -> float:
    """How far the joint that went farthest was at any time from where it had been.

    Args:
        samples (`Sequence[Sample]`):
            In the order of time.
        begin (`float`):
            Moment from which one looks, in s.
        seconds (`float | None`):
            For how long; `None` to the end.

    Returns:
        `float`: rad; 0 if there are no samples.
    """
    end = float("inf") if seconds is None else begin + seconds
    before = [sample for sample in samples if sample.time <= begin]
    after = [sample for sample in samples if begin < sample.time <= end]
    if not after:
        return 0.0
    start = (before[-1] if before else after[0]).joints
    return max(abs(angle - from_) for sample in after for angle, from_ in zip(sample.joints, start, strict=True))


@dataclass(frozen=True)
class Outcome:
    """What one fault led to.

    Args:
        fault (`str`):
            Its name.
        must_stop (`bool`):
            Whether the arm must be stopped, and the recording with it.
        may_resume (`bool`):
            Whether the arm may move again after it stood.
        may_die_of (`int`):
            Number of the signal that may end the command; 0 if none may.
        may_lose (`bool`):
            Whether the recording may be lost.
        speed (`float`):
            Speed of the fastest joint in rad/s when it struck.
        standstill (`float | None`):
            Seconds until the arm stood; `None` if it never did.
        moved_again (`bool`):
            Whether it moved once more after that.
        travel (`float`):
            How far the farthest joint went on until then, in rad.
        ended (`float | None`):
            Seconds until the command had ended; `None` if it had to be killed.
        status (`int | None`):
            Its exit status, negative if a signal ended it.
        told (`str`):
            What it told the user; empty if nothing.
        still_when_cleared (`bool`):
            Whether the arm stayed where it was when the fault was cleared.
        left_running (`tuple[str, ...]`):
            Processes of the command that were still there after its end.
        episodes (`tuple[int, ...]`):
            Frames of each recorded episode that can be read.
        recorded (`int`):
            Episodes that were recorded before the fault.
    """

    fault: str
    must_stop: bool
    may_resume: bool
    may_die_of: int
    may_lose: bool
    speed: float
    standstill: float | None
    moved_again: bool
    travel: float
    ended: float | None
    status: int | None
    told: str
    still_when_cleared: bool
    left_running: tuple[str, ...]
    episodes: tuple[int, ...]
    recorded: int = 1

    @property
    def went_on(self) -> bool:
        """`bool`: whether the recording ended as if nothing had happened."""
        return self.status == 0

    @property
    def lost(self) -> bool:
        """`bool`: whether an episode that was recorded before the fault cannot be read in full."""
        return len(self.episodes) < self.recorded or 0 in self.episodes

    def problems(self) -> list[str]:
        """What must not be.

        Returns:
            `list[str]`: in a few words each; empty if all is well.
        """
        problems = []
        if self.must_stop and (self.standstill is None or self.standstill > MAX_STOP_SECONDS):
            problems.append("the arm moved on")
        if self.moved_again and not self.may_resume:
            problems.append("the arm moved again")
        if self.must_stop and self.went_on and not self.may_resume:
            problems.append("nobody was told")
        if self.ended is None:
            problems.append("the command hung")
        elif self.status is not None and self.status < 0 and -self.status != self.may_die_of:
            problems.append(f"the command crashed ({signal_name(-self.status)})")
        if self.left_running:
            problems.append(f"left running: {', '.join(self.left_running)}")
        if not self.still_when_cleared:
            problems.append("the arm moved when the fault was cleared")
        if self.lost and not self.may_lose:
            problems.append("recorded episode lost")
        return problems

    @property
    def verdict(self) -> str:
        """`str`: the outcome in a few words."""
        if problems := self.problems():
            return "**FAILED**: " + ", ".join(problems)
        if not self.went_on:
            return "stopped; the recording cannot be read" if self.lost else "stopped"
        if self.must_stop:
            return "stopped, then went on"
        return "went on, not noticed"


def signal_name(number: int) -> str:
    """Name of a signal, such as `SIGABRT`.

    Args:
        number (`int`):
            Its number.

    Returns:
        `str`: its name, or the number if there is none.
    """
    try:
        return signal.Signals(number).name
    except ValueError:
        return str(number)


def to_markdown(outcomes: Sequence[Outcome]) -> str:
    """The table.

    Args:
        outcomes (`Sequence[Outcome]`):
            A row each.

    Returns:
        `str`: lines of Markdown.
    """
    rows = [HEADER, ("---",) * len(HEADER), *(_row(outcome) for outcome in outcomes)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _row(outcome: Outcome) -> tuple[str, ...]:
    # When the recording went on, the arm stood at its end, which says nothing of the fault.
    stopped = outcome.standstill is not None and (outcome.must_stop or not outcome.went_on)
    status = "killed" if outcome.ended is None or outcome.status is None else _status(outcome.status)
    frames = ", ".join(map(str, outcome.episodes))
    return (
        outcome.fault,
        f"{outcome.speed:.2f}",
        f"{outcome.standstill:.2f}" if stopped and outcome.standstill is not None else "-",
        f"{outcome.travel:.3f}" if stopped else "-",
        "-" if outcome.ended is None else f"{outcome.ended:.1f}",
        status,
        outcome.told.replace("|", "\\|") or "nothing",
        "at rest" if outcome.still_when_cleared else "moved",
        f"{len(outcome.episodes)} ({frames})" if outcome.episodes else "0",
        outcome.verdict,
    )


def _status(status: int) -> str:
    return signal_name(-status) if status < 0 else str(status)
