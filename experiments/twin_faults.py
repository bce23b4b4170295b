"""Is the arm stopped, the user told and the recording kept when something fails? Tried on the robot's digital twin.

While stock `lerobot-record` moves the twin, one thing after the other is made to fail, early in the second of two
episodes, so that what comes of it can be told from the recording's end. The table says what became of arm, program and
recording; the script fails if something did that must not be. Real time: leave the computer alone meanwhile.
"""

import contextlib
import re
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import psutil
import pyarrow.parquet
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from script import run
from twin import Event, StockCommand, last_error, record_flags, write_events

from env_door.checks import check_range
from env_door.twin import TwinProcess
from lerobot_ufrnn.analysis.results import markdown

EPISODE_SECONDS = 6
START_SECONDS = 180.0  # longest time to connect and record the first episode
STARTS = 5  # a busy computer can stop the arm by itself before anything is made to fail; then one starts again
MOVING, MOVING_SECONDS = 0.05, 0.5  # speed of the fastest joint in rad/s that the arm must have before, and how long
RELEASE_SECONDS = 2.0  # time after which what passes has passed, well before the end of the episode
STILL, STILL_SECONDS = 0.01, 0.5  # speed in rad/s below which the arm stands, and how long it must for a standstill
MAX_STOP_SECONDS = 3.0  # longest time until the standstill; a silent gripper takes longest to be noticed, a second
HANG_SECONDS = 60.0  # time from which a command that still runs counts as hung
WATCH_SECONDS = 1.0  # how long one looks on after the end of the command, and once more after all is in order again
SAMPLE_SECONDS = 0.004
WARNINGS = ("The controller scales", "See on the pendant")  # of the robot, which go on without an error


# ── What is made to fail ──────────────────────────────────────────────

Action = Callable[[TwinProcess, StockCommand], object]


@dataclass(frozen=True)
class Injection:
    """One thing that is made to fail, and what that may lead to."""

    start: Action
    must_stop: bool = True  # the arm, and the recording with it
    release: Action | None = None  # undoes it; the arm may move again then
    may_die_of: int = 0  # signal that may end the command
    may_lose: bool = False  # the recording


def on_twin(name: str, **parameters: float) -> Action:
    """Something that the twin offers."""
    return lambda twin, command: twin.inject(name, **parameters)


def send(number: int) -> Action:
    """A signal to the command."""
    return lambda twin, command: command.send_signal(number)


def servo(command: StockCommand) -> psutil.Process:
    """The servo process, the only one that the command spawns through `multiprocessing`."""
    children = psutil.Process(command.pid).children(recursive=True)
    found = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    if len(found) != 1:
        raise RuntimeError(f"the recording has {len(found)} processes that could be the servo, not one")
    return found[0]


TWIN_FAILURES = (
    *("drop_link", "close_link", "close_control", "freeze"),
    *("protective_stop", "safeguard_stop", "recovery_mode", "safety_violation", "emergency_stop"),
    *("power_off", "script_stop"),
    *("gripper_silent", "gripper_garbage", "gripper_gone", "gripper_fault", "gripper_reset"),
    *("camera_gone", "camera_freeze", "camera_black"),
)
INJECTIONS = {
    **{name: Injection(on_twin(name)) for name in TWIN_FAILURES},
    "delay": Injection(on_twin("delay", ms=500.0)),
    "dashboard_gone": Injection(on_twin("dashboard_gone"), must_stop=False),
    "remote_control_off": Injection(on_twin("remote_control_off"), must_stop=False),
    "speed_slider": Injection(on_twin("speed_slider", fraction=0.2), must_stop=False),
    "gripper_not_active": Injection(on_twin("gripper_fault", code=5)),
    "servo_terminated": Injection(lambda twin, command: servo(command).terminate()),
    "servo_killed": Injection(lambda twin, command: servo(command).kill()),
    "servo_paused": Injection(lambda twin, command: servo(command).suspend()),
    "command_paused": Injection(send(signal.SIGSTOP), release=send(signal.SIGCONT)),
    "command_interrupted": Injection(send(signal.SIGINT), may_die_of=signal.SIGINT),
    "command_terminated": Injection(send(signal.SIGTERM)),
    "terminal_closed": Injection(send(signal.SIGHUP)),
    # LeRobot 0.6.1 writes the ends of a recording's files, without which they cannot be read, when the recording ends.
    "command_killed": Injection(send(signal.SIGKILL), may_die_of=signal.SIGKILL, may_lose=True),
}


