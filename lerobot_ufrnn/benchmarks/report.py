"""Writes measurements as Markdown to read and as JSON to compute with."""

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("torch", "numba", "jax", "diffusers", "lerobot", "mujoco", "numpy")


@dataclass(frozen=True)
class Target:
    """What was promised, and what was measured.

    Attributes:
        name (`str`): what is promised.
        value (`float`, *optional*): what was measured; `None` if it could not be.
        limit (`float`): the bound.
        at_least (`bool`): whether the bound is the least or the largest value allowed.
    """

    name: str
    value: float | None
    limit: float
    at_least: bool

    @property
    def verdict(self) -> str:
        """`str`: `met`, `not met` or `not measured`."""
        if self.value is None:
            return "not measured"
        return "met" if (self.value >= self.limit if self.at_least else self.value <= self.limit) else "not met"


@dataclass(frozen=True)
class Section:
    """One table.

    Attributes:
        title (`str`): heading.
        columns (`Sequence[str]`): names of the columns.
        rows (`Sequence[Sequence[str]]`): cells, ready to print.
        note (`str`): what to know when reading it.
        targets (`Sequence[Target]`): what it decides.
        values (`Any`): the numbers behind the cells, for the JSON file.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    targets: Sequence[Target] = ()
    values: Any = field(default_factory=dict)


def describe_machine() -> dict[str, str]:
    """Processor, cores and versions; nothing that names the machine or its user."""
    machine = {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
    for package in PACKAGES:
        try:
            machine[package] = version(package)
        except PackageNotFoundError:
            machine[package] = "not installed"
    return machine


def to_markdown(title: str, sections: Sequence[Section], machine: dict[str, str]) -> str:
    """The report to read.

    Args:
        title (`str`):
            Heading.
        sections (`Sequence[Section]`):
            What was measured.
        machine (`dict[str, str]`):
            See `describe_machine`.

    Returns:
        `str`: verdicts first, then each table.
    """
    parts = [f"# {title}", ", ".join(f"{name} {value}" for name, value in machine.items())]
    parts.append("Values are medians with [10th, 90th percentile]; what is compared was measured in turns in one run.")
    targets = [target for section in sections for target in section.targets]
    if targets:
        rows = [
            (
                target.name,
                "-" if target.value is None else f"{target.value:.3g}",
                f"{'>=' if target.at_least else '<='} {target.limit:g}",
                target.verdict,
            )
            for target in targets
        ]
        parts.append(_table(("what", "measured", "target", "verdict"), rows))
    for section in sections:
        parts += [
            f"## {section.title}",
            *([section.note] if section.note else []),
            _table(section.columns, section.rows),
        ]
    return "\n\n".join(parts) + "\n"


def write_report(name: str, sections: Sequence[Section], output_dir: Path) -> None:
    """Writes `<name>.md` and `<name>.json`.

    Args:
        name (`str`):
            What was measured, in a word.
        sections (`Sequence[Section]`):
            What was measured.
        output_dir (`Path`):
            Folder; made if it is missing.
    """
    machine = describe_machine()
    output_dir.mkdir(parents=True, exist_ok=True)
    (output_dir / f"{name}.md").write_text(to_markdown(f"Benchmark: {name}", sections, machine))
    content = {
        "machine": machine,
        "targets": [{**asdict(target), "verdict": target.verdict} for s in sections for target in s.targets],
        "measurements": {section.title: section.values for section in sections},
    }
    (output_dir / f"{name}.json").write_text(json.dumps(content, indent=2) + "\n")


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"
