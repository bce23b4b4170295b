"""Does a policy find out by trying, whatever the task? All ambiguous tasks x sets of demonstrations x training seeds.

    python experiments/suite.py
    python experiments/suite.py --tasks=[three_ways,lamp] --sets=[0] --train_seeds=[0] --results=outputs/suite/first

Demonstrations are recorded by `ufrnn record`, each network is trained by `lerobot-train`, and its checkpoints are tried
by `lerobot-eval`. Run it again to go on. The first network of each task comes before the second of any, so that a run
that is stopped early says something of every task. Jobs of a cluster may share all folders, as with sweep.py.
"""

import contextlib
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from draccus.utils import ParsingError
from epochs import MAX_CHECKPOINTS, Model, read_model
from jobs import replace_text
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from networks import Network, Trials, add_to_table, record_missing, run_all
from script import run
from tables import RESULTS, SAME, mean_text

from env_door.checks import check_range
from env_door.latch import KINDS
from env_door.trials import Trial, read_trials
from env_forks.env import ForksEnv
from env_forks.tasks import TASKS, Task
from lerobot_ufrnn.analysis.results import markdown

FIRST_TRIAL = 100_000  # seed of the first trial
SEEDS_OF_A_SET = 1000  # of which demonstrations take the first
KEY = ["task", "set", "train_seed", "updates", "model"]
COUNTS = ["trials", "opened", "wrong_first", "recovered", "needless", "median_steps", "fewest_steps"]
DRAWS = 10_000  # of the bootstrap
MODEL = Path(__file__).parents[1] / "configs" / "forks" / "ufrnn.yaml"
VARIANTS: dict[str, dict[str, Any]] = {"no_recall": {"recall.enabled": False}}
NOTES = (
    "In percent of trials: mean over networks [95 %, bootstrap over sets and in them over seeds]. Recovered: of trials "
    "whose first try was wrong. Needless: tries a trial of a way tried before, or of a wrong one where a colour "
    "tells the way. Steps: median of opened trials (of the shortest search, at a demonstrator's pace).\n"
)


