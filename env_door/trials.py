"""One JSON line for every finished trial, and the reader of that log.

Stock `lerobot-eval` keeps only the success of a trial. What this task is about, whether the door was opened at
the first try or after a wrong one, is in the environment's `info` and would be lost: `TrialLog` writes it down.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import draccus
import gymnasium as gym
from draccus.utils import ParsingError

from env_door.latch import KINDS


@dataclass(frozen=True)
class Trial:
    """What happened in one trial."""

    seed: int | None  # `None` when the environment was reset without one
    door_kind: str  # or in another environment what had to be found out
    success: bool
    steps: int  # control steps taken
    attempts: tuple[str, ...]  # directions in which the unlatched door was tried, and turns of the knob, in order
    opening: float = 0.0  # at the end: 0 closed, 1 the success threshold
    door_offset: float = 0.0  # sideways shift in m
    held_at: int | None = None  # first control step, counted from 0, during which somebody held the door
    tried_while_held: tuple[str, ...] = ()  # directions other than its own tried meanwhile, in order
    path: tuple[tuple[float, float], ...] = ()  # where the disc was at every second step, if there is one

    @property
    def first_try_wrong(self) -> bool:
        """Whether the first direction tried was not the door's own."""
        return bool(self.attempts) and self.attempts[0] != self.door_kind

    @property
    def first_try(self) -> bool:
        """Whether the door was opened without a wrong attempt."""
        return self.success and set(self.attempts) <= {self.door_kind}

    @property
    def opened_after_hold(self) -> bool:
        """Whether the door was opened although it had been held."""
        return self.success and self.held_at is not None


def describe_door(env: gym.Env, info: dict[str, Any]) -> dict[str, Any]:
    """What a door and its last `info` tell of a trial."""
    return {
        "door_kind": info["door_kind"],
        "attempts": tuple(info["attempts"]),
        "opening": float(info["opening"]),
        "door_offset": float(env.get_wrapper_attr("current_offset")),
        "tried_while_held": tuple(info["tried_while_held"]),
    }


class TrialLog(gym.Wrapper):
    """Append one JSON line to a file for every trial that ends.

    A trial ends when the environment terminates or is truncated; one abandoned by an early reset leaves no line.
    Each line is a single write, so that parallel environments, also in other processes, may share the file.
    `describe` gives those fields of a trial that depend on the environment.
    """

    def __init__(
        self,
        env: gym.Env,
        path: str | Path,
        describe: Callable[[gym.Env, dict[str, Any]], dict[str, Any]] = describe_door,
    ):
        super().__init__(env)
        self._describe = describe
        self._path = Path(path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._seed: int | None = None
        self._steps = 0
        self._held_at: int | None = None
        self._finished = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start a new trial; an unfinished one is forgotten."""
        self._seed, self._steps, self._held_at, self._finished = seed, 0, None, False
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        """Step the environment and log the trial when this step ends it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._steps += 1
        if info.get("held") and self._held_at is None:
            self._held_at = self._steps
        if (terminated or truncated) and not self._finished:
            self._finished = True
            trial = Trial(
                seed=self._seed,
                success=bool(info["is_success"]),
                steps=self._steps,
                held_at=self._held_at,
                **self._describe(self.env, info),
            )
            append_trial(self._path, trial)
        return observation, reward, terminated, truncated, info


def append_trial(path: str | Path, trial: Trial) -> None:
    """Add a trial to a log, in a single write."""
    with open(path, "ab", buffering=0) as log:
        log.write(json.dumps(asdict(trial)).encode() + b"\n")


def read_trials(path: str | Path) -> list[Trial]:
    """Read the trials of a log, in the order in which they ended.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If a line is not a trial, or a trial occurs twice; the message names the line.
    """
    trials: list[Trial] = []
    seen: set[tuple[str, int | None]] = set()
    for number, line in enumerate(Path(path).read_text(errors="replace").splitlines(), start=1):
        if not line.strip():
            continue
        try:
            trial = draccus.decode(Trial, json.loads(line))
        except (json.JSONDecodeError, ParsingError, AttributeError) as error:
            raise ValueError(
                f"{path}, line {number} is not a trial ({error}): {line[:80]!r}. "
                "Each line must be a JSON object as written by env_door.trials.TrialLog: remove or repair this one."
            ) from error
        if trial.seed is not None and (trial.door_kind, trial.seed) in seen:
            raise ValueError(
                f"{path}, line {number} repeats the trial {trial.door_kind}, seed {trial.seed}: the log holds more "
                "than one evaluation, perhaps one that was interrupted. Evaluate again into a new log."
            )
        seen.add((trial.door_kind, trial.seed))
        trials.append(trial)
    return trials


def first_of_each_kind(trials: list[Trial], count: int) -> list[Trial]:
    """Of each kind the trials that `lerobot-eval` counts, those with the lowest seeds: its last batch may hold more."""
    ordered = sorted(trials, key=lambda trial: trial.seed or 0)
    kinds = dict.fromkeys((*KINDS, *(trial.door_kind for trial in trials)))
    return [trial for kind in kinds for trial in [t for t in ordered if t.door_kind == kind][:count]]