# ── What becomes of it ────────────────────────────────────────────────


class Sample(NamedTuple):
    """The arm at one moment."""

    time: float  # s on any clock
    speed: float  # of its fastest joint in rad/s
    joints: tuple[float, ...]  # rad


def stop_after(samples: Sequence[Sample], begin: float) -> tuple[float | None, bool, float]:
    """How the arm stopped from a moment on: `standstill`, `moved_again` and `travel` of an outcome."""
    times, speeds, joints = (np.array(column) for column in zip(*samples, strict=True))
    still = speeds < STILL
    start, stood = max(int(np.searchsorted(times, begin, "right")) - 1, 0), None
    for first in np.flatnonzero(still & (times >= begin)):
        enough = np.searchsorted(times, times[first] + STILL_SECONDS)
        if enough < len(times) and still[first : enough + 1].all():
            stood = int(first)
            break
    way = joints[start:] if stood is None else joints[start : stood + 1]
    travel = float(np.abs(way - joints[start]).max())
    if stood is None:
        return None, False, travel
    return float(times[stood]) - begin, not still[stood:].all(), travel


@dataclass(frozen=True)
class Outcome:
    """What became of one injection."""

    name: str
    speed: float  # of the fastest joint at that moment, in rad/s
    standstill: float | None  # s until the arm stood; `None` if it never did
    moved_again: bool  # once it had stood
    travel: float  # rad by which the joint that went farthest went on until then
    ended: float | None  # s until the command had ended; `None` if it had to be killed
    status: int | None  # exit status, negative if a signal ended it
    message: str  # what the user saw; empty if nothing
    still_when_cleared: bool  # whether the arm stayed where it was when the injection was cleared
    left_running: tuple[str, ...]  # processes of the command that were still there after its end, and a program
    episodes: tuple[int, ...]  # frames of each recorded episode that can be read; one was recorded before

    @property
    def lost(self) -> bool:
        """Whether a recorded episode cannot be read in full."""
        return not self.episodes or 0 in self.episodes

    def problems(self) -> list[str]:
        """What must not be, in a few words each; empty if all is well."""
        allowed, status = INJECTIONS[self.name], self.status or 0
        resumes = allowed.release is not None
        late = self.standstill is None or self.standstill > MAX_STOP_SECONDS
        crashed = self.ended is not None and status < 0 and -status != allowed.may_die_of
        found = {
            "the arm moved on": allowed.must_stop and late,
            "the arm moved again": self.moved_again and not resumes,
            "nobody was told": allowed.must_stop and self.status == 0 and not resumes,
            "the command hung": self.ended is None,
            f"the command crashed ({describe(status)})": crashed,
            f"left running: {', '.join(self.left_running)}": self.left_running,
            "the arm moved when the injection was cleared": not self.still_when_cleared,
            "recorded episode lost": self.lost and not allowed.may_lose,
        }
        return [problem for problem, is_so in found.items() if is_so]

    @property
    def verdict(self) -> str:
        """The outcome in a few words."""
        if problems := self.problems():
            return "**FAILED**: " + ", ".join(problems)
        if self.status != 0:
            return "stopped; the recording cannot be read" if self.lost else "stopped"
        if INJECTIONS[self.name].must_stop:
            return "stopped, then went on"
        return "went on" if self.message else "went on, not noticed"

    def row(self) -> dict[str, str]:
        """Its row of the table."""
        # When the recording went on, the arm stood at its end, which says nothing of the injection.
        stopped = self.standstill is not None and (INJECTIONS[self.name].must_stop or self.status != 0)
        frames = ", ".join(map(str, self.episodes))
        return {
            "injection": self.name,
            "speed before, rad/s": f"{self.speed:.2f}",
            "standstill after, s": f"{self.standstill:.2f}" if stopped else "-",
            "farthest joint went on, rad": f"{self.travel:.3f}" if stopped else "-",
            "command ended after, s": "-" if self.ended is None else f"{self.ended:.1f}",
            "exit status": "killed" if self.ended is None or self.status is None else describe(self.status),
            "what the user saw": self.message.replace("|", "\\|") or "nothing",
            "after clearing": "at rest" if self.still_when_cleared else "moved",
            "episodes readable (frames)": f"{len(self.episodes)} ({frames})" if frames else "0",
            "verdict": self.verdict,
        }


