"""What a policy that finds out must beat: demonstrations that are carried out one after the other, with no network.

    python experiments/replay.py
    python experiments/replay.py --tasks=[door] --trials_per_way=10

One that is blocked, or that led to nothing, is taken back, and the next one begins: each of them in turn, or one drawn
at random each time (as who tries again samples another plan). The upper bound knows the way and takes only those of it.
Of the ambiguous tasks, rows are added to the table of suite.py, with the demonstrations and in the trials of that.
"""

import contextlib
import itertools
import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
from draccus.utils import ParsingError
from networks import PROVENANCE_PATH
from script import run
from suite import FIRST_TRIAL, KEY, SEEDS_OF_A_SET, SuiteConfig, add_row, demonstrations

from env_door.checks import check_range
from env_door.configuration_door import make_door
from env_door.trials import Trial, read_trials
from env_forks.configuration_forks import make_task
from env_forks.tasks import EPISODE_STEPS, FPS, TASKS

TOLERANCE = 0.05  # distance from the demonstration that still follows it, as a fraction of the extent of all
AHEAD = 4  # steps of it that are looked at
PATIENCE = 1.5  # seconds for which it waits, where it does not follow and at the end
ORDERS = ("in turn", "at random", "known")


@dataclass
class ReplayConfig:
    """Which demonstrations to carry out in which trials; the names of suite.py mean the same here."""

    tasks: list[str] = field(default_factory=lambda: ["door", *TASKS])  # the door, and names of ambiguous tasks
    sets: list[int] = field(default_factory=lambda: [0, 1, 2])
    orders: list[str] = field(default_factory=lambda: list(ORDERS))
    trials_per_way: int = 10
    episodes_per_way: int = 5
    output_dir: Path = SuiteConfig.output_dir  # demonstrations are here, or are recorded
    results: Path = SuiteConfig.results  # folder of counts.csv; the door is only printed

    def __post_init__(self) -> None:
        for name, allowed in (("tasks", ("door", *TASKS)), ("orders", ORDERS)):
            if not getattr(self, name) or not set(getattr(self, name)) <= set(allowed):
                raise ParsingError(f"--{name} must be of {', '.join(allowed)}; got {getattr(self, name)}.")
        check_range(self, "sets", low=0, high=FIRST_TRIAL // SEEDS_OF_A_SET - 1)
        check_range(self, "trials_per_way", "episodes_per_way", low=1)


@dataclass
class Replay:
    """Carries out demonstrations, states and actions `(L, D)` each, in an order that never ends."""

    demonstrations: Sequence[tuple[np.ndarray, np.ndarray]]
    order: Iterator[int]

    def __post_init__(self) -> None:
        states = np.concatenate([states for states, _ in self.demonstrations])
        self._extent = np.maximum(np.ptp(states, axis=0), 1e-6)
        self._begin()

    def _begin(self) -> None:
        self._states, self._actions = self.demonstrations[next(self.order)]
        self._at, self._waited, self._goes_back = 0, 0, False

    def act(self, state: np.ndarray) -> np.ndarray:
        """The next action, for the state `(D,)` that the robot is in."""
        # It may be a little ahead of the demonstration, which did not wait until the robot was where it was sent.
        gaps = np.abs((self._states[self._at : self._at + AHEAD] - state) / self._extent).max(-1)
        self._waited += 1
        if self._goes_back:
            if gaps.min() <= TOLERANCE or self._waited > FPS:
                self._at, self._waited = self._at - 1, 0
                if self._at < 0:
                    self._begin()
        elif gaps.min() <= TOLERANCE and self._at < len(self._states) - 1:
            self._at, self._waited = min(self._at + max(int(gaps.argmin()), 1), len(self._states) - 1), 0
        elif self._waited > PATIENCE * FPS:
            behind = np.abs((self._states[: self._at + 1] - state) / self._extent).max(-1)
            self._goes_back, self._at, self._waited = True, int(behind.argmin()), 0
        return self._actions[self._at]


def endless(order: str, kinds: Sequence[str], kind: str, seed: Sequence[int]) -> Iterator[int]:
    """Numbers of demonstrations, given the kind of each and that of the trial."""
    random = np.random.default_rng(seed)
    if order == "at random":
        return (int(random.integers(len(kinds))) for _ in itertools.count())
    shuffled = [int(number) for number in random.permutation(len(kinds))]
    return itertools.cycle([number for number in shuffled if order != "known" or kinds[number] == kind])


def read_demonstrations(root: Path) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[str]]:
    """States and actions of each demonstration, and its kind."""
    table = pd.concat([pd.read_parquet(path) for path in sorted(root.glob("data/**/*.parquet"))])
    demonstrations = [
        (np.stack(rows["observation.state"].to_list()), np.stack(rows["action"].to_list()))
        for _, rows in table.sort_values("index").groupby("episode_index")
    ]
    noted = json.loads((root / PROVENANCE_PATH).read_text())
    return demonstrations, [episode["kind"] for episode in noted["episodes"]]


def make_env(task: str, kind: str, log: Path) -> gym.Env:
    """An environment in which one kind, or one way, is right; it logs its trials."""
    if task == "door":
        return make_door(kind=kind, trial_log=str(log), max_episode_steps=EPISODE_STEPS)
    way = TASKS[task].suites.index(kind)
    return make_task(task=task, way=way, trial_log=str(log), max_episode_steps=EPISODE_STEPS)


def try_all(root: Path, task: str, number: int, order: str, trials_per_kind: int) -> list[Trial]:
    """Trials of all kinds or ways with a set of demonstrations."""
    recorded, kinds = read_demonstrations(root)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "trials.jsonl"
        for kind in sorted(set(kinds)):
            with contextlib.closing(make_env(task, kind, log)) as env:
                for seed in range(FIRST_TRIAL, FIRST_TRIAL + trials_per_kind):
                    replay = Replay(recorded, endless(order, kinds, kind, (number, seed)))
                    observation, _ = env.reset(seed=seed)
                    ended = False
                    while not ended:
                        action = replay.act(observation["agent_pos"]).astype(np.float32)
                        observation, _, terminated, truncated, _ = env.step(action)
                        ended = terminated or truncated
        return read_trials(log)


def main(config: ReplayConfig) -> None:
    """Records what is missing, tries, and adds rows."""
    for task, number, order in itertools.product(config.tasks, config.sets, config.orders):
        root, record = demonstrations(config.output_dir, task, number, config.episodes_per_way)
        record()
        trials = try_all(root, task, number, order, config.trials_per_way)
        wrong = [trial for trial in trials if trial.first_try_wrong]
        print(
            f"{task}, set {number}, {order}: {sum(trial.success for trial in trials)} of {len(trials)}, recovered "
            f"{sum(trial.success for trial in wrong)} of {len(wrong)}",
            flush=True,
        )
        if task != "door":
            key = dict(zip(KEY, (task, number, 0, 0, f"replay {order}"), strict=True))
            add_row(config.results / "counts.csv", key, trials)


if __name__ == "__main__":
    run(main, ReplayConfig)
