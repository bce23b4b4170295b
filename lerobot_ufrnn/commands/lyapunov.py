"""`ufrnn lyapunov`: draw how chaotic the imagined futures are along the demonstrations, model by model."""

from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lerobot.utils.random_utils import set_seed

from env_door.checks import check_range
from env_door.demonstration import TIMING_STREAM
from env_door.env import DoorEnv
from env_door.expert import DoorExpert
from env_door.provenance import Provenance

from ..analysis.hidden_states import read_demonstrations, states_along
from ..analysis.lyapunov import draw, exponents_over_time, to_table
from .policies import load_policies, read_provenance

PHASES = ("grasp", "twist", "open")
"""Phases of the expert that are marked; the doors part at the last one."""


@dataclass
class LyapunovConfig:
    """Draws how fast imagined futures part that begin with nearly the same hidden state, along demonstrations."""

    policy_paths: list[str]
    """Checkpoint folders or Hub repositories of `ufrnn` policies."""
    dataset_dir: Path
    """Folder of the demonstrations."""
    output: Path = Path("lyapunov.png")
    """Picture to write; the numbers go beside it, with the ending `.csv`."""
    labels: list[str] = field(default_factory=list)
    """Names of the policies; those of the paper by default."""
    horizon: int = 10
    """Number T of imagined steps over which perturbations grow, 1 to 100."""
    seed: int = 2000
    """Seed of exploration noise."""

    def __post_init__(self) -> None:
        check_range(self, "horizon", low=1, high=100)


def run(config: LyapunovConfig) -> None:
    """Writes the picture and the table."""
    curves = {}
    for label, policy in load_policies(config.policy_paths, config.labels).items():
        set_seed(config.seed)
        states = states_along(policy, read_demonstrations(policy, config.dataset_dir))
        curves[label] = exponents_over_time(policy.model.network, states, config.horizon)
    provenance = read_provenance(config.dataset_dir)
    draw(curves, phase_starts(provenance) if provenance else {}, config.horizon, config.output)
    table = config.output.with_suffix(".csv")
    to_table(curves).to_csv(table, index=False, float_format="%.5f")
    print(f"Lyapunov exponents: {config.output}, {table}")


def phase_starts(provenance: Provenance) -> dict[str, list[int]]:
    """When the phases of the task begin in recorded demonstrations, once a seed: the expert plans them once more."""
    starts: dict[str, list[int]] = {phase: [] for phase in PHASES}
    with closing(DoorEnv(arm=provenance.settings["arm"], door_offset=provenance.settings["door_offset"])) as env:
        for seed, kind in {episode["seed"]: episode["kind"] for episode in provenance.episodes}.items():
            env.reset(seed=seed, options={"kind": kind})
            expert = DoorExpert(env, directions=(kind,))
            expert.reset(np.random.default_rng([seed, TIMING_STREAM]))
            phases = []
            while expert.phase != "hold":
                phases.append(expert.phase)
                expert.act()
            for phase in PHASES:
                starts[phase].append(phases.index(phase))
    return starts
