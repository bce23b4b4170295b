"""Measuring times side by side: calls that take turns on one core, and pages that say on which machine."""

import gc
import json
import os
import platform
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from lerobot_ufrnn.analysis.results import markdown

PACKAGES = ("torch", "numba", "jax", "diffusers", "lerobot", "mujoco", "numpy")  # whose versions matter


def take_turns(
    calls: Mapping[Any, Callable[[], object]], seconds: float, min_rounds: int = 3, warm_up: int = 1
) -> pd.DataFrame:
    """Calls each in turn, round after round, without garbage collection; milliseconds, a row a round."""
    for call in calls.values():
        for _ in range(warm_up):
            call()
    rows: list[dict[str, float]] = []
    gc.collect()
    gc.disable()
    try:
        end = time.perf_counter() + seconds
        while len(rows) < min_rounds or time.perf_counter() < end:
            rows.append({})
            for name, call in calls.items():
                start = time.perf_counter()
                call()
                rows[-1][name] = 1e3 * (time.perf_counter() - start)
    finally:
        gc.enable()
    return pd.DataFrame(rows)


@contextmanager
def one_core() -> Iterator[None]:
    """One core for this thread and those that it starts; the last one, since the first usually serves interrupts."""
    torch.set_num_threads(1)
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def text(values: pd.Series) -> str:
    """Median and middle 80 %."""
    low, median, high = np.percentile(values, (10, 50, 90))
    return f"{median:.3g} [{low:.3g}, {high:.3g}]"


def describe_machine() -> dict[str, str]:
    """Processor, cores and versions; nothing that names the machine or its user."""
    info = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    model = re.search(r"^model name\s*:\s*(.+)$", info, re.MULTILINE)
    machine = {
        "processor": model[1] if model else platform.processor() or "unknown",
        "AVX-512": ("yes" if " avx512f" in info else "no") if info else "unknown",
        "cores": str(os.cpu_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
    return machine | {name: version(name) if find_spec(name) else "not installed" for name in PACKAGES}


def write(name: str, note: str | None, table: pd.DataFrame, output_dir: Path) -> None:
    """Prints a table, and writes `<name>.md` to read and `<name>.json` to compute with."""
    machine = describe_machine()
    page = f"# Benchmark: {name}\n\n{', '.join(f'{key} {value}' for key, value in machine.items())}\n\n"
    page += f"{' '.join((note or '').split())} Medians with [10th, 90th percentile].\n\n{markdown(table)}"
    output_dir.mkdir(parents=True, exist_ok=True)
    (output_dir / f"{name}.md").write_text(page)
    content = {"machine": machine, "table": table.to_dict("records")}
    (output_dir / f"{name}.json").write_text(json.dumps(content, indent=2) + "\n")
    print(page, flush=True)
