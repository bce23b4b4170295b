"""`ufrnn benchmark`: what the policy costs, beside the readable code, XLA, ACT and Diffusion Policy."""

import json
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..benchmarks import sections
from ..benchmarks.acting import measure_acting
from ..benchmarks.report import Section, write_report
from ..benchmarks.update import FAST, REFERENCE, SCAN, measure_update
from .flags import parse_flags

PARTS: dict[str, Callable[[float, Path], list[Section]]] = {
    "update": lambda seconds, _: [sections.of_update(seconds)],
    "acting": lambda seconds, _: [sections.of_acting(seconds)],
    "growth": lambda seconds, _: [sections.of_growth(seconds)],
    "environment": lambda seconds, _: [sections.of_environment(seconds)],
    "pipeline": lambda _, folder: sections.of_pipeline(folder / "demo"),
}
QUICK_SECONDS = 4.0
QUICK_TICKS = 1000


@dataclass
class BenchmarkConfig:
    """What to measure.

    Args:
        quick (`bool`, *optional*, defaults to `False`):
            Only the update and `select_action`, in under 50 s; the last line printed is a JSON object.
        output_dir (`Path`, *optional*, defaults to `outputs/benchmark`):
            Folder for a `.md` and a `.json` file of each part; nothing is written with `quick`.
        parts (`tuple[str, ...]`, *optional*, defaults to all of them):
            `update`, `acting`, `growth`, `environment` (steps a second) and `pipeline` (a whole `ufrnn demo`).
        seconds (`float`, *optional*, defaults to `60.0`):
            Time for each part's measurements, after compiling; Diffusion Policy and the demo take what they take.
    """

    quick: bool = False
    output_dir: Path = Path("outputs/benchmark")
    parts: tuple[str, ...] = tuple(PARTS)
    seconds: float = 60.0

    def __post_init__(self) -> None:
        unknown = [part for part in self.parts if part not in PARTS]
        if unknown or not self.parts:
            raise ValueError(f"--parts must be of {list(PARTS)}, got {list(self.parts)}.")
        if not self.seconds > 0:
            raise ValueError(f"--seconds must be above 0, got {self.seconds}.")


def run(arguments: list[str]) -> None:
    """Measures, prints and writes."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    config = parse_flags(BenchmarkConfig, ["--quick=true" if word == "--quick" else word for word in arguments])
    if config.quick:
        print(json.dumps(quick_figures()), flush=True)
        return
    with tempfile.TemporaryDirectory() as folder:
        for name in config.parts:
            print(f"measuring: {name}", flush=True)
            sections = PARTS[name](config.seconds, Path(folder))
            write_report(name, sections, config.output_dir)
            print((config.output_dir / f"{name}.md").read_text(), flush=True)


def quick_figures() -> dict[str, float | None]:
    """The figures to watch from day to day.

    Returns:
        `dict[str, float | None]`: how many times faster an update is than the reference, how many times the scan's time
            it takes (`None` without JAX), the 99th percentile of `select_action`, and the medians behind them.
    """
    update = measure_update(QUICK_SECONDS)
    acting = measure_acting(0, QUICK_TICKS)
    with_scan = update.with_scan
    figures = {
        "update_speedup_vs_reference": update.with_reference.ratio(REFERENCE, FAST).median,
        "update_ratio_vs_scan": None if with_scan is None else with_scan.ratio(FAST, SCAN).median,
        "select_action_p99_ms": 1e3 * acting.percentile(99),
        "update_ms": 1e3 * (with_scan or update.with_reference).spread(FAST).median,
        "update_reference_ms": 1e3 * update.with_reference.spread(REFERENCE).median,
        "update_scan_ms": None if with_scan is None else 1e3 * with_scan.spread(SCAN).median,
        "select_action_p50_ms": 1e3 * acting.percentile(50),
    }
    return {name: None if value is None else round(value, 4) for name, value in figures.items()}
