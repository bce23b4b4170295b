"""How does success rise over the epochs of training, door by door? Draws experiments/results/success_curve.png.

python experiments/curve.py
"""

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter
from script import run
from tables import RESULTS, SUCCESS_COUNTS, read_table

from lerobot_ufrnn.analysis.picture import DOOR_COLORS


@dataclass
class CurveConfig:
    """What to draw."""

    results: Path = RESULTS / "door_protocol.csv"  # table that `sweep.py` wrote
    output: Path = RESULTS / "success_curve.png"  # picture to write


def draw(table: pd.DataFrame, path: Path) -> None:
    """Draws a panel for each model with several epochs.

    The stacked areas are the doors of each kind that were opened within 30 s, as a share of all trials of all networks,
    so that their upper edge is the success rate. Each thin line is the success rate of one network.
    """
    epochs = table.groupby("model").epoch.nunique()
    models = list(epochs[epochs > 1].index)
    if not models:
        raise ValueError("No model of the table was tried at several epochs: run sweep.py with --epochs.")
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(1 + 2.9 * len(models), 3.2), layout="constrained")
        panels = figure.subplots(1, len(models), sharey=True, squeeze=False)[0]
        for panel, model in zip(panels, models, strict=True):
            _draw_model(panel, table[table.model == model])
            panel.set_title(model, fontsize=10, parse_math=False)
        figure.supylabel("doors opened within 30 s", fontsize=9)
        figure.supxlabel("epoch of training", fontsize=9)
        handles, labels = panels[0].get_legend_handles_labels()
        # The upper area first, as in the picture.
        figure.legend(handles[::-1], labels[::-1], loc="outside right upper", frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


def _draw_model(panel: Axes, table: pd.DataFrame) -> None:
    counts = table.pivot_table(index="epoch", columns="kind", values=["opened_300", "trials"], aggfunc="sum")
    kinds = [kind for kind in DOOR_COLORS if kind in set(table.kind)]
    shares = counts.opened_300[kinds].div(counts.trials.sum(axis=1), axis=0)  # (epochs, kinds)
    colors = [DOOR_COLORS[kind] for kind in kinds]
    panel.stackplot(shares.index, shares.T, labels=kinds, colors=colors, linewidth=0)
    networks = table.groupby(["epoch", "train_seed"])[["opened_300", "trials"]].sum()
    rates = (networks.opened_300 / networks.trials).unstack()  # (epochs, networks)
    for number, seed in enumerate(rates):
        label = "each training seed" if number == 0 else None
        panel.plot(rates[seed].dropna(), "o-k", linewidth=0.6, markersize=1, clip_on=False, label=label)
    panel.set(ylim=(0, 1), xlim=(0, shares.index[-1]))
    panel.grid(axis="y", color="0.9", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.yaxis.set_major_formatter(PercentFormatter(1))
    panel.xaxis.set_major_locator(MaxNLocator(3, integer=True, steps=[1, 2, 5, 10]))


def main(config: CurveConfig) -> None:
    """Writes the picture."""
    draw(read_table(config.results, SUCCESS_COUNTS), config.output)
    print(f"Success over epochs: {config.output}")


if __name__ == "__main__":
    run(main, CurveConfig)
