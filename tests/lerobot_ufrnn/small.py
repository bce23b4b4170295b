"""Small data sets and policies, made on the spot."""

from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_ufrnn.configuration_ufrnn import (
    AugmentationConfig,
    AutoencoderConfig,
    ForesightConfig,
    RecallConfig,
    UFRNNConfig,
)
from lerobot_ufrnn.demonstrations import Demonstrations

JOINTS = ("shoulder_pan.pos", "elbow.pos", "gripper.pos")
IMAGE_SIZE = 32


def make_dataset(
    root: Path,
    lengths: tuple[int, ...],
    cameras: tuple[str, ...] = ("front",),
    broken: dict | None = None,
    use_videos: bool = False,
) -> LeRobotDataset:
    """A data set of smooth random motions; the image shows the first joint as a bright column.

    `broken` may map an episode index to a function that spoils its frames.
    """
    names = list(JOINTS)
    features = {
        "observation.state": {"dtype": "float32", "shape": (len(names),), "names": names},
        "action": {"dtype": "float32", "shape": (len(names),), "names": names},
    }
    for camera in cameras:
        features[f"observation.images.{camera}"] = {
            "dtype": "video" if use_videos else "image",
            "shape": (IMAGE_SIZE, IMAGE_SIZE, 3),
            "names": ["height", "width", "channels"],
        }
    dataset = LeRobotDataset.create("test/motions", fps=10, features=features, root=root, use_videos=use_videos)
    rng = np.random.default_rng(0)
    for index, length in enumerate(lengths):
        phase = rng.uniform(0, 2 * np.pi, len(names))
        joints = np.sin(np.arange(length + 1)[:, None] * 0.2 + phase).astype(np.float32)
        for step in range(length):
            image = np.full((IMAGE_SIZE, IMAGE_SIZE, 3), 60, dtype=np.uint8)
            column = int((joints[step, 0] + 1) / 2 * (IMAGE_SIZE - 4))
            image[:, column : column + 4] = 220
            frame = {
                "observation.state": joints[step],
                "action": joints[step + 1],
                "task": "move",
                **{f"observation.images.{camera}": image for camera in cameras},
            }
            if broken and index in broken:
                frame = broken[index](frame, step)
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("test/motions", root=root, video_backend="pyav")


AUTOENCODER = {
    "image_size": (IMAGE_SIZE, IMAGE_SIZE),
    "feature_dim": 4,
    "conv_channels": (4, 4),
    "conv_first_stride": 4,
    "hidden_dim": 8,
    "steps": 2,
    "batch_size": 4,
}


def small_config(foresight=(), recall=(), autoencoder=(), augmentation=(), **overrides) -> UFRNNConfig:
    """A configuration that trains in a blink; groups are given as dictionaries."""
    return UFRNNConfig(
        device="cpu",
        foresight=ForesightConfig(**{"num_samples": 3, "horizon": 2, **dict(foresight)}),
        recall=RecallConfig(**dict(recall)),
        autoencoder=AutoencoderConfig(**{**AUTOENCODER, **dict(autoencoder)}),
        augmentation=AugmentationConfig(**dict(augmentation)),
        **{"joint_hidden_dim": 6, "image_hidden_dim": 5, "shared_hidden_dim": 4, **overrides},
    )


def batch_of(*episodes: int) -> dict[str, torch.Tensor]:
    """What a training batch says of its episodes."""
    return {"episode_index": torch.tensor(episodes)}


def train(policy, batches: list[dict[str, torch.Tensor]]) -> list[float]:
    """The stock training loop in five lines; returns the losses."""
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    losses = []
    policy.train()
    for batch in batches:
        loss, _ = policy.forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
        losses.append(loss.item())
    return losses


def observation(
    batch_size: int = 2, cameras: tuple[str, ...] = ("front",), size: int = IMAGE_SIZE
) -> dict[str, torch.Tensor]:
    """A random observation."""
    generator = torch.Generator().manual_seed(batch_size)
    return {
        "observation.state": torch.rand(batch_size, len(JOINTS), generator=generator),
        **{
            f"observation.images.{camera}": torch.rand(batch_size, 3, size, size, generator=generator)
            for camera in cameras
        },
    }


def remember_ways(policy, begin: torch.Tensor) -> None:
    """Lets a trained policy remember nothing but two straight ways apart, which begin at a joint state (D_j,)."""
    features = policy.config.image_dim
    policy.demonstrations.load_state_dict(Demonstrations(len(begin), features).state_dict())
    for index, way in enumerate((1.0, -1.0)):
        joints = policy.joint_scaler.scale(begin) + way * torch.arange(21)[:, None] / 20
        sensed = torch.cat((joints, torch.zeros(21, features)), -1)
        policy.demonstrations.remember(index, sensed, joints + way / 20)
