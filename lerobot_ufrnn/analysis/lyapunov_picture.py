"""A picture of Lyapunov exponents over time, model by model (UF-RNN, Fig. 6)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

STYLES = (("#cc3311", "-"), ("#0077bb", "--"), ("#555555", "-."), ("#009988", ":"), ("#ee7733", "-"), ("#aa3377", "--"))

Curves = Mapping[str, Sequence[np.ndarray]]
"""For each model its largest local exponent in 1/step at each step of each demonstration, (L,) each."""


def draw(curves: Curves, phases: Mapping[str, Sequence[int]], num_steps: int, path: Path) -> None:
    """Draws mean and standard deviation over the demonstrations for each model and writes them to `path`.

    `phases` has the steps at which phases of the task begin in the demonstrations, and may be empty; `num_steps` is the
    number of imagined steps.
    """
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(7, 3), layout="constrained")
        axes = figure.subplots()
        for name, starts in phases.items():
            axes.axvspan(min(starts) - 0.5, max(starts) + 0.5, color="#dddddd", linewidth=0, zorder=0)
            axes.text(float(np.mean(starts)), 1.02, name, transform=axes.get_xaxis_transform(), ha="center", fontsize=7)
        axes.axhline(0, color="black", linewidth=0.6)
        for number, (label, exponents) in enumerate(curves.items()):
            color, line = STYLES[number % len(STYLES)]
            mean, deviation = statistics(exponents)
            axes.fill_between(mean.index, mean - deviation, mean + deviation, color=color, alpha=0.2, linewidth=0)
            axes.plot(mean, color=color, linestyle=line, linewidth=1.5, label=label)
        axes.set(xlabel="step", ylabel=f"largest Lyapunov exponent\nover {num_steps} imagined steps (1/step)")
        axes.margins(x=0.01)
        axes.legend(frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


def statistics(exponents: Sequence[np.ndarray]) -> tuple[pd.Series, pd.Series]:
    """Mean and standard deviation over demonstrations of any length, by step."""
    over_time = pd.DataFrame([*exponents])  # missing where a demonstration is over
    return over_time.mean(), over_time.std(ddof=0)


def to_table(curves: Curves) -> pd.DataFrame:
    """The numbers: one row a step of a demonstration."""
    demonstrations = {
        (label, number): pd.Series(values, name="exponent")
        for label, exponents in curves.items()
        for number, values in enumerate(exponents)
    }
    return pd.concat(demonstrations, names=("model", "demonstration", "step")).reset_index()
