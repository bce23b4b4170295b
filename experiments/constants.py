"""How much hangs on the constants of recall? Each is halved and doubled, on all ambiguous tasks.

    python experiments/constants.py

Takes the networks that suite.py has trained. The trials run in this process, by LeRobot's own roll-out, and have seeds
that the suite does not use. Run it again to go on.
"""

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from epochs import read_model
from jobs import replace_text
from lerobot.envs.factory import make_env_pre_post_processors
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from networks import add_to_table
from script import run
from suite import MODEL, SuiteConfig, make_network
from tables import RESULTS

from env_door.checks import check_range
from env_door.trials import Trial, read_trials
from env_forks.configuration_forks import ForksEnvConfig
from env_forks.tasks import TASKS
from lerobot_ufrnn import demonstrations, recall, trail
from lerobot_ufrnn.analysis.results import markdown
from lerobot_ufrnn.configuration_ufrnn import RecallConfig
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy

FIRST_TRIAL = 200_000  # seed
FIELDS = {"horizon": (1.0, 4.0), "stay": (1.25, 2.0), "strange": (2.0, 5.0), "patience": (0.4, 1.6)}
"""Of `--policy.recall`; of what is times as much, which is 1 or more, the excess over 1 is halved and doubled."""
CONSTANTS: dict[Any, tuple[str, ...]] = {
    recall: (
        *("GRACE", "NO_PROGRESS", "STRANGE_SECONDS", "PAUSE", "LIKELY", "BARRED", "REFUTED", "NEVER_ENTERED"),
        *("RUN_UP", "LONGEST_LEAD", "SAME_DIRECTION", "AGREED", "ON_WAY", "OFF_WAY", "FADING"),
    ),
    trail: ("INDEPENDENT", "LEAST_LIKELY", "TAKEN"),
    demonstrations: ("NEIGHBOURS", "FARTHEST_NEAR"),
}
BOUNDED = {
    "SAME_DIRECTION": (0.6, 0.9),
    "FADING": (0.8, 0.95),
    "REFUTED": (0.25, 0.75),
    "NEVER_ENTERED": (0.375, 0.9),
    "NEIGHBOURS": (1, 6),
    "LONGEST_LEAD": (2, 8),
}
"""What must be below 1, half-way to it or twice as far; weights are halved, too. Others are whole numbers."""
KEY = ["constant", "value", "task"]
COUNTS = ["trials", "opened", "wrong_first", "recovered"]


@dataclass
class ConstantsConfig:
    """Which networks to try; on one core half an hour for all tasks."""

    tasks: list[str] = field(default_factory=lambda: list(TASKS))  # names of tasks
    set: int = 0  # of demonstrations
    train_seed: int = 0
    updates: int = 1500
    trials_per_way: int = 2
    output_dir: Path = SuiteConfig.output_dir  # where suite.py keeps its networks
    results: Path = RESULTS / "constants"  # folder of counts.csv and table.md

    def __post_init__(self) -> None:
        check_range(self, "set", "train_seed", low=0)
        check_range(self, "updates", "trials_per_way", low=1)


def usual_values() -> dict[str, float]:
    """The constants as they are."""
    values = {name: getattr(RecallConfig(), name) for name in FIELDS}
    return values | {name: getattr(module, name) for module, names in CONSTANTS.items() for name in names}


def changes() -> list[tuple[str, float]]:
    """Names and values to try: first nothing changed, then every constant smaller, then every one larger."""
    chosen = FIELDS | BOUNDED
    pairs = {name: chosen.get(name, (value / 2, value * 2)) for name, value in usual_values().items()}
    return [("none", 0.0), *((name, pair[larger]) for larger in (0, 1) for name, pair in pairs.items())]


