"""Hidden states along demonstrations, and their plane of largest variance."""

from dataclasses import dataclass
from pathlib import Path

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor, nn

from ..episodes import Episode, EpisodeStore
from ..modeling_ufrnn import UFRNNPolicy
from ..networks import HiddenState


def read_demonstrations(policy: UFRNNPolicy, dataset_dir: Path) -> list[Episode]:
    """All episodes of a dataset, encoded by the policy's autoencoder.

    Args:
        policy (`UFRNNPolicy`):
            Trained policy.
        dataset_dir (`Path`):
            Folder of a LeRobotDataset.

    Returns:
        `list[Episode]`: the episodes, with features in place of images.

    Raises:
        FileNotFoundError: If there is no dataset in that folder.
        ValueError: If it lacks joints or a camera of the policy, or an episode is broken.
    """
    if not (dataset_dir / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"'{dataset_dir}' is not a LeRobotDataset: it has no meta/info.json.")
    meta = LeRobotDatasetMetadata(f"local/{dataset_dir.name}", root=dataset_dir)
    store = EpisodeStore(meta, policy.config.cameras, policy.image_encoder)
    store.encode()  # from now on, each as it comes
    return [store[index] for index in range(meta.total_episodes)]


@torch.no_grad()
def states_along(policy: UFRNNPolicy, demonstrations: list[Episode]) -> list[HiddenState]:
    """Hidden states of the policy that reads demonstrations instead of acting (teacher forcing), exploring as it does.

    Args:
        policy (`UFRNNPolicy`):
            Trained policy.
        demonstrations (`list[Episode]`):
            What it reads.

    Returns:
        `list[HiddenState]`: for each demonstration the state after each of its L steps, (L, hidden size) each.
    """
    scaler, device = policy.image_encoder.scaler, policy.updates.device
    inputs = nn.utils.rnn.pad_sequence(
        [
            torch.cat((policy.joint_scaler.scale(episode.states.to(device)), scaler.scale(episode.features)), dim=-1)
            for episode in demonstrations
        ],
        batch_first=True,
    )  # (B, L, D)
    memory = policy.model.initial_memory(len(demonstrations))
    states = []
    for step_inputs in inputs.unbind(dim=1):
        memory, _ = policy.model.advance(step_inputs, memory)
        states.append(memory.state)
    over_time = HiddenState.stack(states)  # (L, B, hidden size) each
    return [
        HiddenState(*(values[: len(episode), row] for values in over_time))
        for row, episode in enumerate(demonstrations)
    ]


@dataclass(frozen=True)
class Plane:
    """Plane through points along their two directions of largest variance (principal component analysis).

    Attributes:
        origin (`Tensor`): mean of the points, (S,).
        axes (`Tensor`): orthonormal directions, largest variance first, each with its largest entry positive, (2, S).
        shares (`Tensor`): share of all variance along each, (2,).
    """

    origin: Tensor
    axes: Tensor
    shares: Tensor

    @classmethod
    def fit(cls, points: Tensor) -> "Plane":
        """The plane of two or more points, (M, S)."""
        origin = points.mean(0)
        _, lengths, directions = torch.linalg.svd(points - origin, full_matrices=False)
        axes = directions[:2]
        largest = axes.gather(1, axes.abs().argmax(1, keepdim=True))
        variances = lengths.square()
        return cls(origin, axes * largest.sign(), variances[:2] / variances.sum())

    def project(self, points: Tensor) -> Tensor:
        """Coordinates of points in the plane: (..., S) -> (..., 2)."""
        return (points - self.origin) @ self.axes.T
