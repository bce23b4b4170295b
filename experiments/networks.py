"""A network: trained by `lerobot-train`, its checkpoints tried by `lerobot-eval`. What sweep.py and suite.py share.

Everything is left in files, and what is there is not done again: a training goes on from its last checkpoint, an
evaluation without all its trials is repeated. Tables are written in one step and folders are locked, so that a kill
leaves nothing half-written and several processes may share all folders.
"""

import json
import shutil
import signal
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from epochs import Model
from jobs import locked, replace_text, run_command, stop

from env_door.trials import Trial, first_of_each_kind, read_trials

# Nothing here imports LeRobot or PyTorch: their memory would lie idle while the commands need it.
PROVENANCE_PATH = Path("meta/door_recording.json")  # where the recorder keeps its settings; it imports LeRobot
EVALUATION_BATCH_SIZE = 10
REPO_ID = "ufrnn/door"
FREE_SETTINGS = ("save_freq", "log_freq", "output_dir", "job_name", "seed")  # may change: the same is learned


@dataclass(frozen=True)
class Trials:
    """Trials of one checkpoint, and what becomes of them."""

    name: str  # of their folder in that of the network
    step: int  # update whose checkpoint is tried
    environment: dict[str, Any]  # its flags, such as `{type: door}`
    kinds: Sequence[str]  # all its suites
    count: int  # for each kind
    first_seed: int
    policy_flags: dict[str, Any]
    keep: Callable[[list[Trial]], None]


@dataclass(frozen=True)
class Network:
    """A model with a training seed: trained once, then tried at some checkpoints."""

    name: str
    folder: Path  # of everything that it leaves, but for its rows of a table
    model: Model
    seed: int
    demonstrations: Path
    save_freq: int  # updates between checkpoints
    trials: Sequence[Trials]
    prepare: Callable[[], None] = lambda: None  # what comes before training

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

    def run(self) -> list[str]:
        """Trains, then tries one checkpoint after the other; returns what failed."""
        failures = []
        with locked(self.folder / "lock") as lock:
            work = {f"{self.name}: training": partial(self.train, lock)}
            work |= {f"{self.name}: {trials.name}": partial(self.evaluate, trials, lock) for trials in self.trials}
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
        self.prepare()
        settings = {name: value for name, value in self.model.settings.items() if name not in FREE_SETTINGS}
        settings["dataset_dir"] = str(self.demonstrations)
        settings["dataset_size"] = count_demonstrations(self.demonstrations)
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
        flags |= {"dataset.repo_id": REPO_ID, "dataset.root": self.demonstrations}
        flags |= {"output_dir": folder, "save_freq": self.save_freq}
        run_command("lerobot-train", flags=flags, log=self.folder / "train.log", lock=lock)

    def log_of(self, trials: Trials) -> Path:
        """Log of some trials."""
        return self.folder / trials.name / "trials.jsonl"

    def missing(self, trials: Trials) -> set[tuple[str, int]]:
        """Kinds and seeds of the trials that a log lacks: all if a kill left it in pieces."""
        seeds = range(trials.first_seed, trials.first_seed + trials.count)
        try:
            done = {(trial.door_kind, trial.seed) for trial in read_trials(self.log_of(trials))}
        except (FileNotFoundError, ValueError):
            done = set()
        return {(kind, seed) for kind in trials.kinds for seed in seeds} - done

    def evaluate(self, trials: Trials, lock: int) -> None:
        """Tries a checkpoint, unless all trials are there, and hands them on."""
        log = self.log_of(trials)
        claim(log.parent.with_suffix(".json"), trials.policy_flags)
        if self.missing(trials):
            shutil.rmtree(log.parent, ignore_errors=True)
            if trials.step not in self.checkpoints:
                raise FileNotFoundError(
                    f"{self.folder} has no checkpoint of update {trials.step}; it has those of updates "
                    f"{list(self.checkpoints)}. Choose among them, or delete that folder to train again."
                )
            flags = {
                "policy.path": self.checkpoints[trials.step] / "pretrained_model",
                **{f"env.{name}": value for name, value in trials.environment.items()},
                "env.trial_log": log,
                "eval.n_episodes": trials.count,
                "eval.batch_size": min(EVALUATION_BATCH_SIZE, trials.count),
                "eval.use_async_envs": "false",
                "output_dir": log.parent,
                "seed": trials.first_seed,
                **{f"policy.{name}": json.dumps(value) for name, value in trials.policy_flags.items()},
            }
            run_command("lerobot-eval", flags=flags, log=log.parent.with_suffix(".log"), lock=lock)
            if missing := self.missing(trials):
                raise RuntimeError(f"{log} lacks {len(missing)} trials, such as {min(missing)}.")
        trials.keep(first_of_each_kind(read_trials(log), trials.count))


def record_missing(root: Path, folder: Path, flags: dict[str, Any], wanted: int) -> None:
    """Records demonstrations in `root`, or the rest of them; neither we nor the recorder mix them with others."""
    noted = folder / "record.json"
    with locked(folder / "record.lock") as lock:
        if root.exists() and not (root / PROVENANCE_PATH).exists():  # somebody's own
            return
        if noted.exists() and root.exists() and count_demonstrations(root)[0] == wanted:
            claim(noted, flags)
            return
        noted.unlink(missing_ok=True)
        all_flags = {**flags, "repo_id": REPO_ID, "root": root, "resume": str(root.exists()).lower()}
        run_command("ufrnn", "record", flags=all_flags, log=folder / "record.log", lock=lock)
        if (episodes := count_demonstrations(root)[0]) != wanted:
            raise ValueError(
                f"There are {episodes} demonstrations in {root}, not the {wanted} of --episodes_per_kind="
                f"{flags['episodes_per_kind']}. Ask for as many, or give another --output_dir or --dataset_dir."
            )
        claim(noted, flags)


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


def add_to_table(path: Path, rows: pd.DataFrame, key: list[str], read: Callable[[Path], pd.DataFrame]) -> None:
    """Adds rows to a table, in place of those with the same key, in one step."""
    with locked(path.with_name(f".{path.name}.lock")):
        before = [read(path)] if path.exists() else []
        table = pd.concat([*before, rows]).drop_duplicates(key, keep="last").sort_values(key)
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


def run_all(plan: Callable[[], Iterable[Network]], workers: int) -> list[str]:
    """Trains and tries networks side by side; returns what failed. An interruption ends all commands."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `kill` ends the commands as Ctrl-C does
    pool = ThreadPoolExecutor(workers)
    try:
        futures = [pool.submit(network.run) for network in plan()]
        return [name for future in futures for name in future.result()]
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        stop()
        raise