@dataclass
class SuiteConfig:
    """Tries policies on all ambiguous tasks. On two cores the first network of every task takes about an hour, all
    of the defaults 14: a network some six minutes."""

    tasks: list[str] = field(default_factory=lambda: list(TASKS))  # names of tasks
    sets: list[int] = field(default_factory=lambda: [0, 1, 2])  # sets of demonstrations, each with seeds of its own
    train_seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])  # networks for each set
    updates: list[int] = field(default_factory=lambda: [1500, 4500])  # checkpoints to try; training ends with the last
    models: list[Path] = field(default_factory=lambda: [MODEL])  # as for sweep.py; `steps` of a file do not count
    variants: dict[str, dict[str, Any]] = field(default_factory=lambda: VARIANTS)  # changes in the same trials, by name
    trials_per_way: int = 10  # trials with each way as the one that goes on, the same for every network of a task
    episodes_per_way: int = 5  # demonstrations of each way
    output_dir: Path = Path("outputs/suite")  # demonstrations, checkpoints, trial logs and the output of every command
    results: Path = RESULTS / "suite"  # folder of counts.csv, to which rows are added, table.md and picture.png
    workers: int = os.cpu_count() or 1  # networks that are trained and tried side by side, with one thread each

    def __post_init__(self) -> None:
        for name in ("tasks", "sets", "train_seeds", "updates", "models"):
            values = [path.stem for path in self.models] if name == "models" else getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise ParsingError(f"--{name} must be one or more, each once, got {values}.")
        if unknown := set(self.tasks) - set(TASKS):
            raise ParsingError(f"--tasks must be of {', '.join(TASKS)}; got {', '.join(sorted(unknown))} too.")
        check_range(self, "sets", low=0, high=FIRST_TRIAL // SEEDS_OF_A_SET - 1)
        check_range(self, "train_seeds", low=0)
        check_range(self, "updates", "trials_per_way", "episodes_per_way", "workers", low=1)
        if self.save_freq * MAX_CHECKPOINTS < max(self.updates):
            raise ParsingError(
                f"--updates={self.updates} would need a checkpoint every {self.save_freq} updates, over "
                f"{MAX_CHECKPOINTS} in all: choose multiples of a larger number."
            )

    @property
    def save_freq(self) -> int:
        """Updates between checkpoints."""
        return math.gcd(*self.updates)

    @property
    def counts(self) -> Path:
        """Table of all networks."""
        return self.results / "counts.csv"


# ── Networks ──────────────────────────────────────────────────────────


def plan(config: SuiteConfig, models: list[Model]) -> list[Network]:
    """All networks, the first one of every task before any second one."""
    return [
        make_network(config, name, number, model, seed)
        for seed in config.train_seeds
        for number in config.sets
        for name in config.tasks
        for model in models
    ]


def make_network(config: SuiteConfig, name: str, number: int, model: Model, seed: int) -> Network:
    """A network that learns a task from one set of demonstrations."""
    task = TASKS[name]
    root, prepare = demonstrations(config.output_dir, name, number, config.episodes_per_way)
    shared = {"type": "forks", "task": name, "render_size": 64}, task.suites, config.trials_per_way, FIRST_TRIAL
    trials = []
    for update in config.updates:
        for variant, flags in {"": {}, **config.variants}.items():
            label = f"{model.name}+{variant}" if variant else model.name
            key = dict(zip(KEY, (name, number, seed, update, label), strict=True))
            kept = f"{config.trials_per_way}_trials{'_' * bool(variant)}{variant}/update{update:06d}"
            trials.append(Trials(kept, update, *shared, flags, partial(add_row, config.counts, key)))
    folder, label = root.parent / model.name / f"seed{seed}", f"{name}, set {number}, {model.name}, seed {seed}"
    return Network(label, folder, model, seed, root, config.save_freq, trials, prepare)


def demonstrations(output_dir: Path, name: str, number: int, episodes_per_way: int) -> tuple[Path, Callable[[], None]]:
    """Folder of a set of demonstrations of a task, or of the door, and what records those that are missing."""
    home = output_dir / name / f"set{number}"
    what, ways = ({"env": "forks", "task": name}, TASKS[name].ways) if name in TASKS else ({"env": name}, KINDS)
    flags = {**what, "episodes_per_kind": episodes_per_way, "seed": number * SEEDS_OF_A_SET}
    return home / "dataset", partial(record_missing, home / "dataset", home, flags, episodes_per_way * len(ways))


def add_row(counts: Path, key: dict[str, Any], trials: list[Trial]) -> None:
    """Adds what a network did in its trials to the table."""
    task = TASKS[key["task"]]
    steps = [trial.steps for trial in trials if trial.success]
    wrong = [trial for trial in trials if trial.first_try_wrong]
    recovered, needless = sum(trial.success for trial in wrong), sum(needless_tries(task, trial) for trial in trials)
    median = np.median(steps) if steps else math.nan
    row = [*key.values(), len(trials), len(steps), len(wrong), recovered, needless, median, fewest_steps(task)]
    add_to_table(counts, pd.DataFrame([row], columns=[*KEY, *COUNTS]), KEY, read_counts)


def needless_tries(task: Task, trial: Trial) -> int:
    """Tries of a way that had been tried before; where a colour tells the way, of every wrong one."""
    if task.cue:
        return sum(attempt != trial.door_kind for attempt in trial.attempts)
    return len(trial.attempts) - len(set(trial.attempts))


def fewest_steps(task: Task) -> int:
    """Median over the ways of the steps of a search at a demonstrator's pace that tries no way needlessly."""

    def length(points: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())

    nodes = np.array(task.tree.nodes)
    tips = nodes[list(task.tree.ends)] if task.lamp else task.gates(nodes)  # how far a try goes
    steps, travelled, before, tried = [], 0.0, [0], nodes[:1]
    for way in task.ways:
        path = task.path(way)
        out = nodes[path]
        fork = sum(node == other for node, other in zip(path, before, strict=False)) - 1
        travelled += length(tried[fork:])
        whole = travelled + length(out[fork:]) + (length(out) if task.back else 0)
        behind = length(np.stack((tips[way], out[-1])))
        steps.append(max(whole / task.speed, task.shut_steps + behind / task.speed))
        if not task.cue:
            before, tried = path, np.vstack((out[:-1], tips[way]))
            travelled += length(tried[fork:])
    return round(float(np.median(steps)))


def read_counts(path: Path) -> pd.DataFrame:
    """Reads the table of all networks."""
    table = pd.read_csv(path)
    if list(table) != [*KEY, *COUNTS]:
        raise ValueError(f"{path} is no table of suite.py: its first line must be {','.join([*KEY, *COUNTS])}.")
    return table


# ── What they did ─────────────────────────────────────────────────────


def describe(table: pd.DataFrame) -> str:
    """All that the table says, a section for each number of updates."""
    order = [name for name in TASKS if name in set(table.task)]
    ambiguous = [name for name in order if TASKS[name].is_ambiguous]
    sections = []
    for updates, part in sorted(table.groupby("updates"), reverse=True):
        rows = [
            summarize(title, model, group[group.task.isin(names)])
            for title, names in [("all ambiguous", ambiguous), *((name, [name]) for name in order)]
            for model, group in part.groupby("model")
            if group.task.isin(names).any()
        ]
        title = f"{updates} updates" if updates else "Demonstrations carried out by replay.py: nothing is trained"
        sections.append(f"{title}\n\n{markdown(pd.DataFrame(rows))}")
    return "\n".join([*sections, NOTES])


def summarize(title: str, model: str, group: pd.DataFrame) -> dict[str, str]:
    """A row of the table."""
    networks = group.set_index(["task", "set", "train_seed"])
    opened = 100 * networks.opened / networks.trials
    recovered = (100 * networks.recovered / networks.wrong_first).dropna()
    steps, fewest = networks.median_steps.mean(), networks.fewest_steps.mean()
    return {
        "task": title,
        "model": model,
        "opened": mean_text(opened.groupby("task").mean().mean(), bootstrap(opened)),
        "worst network": mean_text(opened.min(), None),
        "recovered": mean_text(recovered.groupby("task").mean().mean(), bootstrap(recovered)),
        "needless": f"{(networks.needless / networks.trials).mean():.2f}",
        "steps (shortest)": f"{'-' if math.isnan(steps) else round(steps)} ({round(fewest)})",
        "networks x trials": f"{len(networks)} x {'/'.join(map(str, networks.trials.unique()))}",
    }


def bootstrap(rates: pd.Series) -> tuple[float, float] | None:
    """95 % interval of the mean of tasks: of each, sets are drawn anew, then networks of them; None without spread."""
    random, means = np.random.default_rng(0), np.zeros(DRAWS)
    by_task = [[networks.to_numpy() for _, networks in task.groupby("set")] for _, task in rates.groupby("task")]
    for sets in by_task:
        drawn = [each[random.integers(len(each), size=(DRAWS, len(sets), len(each)))].mean(-1) for each in sets]
        chosen = random.integers(len(sets), size=(1, DRAWS, len(sets)))
        means += np.take_along_axis(np.stack(drawn), chosen, 0)[0].mean(-1) / len(by_task)
    low, high = np.percentile(means, [2.5, 97.5])
    return (low, high) if np.ptp(means) > SAME else None


# ── The picture ───────────────────────────────────────────────────────


def draw(table: pd.DataFrame, networks: list[Network], path: Path) -> None:
    """A contact sheet: each task with the path of a trial that found out, and what was opened after most updates."""
    last = table[table.updates == table.updates.max()]
    names = [name for name in TASKS if name in set(last.task)]
    columns = min(6, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Figure(figsize=(2.1 * columns, 2.7 * rows), layout="constrained")
    for number, name in enumerate(names, start=1):
        panel = figure.add_subplot(rows, columns, number)
        draw_trial(panel, TASKS[name], telling_trial(name, networks))
        rates = (100 * last.opened / last.trials)[last.task == name].groupby(last.model).mean()
        panel.set_title(name, fontsize=9, parse_math=False)
        panel.set_xlabel("\n".join(f"{model}: {rate:.0f} %" for model, rate in rates.items()), fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def telling_trial(name: str, networks: list[Network]) -> Trial | None:
    """Of the trials with the last checkpoints, unchanged, the quickest of those that opened and tried the most ways."""
    trials = [
        trial
        for network in networks
        for tried in network.trials
        if tried.environment["task"] == name and tried.step == network.model.settings["steps"]
        if not tried.policy_flags and not network.missing(tried)
        for trial in read_trials(network.log_of(tried))
    ]
    return max(trials, key=lambda trial: (trial.success, len(set(trial.attempts)), -trial.steps), default=None)


def draw_trial(panel: Axes, task: Task, trial: Trial | None) -> None:
    """The task as it was when a trial began, the path from dark to bright, and the ways tried in their order."""
    way, seed = (task.suites.index(trial.door_kind), trial.seed) if trial else (0, 0)
    with contextlib.closing(ForksEnv(task.name, way, render_size=384)) as env:
        env.reset(seed=seed)
        panel.imshow(env.render(), extent=(0, 1, 0, 1))
        ends = env.nodes[list(task.tree.ends)]
    panel.set(xticks=[], yticks=[], xlim=(0, 1), ylim=(0, 1))
    if trial is not None:
        points = np.array(trial.path)
        pieces = list(np.stack((points[:-1], points[1:]), 1))
        panel.add_collection(LineCollection(pieces, array=np.arange(len(pieces)), cmap="plasma", linewidths=2))
        for number, attempt in enumerate(dict.fromkeys(trial.attempts), start=1):
            box = {"boxstyle": "circle", "color": "tab:green" if attempt == trial.door_kind else "tab:red"}
            x, y = ends[task.suites.index(attempt)]
            panel.text(x, y, str(number), color="w", ha="center", va="center", bbox=box)


# ── The command ───────────────────────────────────────────────────────


def main(config: SuiteConfig) -> None:
    """Does what is not done yet, then writes table and picture; a RuntimeError if something failed."""
    models = []
    for model in map(read_model, config.models):
        settings = model.settings | {"steps": max(config.updates)}
        models.append(model._replace(text=yaml.safe_dump(settings), settings=settings))
    if config.counts.exists():
        read_counts(config.counts)  # refuses another table before the work
    networks = plan(config, models)
    failures = run_all(lambda: networks, config.workers)
    if config.counts.exists():
        table = read_counts(config.counts)
        replace_text(config.results / "table.md", describe(table))
        draw(table, networks, config.results / "picture.png")
        print(f"\n{describe(table)}\nCounts, table and picture are in {config.results}.")
    if failures:
        raise RuntimeError(f"{len(failures)} failed, see above: {'; '.join(failures)}.")


if __name__ == "__main__":
    run(main, SuiteConfig)
