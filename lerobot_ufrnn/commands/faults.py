"""`ufrnn faults`: each fault strikes while stock `lerobot-record` moves the digital twin; what became of it."""

import contextlib
import json
import math
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from env_door.twin import TwinProcess

from ..analysis.fault_table import Outcome, Sample, moves_again, standstill, to_markdown, travel
from ..experiments.state import replace_text
from .flags import parse_flags
from .injection import FAULTS, RELEASE_SECONDS, Fault, Victim
from .recorded import readable_episodes
from .stock import StockCommand, last_error, record_command

EPISODE_SECONDS = 6
"""Length of an episode: the fault strikes early in the second, so that going on can be told from its end."""

START_SECONDS = 180.0
"""Longest time to connect and record the first episode."""

HANG_SECONDS = 60.0
"""Time after a fault from which a command that still runs counts as hung."""

WATCH_SECONDS = 1.0
"""How long one looks on after the end of the command, and after clearing the fault."""

MOVING = 0.05
"""Speed of the fastest joint in rad/s that the arm must have when a fault strikes."""

MOVING_SECONDS = 0.5
"""For how long it must have had it."""

SAMPLE_SECONDS = 0.004
ATTEMPTS = 5
"""A busy computer can stop the arm by itself before the fault strikes; then one tries again."""


@dataclass
class FaultsConfig:
    """Which faults to try.

    Args:
        faults (`tuple[str, ...]`, *optional*):
            Their names; by default all.
        output (`Path`, *optional*):
            Markdown file for the table; only printed when not given. Written anew after each fault.
        seed (`int`, *optional*, defaults to `3`):
            Seed of the arm's start pose.

    Raises:
        ValueError: If a field is out of its range.
    """

    faults: tuple[str, ...] = field(default=tuple(FAULTS))
    output: Path | None = None
    seed: int = 3

    def __post_init__(self) -> None:
        if not self.faults or not set(self.faults) <= set(FAULTS):
            raise ValueError(f"--faults must be one or more of {list(FAULTS)}, got {list(self.faults)}.")
        if self.seed < 0:
            raise ValueError(f"--seed must be at least 0, got {self.seed}.")


def run(arguments: list[str]) -> None:
    """Tries the faults one after the other, and prints the table.

    Raises:
        RuntimeError: If a fault led to what must not be, or could not be tried.
    """
    config = parse_flags(FaultsConfig, arguments)
    outcomes: list[Outcome] = []
    untried: list[str] = []
    for name in config.faults:
        try:
            outcomes.append(_try(name, config.seed))
        except RuntimeError as error:
            untried.append(name)
            print(f"{name}: not tried: {error}", flush=True)
        else:
            print(f"{name}: {outcomes[-1].verdict}", flush=True)
        if config.output is not None:
            replace_text(config.output, _report(outcomes, untried))
    print("\n" + _report(outcomes, untried), end="", flush=True)
    problems = [f"{outcome.fault} led to what must not be" for outcome in outcomes if outcome.problems()]
    problems += [f"{name} could not be tried" for name in untried]
    if problems:
        raise RuntimeError("; ".join(problems))


def _report(outcomes: list[Outcome], untried: list[str]) -> str:
    note = f"\nNot tried, for the arm did not get into motion: {', '.join(untried)}.\n" if untried else ""
    return to_markdown(outcomes) + note


def _try(name: str, seed: int) -> Outcome:
    """One fault.

    Raises:
        RuntimeError: If the arm could not be set in motion.
    """
    for attempt in range(1, ATTEMPTS + 1):
        # A twin and a folder of its own for each: nothing of one fault is left for the next.
        with tempfile.TemporaryDirectory(prefix="ufrnn-faults-") as folder:
            events, dataset = Path(folder) / "events.jsonl", Path(folder) / "dataset"
            events.write_text(_movement())
            with (
                TwinProcess(kind="push", seed=seed, camera=True) as twin,
                StockCommand(_record(twin.address, events, dataset)) as command,
            ):
                try:
                    samples = _set_in_motion(twin, command)
                except RuntimeError:
                    if attempt == ATTEMPTS:
                        raise
                    continue
                return _watch(name, FAULTS[name], Victim(twin, command), samples, dataset)
    raise AssertionError("unreachable")


