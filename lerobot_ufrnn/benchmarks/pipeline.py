"""Seconds and memory of each stage of `ufrnn demo`, from outside."""

import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

SAMPLE_SECONDS = 0.25
STAGE_LINE = re.compile(r"^\[\d+/\d+\] (\w+)$")
SPEED_LINE = re.compile(r"updt_s:([\d.]+) data_s:([\d.]+)")
ENCODED_LINE = "Autoencoder done"


@dataclass(frozen=True)
class Stage:
    """What one stage took.

    Attributes:
        name (`str`): name of the stage.
        seconds (`float`): wall-clock time.
        peak_bytes (`int`): largest memory of all its processes together.
    """

    name: str
    seconds: float
    peak_bytes: int


@dataclass(frozen=True)
class TrainingSpeed:
    """Medians of what `lerobot-train` logs while the recurrent network trains on encoded episodes.

    Attributes:
        update_seconds (`float`): time of an update.
        data_seconds (`float`): time until the data loader gave the next batch.
    """

    update_seconds: float
    data_seconds: float


def measure_demo(output_dir: Path, flags: Sequence[str] = ()) -> tuple[list[Stage], TrainingSpeed | None]:
    """Runs `ufrnn demo` and watches it.

    Args:
        output_dir (`Path`):
            Empty or missing folder for the demo; `demo.log` beside it keeps what was printed.
        flags (`Sequence[str]`, *optional*):
            More flags of `ufrnn demo`.

    Returns:
        `tuple[list[Stage], TrainingSpeed | None]`: the stages, and the speed of training where it was logged.

    Raises:
        ValueError: If the folder has a demo already, whose stages would be skipped.
        RuntimeError: If the demo fails.
    """
    if output_dir.exists() and any(output_dir.iterdir()):
        raise ValueError(f"'{output_dir}' is not empty: a demo that is half done already cannot be measured.")
    command = [sys.executable, "-u", "-m", "lerobot_ufrnn.commands", "demo", f"--output_dir={output_dir}", *flags]
    log = output_dir.with_name("demo.log")
    stages = watch(command, log)
    return stages, training_speed(log.read_text().splitlines())


def watch(command: Sequence[str], log: Path) -> list[Stage]:
    """Runs a command that announces its stages as `[1/4] name`.

    Args:
        command (`Sequence[str]`):
            Program and arguments.
        log (`Path`):
            Where to write what it prints.

    Returns:
        `list[Stage]`: the stages in their order. What comes before the first counts to it.

    Raises:
        RuntimeError: If it fails or announces no stage.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    starts: list[tuple[str, float]] = []
    samples: list[tuple[float, int]] = []
    begin = time.perf_counter()
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", bufsize=1
    )
    reader = threading.Thread(target=_read, args=(process, log, starts), daemon=True)
    reader.start()
    try:
        while process.poll() is None:
            samples.append((time.perf_counter(), _tree_bytes(process.pid)))
            time.sleep(SAMPLE_SECONDS)
    finally:
        if process.poll() is None:
            process.terminate()
        process.wait()
        reader.join()
    end = time.perf_counter()
    if process.returncode != 0 or not starts:
        last_lines = "\n".join(log.read_text().splitlines()[-20:])
        raise RuntimeError(f"The measured command ended with status {process.returncode}:\n{last_lines}")
    bounds = [begin, *(start for _, start in starts[1:]), end]
    return [
        Stage(
            name,
            bounds[number + 1] - bounds[number],
            max((size for moment, size in samples if bounds[number] <= moment < bounds[number + 1]), default=0),
        )
        for number, (name, _) in enumerate(starts)
    ]


def training_speed(lines: Iterable[str]) -> TrainingSpeed | None:
    """Speed of the recurrent network's training, from the lines that `lerobot-train` logged.

    Args:
        lines (`Iterable[str]`):
            Everything that was printed.

    Returns:
        `TrainingSpeed | None`: medians over the logged windows; `None` if there is none after the autoencoder's end.
    """
    speeds: list[tuple[float, float]] = []
    encoded = False
    for line in lines:
        encoded = encoded or ENCODED_LINE in line
        if encoded and (found := SPEED_LINE.search(line)):
            speeds.append((float(found[1]), float(found[2])))
    # The first window ends with the autoencoder's last update.
    if len(speeds) < 2:
        return None
    return TrainingSpeed(*(float(value) for value in np.median(speeds[1:], axis=0)))


def _read(process: subprocess.Popen[str], log: Path, starts: list[tuple[str, float]]) -> None:
    assert process.stdout is not None
    with log.open("w") as file:
        for line in process.stdout:
            file.write(line)
            if found := STAGE_LINE.match(line.strip()):
                starts.append((found[1], time.perf_counter()))


def _tree_bytes(pid: int) -> int:
    """Memory of a process and its children; what they share counts once where the system can tell."""
    total = 0
    try:
        root = psutil.Process(pid)
        processes = [root, *root.children(recursive=True)]
    except psutil.NoSuchProcess:
        return 0
    for process in processes:
        try:
            info = process.memory_full_info()
            total += getattr(info, "pss", 0) or info.rss
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return total
