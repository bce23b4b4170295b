"""Which model opens how many doors? Models x training seeds x checkpoints through LeRobot's own commands.

    python experiments/sweep.py --models=[configs/ufrnn.yaml,configs/sh_rnn_noise.yaml]

Demonstrations are recorded once; each network (a model with a training seed) is trained by `lerobot-train`, its
checkpoints are tried by `lerobot-eval`, and the counts are added to a table. Run it again to go on: a training goes on
from its last checkpoint, an evaluation without all its trials is repeated, what is done is skipped.

Networks depend on nothing but the demonstrations, so that a cluster needs no code here. Jobs may share all folders:

    sbatch --array=0-2 --wrap='python experiments/sweep.py --models=[...] --train_seeds=[$SLURM_ARRAY_TASK_ID]'
"""

import json
import os
import shutil
import signal
import string
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from draccus.utils import ParsingError
from epochs import Model, find_checkpoints, read_model
from jobs import locked, replace_text, run_command, stop
from script import run
from tables import HELD_COUNTS, KEY, RESULTS, SUCCESS_COUNTS, describe, read_table

from env_door.checks import check_range
from env_door.latch import KINDS, check_kinds
from env_door.limits import MAX_HOLD, MAX_OFFSET
from env_door.trials import first_of_each_kind, read_trials
from lerobot_ufrnn.analysis.results import count_by_door

# Nothing here imports LeRobot or PyTorch: their memory would lie idle while the commands need it.
PROVENANCE_PATH = Path("meta/door_recording.json")  # where the recorder keeps its settings; it imports LeRobot
EVALUATION_BATCH_SIZE = 10
REPO_ID = "ufrnn/door"
NAME_CHARACTERS = set(string.ascii_letters + string.digits + "_-")
DEMONSTRATED = ("kinds", "episodes_per_kind", "matched", "num_steps", "door_offset")  # what is recorded
FREE_SETTINGS = ("save_freq", "log_freq", "output_dir", "job_name", "seed")  # may change: the same is learned


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


# ── The demonstrations ────────────────────────────────────────────────


def record_missing(config: SweepConfig) -> None:
    """Records the demonstrations, or the rest of them; the recorder refuses to mix them with others."""
    root = config.demonstrations
    with locked(config.output_dir / "record.lock") as lock:
        if root.exists() and not (root / PROVENANCE_PATH).exists():  # somebody's own
            return
        flags = {name: getattr(config, name) for name in DEMONSTRATED}
        flags |= {"kinds": f"[{','.join(config.kinds)}]", "matched": str(config.matched).lower()}
        flags |= {"repo_id": REPO_ID, "root": root, "resume": str(root.exists()).lower()}
        run_command("ufrnn", "record", flags=flags, log=config.output_dir / "record.log", lock=lock)
        episodes, wanted = count_demonstrations(root)[0], config.episodes_per_kind * len(config.kinds)
        if episodes != wanted:
            raise ValueError(
                f"There are {episodes} demonstrations in {root}, not the {wanted} of --episodes_per_kind="
                f"{config.episodes_per_kind}. Ask for as many, or give another --output_dir or --dataset_dir."
            )


def count_demonstrations(root: Path) -> tuple[int, int]:
    """Episodes and frames of a LeRobotDataset."""
    path = root / "meta" / "info.json"
    if not path.exists():
        raise FileNotFoundError(
            f"'{root}' is not a LeRobotDataset: {path} is missing. Give --dataset_dir a folder that `ufrnn record` or "
            "LeRobot made, or one that does not exist yet."
        )
    info = json.loads(path.read_text())
    return info["total_episodes"], info["total_frames"]


