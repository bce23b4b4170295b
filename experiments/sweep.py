"""Which model opens how many doors? Models x training seeds x checkpoints through LeRobot's own commands.

    python experiments/sweep.py --models=[configs/ufrnn.yaml,configs/sh_rnn_noise.yaml]

Demonstrations are recorded once; each network (a model with a training seed) is trained by `lerobot-train`, its
checkpoints are tried by `lerobot-eval`, and the counts are added to a table. Run it again to go on: a training goes on
from its last checkpoint, an evaluation without all its trials is repeated, what is done is skipped.

Networks depend on nothing but the demonstrations, so that a cluster needs no code here. Jobs may share all folders:

    sbatch --array=0-2 --wrap='python experiments/sweep.py --models=[...] --train_seeds=[$SLURM_ARRAY_TASK_ID]'
"""

import os
import string
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from draccus.utils import ParsingError
from epochs import Model, find_checkpoints, read_model
from networks import Network, Trials, add_to_table, count_demonstrations, record_missing, run_all
from script import run
from tables import HELD_COUNTS, KEY, RESULTS, SUCCESS_COUNTS, describe, read_table

from env_door.checks import check_range
from env_door.latch import KINDS, check_kinds
from env_door.limits import MAX_HOLD, MAX_OFFSET
from env_door.trials import Trial
from lerobot_ufrnn.analysis.results import count_by_door

NAME_CHARACTERS = set(string.ascii_letters + string.digits + "_-")
DEMONSTRATED = ("kinds", "episodes_per_kind", "matched", "num_steps", "door_offset")  # what is recorded


@dataclass
class SweepConfig:
    """What to train, and how to try it."""

    models: list[Path]  # files for `lerobot-train --config_path`; a model has the name of its file
    train_seeds: list[int] = field(default_factory=lambda: [0, 1, 2])  # each model is trained with each seed
    epochs: list[int] = field(default_factory=list)  # checkpoints to try, in passes over the data; else the last one
    trials_per_kind: int = 100  # trials for each kind of door at each checkpoint
    trial_seed: int = 10000  # seed of the first trial; the others count up from it, the same for every network
    hold_seconds: float = 0.0  # interference: for how long somebody holds the door still once it has begun to open
    variant: str = ""  # name of what `policy_flags` change, in the table `<model>+<variant>`
    policy_flags: dict[str, Any] = field(default_factory=dict)  # changes in the trials: `{recall.enabled: false}`
    kinds: tuple[str, ...] = KINDS  # kinds of door, in demonstrations and trials
    episodes_per_kind: int = 5  # demonstrations for each kind of door
    matched: bool = True  # whether the kinds share start poses and timing, which may tell them apart otherwise
    num_steps: int = 150  # steps of a demonstration; the demonstrator needs up to 102, or 99 without sliding doors
    door_offset: float = 0.0  # half-width in m of the range of the door's lateral shift, demonstrations and trials
    output_dir: Path = Path("outputs/sweep")  # folder of checkpoints, trial logs and the output of every command
    dataset_dir: Path | None = None  # demonstrations, recorded if missing; by default in `output_dir`
    results: Path | None = None  # table to add to; it does not say which trials were run: others need another one
    workers: int = os.cpu_count() or 1  # networks that are trained and tried side by side, with one thread each

    def __post_init__(self) -> None:
        for name in ("models", "train_seeds", "epochs"):
            values = [path.stem for path in self.models] if name == "models" else getattr(self, name)
            if len(set(values)) != len(values) or not (values or name == "epochs"):
                raise ParsingError(f"--{name} must be one or more, with different names, got {values}.")
        check_range(self, "train_seeds", "trial_seed", low=0)
        check_range(self, "epochs", "trials_per_kind", "episodes_per_kind", "num_steps", "workers", low=1)
        check_range(self, "hold_seconds", low=0, high=MAX_HOLD, unit="s")
        check_range(self, "door_offset", low=0, high=MAX_OFFSET, unit="m")
        check_kinds(self.kinds, "--kinds")
        if bool(self.variant) != bool(self.policy_flags) or not set(self.variant) <= NAME_CHARACTERS:
            raise ParsingError(
                "--variant must name --policy_flags in letters, digits, '_' and '-', and neither goes without the "
                f"other; got {self.variant!r} and {self.policy_flags}."
            )
        other = [f"--{name}" for name in DEMONSTRATED if getattr(self, name) != getattr(SweepConfig, name)]
        if other and self.results is None:
            raise ParsingError(
                f"A table does not say what was demonstrated and tried: with {' and '.join(other)} give it a table of "
                "its own, such as --results=experiments/results/door_offset.csv."
            )

    @property
    def demonstrations(self) -> Path:
        """Folder of the demonstrations."""
        return self.dataset_dir or self.output_dir / "dataset"

    @property
    def table(self) -> Path:
        """Table of results."""
        return self.results or RESULTS / f"door_{'interference' if self.hold_seconds > 0 else 'protocol'}.csv"

    @property
    def counts(self) -> list[str]:
        """What that table counts."""
        return HELD_COUNTS if self.hold_seconds > 0 else SUCCESS_COUNTS

    @property
    def trials(self) -> str:
        """Name of the trials; those of another number, seed, hold or door have another name."""
        name = f"{self.trials_per_kind}_trials_from_{self.trial_seed}_offset_{self.door_offset:g}"
        name += f"_{'_'.join(self.kinds)}" if self.kinds != KINDS else ""
        name += f"_held_{self.hold_seconds:g}" if self.hold_seconds > 0 else ""
        return name + (f"_{self.variant}" if self.variant else "")


