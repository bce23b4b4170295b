"""Trained policies to look into: loading and naming them, running a trial with one, what their demonstrations show."""

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from lerobot.configs import PreTrainedConfig

import env_door  # noqa: F401  registers the environment
from env_door.checks import check_range
from env_door.provenance import PROVENANCE_PATH, Provenance

from ..analysis.trial import TrialHistory, run_trial
from ..modeling_ufrnn import UFRNNPolicy

MODEL_NAMES = {"foresight": "UF-RNN", "noise": "SH-RNN+noise", "none": "SH-RNN"}
"""What the paper calls a policy with this exploration."""


@dataclass(kw_only=True)
class DoorTrialConfig:
    """Which trial to run; the commands that run one add their own flags."""

    kind: str = "any"
    """Kind of the door: `push`, `pull`, `slide` or `random`, or another of the eight; `any` takes the first of three
    that shows something."""
    arm: str = "ur5e"
    """`ur5e` or `panda`."""
    door_offset: float = 0.0
    """Half-width in metres of the range of the door's shift."""
    seed: int = 2000
    """Seed of environment and exploration noise."""
    num_steps: int = 300
    """Longest trial in steps."""

    def __post_init__(self) -> None:
        check_range(self, "num_steps", low=1)


def run_door_trial(
    policy: UFRNNPolicy, config: DoorTrialConfig, kind: str, film: bool = False, **options: Any
) -> TrialHistory:
    """Runs one trial with a door of this kind; further options are those of [`~env_door.env.DoorEnv`]."""
    options |= {"kind": kind, "arm": config.arm, "door_offset": config.door_offset}
    with closing(gym.make("env_door/Door-v0", max_episode_steps=config.num_steps, **options)) as env:
        return run_trial(policy, env, config.seed, film)


def load_policy(path: str) -> UFRNNPolicy:
    """Loads a `ufrnn` policy with the reference kernel, which keeps what it imagines and needs no compiling."""
    config = PreTrainedConfig.from_pretrained(path)
    if config.type != "ufrnn":
        raise ValueError(f"'{path}' is a policy of type {config.type}; only ufrnn can be looked into.")
    config.kernel = "reference"
    return UFRNNPolicy.from_pretrained(path, config=config)


def load_policies(paths: Sequence[str], labels: Sequence[str]) -> dict[str, UFRNNPolicy]:
    """Loads policies to compare, by name: its label or, without labels, what the paper calls one that explores like it.

    Raises:
        ValueError: If there is no policy, one is of another type, or they cannot be told apart by their names.
    """
    if not paths:
        raise ValueError("--policy_paths must name one or more checkpoints, such as [outputs/a,outputs/b]; got [].")
    if labels and len(labels) != len(paths):
        raise ValueError(f"--labels must be one for each of the {len(paths)} policies, got {list(labels)}.")
    policies = [load_policy(path) for path in paths]
    names = list(labels) or [MODEL_NAMES[policy.config.exploration] for policy in policies]
    if len(set(names)) != len(names):
        raise ValueError(f"The policies would be called {names}; tell them apart with --labels=[...].")
    return dict(zip(names, policies, strict=True))


def read_provenance(dataset_dir: Path) -> Provenance | None:
    """How a dataset was recorded, or `None` if `ufrnn record` did not record it."""
    path = dataset_dir / PROVENANCE_PATH
    return Provenance(**json.loads(path.read_text())) if path.exists() else None