# ── A network ─────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Network:
    """A model with a training seed: trained once, then tried at some epochs."""

    config: SweepConfig
    model: Model
    seed: int
    step_of: dict[int, int]  # epochs to try, and the updates that end them
    save_freq: int  # updates between checkpoints

    @property
    def name(self) -> str:
        """Model and seed."""
        return f"{self.model.name}, seed {self.seed}"

    @property
    def folder(self) -> Path:
        """Everything that it leaves, but for its rows of the table."""
        return self.config.output_dir / self.model.name / f"seed{self.seed}"

    @property
    def checkpoints(self) -> dict[int, Path]:
        """Update to the folder of its checkpoint, in rising order."""
        folders = (self.folder / "train" / "checkpoints").glob("[0-9]*")
        return {int(folder.name): folder for folder in sorted(folders, key=lambda folder: int(folder.name))}

    @property
    def last_checkpoint(self) -> int:
        """The last update whose checkpoint is whole, to which LeRobot points the link `last`; 0 if there is none."""
        link = self.folder / "train" / "checkpoints" / "last"
        return int(link.readlink().name) if link.is_symlink() else 0

    def trial_log(self, epoch: int) -> Path:
        """Trials of an epoch's checkpoint."""
        return self.folder / self.config.trials / f"epoch{epoch:06d}" / "trials.jsonl"

    def run(self) -> list[str]:
        """Trains, then tries one checkpoint after the other; returns what failed."""
        failures = []
        with locked(self.folder / "lock") as lock:
            work = {f"{self.name}: training": partial(self.train, lock)}
            for epoch in self.step_of:
                work[f"{self.name}: trials {self.config.trials} of epoch {epoch}"] = partial(self.evaluate, epoch, lock)
            for name, do in work.items():
                try:
                    do()
                    print(f"[{name}] is done", flush=True)
                except (RuntimeError, ValueError, OSError) as error:
                    print(f"[{name}] failed: {error}", flush=True)
                    failures.append(name)
                    if name.endswith("training"):
                        break
        return failures

    def train(self, lock: int) -> None:
        """Trains, from the last checkpoint on if there is one, unless it is done."""
        settings = {name: value for name, value in self.model.settings.items() if name not in FREE_SETTINGS}
        settings["dataset_dir"] = str(self.config.demonstrations)
        settings["dataset_size"] = count_demonstrations(self.config.demonstrations)
        claim(self.folder / "train.json", settings)
        folder, step = self.folder / "train", self.last_checkpoint
        if step == self.model.settings["steps"]:
            return
        if step > 0:
            flags = {"config_path": self.checkpoints[step] / "pretrained_model" / "train_config.json", "resume": "true"}
        else:  # a run that was stopped before its first checkpoint left nothing to go on from
            shutil.rmtree(folder, ignore_errors=True)
            replace_text(self.folder / "model.yaml", self.model.text)
            flags = {"config_path": self.folder / "model.yaml", "seed": self.seed, "policy.push_to_hub": "false"}
        flags |= {"dataset.repo_id": REPO_ID, "dataset.root": self.config.demonstrations}
        flags |= {"output_dir": folder, "save_freq": self.save_freq}
        run_command("lerobot-train", flags=flags, log=self.folder / "train.log", lock=lock)

    def evaluate(self, epoch: int, lock: int) -> None:
        """Tries an epoch's checkpoint, unless all trials are there, and adds its rows to the table."""
        config, log = self.config, self.trial_log(epoch)
        claim(log.parent.with_suffix(".json"), config.policy_flags)
        if self.missing_trials(epoch):
            shutil.rmtree(log.parent, ignore_errors=True)
            if (step := self.step_of[epoch]) not in self.checkpoints:
                raise FileNotFoundError(
                    f"{self.folder} has no checkpoint of epoch {epoch} (update {step}); it has those of updates "
                    f"{list(self.checkpoints)}. Choose among them, or delete that folder to train again."
                )
            flags = {
                "policy.path": self.checkpoints[step] / "pretrained_model",
                "env.type": "door",
                "env.task": ",".join(config.kinds),
                "env.door_offset": config.door_offset,
                "env.hold_seconds": config.hold_seconds,
                "env.trial_log": log,
                "eval.n_episodes": config.trials_per_kind,
                "eval.batch_size": min(EVALUATION_BATCH_SIZE, config.trials_per_kind),
                "eval.use_async_envs": "false",
                "output_dir": log.parent,
                "seed": config.trial_seed,
                **{f"policy.{name}": json.dumps(value) for name, value in config.policy_flags.items()},
            }
            run_command("lerobot-eval", flags=flags, log=log.parent.with_suffix(".log"), lock=lock)
            if missing := self.missing_trials(epoch):
                raise RuntimeError(f"{log} lacks {len(missing)} trials, such as {min(missing)}.")
        rows = count_by_door(first_of_each_kind(read_trials(log), config.trials_per_kind)).drop("all").reset_index()
        label = f"{self.model.name}+{config.variant}" if config.variant else self.model.name
        rows = rows.assign(model=label, train_seed=self.seed, epoch=epoch)
        add_to_table(config.table, rows[[*KEY, *config.counts]])

    def missing_trials(self, epoch: int) -> set[tuple[str, int]]:
        """Kinds and seeds of the trials that an epoch's log lacks: all if a kill left it in pieces."""
        first, log = self.config.trial_seed, self.trial_log(epoch)
        seeds = range(first, first + self.config.trials_per_kind)
        try:
            done = {(trial.door_kind, trial.seed) for trial in read_trials(log)}
        except (FileNotFoundError, ValueError):
            done = set()
        return {(kind, seed) for kind in self.config.kinds for seed in seeds} - done


