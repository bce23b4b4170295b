"""Is every saved episode kept when the computer loses power? Simulated, on Linux as root.

Recordings go to an ext4 file system in a file. At a random moment they are stopped, and the file is copied: the copy
has what was written to the disk, not what was still in memory. It is mounted and read as after a loss of power. As a
control, some recordings do not wait for the disk. What a drive loses of its own write cache is not simulated.
"""

import os
import random
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from jobs import replace_text
from kill_recording import RECORDERS, STOCK, begin, readable_episodes, saved_episodes, work
from script import run

from env_door.checks import check_range
from lerobot_ufrnn.analysis.results import markdown


@dataclass
class PowerLossConfig:
    """How often to try, and where the table goes."""

    trials: int = 4  # with each way to record
    controls: int = 1  # the same without waiting for the disk
    max_seconds: float = 3.0  # latest moment of the loss after the recording has begun, in s
    seed: int = 0  # of the moments
    output: Path | None = Path("experiments/results/power_loss.md")  # where the table goes

    def __post_init__(self) -> None:
        check_range(self, "trials", low=1)
        check_range(self, "controls", low=0)
        check_range(self, "max_seconds", low=0.1, high=60, unit="s")


def work_without_waiting(name: str, root: Path, first: int, log: Path) -> None:
    """Body of a control."""
    os.fsync = lambda fd: None
    work(name, root, first, log)


@contextmanager
def mounted(image: Path, folder: Path) -> Iterator[None]:
    """Mounts a file system in a file."""
    subprocess.run(["mount", "-o", "loop", image, folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


def lose_power(name: str, waits: bool, seconds: float, folder: Path) -> tuple[int, int | str]:
    """Records until the power is lost; returns how many episodes were saved, and how many are readable, or why not."""
    image, copy, place, log = (folder / part for part in ("image", "copy", "place", "log"))
    place.mkdir(exist_ok=True)
    with image.open("wb") as file:
        file.truncate(64 * 2**20)
    subprocess.run(["mkfs.ext4", "-q", "-F", image], check=True)
    with mounted(image, place):
        (place / "recordings").mkdir()
        os.sync()
        root = place / "recordings" / "dataset"
        process, _ = begin(name, root, 0, log, work if waits else work_without_waiting)
        assert process.pid is not None
        time.sleep(seconds)
        os.kill(process.pid, signal.SIGSTOP)
        saved = saved_episodes(log)
        assert saved is not None
        subprocess.run(["cp", image, copy], check=True)
        process.kill()
        process.join()
        time.sleep(0.5)  # for what else it had started
    with mounted(copy, place):
        return saved, readable_episodes(root)


def main(config: PowerLossConfig) -> None:
    """Tries, prints the table and writes it; fails if something was lost although the recording waited for the disk."""
    rng = random.Random(config.seed)
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in RECORDERS:
            for waits, trials in ((True, config.trials), (False, config.controls)):
                if name == STOCK or not trials:
                    continue
                row = {"losses of power": trials, "episodes saved": 0, "episodes lost": 0, "unreadable": 0}
                for _ in range(trials):
                    saved, found = lose_power(name, waits, rng.uniform(0, config.max_seconds), Path(folder))
                    print(f"{name}{'' if waits else ', control'}: {saved} were saved, readable: {found}", flush=True)
                    row["episodes saved"] += saved
                    row["episodes lost"] += saved if isinstance(found, str) else max(saved - found, 0)
                    row["unreadable"] += isinstance(found, str)
                rows.append({"command": name, "waits for the disk": "yes" if waits else "no (control)", **row})
    table = markdown(pd.DataFrame(rows))
    print(table)
    if config.output:
        replace_text(config.output, table)
    if any(row["episodes lost"] for row in rows if row["waits for the disk"] == "yes"):
        raise RuntimeError("episodes were lost whose saving had returned")


if __name__ == "__main__":
    run(main, PowerLossConfig)
