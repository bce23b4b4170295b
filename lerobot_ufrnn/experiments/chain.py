"""One model trained with one seed, and the evaluations of its checkpoints."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from filelock import FileLock

from env_door.trials import Trial, first_of_each_kind, read_trials

from ..analysis.evaluation_table import EvaluationRow, read_table, rows_of, to_csv
from ..analysis.results import summarize
from .configuration import ProtocolConfig
from .demonstrations import REPO_ID, count_demonstrations
from .model import Model
from .processes import Runner
from .schedule import Schedule
from .state import replace_text, run_once

EVALUATION_BATCH_SIZE = 10
# What may change without changing what is learned.
FREE_SETTINGS = ("save_freq", "log_freq", "output_dir", "job_name", "seed")


@dataclass(frozen=True)
class Chain:
    """One training run and its evaluations, in order.

    Attributes:
        protocol (`ProtocolConfig`): what is compared.
        model (`Model`): what to train.
        schedule (`Schedule`): its epochs.
        train_seed (`int`): with which seed.
    """

    protocol: ProtocolConfig
    model: Model
    schedule: Schedule
    train_seed: int

    @property
    def name(self) -> str:
        """`str`: model and seed."""
        return f"{self.model.name}, seed {self.train_seed}"

    @property
    def label(self) -> str:
        """`str`: what the table calls the model as it is tried."""
        variant = self.protocol.variant
        return f"{self.model.name}+{variant}" if variant else self.model.name

    @property
    def training(self) -> str:
        """`str`: what to call its training."""
        return f"{self.name}: training"

    def evaluation(self, epoch: int) -> str:
        """`str`: what to call the evaluation of an epoch."""
        return f"{self.label}, seed {self.train_seed}: evaluation of epoch {epoch}"

    @property
    def folder(self) -> Path:
        """`Path`: everything that this chain makes, but for its rows in the table."""
        return self.protocol.output_dir / self.model.name / f"seed{self.train_seed}"

    @property
    def epochs(self) -> list[int]:
        """`list[int]`: checkpoints to evaluate."""
        return sorted(self.protocol.epochs) or [self.schedule.last_epoch]

    @property
    def save_freq(self) -> int:
        """`int`: updates between checkpoints."""
        wanted = self.model.settings.get("save_freq") or 0
        return self.schedule.save_freq(self.epochs, wanted if wanted > 0 else self.schedule.steps)

    @property
    def checkpoints(self) -> dict[int, Path]:
        """`dict[int, Path]`: update to the folder of its checkpoint, in rising order."""
        folders = (self.folder / "train" / "checkpoints").glob("[0-9]*")
        return {int(folder.name): folder for folder in sorted(folders, key=lambda folder: int(folder.name))}

    @property
    def last_checkpoint(self) -> int:
        """`int`: the last update whose checkpoint is whole, 0 if there is none.

        LeRobot points the link `last` at a checkpoint once it is written; it takes the old link away just before.
        """
        steps = list(self.checkpoints)
        link = self.folder / "train" / "checkpoints" / "last"
        if link.is_symlink():
            return int(link.readlink().name)
        return steps[-1] if len(steps) > 1 else 0

    def trial_log(self, epoch: int) -> Path:
        """`Path`: trials of an epoch's checkpoint."""
        return self._evaluation_folder(epoch) / "trials.jsonl"

    def train(self, runner: Runner, lock: int) -> None:
        """Trains, from the last checkpoint on if there is one, unless it is done.

        Args:
            runner (`Runner`):
                Runs `lerobot-train`.
            lock (`int`):
                Descriptor of the locked file, for `runner`.

        Raises:
            ValueError: If the folder holds a training with other settings or demonstrations.
            RuntimeError: If training fails.
        """
        settings = {name: value for name, value in self.model.settings.items() if name not in FREE_SETTINGS}
        settings["dataset_dir"] = str(self.protocol.demonstrations)
        settings["dataset_size"] = count_demonstrations(self.protocol.demonstrations)
        run_once(self.training, self.folder / "train.json", settings, partial(self._train, runner, lock))

    def evaluate(self, epoch: int, runner: Runner, lock: int) -> None:
        """Evaluates an epoch's checkpoint, unless it is done, and adds its rows to the table.

        Args:
            epoch (`int`):
                Which checkpoint.
            runner (`Runner`):
                Runs `lerobot-eval`.
            lock (`int`):
                Descriptor of the locked file, for `runner`.

        Raises:
            FileNotFoundError: If the checkpoint was not kept.
            RuntimeError: If evaluation fails, or its log lacks trials.
        """
        folder = self._evaluation_folder(epoch)
        state = folder.with_name(f"{folder.name}.json")
        run_once(
            self.evaluation(epoch), state, self.protocol.policy_flags, partial(self._evaluate, epoch, runner, lock)
        )
        doors = summarize(self._trials(epoch))
        rows = rows_of(self.protocol.row_type, self.label, self.train_seed, epoch, doors)
        add_to_table(self.protocol.table, rows)

    def _evaluation_folder(self, epoch: int) -> Path:
        return self.folder / self.protocol.trials / f"epoch{epoch:06d}"

    def _train(self, runner: Runner, lock: int) -> None:
        folder = self.folder / "train"
        step = self.last_checkpoint
        if step == self.schedule.steps:
            return
        if step > 0:
            config = self.checkpoints[step] / "pretrained_model" / "train_config.json"
            flags = ["--resume=true"]
        else:
            # A run that was stopped before its first checkpoint left nothing to go on from.
            shutil.rmtree(folder, ignore_errors=True)
            config = self.folder / "model.yaml"
            replace_text(config, self.model.text)
            flags = [f"--seed={self.train_seed}", "--policy.push_to_hub=false"]
        runner.run(
            [
                "lerobot-train",
                f"--config_path={config}",
                f"--dataset.repo_id={REPO_ID}",
                f"--dataset.root={self.protocol.demonstrations}",
                f"--output_dir={folder}",
                f"--save_freq={self.save_freq}",
                *flags,
            ],
            self.folder / "train.log",
            lock,
        )

    def _evaluate(self, epoch: int, runner: Runner, lock: int) -> None:
        folder = self._evaluation_folder(epoch)
        shutil.rmtree(folder, ignore_errors=True)
        step = self.schedule.step_of(epoch)
        if step not in self.checkpoints:
            raise FileNotFoundError(
                f"{self.folder} has no checkpoint of epoch {epoch} (update {step}); it has those of updates "
                f"{list(self.checkpoints)}. Choose among them, or delete that folder to train again."
            )
        runner.run(
            [
                "lerobot-eval",
                f"--policy.path={self.checkpoints[step] / 'pretrained_model'}",
                "--env.type=door",
                f"--env.task={','.join(self.protocol.kinds)}",
                f"--env.door_offset={self.protocol.door_offset}",
                f"--env.hold_seconds={self.protocol.hold_seconds}",
                f"--env.trial_log={self.trial_log(epoch)}",
                f"--eval.n_episodes={self.protocol.trials_per_kind}",
                f"--eval.batch_size={min(EVALUATION_BATCH_SIZE, self.protocol.trials_per_kind)}",
                "--eval.use_async_envs=false",
                f"--output_dir={folder}",
                f"--seed={self.protocol.trial_seed}",
                *(f"--policy.{name}={json.dumps(value)}" for name, value in self.protocol.policy_flags.items()),
            ],
            folder.with_name(f"{folder.name}.log"),
            lock,
        )
        self._trials(epoch)

    def _trials(self, epoch: int) -> list[Trial]:
        number, first = self.protocol.trials_per_kind, self.protocol.trial_seed
        trials = first_of_each_kind(read_trials(self.trial_log(epoch)), number)
        wanted = [(kind, seed) for kind in self.protocol.kinds for seed in range(first, first + number)]
        missing = set(wanted) - {(trial.door_kind, trial.seed) for trial in trials}
        if missing:
            raise RuntimeError(
                f"{self.trial_log(epoch)} lacks {len(missing)} of {len(wanted)} trials, such as {min(missing)}. "
                f"Delete {self._evaluation_folder(epoch).with_suffix('.json')} to evaluate again."
            )
        return trials


