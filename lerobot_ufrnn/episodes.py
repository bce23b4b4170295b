"""Whole episodes of the training set: decoded once, encoded once, then kept as features."""

import logging
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from .networks import ImageEncoder

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)

ENCODING_BATCH_SIZE = 64


@dataclass(frozen=True)
class Episode:
    """One demonstration, in the dataset's units.

    Attributes:
        states (`Tensor`): measured joints, (L, D_j).
        actions (`Tensor`): commanded joints, (L, D_j).
        images (`dict[str, Tensor]`): camera key to frames, uint8 (L, 3, height, width); empty once encoded.
        features (`Tensor`): unscaled image features, (L, D_f); empty until encoded.
    """

    states: Tensor
    actions: Tensor
    images: dict[str, Tensor]
    features: Tensor = field(default_factory=lambda: torch.empty(0))

    def __len__(self) -> int:
        return len(self.states)


class EpisodeStore:
    """Gives whole episodes by their index and keeps them in memory.

    LeRobot's data loader names the episodes of a batch; their frames come from here. Each video is decoded once, when
    its episode is first named, and its frames give way to the features once the autoencoder is trained. Only episodes
    that were named are ever read, so a held-out split stays unseen.
    """

    def __init__(self, meta: "LeRobotDatasetMetadata", cameras: tuple[str, ...], encoder: ImageEncoder):
        if meta.total_episodes == 0:
            raise ValueError(f"Dataset '{meta.repo_id}' has no episodes; record some before training.")
        missing = [key for key in (OBS_STATE, ACTION, *cameras) if key not in meta.features]
        if missing:
            raise ValueError(
                f"Dataset '{meta.repo_id}' lacks {missing}; it has {sorted(meta.features)}. UF-RNN needs the joint "
                "state, the action and every camera that the policy was built with."
            )
        self._meta = meta
        self._cameras = cameras
        self._encoder = encoder
        self._dataset: LeRobotDataset | None = None
        self._episodes: dict[int, Episode] = {}
        self._encoded = False

    @property
    def lengths(self) -> list[int]:
        """`list[int]`: number of frames of every episode of the dataset."""
        return [int(length) for length in self._meta.episodes["length"]]

    @property
    def loaded(self) -> dict[int, Episode]:
        """`dict[int, Episode]`: the episodes named so far."""
        return self._episodes

    def __getitem__(self, index: int) -> Episode:
        """The episode with this `episode_index`: frames, or features after `encode`. A broken one is refused."""
        if index not in self._episodes:
            episode = self._load(index)
            self._episodes[index] = self._encode(episode) if self._encoded else episode
        return self._episodes[index]

    @torch.no_grad()
    def encode(self) -> None:
        """Replaces all frames by features; episodes named later are encoded as they come.

        From now on LeRobot's loader need not decode a frame for each item either, which would take half as long as the
        update itself: the videos are removed from the metadata that this store was given, and so from the items of
        the dataset that it belongs to.
        """
        self._encoded = True
        for key in self._meta.video_keys:
            del self._meta.features[key]
        for index, episode in self._episodes.items():
            if len(episode.features) == 0:
                self._episodes[index] = self._encode(episode)

    @torch.no_grad()
    def _encode(self, episode: Episode) -> Episode:
        device = next(self._encoder.parameters()).device
        parts = []
        for start in range(0, len(episode), ENCODING_BATCH_SIZE):
            stop = start + ENCODING_BATCH_SIZE
            images = {key: frames[start:stop].to(device) for key, frames in episode.images.items()}
            parts.append(self._encoder.encode(images))
        return replace(episode, images={}, features=torch.cat(parts))

    def _open(self) -> LeRobotDataset:
        if self._dataset is None:
            window = [step / self._meta.fps for step in range(max(self.lengths))]
            self._dataset = LeRobotDataset(
                self._meta.repo_id,
                root=self._meta.root,
                revision=self._meta.revision,
                delta_timestamps=dict.fromkeys((OBS_STATE, ACTION, *self._cameras), window),
                video_backend="pyav",
                return_uint8=True,
            )
        return self._dataset

    def _load(self, index: int) -> Episode:
        dataset = self._open()
        if not 0 <= index < len(self.lengths):
            raise ValueError(f"Episode {index} does not exist: the dataset has episodes 0 to {len(self.lengths) - 1}.")
        length = self.lengths[index]
        if length < 2:
            raise ValueError(
                f"Episode {index} of '{self._meta.repo_id}' has {length} frame(s); an episode needs at least 2 so that "
                "there is a next frame to predict. Leave it out with --dataset.episodes or delete it with "
                "lerobot-edit-dataset."
            )
        item = dataset[int(self._meta.episodes["dataset_from_index"][index])]
        episode = Episode(
            states=item[OBS_STATE][:length].float(),
            actions=item[ACTION][:length].float(),
            images={key: self._keep(item[key][:length], key, index) for key in self._cameras},
        )
        for name, values in (("observation.state", episode.states), ("action", episode.actions)):
            bad = (~torch.isfinite(values)).any(dim=-1).nonzero().flatten().tolist()
            if bad:
                raise ValueError(
                    f"Episode {index} of '{self._meta.repo_id}' has NaN or infinite values in '{name}' at frame(s) "
                    f"{bad[:10]}. Repair or delete the episode, or leave it out with --dataset.episodes."
                )
        return episode

    def _keep(self, frames: Tensor, camera: str, index: int) -> Tensor:
        if frames.ndim != 4 or frames.shape[1] != 3:
            raise ValueError(
                f"Camera '{camera}' of episode {index} has frames of shape {tuple(frames.shape[1:])}; UF-RNN reads "
                "colour images of shape (3, height, width)."
            )
        if frames.is_floating_point():
            if not torch.isfinite(frames).all():
                raise ValueError(
                    f"Camera '{camera}' of episode {index} has NaN or infinite pixels; delete the episode."
                )
            frames = (frames.clamp(0, 1) * 255).round().to(torch.uint8)
        if tuple(frames.shape[-2:]) != self._encoder.image_size:
            frames = (self._encoder.resize(frames) * 255).round().to(torch.uint8)
        return frames