def describe(status: int) -> str:
    """An exit status; the name of the signal, such as `SIGABRT`, if one ended the process."""
    with contextlib.suppress(ValueError):
        return signal.Signals(-status).name
    return str(status)


# ── The experiment ────────────────────────────────────────────────────


@dataclass
class FaultsConfig:
    """What to try."""

    injections: tuple[str, ...] = tuple(INJECTIONS)  # what shall fail
    output: Path | None = None  # Markdown file for the table, written anew after each injection
    seed: int = 3  # seed of the arm's start pose

    def __post_init__(self) -> None:
        if not self.injections or not set(self.injections) <= set(INJECTIONS):
            raise ValueError(f"--injections must be one or more of {list(INJECTIONS)}, got {list(self.injections)}.")
        check_range(self, "seed", low=0)


def main(config: FaultsConfig) -> None:
    """Tries the injections one after the other, and prints the table; a RuntimeError if one led to what must not be."""
    outcomes: list[Outcome] = []
    for name in config.injections:
        outcomes.append(inject(name, config.seed))
        print(f"{name}: {outcomes[-1].verdict}", flush=True)
        table = markdown(pd.DataFrame([outcome.row() for outcome in outcomes]))
        if config.output is not None:
            config.output.parent.mkdir(parents=True, exist_ok=True)
            config.output.write_text(table)
    print(f"\n{table}", end="", flush=True)
    if failed := [outcome.name for outcome in outcomes if outcome.problems()]:
        raise RuntimeError(f"{', '.join(failed)} led to what must not be")


def inject(name: str, seed: int, starts: int = STARTS) -> Outcome:
    """One injection, with a twin and a folder of its own: nothing of it is left for the next."""
    with tempfile.TemporaryDirectory(prefix="twin-faults-") as folder:
        write_events(movement(), events := Path(folder) / "events.jsonl")
        dataset = Path(folder) / "dataset"
        flags = [
            "--dataset.single_task=move",
            "--dataset.reset_time_s=0",
            # As root LeRobot's default encoder would give the whole program real-time priority, over the servo's head.
            "--dataset.rgb_encoder.vcodec=h264",
            "--display_data=false",
        ]
        with TwinProcess(kind="push", seed=seed, camera=True) as twin:
            flags += record_flags(twin.address, events, "me/faults", dataset, EPISODE_SECONDS, episodes=2)
            with StockCommand("lerobot-record", *flags) as command:
                if samples := set_in_motion(twin, command):
                    return watch(name, twin, command, samples, dataset)
                text = command.output()
    if starts == 1:
        raise RuntimeError(f"{name} could not be tried, for the arm did not get into motion:\n{text[-2000:]}")
    return inject(name, seed, starts - 1)


def movement() -> list[Event]:
    """Leads the tool away from the door and then around in a circle of 4 cm, never at rest.

    LeRobot's pauses for saving cut arcs out of the circle, which the way away from the door leaves room for.
    """
    angles = 2 * np.pi / 24 * np.arange(24 * 60)
    circle = 0.8 * np.column_stack([np.cos(angles), 0 * angles, np.sin(angles), np.zeros((angles.size, 3))])
    return [Event(1.5, np.array([-0.8, 0, 0, 0, 0, 0])), *(Event(1 / 8, twist) for twist in circle)]


