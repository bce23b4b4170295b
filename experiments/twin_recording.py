"""Can demonstrations be recorded on the robot's digital twin, in real time? A scripted operator opens its doors.

The expert of the simulated door plans, a scripted operator turns its plan into the events of a SpaceMouse, and stock
`lerobot-record` records what the robot does while they are played. An episode enters the data set only if the door is
open at its end; each enters in one atomic step, so that whatever stops the script, the data set is readable, and the
same command goes on with it. Real time: leave the computer alone meanwhile.
"""

import contextlib
import itertools
import json
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import av
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from script import run
from scripted_operator import events_along, plan
from twin import Event, StockCommand, describe_failure, late_ticks, record_flags, write_events

from env_door.checks import check_range
from env_door.env import DoorEnv
from env_door.kinematics import UnreachableError
from env_door.latch import KINDS
from env_door.limits import FPS
from env_door.recording import CAMERA
from env_door.recording_config import FrameEncoderConfig, RecordConfig
from env_door.staging import StagedDirectory
from env_door.twin import TwinProcess

LEDGER = Path("meta/door_operation.json")  # in the data set: kind and seed of each episode
START_SECONDS = 120.0  # longest time for LeRobot to start, connect and save


class SpoiltTakeError(RuntimeError):
    """An episode that is not to be kept, and why."""


@dataclass
class RecordingConfig:
    """What to record, and where to."""

    dataset_dir: Path  # folder of the data set
    repo_id: str  # its name, {hf_username}/{dataset_name}; nothing is uploaded
    kinds: tuple[str, ...] = KINDS  # kinds of doors; they share their seeds, so that demonstrations are matched
    episodes_per_kind: int = 5  # episodes for each
    seed: int = 0  # seed of the first; the others count up from it
    episode_seconds: float = 15.0  # length of an episode in s, 12 to 60; at its end the door is held open
    takes: int = 5  # how often a door is tried before giving up: on a busy machine the robot may stop

    def __post_init__(self) -> None:
        RecordConfig(self.repo_id, None, self.episodes_per_kind, list(self.kinds), seed=self.seed)  # refuses the same
        check_range(self, "takes", low=1)
        check_range(self, "episode_seconds", low=12, high=60, unit="s")


def main(config: RecordingConfig) -> None:
    """Records the episodes that the data set does not have."""
    with StagedDirectory(config.dataset_dir) as directory:
        episodes = read_ledger(config.dataset_dir)
        with TwinProcess(camera=True) as twin:
            for kind, seed, events in demonstrations(config):
                if (episode := {"kind": kind, "seed": seed}) not in episodes:
                    record(config, twin, directory, episodes, episode, events)
    print(f"{len(episodes)} episodes in {config.dataset_dir}")


def read_ledger(root: Path) -> list[dict[str, Any]]:
    """Kind and seed of each episode that the data set has."""
    if not root.exists() or not any(root.iterdir()):
        return []
    if not (root / LEDGER).exists():
        raise ValueError(
            f"--dataset_dir: {root} is not empty and was not made by this script ({LEDGER} is missing); "
            "choose another folder."
        )
    return json.loads((root / LEDGER).read_text())


def demonstrations(config: RecordingConfig) -> Iterator[tuple[str, int, list[Event]]]:
    """What to record: all kinds at one seed after the other, without the seeds at which one of them is out of reach."""
    door, found = DoorEnv(arm="ur5e"), 0
    for seed in itertools.count(config.seed):
        try:
            plans = [events_along(plan(door, kind, seed)) for kind in config.kinds]
        except UnreachableError:
            continue
        for kind, events in zip(config.kinds, plans, strict=True):
            yield kind, seed, events
        found += 1
        if found == config.episodes_per_kind:
            return


def record(
    config: RecordingConfig,
    twin: TwinProcess,
    directory: StagedDirectory,
    episodes: list[dict[str, Any]],
    episode: dict[str, Any],
    events: list[Event],
) -> None:
    """Records an episode, again if need be, and adds it to the data set and to the list of what that has."""
    door = f"{episode['kind']} door, seed {episode['seed']}"
    if (needed := sum(event.seconds for event in events) + 0.5) > config.episode_seconds:
        raise ValueError(f"--episode_seconds={config.episode_seconds:g} is too short: {door} takes {needed:.1f} s.")
    for take in range(1, config.takes + 1):
        try:
            with directory.change() as staged:
                delays = operate(config, twin, staged, events, **episode)
                steps = count_steps(config, staged, len(episodes) + 1)
                (staged / LEDGER).write_text(json.dumps([*episodes, episode], indent=4))
        except SpoiltTakeError as error:
            print(f"{door}: take {take} is not kept, {error}", flush=True)
        else:
            episodes.append(episode)
            print(f"{door}: opened; {steps} steps, {delays}", flush=True)
            return
    raise RuntimeError(
        f"{door} was not recorded in {config.takes} takes. {len(episodes)} episodes are safe in {config.dataset_dir}; "
        "the same command goes on with them. Delays spoil takes: let the machine be less busy."
    )


def operate(config: RecordingConfig, twin: TwinProcess, root: Path, events: list[Event], kind: str, seed: int) -> str:
    """Records one episode into a folder; returns how late what was, or raises `SpoiltTakeError`."""
    before = twin.reset(kind, seed)
    # LeRobot moves temporary files into place. From another file system that would write through the hard links of a
    # staged directory, into the data set itself; this folder lies beside it.
    with tempfile.TemporaryDirectory() as folder:
        write_events(events, file := Path(folder) / "events.jsonl")
        # As in the simulation: frames keep the full resolution of colours and no trace of later ones.
        encoder = asdict(FrameEncoderConfig())
        flags = [
            *record_flags(twin.address, file, config.repo_id, root, config.episode_seconds, episodes=1),
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
        with StockCommand("lerobot-record", *flags, TMPDIR=folder) as command:
            with contextlib.suppress(subprocess.TimeoutExpired):
                command.wait(START_SECONDS + 2 * config.episode_seconds)
            state = twin.state()
            command.stop()
            text, status = command.output(), command.returncode
    delays = f"{late_ticks(text)} late ticks, {state['lost_seconds'] - before['lost_seconds']:.1f} s lost by the twin"
    if status != 0:
        raise SpoiltTakeError(f"lerobot-record ended with {describe_failure(status, text)}")
    if not state["is_open"]:
        raise SpoiltTakeError(f"the door did not open (opening {state['opening']:.2f} of 1; {delays})")
    if state["attempts"] != [kind]:
        raise SpoiltTakeError(f"it shows wrong tries: {', '.join(state['attempts'])}")
    return delays


def count_steps(config: RecordingConfig, root: Path, num_episodes: int) -> int:
    """Steps of the last of some episodes; a `SpoiltTakeError` if it is not there in full."""
    metadata = LeRobotDatasetMetadata(config.repo_id, root=root)
    if metadata.total_episodes != num_episodes:
        saved = metadata.total_episodes - num_episodes + 1
        raise SpoiltTakeError(f"lerobot-record saved {saved} episodes instead of one")
    steps = int(metadata.episodes[num_episodes - 1]["length"])
    with av.open(str(max((root / "videos" / CAMERA).rglob("*.mp4")))) as video:
        frames = video.streams.video[0].frames
    if frames != steps:
        raise SpoiltTakeError(f"the video has {frames} frames instead of {steps}")
    return steps


if __name__ == "__main__":
    run(main, RecordingConfig)
