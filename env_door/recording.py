"""Record a scripted expert into a LeRobotDataset, at the door or in another environment.

Demonstrations are matched by default: the kinds share their seeds for start pose, door position and timing, so that
nothing before the first opening motion tells which door it is. A policy trained on unmatched demonstrations may learn
such accidents, "know" its door and try no other.

The episodes that share a seed are saved together, in one atomic step (see [`~env_door.staging`]): whatever stops a
recording, the dataset on disk is readable and holds whole, matched episodes.
"""

import contextlib
import logging
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import av
from lerobot.datasets.io_utils import SuppressProgressBars
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from tqdm import tqdm

from env_door.demonstration import Demonstration, demonstrate, spread
from env_door.env import DoorEnv
from env_door.latch import beyond_three
from env_door.limits import FPS
from env_door.provenance import Provenance
from env_door.recording_config import DatasetConfig, RecordConfig
from env_door.staging import StagedDirectory

logger = logging.getLogger(__name__)

type Demonstrate = Callable[[str, int], Demonstration | None]
"""Demonstrates one of `config.kinds` with a seed; `None` if the expert fails at it."""

CAMERA = f"{OBS_IMAGES}.front"
MAX_DROPS_IN_A_ROW = 20


class Recordable(Protocol):
    """What the recorder needs to know of an environment."""

    joint_names: tuple[str, ...]
    task_description: str


@dataclass
class RecordReport:
    """What a recording did."""

    provenance: Provenance  # of the whole dataset, with the episodes of earlier runs
    episodes: list[dict[str, Any]] = field(default_factory=list)
    """`episode_index`, `kind`, `seed`, `branch_step` and `success_step` of each episode that this run saved."""


def record(config: RecordConfig) -> RecordReport:
    """Record demonstrations of the door's expert; see [`record_demonstrations`]."""
    eight = beyond_three(config.kinds)
    with contextlib.closing(DoorEnv(config.kinds[0], config.arm, config.door_offset, eight=eight)) as env:

        def demonstrate_kind(kind: str, seed: int) -> Demonstration | None:
            # Where each kind has seeds of its own, positions that follow from the seed could tell the kind.
            door_offset = spread(seed) * config.door_offset if config.matched else None
            return demonstrate(env, kind, seed, config.num_steps, door_offset)

        return record_demonstrations(config, env, demonstrate_kind)


def record_demonstrations(config: DatasetConfig, env: Recordable, demonstrate_kind: Demonstrate) -> RecordReport:
    """Record what an expert demonstrates, push the dataset to the Hub if asked, and report.

    Raises:
        FileExistsError: If the folder holds something and `resume` is off.
        ValueError: If an option does not fit the dataset to go on with.
        RuntimeError: If the expert keeps failing, or the upload fails; the dataset on disk stays whole.
    """
    with StagedDirectory(config.path) as directory:
        report = RecordReport(Provenance.open(config))
        try:
            _record_missing(config, env, demonstrate_kind, directory, report)
        except (Exception, KeyboardInterrupt):
            if safe := len(report.provenance.episodes):
                logger.warning(
                    f"Recording stopped: {safe} of {config.total_episodes} episodes are safe in {config.path}. "
                    "Go on with the same command and --resume=true."
                )
            raise
    if config.push_to_hub:
        _push(config)
    return report


def _record_missing(
    config: DatasetConfig,
    env: Recordable,
    demonstrate_kind: Demonstrate,
    directory: StagedDirectory,
    report: RecordReport,
) -> None:
    provenance, total = report.provenance, config.total_episodes
    with tqdm(total=total, initial=len(provenance.episodes), desc="Recording", unit="episode") as progress:
        while len(provenance.episodes) < total:
            group = _demonstrate_group(config, demonstrate_kind, provenance, progress)
            sources = [{"kind": run.kind, "seed": run.seed} for run in group]
            with directory.change() as staged:
                _write_episodes(config, env, staged, group)
                replace(provenance, episodes=provenance.episodes + sources).write(staged)
            for run, source in zip(group, sources, strict=True):
                steps = {"branch_step": run.branch_step, "success_step": run.success_step}
                report.episodes.append({"episode_index": len(provenance.episodes)} | source | steps)
                provenance.episodes.append(source)
            progress.update(len(group))