def set_in_motion(twin: TwinProcess, command: StockCommand) -> list[Sample]:
    """Waits until the arm moves in the second episode: the samples of its motion, none if it does not."""
    begin = time.monotonic()
    while "Recording episode 1" not in command.output():
        if command.poll() is not None or time.monotonic() - begin > START_SECONDS:
            return []
        time.sleep(SAMPLE_SECONDS)
    begin, samples = time.monotonic(), []
    while time.monotonic() - begin < EPISODE_SECONDS / 2 and command.poll() is None:
        samples.append(look(twin))
        if samples[-1].speed < MOVING:
            samples.clear()
        elif samples[-1].time - samples[0].time >= MOVING_SECONDS:
            return samples
    return []


def look(twin: TwinProcess) -> Sample:
    """The arm as it is now."""
    state = twin.state()
    sample = Sample(time.monotonic(), state["arm_speed"], tuple(state["joints"].values())[:6])
    time.sleep(SAMPLE_SECONDS)
    return sample


def watch(name: str, twin: TwinProcess, command: StockCommand, samples: list[Sample], dataset: Path) -> Outcome:
    """Makes it fail, looks on until a little after the end of the command, clears it, and looks once more."""
    injection = INJECTIONS[name]
    children = psutil.Process(command.pid).children(recursive=True)
    try:
        speed, begin = samples[-1].speed, time.monotonic()
        injection.start(twin, command)
        release, ended = injection.release, None
        while (now := time.monotonic() - begin) < HANG_SECONDS:
            samples.append(look(twin))
            if release is not None and now > RELEASE_SECONDS:
                release(twin, command)
                release = None
            if ended is None and command.poll() is not None:
                ended = now
            if ended is not None and now > ended + WATCH_SECONDS:
                break
        status = command.poll()
        command.stop()
        left_running = names_of_running(children)
        if twin.state()["program"] != "STOPPED":
            left_running += ("a program on the controller",)
    finally:
        for child in children:
            if child.is_running():
                child.kill()
    twin.clear()
    cleared = [look(twin)]
    while cleared[-1].time - cleared[0].time < WATCH_SECONDS:
        cleared.append(look(twin))
    return Outcome(
        name,
        speed,
        *stop_after(samples, begin),
        ended=ended,
        status=status,
        message=last_error(command.output()) or last_warning(command.output()),
        still_when_cleared=stop_after(cleared, cleared[0].time)[:2] == (0.0, False),
        left_running=left_running,
        episodes=readable_episodes(dataset),
    )


def last_warning(output: str) -> str:
    """The last of the warnings with which the robot goes on; empty if there was none."""
    found = re.findall(rf"(?:{'|'.join(WARNINGS)}).*", output)
    return found[-1].strip() if found else ""


def names_of_running(children: Sequence[psutil.Process]) -> tuple[str, ...]:
    """Processes that are still there a few seconds after the end of the one that started them."""
    found = []
    for child in psutil.wait_procs(children, timeout=5.0)[1]:
        with contextlib.suppress(psutil.NoSuchProcess):  # it ended just now
            if child.status() != psutil.STATUS_ZOMBIE:
                found.append(child.name())
    return tuple(found)


def readable_episodes(root: Path) -> tuple[int, ...]:
    """Frames of each episode of a data set; 0 for one of which a frame, images included, is missing or unreadable.

    Empty if the data set cannot be opened.
    """
    try:
        for folder in (root / "meta" / "episodes", root / "data"):
            # Where files are missing LeRobot would look for them on the Hub.
            for file in list(folder.rglob("*.parquet")) or [folder]:
                pyarrow.parquet.read_metadata(file)
        dataset = LeRobotDataset("me/recording", root=root, video_backend="pyav")
    except Exception:
        return ()
    readable = []
    for number, episode in enumerate(dataset.meta.episodes):
        first, end = episode["dataset_from_index"], episode["dataset_to_index"]
        try:
            frames = (dataset[index] for index in range(first, end))
            places = [(frame["episode_index"].item(), frame["frame_index"].item()) for frame in frames]
        except Exception:
            places = []
        readable.append(len(places) if places == [(number, frame) for frame in range(end - first)] else 0)
    return tuple(readable)


if __name__ == "__main__":
    run(main, FaultsConfig)
