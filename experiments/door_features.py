"""How well the image features tell a closed door from one that is a little open."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from env_door import KINDS, DoorEnv
from env_door.demonstration import TIMING_STREAM
from env_door.expert import HINGE_FROM_KNOB, DoorExpert
from env_door.kinematics import UnreachableError
from env_door.latch import OPENINGS
from env_door.rendering import make_renderer
from lerobot_ufrnn.networks import ImageEncoder

ANGLES = (0.0, np.deg2rad(5), np.deg2rad(10))
"""Turn of a hinged door in rad; a sliding door goes as far as the handle of a hinged one would travel (31, 61 mm)."""

HANDLE_RADIUS = float(np.linalg.norm(HINGE_FROM_KNOB))
"""Distance in metres between the handle and the hinge's axis."""

NUM_STEPS = 150


@dataclass(frozen=True)
class DoorSeparability:
    """How well the scaled features of one kind of door separate closed, 5 degrees open and 10 degrees open.

    A d' is the distance of two class means in units of the standard deviation within the classes along the line that
    joins them.

    Attributes:
        kind (`str`): kind of the door.
        arm (`str`): `follows` the handle, as in a demonstration, or stays `still` while the door alone is moved.
        accuracy (`float`): fraction of frames nearest to their own class's mean, each frame left out of it.
        d_prime_closed_5 (`float`): d' of closed and 5 degrees.
        d_prime_5_10 (`float`): d' of 5 and 10 degrees.
        distance_closed_5 (`float`): distance of the means of closed and 5 degrees in scaled units.
        kind_accuracy (`float`): fraction of frames at 5 degrees nearest to their own kind's mean at 5 degrees.
    """

    kind: str
    arm: str
    accuracy: float
    d_prime_closed_5: float
    d_prime_5_10: float
    distance_closed_5: float
    kind_accuracy: float


def door_separability(encoder: ImageEncoder, seeds: Sequence[int]) -> list[DoorSeparability]:
    """Lets the expert open doors and asks how far the encoder's features tell how far they are open.

    Args:
        encoder (`ImageEncoder`):
            A trained encoder of one camera, with its scaling.
        seeds (`Sequence[int]`):
            Seeds of the expert's runs, best not those of the demonstrations; a seed that the expert fails at is left
            out. At least two must remain.

    Returns:
        `list[DoorSeparability]`: one row for each kind with the arm following the handle, then the same with it still.

    Raises:
        ValueError: If the encoder has several cameras, or fewer than two seeds succeed.
    """
    if len(encoder.cameras) != 1:
        raise ValueError(f"The door has one camera, but the encoder reads {list(encoder.cameras)}.")
    frames = list(_frames(seeds))
    if len(frames) < 2:
        raise ValueError(f"The expert succeeded at {len(frames)} of the seeds {list(seeds)}; at least 2 are needed.")
    images = np.stack(frames)  # (seeds, arm, kinds, angles, height, width, 3)
    with torch.no_grad():
        pixels = torch.from_numpy(images.reshape(-1, *images.shape[-3:])).permute(0, 3, 1, 2)
        features = torch.cat([encoder({encoder.cameras[0]: part}) for part in pixels.split(64)])
    features_by_class = features.double().numpy().reshape(*images.shape[:4], -1)
    rows = []
    for arm, of_arm in zip(("follows", "still"), np.moveaxis(features_by_class, 1, 0), strict=True):
        kinds_at_5 = _nearest_mean_hits(of_arm[:, :, 1]).mean(axis=0)
        for kind, of_kind, kind_accuracy in zip(KINDS, np.moveaxis(of_arm, 1, 0), kinds_at_5, strict=True):
            closed, at_5, at_10 = np.moveaxis(of_kind, 1, 0)
            rows.append(
                DoorSeparability(
                    kind,
                    arm,
                    accuracy=float(_nearest_mean_hits(of_kind).mean()),
                    d_prime_closed_5=_d_prime(closed, at_5),
                    d_prime_5_10=_d_prime(at_5, at_10),
                    distance_closed_5=float(np.linalg.norm(at_5.mean(axis=0) - closed.mean(axis=0))),
                    kind_accuracy=float(kind_accuracy),
                )
            )
    return rows


def _frames(seeds: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
    """For each seed the frames (arm, kinds, angles, height, width, 3): arm following, then still."""
    env = DoorEnv()
    renderer = make_renderer(env.model, "front", env.observation_size)
    try:
        for seed in seeds:
            runs = []
            for kind in KINDS:
                try:
                    runs.append(_open_door(env, renderer.draw, kind, seed))
                except UnreachableError:
                    break
            if len(runs) == len(KINDS) and all(len(following) == len(ANGLES) for following, _ in runs):
                yield np.stack([np.stack(of_arm) for of_arm in zip(*runs, strict=True)])
    finally:
        renderer.close()
        env.close()


def _open_door(
    env: DoorEnv, draw: Callable[[mujoco.MjData], NDArray[np.uint8]], kind: str, seed: int
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]:
    """Frames at `ANGLES`: first those of the expert (fewer if it fails), then those of the door moved on its own.

    The closed door is seen at the last moment before it gives way, with the arm already working on it.
    """
    env.reset(seed=seed, options={"kind": kind})
    expert = DoorExpert(env, directions=(kind,))
    expert.reset(np.random.default_rng([seed, TIMING_STREAM]))
    opening = OPENINGS[kind]
    travels = [angle * (HANDLE_RADIUS if kind == "slide" else 1) for angle in ANGLES]
    following: list[NDArray[np.uint8]] = []
    still: list[NDArray[np.uint8]] = []
    closed = copy.copy(env.data)
    for _ in range(NUM_STEPS):
        env.advance(expert.act())
        if not env.latch.freed:
            closed = copy.copy(env.data)
            continue
        if not following:
            following = [draw(closed)]
            still = following.copy()
            for travel in travels[1:]:
                closed.joint(opening.joint).qpos = opening.sign * travel
                mujoco.mj_forward(env.model, closed)
                still.append(draw(closed))
        if env.latch.travel >= travels[len(following)]:
            following.append(draw(env.data))
            if len(following) == len(travels):
                break
    return following, still


def _nearest_mean_hits(samples: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of `samples` (seeds, classes, features) are nearest to the mean of the others of their own class."""
    count, num_classes, _ = samples.shape
    means = np.broadcast_to(samples.mean(axis=0), (count, num_classes, *samples.shape[1:])).copy()
    own = np.arange(num_classes)
    means[:, own, own] = (samples.sum(axis=0) - samples) / (count - 1)  # (seeds, class of the sample, class, features)
    distances = np.linalg.norm(samples[:, :, None] - means, axis=-1)
    others = np.where(np.eye(num_classes, dtype=bool), np.inf, distances).min(axis=-1)
    return distances[:, own, own] < others


def _d_prime(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Distance of the means of two classes (seeds, features) in standard deviations along the line between them."""
    difference = second.mean(axis=0) - first.mean(axis=0)
    distance = np.linalg.norm(difference)
    if distance == 0:
        return 0.0
    along = [samples @ difference / distance for samples in (first, second)]
    spread = np.sqrt(np.mean([projection.var(ddof=1) for projection in along]))
    return float(distance / spread) if spread > 0 else float("inf")
