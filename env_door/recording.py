"""Record the scripted expert into a LeRobotDataset.

Demonstrations are matched by default: the kinds share their seeds for start pose, door position and timing, so that
nothing before the first opening motion tells which door it is. A policy trained on unmatched demonstrations may learn
such accidents, "know" its door and try no other.

The episodes that share a seed are saved together, in one atomic step (see [`~env_door.staging`]): whatever stops a
recording, the dataset on disk is readable and holds whole, matched episodes.
"""

import contextlib
import logging
import shutil
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import av
from lerobot.datasets.io_utils import SuppressProgressBars
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from tqdm import tqdm

from env_door.demonstration import Demonstration, demonstrate, spread
from env_door.env import DoorEnv
from env_door.limits import FPS
from env_door.provenance import Provenance
from env_door.recording_config import ROBOT_TYPES, RecordConfig
from env_door.staging import StagedDirectory

logger = logging.getLogger(__name__)

CAMERA = f"{OBS_IMAGES}.front"
MAX_DROPS_IN_A_ROW = 20


@dataclass
class RecordReport:
    """What a recording did."""

    root: Path
    episodes: list[dict[str, Any]] = field(default_factory=list)
    """`episode_index`, `kind`, `seed`, `branch_step` and `success_step` of each episode that this run saved."""
    total_episodes: int = 0
    """Episodes in the dataset, with those of earlier runs."""
    dropped_seeds: list[int] = field(default_factory=list)
    """Seeds at which the expert failed at one kind, with those of earlier runs."""
    seconds: float = 0.0
    """Duration of this run."""


def record(config: RecordConfig) -> RecordReport:
    """Record demonstrations of the scripted expert, push the dataset to the Hub if asked, and report.

    Args:
        config (`RecordConfig`):
            What to record, and where to.

    Returns:
        `RecordReport`: What was saved and what was dropped.

    Raises:
        FileExistsError: If the folder holds something and `resume` is off.
        ValueError: If an option does not fit the dataset to go on with.
        RuntimeError: If the expert keeps failing, or the upload fails; the dataset on disk stays whole.
    """
    start = time.perf_counter()
    env = DoorEnv(kind=config.kinds[0], arm=config.arm, door_offset=config.door_offset)
    try:
        with StagedDirectory(config.path) as directory:
            provenance = Provenance.open(config)
            report = RecordReport(config.path, dropped_seeds=provenance.dropped_seeds)
            try:
                _record_missing(config, env, directory, provenance, report)
            except (Exception, KeyboardInterrupt):
                if provenance.episodes:
                    logger.warning(
                        f"Recording stopped: {len(provenance.episodes)} of {config.total_episodes} episodes are safe "
                        f"in {config.path}. Go on with the same command and --resume=true."
                    )
                raise
    finally:
        env.close()
    report.total_episodes = len(provenance.episodes)
    report.seconds = time.perf_counter() - start
    logger.info(
        f"{len(report.episodes)} episodes saved to {config.path} in {report.seconds:.0f} s "
        f"({report.total_episodes} in all, {len(report.dropped_seeds)} seeds dropped)."
    )
    if config.push_to_hub:
        _push(config)
    return report


def _record_missing(
    config: RecordConfig, env: DoorEnv, directory: StagedDirectory, provenance: Provenance, report: RecordReport
) -> None:
    done = len(provenance.episodes)
    with tqdm(total=config.total_episodes, initial=done, desc="Recording", unit="episode") as progress:
        while len(provenance.episodes) < config.total_episodes:
            group = _demonstrate_group(config, env, provenance, progress)
            sources = [{"kind": demonstration.kind, "seed": demonstration.seed} for demonstration in group]
            with directory.change() as staged:
                _write_episodes(config, env, staged, group)
                replace(provenance, episodes=provenance.episodes + sources).write(staged)
            for demonstration, source in zip(group, sources, strict=True):
                steps = {"branch_step": demonstration.branch_step, "success_step": demonstration.success_step}
                report.episodes.append({"episode_index": len(provenance.episodes)} | source | steps)
                provenance.episodes.append(source)
            progress.update(len(group))


def _demonstrate_group(
    config: RecordConfig, env: DoorEnv, provenance: Provenance, progress: tqdm
) -> list[Demonstration]:
    """Run the expert until it succeeds at one seed with every kind that shares the seed."""
    kinds = config.kinds
    if not config.matched:
        kinds = [kinds[len(provenance.episodes) % len(kinds)]]
    for _ in range(MAX_DROPS_IN_A_ROW):
        seed = provenance.next_seed
        group = []
        for kind in kinds:
            # Where each kind has seeds of its own, positions that follow from the seed could tell the kind.
            door_offset = spread(seed) * config.door_offset if config.matched else None
            demonstration = demonstrate(env, kind, seed, config.num_steps, door_offset)
            if demonstration is None:
                break
            group.append(demonstration)
        else:
            return group
        provenance.dropped_seeds.append(seed)
        progress.set_postfix(dropped=len(provenance.dropped_seeds))
    raise RuntimeError(
        f"The expert failed at {MAX_DROPS_IN_A_ROW} seeds in a row, {seed} the last. With num_steps="
        f"{config.num_steps} it may lack the time to open the door; 150 is enough for every kind."
    )


def _write_episodes(config: RecordConfig, env: DoorEnv, staged: Path, group: list[Demonstration]) -> None:
    # LeRobot hands libav's messages over to the terminal, at libav's own level.
    av.logging.set_libav_level(av.logging.ERROR)
    options = {
        "root": staged,
        "rgb_encoder": config.rgb_encoder,
        # LeRobot's way over image files passes over those that it could not write; the stream to the encoder does not,
        # and it drops no frame when its queue holds the whole episode.
        "streaming_encoding": True,
        "encoder_queue_maxsize": config.num_steps + 1,
        "encoder_threads": 1,
        # LeRobot's own choice warns at length where torchcodec is installed but cannot load.
        "video_backend": "pyav",
    }
    if staged.exists():
        dataset = LeRobotDataset.resume(config.repo_id, **options)
    else:
        dataset = LeRobotDataset.create(
            config.repo_id,
            fps=FPS,
            features=_features(config, env),
            robot_type=ROBOT_TYPES[config.arm],
            **options,
        )
    try:
        for demonstration in group:
            frames = zip(demonstration.images, demonstration.states, demonstration.actions, strict=True)
            for image, state, action in frames:
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
    _check_video(staged, num_frames=len(group) * config.num_steps)


def _check_video(root: Path, num_frames: int) -> None:
    newest = max((root / "videos" / CAMERA).rglob("*.mp4"))
    with av.open(str(newest)) as video:
        found = video.streams.video[0].frames
    if found != num_frames:
        raise RuntimeError(f"The encoder wrote {found} of {num_frames} frames; the episodes were thrown away.")


def _features(config: RecordConfig, env: DoorEnv) -> dict[str, dict[str, Any]]:
    joints = [f"{name}.pos" for name in env.joint_names]
    vector = {"dtype": "float32", "shape": (len(joints),), "names": joints}
    size = env.observation_size
    image = {"dtype": "video", "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    return {OBS_STATE: vector, ACTION: dict(vector), CAMERA: image}


def _push(config: RecordConfig) -> None:
    try:
        dataset = LeRobotDataset(config.repo_id, root=config.path, video_backend="pyav")
        dataset.push_to_hub(tags=config.tags, private=config.private)
    except Exception as error:
        raise RuntimeError(
            f"Uploading {config.repo_id} failed: {error}\nThe dataset is complete in {config.path}. "
            "Upload it later with the same command and --resume=true."
        ) from error
