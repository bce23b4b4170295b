"""`ufrnn rehearse`: door trials of a policy on the digital twin, through stock `lerobot-rollout`."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from env_door.env import MAX_HOLD
from env_door.latch import KINDS, check_kinds
from env_door.trials import Trial, append_trial, read_trials
from env_door.twin import TwinProcess

from ..analysis.results import summarize, to_markdown
from .flags import parse_flags
from .stock import FPS, StockCommand, describe_failure, late_ticks, twin_flags

START_SECONDS = 120.0
"""Longest time for a roll-out to load its policy and connect."""

POLL_SECONDS = 0.05
MISSED = 0.012
"""Interval in s between set-points above which one was missed: the servo sends one every 8 ms."""


@dataclass
class RehearseConfig:
    """Which policy to try, and in which trials.

    Args:
        policy_path (`str`):
            Checkpoint folder or Hub repository.
        trial_log (`Path`):
            File that gets a JSON line for each trial, as from `lerobot-eval --env.trial_log`. Trials that are in it are
            not repeated.
        kinds (`tuple[str, ...]`, *optional*, defaults to `("push", "pull", "slide")`):
            Kinds of doors.
        trials_per_kind (`int`, *optional*, defaults to `7`):
            Trials for each.
        seed (`int`, *optional*, defaults to `20000`):
            Seed of the first; the others count up from it.
        duration (`float`, *optional*, defaults to `30.0`):
            Longest trial in s.
        hold_seconds (`float`, *optional*, defaults to `0.0`):
            Time in s for which somebody holds the door once it has begun to open.

    Raises:
        ValueError: If a field is out of its range.
    """

    policy_path: str
    trial_log: Path
    kinds: tuple[str, ...] = field(default=KINDS)
    trials_per_kind: int = 7
    seed: int = 20000
    duration: float = 30.0
    hold_seconds: float = 0.0

    def __post_init__(self) -> None:
        check_kinds(self.kinds, "--kinds")
        if self.trials_per_kind < 1 or self.seed < 0:
            raise ValueError("--trials_per_kind must be at least 1 and --seed at least 0.")
        if not 0 < self.duration <= 3600:
            raise ValueError(f"--duration must be above 0 and at most 3600 s, got {self.duration}.")
        if not 0 <= self.hold_seconds <= MAX_HOLD:
            raise ValueError(f"--hold_seconds must be 0 to {MAX_HOLD:g} s, got {self.hold_seconds}.")


def run(arguments: list[str]) -> None:
    """Runs the trials that the log does not have; prints how evenly the arm was served, and the table of all."""
    config = parse_flags(RehearseConfig, arguments)
    config.trial_log.parent.mkdir(parents=True, exist_ok=True)
    done = {(trial.door_kind, trial.seed) for trial in _logged(config.trial_log)}
    intervals: list[NDArray[np.float64]] = []
    with TwinProcess(camera=True, hold_seconds=config.hold_seconds) as twin:
        for kind, seed in _trials(config):
            if (kind, seed) in done:
                continue
            trial, told = _try(config, twin, kind, seed)
            append_trial(config.trial_log, trial)
            intervals.append(np.diff(twin.arrivals()))
            tried = ", ".join(trial.attempts) or "nothing"
            outcome = f"{'opened' if trial.success else 'not opened'} after {trial.steps / FPS:.1f} s"
            print(f"{kind} door, seed {seed}: {outcome}; tried {tried}; {told}", flush=True)
    if intervals:
        print(f"\n{describe_intervals(np.concatenate(intervals))}")
    print("\n" + to_markdown(summarize(_logged(config.trial_log))), end="")


def describe_intervals(intervals: NDArray[np.float64]) -> str:
    """How evenly set-points came.

    Args:
        intervals (`NDArray[np.float64]`):
            Times in s from one to the next, (M,).

    Returns:
        `str`: a sentence.
    """
    if intervals.size == 0:
        return "No set-points came."
    median, high, longest = 1000 * np.quantile(intervals, [0.5, 0.99, 1.0])
    missed = int((intervals > MISSED).sum())
    return (
        f"{intervals.size} set-points in {intervals.sum():.0f} s as the controller received them: one every "
        f"{median:.2f} ms (median; 99th percentile {high:.2f} ms, longest {longest:.1f} ms), "
        f"{missed} more than {1000 * MISSED:.0f} ms after the one before."
    )


def _logged(path: Path) -> list[Trial]:
    return read_trials(path) if path.exists() else []


def _trials(config: RehearseConfig) -> Iterator[tuple[str, int]]:
    for number in range(config.trials_per_kind):
        for kind in config.kinds:
            yield kind, config.seed + number


def _try(config: RehearseConfig, twin: TwinProcess, kind: str, seed: int) -> tuple[Trial, str]:
    """One trial, and what else there is to tell of its roll-out. One that fails on the way is a trial, too.

    Raises:
        RuntimeError: If it ends before it moves the arm; the message has the end of its output.
    """
    twin.reset(kind, seed)
    with StockCommand(_rollout(config, twin.address)) as rollout:
        trial = _watch(config, twin, rollout, kind, seed)
        failed = rollout.has_ended and rollout.process.returncode != 0
        rollout.stop()
        text, status = rollout.output(), rollout.process.returncode
    if trial is None:
        raise RuntimeError(f"lerobot-rollout ended with status {status} before it moved the arm:\n{text[-2000:]}")
    told = f"{late_ticks(text)} late ticks"
    return trial, f"{told}; lerobot-rollout ended with {describe_failure(status, text)}" if failed else told


def _rollout(config: RehearseConfig, address: str) -> list[str]:
    return [
        "lerobot-rollout",
        f"--policy.path={config.policy_path}",
        *twin_flags(address),
        f"--fps={FPS}",
        f"--duration={config.duration}",
        "--task=open the door",
        "--return_to_initial_position=false",
    ]


def _watch(config: RehearseConfig, twin: TwinProcess, rollout: StockCommand, kind: str, seed: int) -> Trial | None:
    """Looks on until the door is open or the time is over; `None` if the roll-out ends before it moved the arm."""
    begin = held_at = None
    deadline = time.monotonic() + START_SECONDS + config.duration
    state: dict[str, Any] = {}
    while time.monotonic() < deadline:
        state = twin.state()
        if begin is None and max(abs(state["targets"][name] - value) for name, value in state["joints"].items()) > 0.01:
            begin = state["time"]
            twin.arrivals()  # those of connecting do not count
        if begin is not None:
            steps = round((state["time"] - begin) * FPS)
            if state["held"] and held_at is None:
                held_at = steps
            if state["is_open"] or steps >= config.duration * FPS or rollout.has_ended:
                break
        elif rollout.has_ended:
            return None
        time.sleep(POLL_SECONDS)
    if begin is None:
        return None
    return Trial(
        seed=seed,
        door_kind=kind,
        success=bool(state["is_open"]),
        steps=steps,
        attempts=tuple(state["attempts"]),
        opening=float(state["opening"]),
        door_offset=0.0,
        held_at=held_at,
        tried_while_held=tuple(state["tried_while_held"]),
    )
