"""How far do imagined futures drift from what was demonstrated? Whether one that is chosen can be carried out.

    python experiments/drift.py --policy_paths=[outputs/sweep/ufrnn/seed0/train/checkpoints/last/pretrained_model] \
        --dataset_dir=outputs/sweep/dataset

A network that predicts every single step well may still leave the demonstrated way once it feeds on its own
predictions. Its imagined futures then end in poses that no arm ever went through, and trying them opens no door.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from lerobot.utils.random_utils import set_seed
from script import run
from torch import Tensor

from env_door.checks import check_range
from lerobot_ufrnn.analysis.hidden_states import read_demonstrations, states_along
from lerobot_ufrnn.commands.policies import load_policies
from lerobot_ufrnn.episodes import Episode
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy


@dataclass
class DriftConfig:
    """Which policies to compare."""

    policy_paths: list[str]  # checkpoint folders or Hub repositories of `ufrnn` policies
    dataset_dir: Path  # folder of the demonstrations
    labels: list[str] = field(default_factory=list)  # names of the policies; those of the paper by default
    horizon: int = 30  # number T of imagined steps
    seed: int = 2000  # seed of the exploration while it reads the demonstrations

    def __post_init__(self) -> None:
        check_range(self, "horizon", low=1)


@torch.no_grad()
def imagined_drift(policy: UFRNNPolicy, demonstrations: Sequence[Episode], num_steps: int) -> list[Tensor]:
    """Mean distance of T imagined poses from the nearest demonstrated one, (L,) for the L steps of each demonstration.

    The policy reads the demonstrations, exploring as in training, and imagines from each of their steps without noise.
    Units are those of the scaled joints, which were demonstrated between -0.8 and 0.8.
    """
    poses = [policy.joint_scaler.scale(episode.states.to(policy.updates.device)) for episode in demonstrations]
    demonstrated, joint_dim = torch.cat(poses), policy.model.network.joint_dim
    drifts = []
    for states in states_along(policy, list(demonstrations)):
        imagined = policy.model.network.predict_mean(policy.model.imagine(states, num_steps))  # (T + 1, L, D)
        drifts.append(torch.cdist(imagined[..., :joint_dim], demonstrated).amin(-1).mean(0))
    return drifts


def main(config: DriftConfig) -> None:
    """Prints a table: a row for each policy."""
    print(
        f"Distance of {config.horizon} imagined steps from the nearest demonstrated pose in scaled units (0.8 is half\n"
        "the range of a joint): mean, and 95th percentile over where imagining starts.\n\n"
        "| model | mean | 95th percentile |\n|---|---|---|"
    )
    for label, policy in load_policies(config.policy_paths, config.labels).items():
        set_seed(config.seed)
        drift = torch.cat(imagined_drift(policy, read_demonstrations(policy, config.dataset_dir), config.horizon))
        print(f"| {label} | {drift.mean():.3f} | {drift.quantile(0.95):.3f} |")


if __name__ == "__main__":
    run(main, DriftConfig)
