"""What to compare: the options of `ufrnn protocol`."""

import string
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from env_door.env import MAX_HOLD, MAX_OFFSET
from env_door.latch import KINDS, check_kinds

from ..analysis.evaluation_table import EvaluationRow, InterferenceRow, ProtocolRow

EXECUTORS = ("local", "slurm")
NAME_CHARACTERS = set(string.ascii_letters + string.digits + "_-")
DEMONSTRATED = ("kinds", "episodes_per_kind", "matched", "num_steps", "door_offset")
"""Options that choose the demonstrations to record."""


@dataclass
class ProtocolConfig:
    """Which models to train and how to try them.

    Run again, it goes on where it was stopped: what is done is skipped, a training goes on from its last checkpoint,
    and an evaluation that was cut short is repeated.

    Args:
        models (`list[Path]`):
            Configuration files for `lerobot-train --config_path`, of any type of policy; each must state `policy.type`,
            `batch_size` and `steps`. The name of a file without its ending is the name of the model.
        train_seeds (`list[int]`, *optional*, defaults to `[0, 1, 2]`):
            Seeds of training; each model is trained with each of them.
        epochs (`list[int]`, *optional*, defaults to `[]`):
            Checkpoints to evaluate, in passes over the demonstrations; the last one when empty.
        trials_per_kind (`int`, *optional*, defaults to `100`):
            Trials for each kind of door at each checkpoint.
        trial_seed (`int`, *optional*, defaults to `10000`):
            Seed of the first trial; the others count up from it, the same for every model.
        hold_seconds (`float`, *optional*, defaults to `0.0`):
            Interference: time in seconds, 0 to 60, for which somebody holds the door of a trial still once it has begun
            to open.
        variant (`str`, *optional*):
            Name of what `policy_flags` change, in the table `<model>+<variant>`.
        policy_flags (`dict[str, Any]`, *optional*):
            Fields of the policy's configuration to change in the trials only, such as `{recall: false}`: an ablation of
            what needs no other training. Needs a `variant`.
        kinds (`tuple[str, ...]`, *optional*, defaults to `("push", "pull", "slide")`):
            Kinds of door, in demonstrations and trials.
        episodes_per_kind (`int`, *optional*, defaults to `5`):
            Demonstrations for each kind of door.
        matched (`bool`, *optional*, defaults to `True`):
            Whether the kinds share start poses, door positions and timing, as one would have them. Unmatched, as a
            human's are, each demonstration has its own, and they may tell one kind from another.
        num_steps (`int`, *optional*, defaults to `150`):
            Steps of a demonstration; the demonstrator needs up to 102, or 99 without sliding doors.
        door_offset (`float`, *optional*, defaults to `0.0`):
            Half-width in metres of the range of the door's lateral shift, in demonstrations and trials; 0 to 0.05.
        output_dir (`Path`, *optional*, defaults to `outputs/protocol`):
            Folder of checkpoints, trial logs and the output of every command.
        dataset_dir (`Path`, *optional*):
            Folder of the demonstrations; defaults to `dataset` in `output_dir`. Recorded if missing; a recording with
            other settings is refused. A data set that `ufrnn record` did not make is taken as it is.
        results (`Path`, *optional*):
            Table to add to: one row a model, training seed, epoch and kind of door. Defaults to
            `results/door_protocol.csv`, with `hold_seconds` to `results/door_interference.csv`. It does not say which
            trials were run: give those with another seed or hold a table of their own. With other demonstrations or
            doors than by default it must be given, such as `results/door_offset.csv`.
        workers (`int`, *optional*, defaults to `2`):
            Chains of training and evaluation that run side by side, with one thread each.
        executor (`str`, *optional*, defaults to `"local"`):
            `local` runs the chains on this machine, `slurm` submits them (needs `lerobot_policy_ufrnn[cluster]`, and
            folders that all machines see).
        cluster_options (`dict[str, Any]`, *optional*):
            Options for submitit's executor, such as `{slurm_partition: cpu, timeout_min: 600}`.

    Raises:
        ValueError: If a field is out of its range.
    """

    models: list[Path]
    train_seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    epochs: list[int] = field(default_factory=list)
    trials_per_kind: int = 100
    trial_seed: int = 10000
    hold_seconds: float = 0.0
    variant: str = ""
    policy_flags: dict[str, Any] = field(default_factory=dict)
    kinds: tuple[str, ...] = KINDS
    episodes_per_kind: int = 5
    matched: bool = True
    num_steps: int = 150
    door_offset: float = 0.0
    output_dir: Path = Path("outputs/protocol")
    dataset_dir: Path | None = None
    results: Path | None = None
    workers: int = 2
    executor: str = "local"
    cluster_options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [path.stem for path in self.models]
        if not names or len(set(names)) != len(names):
            raise ValueError(
                f"--models must be one or more files with different names, got {list(map(str, self.models))}."
            )
        for name, least in (("train_seeds", 0), ("epochs", 1)):
            values = getattr(self, name)
            if any(value < least for value in values) or len(set(values)) != len(values):
                raise ValueError(f"--{name} must be different numbers, {least} or more, got {values}.")
        if not self.train_seeds:
            raise ValueError("--train_seeds must be one or more numbers, such as [0,1,2], got [].")
        for name, least in (
            ("trials_per_kind", 1),
            ("trial_seed", 0),
            ("episodes_per_kind", 1),
            ("num_steps", 1),
            ("workers", 1),
        ):
            if getattr(self, name) < least:
                raise ValueError(f"--{name} must be at least {least}, got {getattr(self, name)}.")
        check_kinds(self.kinds, "--kinds")
        if bool(self.variant) != bool(self.policy_flags) or not set(self.variant) <= NAME_CHARACTERS:
            raise ValueError(
                "--variant must name --policy_flags in letters, digits, '_' and '-', and neither goes without the "
                f"other; got {self.variant!r} and {self.policy_flags}."
            )
        if not 0 <= self.hold_seconds <= MAX_HOLD:
            raise ValueError(f"--hold_seconds must be 0 to {MAX_HOLD} s, got {self.hold_seconds}.")
        if not 0 <= self.door_offset <= MAX_OFFSET:
            raise ValueError(f"--door_offset must be 0 to {MAX_OFFSET} m, got {self.door_offset}.")
        if self.executor not in EXECUTORS:
            raise ValueError(f"--executor must be one of {list(EXECUTORS)}, got {self.executor!r}.")
        other = [f"--{name}" for name in DEMONSTRATED if getattr(self, name) != getattr(ProtocolConfig, name)]
        if other and self.results is None:
            raise ValueError(
                f"A table does not say what was demonstrated and tried: with {' and '.join(other)} give it a table of "
                "its own, such as --results=results/door_offset.csv."
            )

    @property
    def demonstrations(self) -> Path:
        """Folder of the demonstrations."""
        return self.dataset_dir or self.output_dir / "dataset"

    @property
    def table(self) -> Path:
        """Table of results."""
        name = "door_interference" if self.hold_seconds > 0 else "door_protocol"
        return self.results or Path("results") / f"{name}.csv"

    @property
    def row_type(self) -> type[EvaluationRow]:
        """What a row of that table counts."""
        return InterferenceRow if self.hold_seconds > 0 else ProtocolRow

    @property
    def trials(self) -> str:
        """Name of the trials; those of another number, seed, hold or door have another name."""
        name = f"{self.trials_per_kind}_trials_from_{self.trial_seed}_offset_{self.door_offset:g}"
        if self.kinds != KINDS:
            name += f"_{'_'.join(self.kinds)}"
        if self.hold_seconds > 0:
            name += f"_held_{self.hold_seconds:g}"
        if self.variant:
            name += f"_{self.variant}"
        return name
