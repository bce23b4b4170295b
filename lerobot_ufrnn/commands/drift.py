"""`ufrnn drift`: how far what policies imagine drifts from the demonstrations; needs no simulation."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from lerobot.utils.random_utils import set_seed

from ..analysis.drift import imagined_drift
from ..analysis.hidden_states import read_demonstrations
from .flags import parse_flags
from .policies import load_policies


@dataclass
class DriftConfig:
    """Which policies to compare.

    Args:
        policy_paths (`list[str]`):
            Checkpoint folders or Hub repositories of `ufrnn` policies.
        dataset_dir (`Path`):
            Folder of the demonstrations.
        labels (`list[str]`, *optional*):
            Names of the policies; those of the paper by default.
        horizon (`int`, *optional*, defaults to `30`):
            Number T of imagined steps.
        seed (`int`, *optional*, defaults to `2000`):
            Seed of the exploration while it reads the demonstrations.
    """

    policy_paths: list[str]
    dataset_dir: Path
    labels: list[str] = field(default_factory=list)
    horizon: int = 30
    seed: int = 2000

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise ValueError(f"--horizon must be at least 1, got {self.horizon}.")


def run(arguments: list[str]) -> None:
    """Prints a table: a row for each policy."""
    config = parse_flags(DriftConfig, arguments)
    print(
        f"Distance of {config.horizon} imagined steps from the nearest demonstrated pose, in scaled units (0.8 is half"
    )
    print("the range of a joint): mean, and 95th percentile over where imagining starts.\n")
    print("| model | mean | 95th percentile |\n|---|---|---|")
    for label, policy in load_policies(config.policy_paths, config.labels).items():
        set_seed(config.seed)
        drift = torch.cat(imagined_drift(policy, read_demonstrations(policy, config.dataset_dir), config.horizon))
        print(f"| {label} | {drift.mean():.3f} | {drift.quantile(0.95):.3f} |")