def plan(config: SweepConfig, models: list[Model]) -> list[Network]:
    """All networks, every model with the first seed before any with the second; the demonstrations exist."""
    size, checkpoints = count_demonstrations(config.demonstrations), {}
    for model in models:
        try:
            checkpoints[model.name] = find_checkpoints(model.settings, *size, config.epochs)
        except ValueError as error:
            raise ValueError(f"Model {model.name}: {error}") from error
    return [Network(config, model, seed, *checkpoints[model.name]) for seed in config.train_seeds for model in models]


# ── Files ─────────────────────────────────────────────────────────────


def add_to_table(path: Path, rows: pd.DataFrame) -> None:
    """Adds rows to a table, in place of those with the same key, in one step."""
    with locked(path.with_name(f".{path.name}.lock")):
        before = [read_table(path, list(rows)[4:])] if path.exists() else []
        table = pd.concat([*before, rows]).drop_duplicates(KEY, keep="last").sort_values(KEY)
        replace_text(path, table.to_csv(index=False))


def claim(file: Path, request: dict[str, Any]) -> None:
    """Notes what a folder is made with; refuses to mix that with something else."""
    request = json.loads(json.dumps(request, default=str))
    before = json.loads(file.read_text()) if file.exists() else request
    if before != request:
        old, new = (pd.json_normalize(settings).to_dict("records")[0] for settings in (before, request))
        names = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
        changes = "; ".join(f"{name} was {old.get(name)}, now {new.get(name)}" for name in names)
        raise ValueError(
            f"{file.parent} was made with other settings: {changes}. Go back to them, give another --output_dir, or "
            "delete that folder to make it anew."
        )
    replace_text(file, json.dumps(request, indent=2))


# ── The command ───────────────────────────────────────────────────────


def main(config: SweepConfig) -> None:
    """Does what is not done yet, and prints the table; a RuntimeError if something failed, with the rest done."""
    if config.table.exists():
        read_table(config.table, config.counts)  # refuses another kind of table before the work
    models = [read_model(path) for path in config.models]
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `kill` ends the commands as Ctrl-C does
    pool = ThreadPoolExecutor(config.workers)
    try:
        record_missing(config)
        futures = [pool.submit(network.run) for network in plan(config, models)]
        failures = [name for future in futures for name in future.result()]
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        stop()
        raise
    if config.table.exists():
        print(f"\n{describe(read_table(config.table))}\n\nAll rows are in {config.table}.")
    if failures:
        raise RuntimeError(f"{len(failures)} failed, see above: {'; '.join(failures)}.")


if __name__ == "__main__":
    run(main, SweepConfig)
