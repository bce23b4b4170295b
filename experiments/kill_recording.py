"""Is every saved episode kept when a recording is killed? Recordings are killed (SIGKILL) at random moments.

A robot that counts is recorded by stock `lerobot-record` and by `ufrnn lerobot-record`, demonstrations that count by
our recorder. After each kill the dataset must be readable as it is and hold, frame by frame, every episode whose saving
had returned; then the next recording goes on with it until it is killed, too.
"""

import os
import random
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import forkserver, get_context
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pandas as pd
from counting_robot import CAMERA, JOINT, picture
from jobs import replace_text
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_record
from script import run

from env_door.checks import check_range
from env_door.demonstration import Demonstration
from env_door.inspection import files_of_episodes, inspect
from env_door.recording import record_demonstrations
from env_door.recording_config import DatasetConfig
from lerobot_ufrnn.analysis.results import markdown
from lerobot_ufrnn.commands import lerobot_record as kept_record

REPO_ID, FPS = "tester/counted", 30
SESSION = 10_000  # from which count to which one recording may count
EPISODE_SECONDS, STEPS = 0.15, 8  # of an episode of the robot, of a demonstration; short, so that most is saving
MAX_EPISODES = 16  # of a dataset; then another is begun
START_SECONDS = 120.0  # longest time until a recording records


@dataclass
class KillConfig:
    """How often to kill, and where the table goes."""

    kills: int = 100  # in all, spread over the ways to record
    max_seconds: float = 3.0  # latest moment of a kill after the recording has begun, in s
    seed: int = 0  # of the moments
    output: Path | None = Path("experiments/results/kill_recording.md")  # where the table goes

    def __post_init__(self) -> None:
        check_range(self, "kills", low=1)
        check_range(self, "max_seconds", low=0.1, high=60, unit="s")


# ── Ways to record; each begins at a count and goes on until it is killed ──────

Recorder = Callable[[Path, int, int], None]


def robot_flags(root: Path, first: int, num_episodes: int) -> list[str]:
    """Flags of `lerobot-record` for the robot that counts from `first`."""
    return [
        "--robot.discover_packages_path=counting_robot",
        "--robot.type=counting_robot",
        f"--robot.first={first}",
        "--teleop.type=counting_teleop",
        f"--teleop.first={first}",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={root}",
        "--dataset.single_task=count",
        f"--dataset.fps={FPS}",
        f"--dataset.num_episodes={num_episodes}",
        f"--dataset.episode_time_s={EPISODE_SECONDS}",
        "--dataset.reset_time_s=0",
        "--dataset.push_to_hub=false",
        "--dataset.no_stamp=true",
        "--dataset.rgb_encoder.vcodec=h264",  # SVT-AV1 gives itself real-time priority
        "--play_sounds=false",
        f"--resume={str(root.exists()).lower()}",
    ]


def with_robot(record: Callable[[list[str]], None], *flags: str) -> Recorder:
    """Recording the robot with some more flags; LeRobot itself says which episode it begins."""
    return lambda root, first, episodes: record([*robot_flags(root, first, episodes), *flags])


def stock(arguments: list[str]) -> None:
    """LeRobot's own command."""
    sys.argv = ["lerobot-record", *arguments]
    lerobot_record.main()


@dataclass
class CountedConfig(DatasetConfig):
    """What our recorder is told."""

    kinds: list[str] = field(default_factory=lambda: ["one", "two"])


class CountedEnv:
    """What our recorder asks of an environment."""

    joint_names: tuple[str, ...] = ("joint",)
    task_description = "count"


def ours(root: Path, first: int, num_episodes: int) -> None:
    """Our recorder, with demonstrations that count; two are saved together."""

    def demonstrate(kind: str, seed: int) -> Demonstration:
        if kind == "one":
            print(f"Recording episode {2 * seed}", flush=True)  # as LeRobot does: those before it are saved
        counts = np.arange(STEPS) + (2 * seed + (kind == "two")) * STEPS
        states = counts[:, None].astype(np.float32)
        images = np.stack([picture(int(count)) for count in counts])
        return Demonstration(kind, seed, images, states, states + 0.5, branch_step=1, success_step=2)

    config = CountedConfig(REPO_ID, root, episodes_per_kind=num_episodes, resume=True)
    record_demonstrations(config, CountedEnv(), demonstrate)