def record(config: SweepConfig) -> None:
    """Records the demonstrations, or the rest of them."""
    flags = {name: getattr(config, name) for name in DEMONSTRATED}
    flags |= {"kinds": f"[{','.join(config.kinds)}]", "matched": str(config.matched).lower()}
    record_missing(config.demonstrations, config.output_dir, flags, config.episodes_per_kind * len(config.kinds))


def plan(config: SweepConfig, models: list[Model]) -> list[Network]:
    """All networks, every model with the first seed before any with the second; the demonstrations exist."""
    size, checkpoints = count_demonstrations(config.demonstrations), {}
    for model in models:
        try:
            checkpoints[model.name] = find_checkpoints(model.settings, *size, config.epochs)
        except ValueError as error:
            raise ValueError(f"Model {model.name}: {error}") from error
    return [
        make_network(config, model, seed, *checkpoints[model.name]) for seed in config.train_seeds for model in models
    ]


def make_network(config: SweepConfig, model: Model, seed: int, step_of: dict[int, int], save_freq: int) -> Network:
    """A network, to be tried at the updates that end some epochs."""
    environment = {"type": "door", "task": ",".join(config.kinds)}
    environment |= {name: getattr(config, name) for name in ("door_offset", "hold_seconds")}
    shared = config.kinds, config.trials_per_kind, config.trial_seed, config.policy_flags
    trials = []
    for epoch, step in step_of.items():
        keep = partial(add_counts, config, model.name, seed, epoch)
        trials.append(Trials(f"{config.trials}/epoch{epoch:06d}", step, environment, *shared, keep))
    name, folder = f"{model.name}, seed {seed}", config.output_dir / model.name / f"seed{seed}"
    return Network(name, folder, model, seed, config.demonstrations, save_freq, trials)


def add_counts(config: SweepConfig, model: str, seed: int, epoch: int, trials: list[Trial]) -> None:
    """Adds the rows of a network at an epoch to the table."""
    rows = count_by_door(trials).drop("all").reset_index()
    rows = rows.assign(model=f"{model}+{config.variant}" if config.variant else model, train_seed=seed, epoch=epoch)
    add_to_table(config.table, rows[[*KEY, *config.counts]], KEY, partial(read_table, counts=config.counts))


def main(config: SweepConfig) -> None:
    """Does what is not done yet, and prints the table; a RuntimeError if something failed, with the rest done."""
    if config.table.exists():
        read_table(config.table, config.counts)  # refuses another kind of table before the work
    models = [read_model(path) for path in config.models]

    def recorded_plan() -> list[Network]:
        record(config)
        return plan(config, models)

    failures = run_all(recorded_plan, config.workers)
    if config.table.exists():
        print(f"\n{describe(read_table(config.table))}\n\nAll rows are in {config.table}.")
    if failures:
        raise RuntimeError(f"{len(failures)} failed, see above: {'; '.join(failures)}.")


if __name__ == "__main__":
    run(main, SweepConfig)
