"""`ufrnn operate`: demonstrations recorded on the digital twin of the robot, through stock `lerobot-record`.

The expert of the simulated door plans, a scripted operator turns its plan into the events of an input device, and
LeRobot records what a robot does whose operator plays them. An episode enters the data set only if the door is open at
its end; each enters in one atomic step (see [`~env_door.staging`]), so that whatever stops the command, the data set is
readable and can be gone on with.
"""

import contextlib
import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import av
import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from env_door.demonstration import TIMING_STREAM
from env_door.expert import DoorExpert
from env_door.kinematics import UnreachableError
from env_door.latch import KINDS, check_kinds
from env_door.recording import CAMERA
from env_door.recording_config import FrameEncoderConfig
from env_door.staging import StagedDirectory
from env_door.twin import TwinProcess
from env_door.twin.live_door import LiveDoor

from ..teleoperators import SpaceMouseTwistConfig
from ..teleoperators.scripted_operator import Event, ToolPath, duration, events_along, write_events
from .flags import parse_flags
from .stock import FPS, StockCommand, describe_failure, late_ticks, record_command

LEDGER = Path("meta/door_operation.json")
"""In the data set: kind and seed of each episode."""

START_SECONDS = 120.0
"""Longest time for LeRobot to start, connect and save."""


class AttemptError(RuntimeError):
    """An episode that is not to be kept, and why."""


