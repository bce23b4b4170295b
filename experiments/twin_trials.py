"""Does a policy open doors on the robot's digital twin, in real time? Trials through stock `lerobot-rollout`.

Each trial becomes a line of the log, as from `lerobot-eval --env.trial_log`; run again to go on where it stopped.
Real time: leave the computer alone meanwhile.
"""

import itertools
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from script import run
from twin import StockCommand, describe_failure, late_ticks, robot_flags

from env_door.checks import check_range
from env_door.latch import KINDS, check_kinds
from env_door.limits import FPS, MAX_HOLD
from env_door.trials import Trial, append_trial, read_trials
from env_door.twin import TwinProcess
from lerobot_ufrnn.analysis.results import count_by_door, to_markdown

START_SECONDS = 120.0  # longest time for a roll-out to load its policy and connect
POLL_SECONDS = 0.05

MOVED = 0.01  # distance in rad between a joint and its target from which the policy counts as moving the arm
MISSED = 0.012  # interval in s between set-points above which one was missed: the servo sends one every 8 ms


@dataclass
class TrialsConfig:
    """Which policy to try, and in which trials."""

    policy_path: str  # checkpoint folder or Hub repository
    trial_log: Path  # file that gets a JSON line for each trial
    kinds: tuple[str, ...] = KINDS  # kinds of doors
    trials_per_kind: int = 7  # trials for each
    seed: int = 20000  # seed of the first; the others count up from it
    duration: float = 30.0  # longest trial in s
    hold_seconds: float = 0.0  # time in s for which somebody holds the door once it has begun to open

    def __post_init__(self) -> None:
        check_kinds(self.kinds, "--kinds")
        check_range(self, "trials_per_kind", low=1)
        check_range(self, "seed", low=0)
        check_range(self, "duration", above=0, high=3600, unit="s")
        check_range(self, "hold_seconds", low=0, high=MAX_HOLD, unit="s")


def main(config: TrialsConfig) -> None:
    """Runs the trials that the log does not have; prints how evenly the arm was served, and the table of all."""
    log = config.trial_log
    log.parent.mkdir(parents=True, exist_ok=True)
    done = {(trial.door_kind, trial.seed) for trial in read_trials(log)} if log.exists() else set()
    intervals: list[NDArray[np.float64]] = []
    with TwinProcess(camera=True, hold_seconds=config.hold_seconds) as twin:
        for seed, kind in itertools.product(range(config.seed, config.seed + config.trials_per_kind), config.kinds):
            if (kind, seed) not in done:
                trial, note = try_door(twin, config.policy_path, kind, seed, config.duration)
                append_trial(log, trial)
                intervals.append(np.diff(twin.arrivals()))
                tried = ", ".join(trial.attempts) or "nothing"
                outcome = f"{'opened' if trial.success else 'not opened'} after {trial.steps / FPS:.1f} s"
                print(f"{kind} door, seed {seed}: {outcome}; tried {tried}; {note}", flush=True)
    if intervals:
        print(f"\n{describe_intervals(np.concatenate(intervals))}")
    print("\n" + to_markdown(count_by_door(read_trials(log))), end="")


def try_door(twin: TwinProcess, policy_path: str, kind: str, seed: int, duration: float) -> tuple[Trial, str]:
    """One trial, and a note on its roll-out; one that fails on the way is a trial, too, if it has moved the arm."""
    twin.reset(kind, seed)
    flags = [f"--policy.path={policy_path}", f"--fps={FPS}", f"--duration={duration}", "--task=open the door"]
    flags += [*robot_flags(twin.address), "--return_to_initial_position=false"]
    with StockCommand("lerobot-rollout", *flags) as rollout:
        trial = watch(twin, rollout, kind, seed, duration)
        failed = bool(rollout.poll())
        rollout.stop()
        text, status = rollout.output(), rollout.returncode
    if trial is None:
        raise RuntimeError(f"lerobot-rollout ended with status {status} before it moved the arm:\n{text[-2000:]}")
    note = f"{late_ticks(text)} late ticks"
    return trial, f"{note}; lerobot-rollout ended with {describe_failure(status, text)}" if failed else note


def watch(twin: TwinProcess, rollout: StockCommand, kind: str, seed: int, duration: float) -> Trial | None:
    """Looks on until the door is open or the time is over; `None` if the roll-out ends before it moved the arm."""
    begin = held_at = None
    deadline = time.monotonic() + START_SECONDS + duration
    while time.monotonic() < deadline:
        state, has_ended = twin.state(), rollout.poll() is not None
        if begin is None and any(abs(state["targets"][name] - at) > MOVED for name, at in state["joints"].items()):
            begin = state["time"]
            twin.arrivals()  # those of connecting do not count
        if begin is not None:
            steps = round((state["time"] - begin) * FPS)
            if state["held"] and held_at is None:
                held_at = steps
        if has_ended or (begin is not None and (state["is_open"] or steps >= duration * FPS)):
            break
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


def describe_intervals(intervals: NDArray[np.float64]) -> str:
    """How evenly set-points came, given the times in s from one to the next, (M,)."""
    if intervals.size == 0:
        return "No set-points came."
    median, high, longest = 1000 * np.quantile(intervals, [0.5, 0.99, 1.0])
    missed = int((intervals > MISSED).sum())
    return (
        f"{intervals.size} set-points in {intervals.sum():.0f} s as the controller received them: one every "
        f"{median:.2f} ms (median; 99th percentile {high:.2f} ms, longest {longest:.1f} ms), "
        f"{missed} more than {1000 * MISSED:.0f} ms after the one before."
    )


if __name__ == "__main__":
    run(main, TrialsConfig)