def _demonstrate_group(
    config: DatasetConfig, demonstrate_kind: Demonstrate, provenance: Provenance, progress: tqdm
) -> list[Demonstration]:
    """Run the expert until it succeeds at one seed with every kind that shares the seed."""
    kinds = config.kinds
    if not config.matched:
        kinds = [kinds[len(provenance.episodes) % len(kinds)]]
    for _ in range(MAX_DROPS_IN_A_ROW):
        seed = provenance.next_seed
        group = []
        for kind in kinds:
            run = demonstrate_kind(kind, seed)
            if run is None:
                break
            group.append(run)
        else:
            return group
        provenance.dropped_seeds.append(seed)
        progress.set_postfix(dropped=len(provenance.dropped_seeds))
    raise RuntimeError(f"The expert failed at {MAX_DROPS_IN_A_ROW} seeds in a row, {seed} the last.{config.hint}")


def _write_episodes(config: DatasetConfig, env: Recordable, staged: Path, group: list[Demonstration]) -> None:
    # LeRobot hands libav's messages over to the terminal, at libav's own level.
    av.logging.set_libav_level(av.logging.ERROR)
    options = {
        "root": staged,
        "rgb_encoder": config.rgb_encoder,
        # LeRobot's way over image files passes over those that it could not write; the stream to the encoder does not,
        # and it drops no frame when its queue holds the whole episode.
        "streaming_encoding": True,
        "encoder_queue_maxsize": max(len(run.images) for run in group) + 1,
        "encoder_threads": 1,
        # LeRobot's own choice warns at length where torchcodec is installed but cannot load.
        "video_backend": "pyav",
    }
    if staged.exists():
        dataset = LeRobotDataset.resume(config.repo_id, **options)
    else:
        features = _features(env, group[0].images.shape[1:])
        dataset = LeRobotDataset.create(config.repo_id, FPS, features, robot_type=config.robot_type, **options)
    try:
        for run in group:
            for image, state, action in zip(run.images, run.states, run.actions, strict=True):
                dataset.add_frame({CAMERA: image, OBS_STATE: state, ACTION: action, "task": env.task_description})
            with SuppressProgressBars():
                dataset.save_episode()
        dataset.finalize()
    except BaseException:
        # LeRobot closes its files at the latest when it is garbage-collected, and makes their folder anew for that.
        # Close them now, with the room on a full disk that this takes.
        shutil.rmtree(staged, ignore_errors=True)
        with contextlib.suppress(Exception):
            dataset.finalize()
        raise
    wanted = sum(len(run.images) for run in group)
    with av.open(str(max((staged / "videos" / CAMERA).rglob("*.mp4")))) as newest:
        found = newest.streams.video[0].frames
    if found != wanted:
        raise RuntimeError(f"The encoder wrote {found} of {wanted} frames; the episodes were thrown away.")


def _features(env: Recordable, image_shape: tuple[int, ...]) -> dict[str, dict[str, Any]]:
    joints = [f"{name}.pos" for name in env.joint_names]
    vector = {"dtype": "float32", "shape": (len(joints),), "names": joints}
    image = {"dtype": "video", "shape": image_shape, "names": ["height", "width", "channels"]}
    return {OBS_STATE: vector, ACTION: dict(vector), CAMERA: image}


def _push(config: DatasetConfig) -> None:
    try:
        dataset = LeRobotDataset(config.repo_id, root=config.path, video_backend="pyav")
        dataset.push_to_hub(tags=config.tags, private=config.private)
    except Exception as error:
        raise RuntimeError(
            f"Uploading {config.repo_id} failed: {error}\nThe dataset is complete in {config.path}. "
            "Upload it later with the same command and --resume=true."
        ) from error