@contextlib.contextmanager
def change(policy: UFRNNPolicy, name: str, value: float) -> Iterator[None]:
    """Within it, a constant has another value."""
    owners = [policy.config.recall] if name in FIELDS else [m for m, names in CONSTANTS.items() if name in names]
    usual = [getattr(owner, name) for owner in owners]
    try:
        for owner in owners:
            setattr(owner, name, value)
        policy.demonstrations.train(False)  # measures are taken anew
        yield
    finally:
        for owner, before in zip(owners, usual, strict=True):
            setattr(owner, name, before)


def try_ways(policy: UFRNNPolicy, processors: tuple, task: str, trials_per_way: int) -> list[Trial]:
    """Trials of a task, with each way as the one that goes on; the processors are those of policy and actions."""
    seeds = list(range(FIRST_TRIAL, FIRST_TRIAL + trials_per_way))
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "trials.jsonl"
        environment = ForksEnvConfig(task=task, trial_log=str(log))
        around = make_env_pre_post_processors(env_cfg=environment, policy_cfg=policy.config)
        for suite in environment.create_envs(trials_per_way).values():
            with contextlib.closing(suite[0]) as envs:
                rollout(envs, policy, *around, *processors, seeds=seeds)
        return read_trials(log)


def describe(table: pd.DataFrame) -> str:
    """A row for each constant: opened trials of all tasks, and the task that lost most, smaller and larger."""
    ambiguous = [name for name, task in TASKS.items() if task.is_ambiguous]
    rates = (100 * table.opened / table.trials).groupby([table.constant, table.value, table.task]).first()
    usual = rates["none"][0.0]
    rows = []
    for name, value in usual_values().items():
        row = {"constant": f"`{name}`", "is": f"{value:g}", "smaller": "-", "larger": "-"}
        for title, tried in zip(("smaller", "larger"), [v for n, v in changes() if n == name], strict=True):
            if (name, tried) not in rates.index:
                continue
            changed = rates[name][tried]
            lost = (usual - changed).dropna()
            mean = changed[changed.index.isin(ambiguous)].mean()
            worst = f"{lost.idxmax()} {-lost.max():+.0f}" if lost.max() > 0 else "none loses"
            row[title] = f"{tried:g}: {mean:.0f} ({worst})"
        rows.append(row)
    mean = usual[usual.index.isin(ambiguous)].mean()
    return (
        f"{markdown(pd.DataFrame(rows))}\n"
        f"Opened in percent, mean over {usual.index.isin(ambiguous).sum()} ambiguous tasks (as it is: {mean:.0f}); in "
        "brackets the task that loses most, in points. One network a task: a trial is "
        f"{100 / table.trials.max():.0f} to {100 / table.trials.min():.0f} points.\n"
    )


def main(config: ConstantsConfig) -> None:
    """Tries what is not in the table yet."""
    counts = config.results / "counts.csv"
    done = set(pd.read_csv(counts)[KEY].itertuples(index=False, name=None)) if counts.exists() else set()
    suite, model = SuiteConfig(output_dir=config.output_dir), read_model(MODEL)
    for task in config.tasks:
        missing = [(name, value) for name, value in changes() if (name, value, task) not in done]
        if not missing:
            continue
        network = make_network(suite, task, config.set, model, config.train_seed)
        if config.updates not in network.checkpoints:
            raise FileNotFoundError(
                f"{network.folder} has no checkpoint of update {config.updates}: run suite.py first."
            )
        checkpoint = network.checkpoints[config.updates] / "pretrained_model"
        policy = UFRNNPolicy.from_pretrained(checkpoint)
        processors = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
        for name, value in missing:
            with change(policy, name, value):
                trials = try_ways(policy, processors, task, config.trials_per_way)
            wrong = [trial.success for trial in trials if trial.first_try_wrong]
            row = [name, value, task, len(trials), sum(trial.success for trial in trials), len(wrong), sum(wrong)]
            add_to_table(counts, pd.DataFrame([row], columns=[*KEY, *COUNTS]), KEY, pd.read_csv)
        print(f"{task} is done", flush=True)
    page = describe(pd.read_csv(counts))
    replace_text(config.results / "table.md", page)
    print(page)


if __name__ == "__main__":
    run(main, ConstantsConfig)