def plan(protocol: ProtocolConfig, models: list[Model]) -> list[Chain]:
    """All chains, every model with the first seed before any with the second.

    Args:
        protocol (`ProtocolConfig`):
            What is compared; the demonstrations exist.
        models (`list[Model]`):
            The models.

    Returns:
        `list[Chain]`: the chains.

    Raises:
        ValueError: If a model has no checkpoint where one is asked for.
    """
    episodes, frames = count_demonstrations(protocol.demonstrations)
    schedules = []
    for model in models:
        try:
            schedule = Schedule.of(model.settings, episodes, frames)
            _ = Chain(protocol, model, schedule, protocol.train_seeds[0]).save_freq
        except ValueError as error:
            raise ValueError(f"Model {model.name}: {error}") from error
        schedules.append(schedule)
    return [
        Chain(protocol, model, schedule, seed)
        for seed in protocol.train_seeds
        for model, schedule in zip(models, schedules, strict=True)
    ]


def run_chain(chain: Chain, runner: Runner) -> list[str]:
    """Trains, then evaluates one checkpoint after the other.

    Args:
        chain (`Chain`):
            What to do.
        runner (`Runner`):
            Runs the commands.

    Returns:
        `list[str]`: what failed. Without training there is no evaluation; evaluations do not depend on each other.

    Raises:
        Stopped: If the runner is stopped.
    """
    with runner.hold(chain.folder / "lock") as lock:
        failures = _attempt(chain.training, partial(chain.train, runner, lock))
        if not failures:
            for epoch in chain.epochs:
                failures += _attempt(chain.evaluation(epoch), partial(chain.evaluate, epoch, runner, lock))
    return failures


def add_to_table[Row: EvaluationRow](table: Path, rows: list[Row]) -> None:
    """Adds rows to the table of results, in place of those with the same key, in one step.

    Args:
        table (`Path`):
            CSV file; made if it is missing.
        rows (`list[Row]`):
            What was counted.

    Raises:
        ValueError: If the file is another kind of table.
    """
    table.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(table.with_name(f".{table.name}.lock")):
        before = read_table(table, type(rows[0])) if table.exists() else []
        merged = {row.key: row for row in [*before, *rows]}
        replace_text(table, to_csv(list(merged.values())))


def _attempt(name: str, work: Callable[[], None]) -> list[str]:
    try:
        work()
    except (RuntimeError, ValueError, OSError) as error:
        print(f"[{name}] failed: {error}", flush=True)
        return [name]
    return []