def _movement() -> str:
    """Events that lead the tool away from the door and then around in a circle of 4 cm, never at rest.

    LeRobot's pauses for saving cut arcs out of the circle, which the way away from the door leaves room for.
    """
    events = [(0.0, -0.8, 0.0)]
    for step in range(24 * 60):
        angle = 2 * math.pi * step / 24
        events.append((1.5 + step / 8, 0.8 * math.cos(angle), 0.8 * math.sin(angle)))
    events.append((events[-1][0] + 1 / 8, 0.0, 0.0))
    lines = [{"time": moment, "twist": [round(x, 3), 0, round(z, 3), 0, 0, 0]} for moment, x, z in events]
    return "".join(json.dumps(line) + "\n" for line in lines)


def _record(address: str, events: Path, dataset: Path) -> list[str]:
    return [
        *record_command(address, events, "me/faults", dataset, EPISODE_SECONDS, num_episodes=2),
        "--dataset.single_task=move",
        "--dataset.reset_time_s=0",
        # As root LeRobot's default encoder would give the whole program real-time priority, over the servo's head.
        "--dataset.rgb_encoder.vcodec=h264",
        "--display_data=false",
    ]


def _set_in_motion(twin: TwinProcess, command: StockCommand) -> list[Sample]:
    """Waits until the arm moves in the second episode.

    Raises:
        RuntimeError: If it does not.
    """
    command.wait_for("Recording episode 1", START_SECONDS)
    samples: list[Sample] = []
    begin = time.monotonic()
    while time.monotonic() - begin < EPISODE_SECONDS / 2:
        if command.has_ended:
            raise RuntimeError(f"lerobot-record ended too soon:\n{command.output()[-2000:]}")
        samples.append(_look(twin))
        if samples[-1].speed < MOVING:
            samples.clear()
        elif samples[-1].time - samples[0].time >= MOVING_SECONDS:
            return samples
    raise RuntimeError(f"the arm did not move at {MOVING} rad/s for {MOVING_SECONDS} s:\n{command.output()[-2000:]}")


def _look(twin: TwinProcess) -> Sample:
    state = twin.state()
    sample = Sample(time.monotonic(), state["arm_speed"], tuple(state["joints"].values())[:6])
    time.sleep(SAMPLE_SECONDS)
    return sample


def _watch(name: str, fault: Fault, victim: Victim, samples: list[Sample], dataset: Path) -> Outcome:
    twin, command = victim.twin, victim.command
    children = psutil.Process(command.process.pid).children(recursive=True)
    try:
        speed = samples[-1].speed
        begin = time.monotonic()
        fault.strike(victim)
        ended = _look_on(fault, victim, samples, begin)
        status = command.process.poll()
        command.stop()
        left = _left_running(children)
    finally:
        for child in children:
            if child.is_running():
                child.kill()
    stood = standstill(samples, begin)
    twin.clear()
    cleared = [_look(twin)]
    while cleared[-1].time - cleared[0].time < WATCH_SECONDS:
        cleared.append(_look(twin))
    told = last_error(command.output())
    return Outcome(
        fault=name,
        must_stop=fault.must_stop,
        may_resume=fault.release is not None,
        may_die_of=fault.may_die_of,
        may_lose=fault.may_lose,
        speed=speed,
        standstill=stood,
        moved_again=moves_again(samples, begin),
        travel=travel(samples, begin, stood),
        ended=ended,
        status=status,
        told=told,
        still_when_cleared=standstill(cleared, cleared[0].time) == 0.0 and not moves_again(cleared, cleared[0].time),
        left_running=left,
        episodes=readable_episodes(dataset),
    )


def _look_on(fault: Fault, victim: Victim, samples: list[Sample], begin: float) -> float | None:
    """Looks at the arm until a little after the end of the command; seconds until that end, `None` if it hangs."""
    release, ended = fault.release, None
    while (now := time.monotonic() - begin) < HANG_SECONDS:
        samples.append(_look(victim.twin))
        if release is not None and now > RELEASE_SECONDS:
            release(victim)
            release = None
        if ended is None and victim.command.has_ended:
            ended = now
        if ended is not None and now > ended + WATCH_SECONDS:
            break
    return ended


def _left_running(children: list[psutil.Process]) -> tuple[str, ...]:
    """Processes that are still there a few seconds after the end of the one that started them."""
    _, left = psutil.wait_procs(children, timeout=5.0)
    found = []
    for child in left:
        with contextlib.suppress(psutil.NoSuchProcess):  # it ended just now
            if child.status() != psutil.STATUS_ZOMBIE:
                found.append(child.name())
    return tuple(found)
