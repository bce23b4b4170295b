"""A picture of Lyapunov exponents over time, model by model (UF-RNN, Fig. 6)."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

STYLES = (("#cc3311", "-"), ("#0077bb", "--"), ("#555555", "-."), ("#009988", ":"), ("#ee7733", "-"), ("#aa3377", "--"))


@dataclass(frozen=True)
class ExponentCurves:
    """Exponents of one model.

    Attributes:
        label (`str`): name of the model.
        exponents (`list[np.ndarray]`): largest local exponent in 1/step at each step of each demonstration, (L,) each.
    """

    label: str
    exponents: list[np.ndarray]

    @property
    def statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """`tuple[np.ndarray, np.ndarray]`: mean and standard deviation over the demonstrations, (longest L,) each."""
        padded = np.full((len(self.exponents), max(map(len, self.exponents))), np.nan)
        for row, values in zip(padded, self.exponents, strict=True):
            row[: len(values)] = values
        return np.nanmean(padded, axis=0), np.nanstd(padded, axis=0)


def draw(curves: Sequence[ExponentCurves], phases: Mapping[str, Sequence[int]], num_steps: int, path: Path) -> None:
    """Draws mean and standard deviation over the demonstrations for each model and writes them to `path`.

    Args:
        curves (`Sequence[ExponentCurves]`):
            The models.
        phases (`Mapping[str, Sequence[int]]`):
            Phases of the task and the steps at which they begin in the demonstrations; may be empty.
        num_steps (`int`):
            Number of imagined steps, for the label.
        path (`Path`):
            Where to write the picture; its ending chooses the format.
    """
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(7, 3), layout="constrained")
        axes = figure.subplots()
        for name, starts in phases.items():
            axes.axvspan(min(starts) - 0.5, max(starts) + 0.5, color="#dddddd", linewidth=0, zorder=0)
            axes.text(float(np.mean(starts)), 1.02, name, transform=axes.get_xaxis_transform(), ha="center", fontsize=7)
        axes.axhline(0, color="black", linewidth=0.6)
        for number, curve in enumerate(curves):
            color, line = STYLES[number % len(STYLES)]
            mean, deviation = curve.statistics
            steps = np.arange(len(mean))
            axes.fill_between(steps, mean - deviation, mean + deviation, color=color, alpha=0.2, linewidth=0)
            axes.plot(steps, mean, color=color, linestyle=line, linewidth=1.5, label=curve.label)
        axes.set(xlabel="step", ylabel=f"largest Lyapunov exponent\nover {num_steps} imagined steps (1/step)")
        axes.margins(x=0.01)
        axes.legend(frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


def to_csv(curves: Sequence[ExponentCurves]) -> str:
    """The numbers: one row a step of a demonstration."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("model", "demonstration", "step", "exponent"))
    for curve in curves:
        for demonstration, exponents in enumerate(curve.exponents):
            writer.writerows((curve.label, demonstration, step, f"{value:.5f}") for step, value in enumerate(exponents))
    return text.getvalue()