STREAMED = ("--dataset.streaming_encoding=true", "--dataset.encoder_threads=1", "--dataset.encoder_queue_maxsize=1000")
IMAGES = ("--dataset.video=false",)
STOCK = "`lerobot-record`"
RECORDERS: dict[str, Recorder] = {
    STOCK: with_robot(stock),
    "`ufrnn lerobot-record`": with_robot(kept_record.run),
    "`ufrnn lerobot-record`, streamed": with_robot(kept_record.run, *STREAMED),
    "`ufrnn lerobot-record`, images": with_robot(kept_record.run, *IMAGES),
    "`ufrnn record`": ours,
}


# ── Killing ───────────────────────────────────────────────────────────


def work(name: str, root: Path, first: int, log: Path, num_episodes: int = 1000) -> None:
    """Body of the process that records; what it says goes to a file."""
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(file, 1)
    os.dup2(file, 2)
    RECORDERS[name](root, first, num_episodes)


def saved_episodes(log: Path) -> int | None:
    """Number of the last episode that was begun, as all before it are saved; `None` if none was."""
    text = log.read_text(errors="replace") if log.exists() else ""
    begun = [
        line.split("Recording episode ")[1].split()[0] for line in text.splitlines() if "Recording episode " in line
    ]
    return int(begun[-1]) if begun else None


def begin(name: str, root: Path, first: int, log: Path, target: Callable[..., None] = work) -> tuple[BaseProcess, int]:
    """Starts a recording; returns it and how many episodes there were before, as soon as it records."""
    log.unlink(missing_ok=True)
    process = forking().Process(target=target, args=(name, root, first, log))
    process.start()
    deadline = time.monotonic() + START_SECONDS
    while (before := saved_episodes(log)) is None:
        if not process.is_alive() or time.monotonic() > deadline:
            process.kill()
            raise RuntimeError(f"{name} did not begin to record:\n{log.read_text()[-2000:]}")
        time.sleep(0.002)
    return process, before


def record_and_kill(name: str, root: Path, first: int, seconds: float) -> tuple[int, int]:
    """Records and kills after some time; returns how many episodes there were before, and how many were saved."""
    log = root.parent / f"{root.name}.log"
    process, before = begin(name, root, first, log)
    time.sleep(seconds)
    if not process.is_alive():
        raise RuntimeError(f"{name} ended by itself:\n{log.read_text()[-2000:]}")
    process.kill()
    process.join()
    saved = saved_episodes(log)
    assert saved is not None
    return before, saved


@cache
def forking() -> ForkServerContext:
    """Starts processes as forks of one that has imported all of this, as LeRobot takes long to import."""
    context, outside = get_context("forkserver"), os.environ.get("PYTHONPATH", "")
    context.set_forkserver_preload([Path(__file__).stem])
    try:
        os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
        forkserver.ensure_running()
    finally:
        os.environ["PYTHONPATH"] = outside
    return context


# ── What is there afterwards ──────────────────────────────────────────


def read_counts(root: Path) -> list[list[int]]:
    """Counts of each episode, read with all frames; a ValueError if a frame is not what was recorded."""
    dataset = LeRobotDataset(REPO_ID, root=root, video_backend="pyav", return_uint8=True)
    if len(dataset.hf_dataset) != dataset.num_frames:
        raise ValueError(f"{len(dataset.hf_dataset)} rows for {dataset.num_frames} frames")
    episodes: list[list[int]] = [[] for _ in range(dataset.num_episodes)]
    for item in (dataset[index] for index in range(dataset.num_frames)):
        count, image = float(item["observation.state"].reshape(-1)[0]), item[f"observation.images.{CAMERA}"]
        image = np.asarray(image * 255 if image.is_floating_point() else image, np.float32)
        if (
            float(item["action"].reshape(-1)[0]) != count + 0.5
            or np.abs(image - picture(int(count))[0, 0, 0]).max() > 6
        ):
            raise ValueError(f"frame {int(item['index'])} is not what was recorded at {JOINT}={count}")
        episodes[int(item["episode_index"])].append(int(count))
    return episodes