@dataclass
class OperateConfig:
    """What to record, and where to.

    Args:
        dataset_dir (`Path`):
            Folder of the data set. Episodes that are in it are not repeated.
        repo_id (`str`):
            Name of the data set, `{hf_username}/{dataset_name}`. Nothing is uploaded.
        kinds (`tuple[str, ...]`, *optional*, defaults to `("push", "pull", "slide")`):
            Kinds of doors. They share their seeds, so that demonstrations are matched.
        episodes_per_kind (`int`, *optional*, defaults to `5`):
            Episodes for each.
        seed (`int`, *optional*, defaults to `0`):
            Seed of the first; the others count up from it.
        episode_seconds (`float`, *optional*, defaults to `15.0`):
            Length of an episode in s, 12 to 60; what is left of it after the opening the door is held open.
        attempts (`int`, *optional*, defaults to `5`):
            How often a door is tried before the command gives up. On a busy machine the twin or LeRobot may come too
            late, and the robot then stops.

    Raises:
        ValueError: If a field is out of its range.
    """

    dataset_dir: Path
    repo_id: str
    kinds: tuple[str, ...] = field(default=KINDS)
    episodes_per_kind: int = 5
    seed: int = 0
    episode_seconds: float = 15.0
    attempts: int = 5

    def __post_init__(self) -> None:
        if self.repo_id.count("/") != 1 or not all(self.repo_id.split("/")):
            raise ValueError(f"--repo_id must read {{hf_username}}/{{dataset_name}}, got {self.repo_id!r}.")
        if self.repo_id.split("/")[1].startswith("eval_"):
            raise ValueError(f"--repo_id: LeRobot keeps names with 'eval_' for evaluations, got {self.repo_id!r}.")
        check_kinds(self.kinds, "--kinds")
        for name, least in (("episodes_per_kind", 1), ("seed", 0), ("attempts", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"--{name} must be at least {least}, got {getattr(self, name)}.")
        if not 12 <= self.episode_seconds <= 60:
            raise ValueError(f"--episode_seconds must be 12 to 60 s, got {self.episode_seconds}.")


def run(arguments: list[str]) -> None:
    """Records the episodes that the data set does not have."""
    config = parse_flags(OperateConfig, arguments)
    door = LiveDoor()
    with StagedDirectory(config.dataset_dir) as directory:
        episodes = _read_ledger(config.dataset_dir)
        with TwinProcess(camera=True) as twin:
            for kind, seed, events in _plans(config, door):
                if {"kind": kind, "seed": seed} not in episodes:
                    _record(config, twin, directory, episodes, kind, seed, events)
    print(f"{len(episodes)} episodes in {config.dataset_dir}")


def plan(door: LiveDoor, kind: str, seed: int) -> ToolPath:
    """The path of the tool that the expert of the simulation plans.

    Args:
        door (`LiveDoor`):
            The scene of the twin, to plan in.
        kind (`str`):
            Kind of the door.
        seed (`int`):
            Seed of the trial.

    Returns:
        `ToolPath`: a pose for each control step, the first one where the arm starts.

    Raises:
        UnreachableError: If the arm cannot reach a pose.
    """
    door.place(seed, kind, keep_arm=False)
    expert = DoorExpert(door, directions=(kind,))
    expert.reset(np.random.default_rng([seed, TIMING_STREAM]))
    targets = [door.measured_joints()]
    while expert.phase != "hold":
        targets.append(expert.act().astype(np.float64))
    joints = np.array(targets)[:, :-1]
    positions, rotations = zip(*map(door.kinematics.forward, joints), strict=True)
    return ToolPath(np.array(positions), np.array(rotations), np.array(targets)[:, -1], joints)


def _plans(config: OperateConfig, door: LiveDoor) -> Iterator[tuple[str, int, list[Event]]]:
    """What to record: all kinds at one seed after the other, without the seeds at which one of them is out of reach."""
    found = 0
    teleoperator = SpaceMouseTwistConfig(robot_ip="twin")
    for seed in count(config.seed):
        try:
            plans = [events_along(plan(door, kind, seed), 1 / FPS, teleoperator) for kind in config.kinds]
        except UnreachableError:
            continue
        for kind, events in zip(config.kinds, plans, strict=True):
            yield kind, seed, events
        found += 1
        if found == config.episodes_per_kind:
            return


def _read_ledger(root: Path) -> list[dict[str, Any]]:
    if not root.exists() or not any(root.iterdir()):
        return []
    if not (root / LEDGER).exists():
        raise ValueError(
            f"--dataset_dir: {root} is not empty and was not made by this command ({LEDGER} is missing); "
            "choose another folder."
        )
    return json.loads((root / LEDGER).read_text())


def _record(
    config: OperateConfig,
    twin: TwinProcess,
    directory: StagedDirectory,
    episodes: list[dict[str, Any]],
    kind: str,
    seed: int,
    events: list[Event],
) -> None:
    """Records a door, again if need be, and adds it to the data set and to `episodes`."""
    if (needed := duration(events) + 0.5) > config.episode_seconds:
        raise ValueError(
            f"--episode_seconds={config.episode_seconds:g} is too short for the {kind} door with seed {seed}, which "
            f"takes {needed:.1f} s."
        )
    for attempt in range(1, config.attempts + 1):
        try:
            with directory.change() as staged:
                steps, delays = _operate(config, twin, staged, len(episodes), kind, seed, events)
                after = [*episodes, {"kind": kind, "seed": seed}]
                (staged / LEDGER).write_text(json.dumps(after, indent=4))
        except AttemptError as error:
            print(f"{kind} door, seed {seed}: attempt {attempt} is not kept, {error}", flush=True)
        else:
            episodes[:] = after
            print(f"{kind} door, seed {seed}: opened; {steps} steps, {delays}", flush=True)
            return
    raise RuntimeError(
        f"The {kind} door with seed {seed} was not recorded in {config.attempts} attempts. {len(episodes)} episodes "
        f"are safe in {config.dataset_dir}; the same command goes on with them. Delays spoil attempts: let the "
        "machine be less busy."
    )


def _operate(
    config: OperateConfig,
    twin: TwinProcess,
    staged: Path,
    index: int,
    kind: str,
    seed: int,
    events: list[Event],
) -> tuple[int, str]:
    """Records one episode; returns its steps and how late what was.

    Raises:
        AttemptError: If it is not to be kept.
    """
    before = twin.reset(kind, seed)
    with tempfile.TemporaryDirectory() as folder, _children_use(folder):
        script = Path(folder) / "events.jsonl"
        write_events(events, script)
        with StockCommand(_command(config, twin.address, staged, script)) as command:
            with contextlib.suppress(subprocess.TimeoutExpired):
                command.process.wait(START_SECONDS + 2 * config.episode_seconds)
            state = twin.state()
            command.stop()
            text, status = command.output(), command.process.returncode
    delays = f"{late_ticks(text)} late ticks, {state['lost_seconds'] - before['lost_seconds']:.1f} s lost by the twin"
    if status != 0:
        raise AttemptError(f"lerobot-record ended with {describe_failure(status, text)}")
    if not state["is_open"]:
        raise AttemptError(f"the door did not open (opening {state['opening']:.2f} of 1; {delays})")
    if state["attempts"] != [kind]:
        raise AttemptError(f"it shows wrong tries: {', '.join(state['attempts'])}")
    return _check(config, staged, index), delays


def _command(config: OperateConfig, address: str, root: Path, script: Path) -> list[str]:
    # As in the simulation: frames keep the full resolution of colours and no trace of later ones.
    encoder = asdict(FrameEncoderConfig())
    return [
        *record_command(address, script, config.repo_id, root, config.episode_seconds, num_episodes=1),
        "--teleop.id=script",
        "--dataset.single_task=open the door",
        "--dataset.no_stamp=true",
        "--dataset.streaming_encoding=true",
        "--dataset.encoder_threads=1",
        # A full queue drops frames; this one holds the episode.
        f"--dataset.encoder_queue_maxsize={round(config.episode_seconds * FPS) + 1}",
        *(f"--dataset.rgb_encoder.{name}={json.dumps(value)}" for name, value in encoder.items()),
        f"--resume={str(root.exists()).lower()}",
    ]


@contextlib.contextmanager
def _children_use(folder: str) -> Iterator[None]:
    """Lets commands put temporary files on the data set's file system.

    LeRobot moves some into place; from another file system that would write through the hard links of a staged
    directory, into the data set itself.
    """
    before = os.environ.get("TMPDIR")
    os.environ["TMPDIR"] = folder
    try:
        yield
    finally:
        if before is None:
            del os.environ["TMPDIR"]
        else:
            os.environ["TMPDIR"] = before


def _check(config: OperateConfig, root: Path, index: int) -> int:
    """Returns the steps of the episode.

    Raises:
        AttemptError: If it is not there in full.
    """
    metadata = LeRobotDatasetMetadata(config.repo_id, root=root)
    if metadata.total_episodes != index + 1:
        raise AttemptError(f"lerobot-record saved {metadata.total_episodes - index} episodes instead of one")
    steps = int(metadata.episodes[index]["length"])
    with av.open(str(max((root / "videos" / CAMERA).rglob("*.mp4")))) as video:
        frames = video.streams.video[0].frames
    if frames != steps:
        raise AttemptError(f"the video has {frames} frames instead of {steps}")
    return steps
