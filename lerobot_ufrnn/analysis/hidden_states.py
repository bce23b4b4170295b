"""Hidden states along demonstrations, and their plane of largest variance."""

from pathlib import Path
from typing import NamedTuple

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor, nn

from ..episodes import Episode, EpisodeStore
from ..modeling_ufrnn import UFRNNPolicy
from ..networks import HiddenState


def read_demonstrations(policy: UFRNNPolicy, dataset_dir: Path) -> list[Episode]:
    """All episodes of a LeRobotDataset, with features of the policy's autoencoder in place of images.

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
    """Hidden states of the policy that reads demonstrations (teacher forcing), exploring as in training.

    For each demonstration the state after each of its L steps, (L, hidden size) each.
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
    return [over_time.at((slice(len(episode)), row)) for row, episode in enumerate(demonstrations)]


class Plane(NamedTuple):
    """Plane through points along their two directions of largest variance (principal component analysis)."""

    origin: Tensor  # mean of the points, (S,)
    axes: Tensor  # orthonormal directions, largest variance first, each with its largest entry positive, (2, S)
    shares: Tensor  # share of all variance along each, (2,)

    @classmethod
    def fit(cls, points: Tensor) -> "Plane":
        """The plane of two or more points, (M, S)."""
        origin = points.mean(0)
        _, lengths, directions = torch.linalg.svd(points - origin, full_matrices=False)
        axes, variances = directions[:2], lengths.square()
        largest = axes.gather(1, axes.abs().argmax(1, keepdim=True))
        return cls(origin, axes * largest.sign(), variances[:2] / variances.sum())

    def project(self, points: Tensor) -> Tensor:
        """Coordinates of points in the plane: (..., S) -> (..., 2)."""
        return (points - self.origin) @ self.axes.T