def check_counts(episodes: list[list[int]]) -> None:
    """Raises a ValueError unless each recording counted on from its beginning without a gap."""
    counts = np.array([count for episode in episodes for count in episode])
    follows, begins = np.diff(counts) == 1, counts[1:] % SESSION == 0
    if not counts[0] % SESSION == 0 or not (follows | (begins & (np.diff(counts) > 0))).all():
        raise ValueError(f"counts {counts.tolist()} have gaps")


def readable_episodes(root: Path) -> int | str:
    """How many episodes can be read as they were recorded, or why not."""
    if not root.exists():
        return 0
    try:
        check_counts(episodes := read_counts(root))
    except Exception as error:  # LeRobot raises what its libraries do
        return f"{type(error).__name__}: {str(error).splitlines()[0][:80]}"
    return len(episodes)


def was_saving(root: Path) -> bool:
    """Whether a killed recording had begun to write an episode that is not in the dataset."""
    staged = root.parent / f".{root.name}.staging" / "staged"
    return any(not (root / path.relative_to(staged)).exists() for path in files_of_episodes(staged))


def kill(name: str, kills: int, seconds: float, rng: random.Random, folder: Path) -> dict[str, object]:
    """Kills one way to record again and again; returns a row of the table."""
    counts = dict.fromkeys(("while saving", "episodes saved", "episodes lost", "unreadable", "with leftovers"), 0)
    number, session, readable = 0, 0, 0
    for _ in range(kills):
        root = folder / f"{number}"
        before, saved = record_and_kill(name, root, session * SESSION, rng.uniform(0, seconds))
        if before != readable:
            raise RuntimeError(f"{name} went on with {before} of {readable} episodes")
        found, session = readable_episodes(root), session + 1
        counts["episodes saved"] += saved - before
        if isinstance(found, str):
            print(f"{name}: {saved} saved episodes cannot be read ({found})", flush=True)
            counts["unreadable"] += 1
            counts["episodes lost"] += saved
        else:
            print(f"{name}: {saved} episodes were saved, {found} can be read", flush=True)
            counts["episodes lost"] += max(saved - found, 0)
            counts["while saving"] += found > saved or was_saving(root)
            counts["with leftovers"] += root.exists() and bool(inspect(root).faults)
        readable = found if isinstance(found, int) else MAX_EPISODES
        if readable >= MAX_EPISODES:
            number, readable = number + 1, 0
    unknown = {"while saving": "-", "with leftovers": "-"} if name == STOCK else {}
    return {"command": name, "kills": kills, **counts, **unknown}


def main(config: KillConfig) -> None:
    """Kills, prints the table and writes it; fails if one of our ways to record lost anything."""
    rng = random.Random(config.seed)
    rows: list[dict[str, object]] = []
    ends = [config.kills * place // len(RECORDERS) for place in range(len(RECORDERS) + 1)]
    with tempfile.TemporaryDirectory() as folder:
        for name, kills in zip(RECORDERS, np.diff(ends), strict=True):
            path = Path(folder) / f"{len(rows)}"
            path.mkdir()
            rows.append(kill(name, int(kills), config.max_seconds, rng, path))
    table = markdown(pd.DataFrame(rows))
    print(table)
    if config.output:
        replace_text(config.output, table)
    if any(
        row["episodes lost"] or row["unreadable"] or row["with leftovers"] for row in rows if row["command"] != STOCK
    ):
        raise RuntimeError("episodes were lost whose saving had returned")


if __name__ == "__main__":
    run(main, KillConfig)
