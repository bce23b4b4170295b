"""A picture of success over the epochs of training, door by door."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from .colors import DOOR_COLORS
from .evaluation_table import ProtocolRow, total

PANELS_PER_ROW = 3


def draw(rows: Sequence[ProtocolRow], path: Path) -> None:
    """Draws a panel a model and writes them to `path`.

    The stacked areas are the doors of each kind that were opened within 30 s, as a share of all trials and pooled over
    training seeds, so that their upper edge is the success rate. Each thin line is the success rate of one seed. Where
    there are models with several evaluated epochs, those with a single one are left out.

    Args:
        rows (`Sequence[ProtocolRow]`):
            The table.
        path (`Path`):
            Where to write the picture; its ending chooses the format.

    Raises:
        ValueError: If the table is empty.
    """
    epochs = {model: {row.epoch for row in rows if row.model == model} for model in {row.model for row in rows}}
    models = sorted(model for model in epochs if len(epochs[model]) > 1) or sorted(epochs)
    if not models:
        raise ValueError("There are no results to draw: the table is empty. `ufrnn protocol` fills it.")
    num_columns = min(len(models), PANELS_PER_ROW)
    num_rows = -(-len(models) // num_columns)
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(1 + 2.9 * num_columns, 0.6 + 2.6 * num_rows), layout="constrained")
        panels = figure.subplots(num_rows, num_columns, sharey=True, squeeze=False).flatten()
        for panel, model in zip(panels, models, strict=False):
            _draw_model(panel, [row for row in rows if row.model == model])
            panel.set_title(model, fontsize=10, parse_math=False)
        for panel in panels[len(models) :]:
            panel.set_visible(False)
        figure.supylabel("doors opened within 30 s", fontsize=9)
        figure.supxlabel("epoch of training", fontsize=9)
        handles, labels = panels[0].get_legend_handles_labels()
        # The upper area first, as in the picture.
        figure.legend(handles[::-1], labels[::-1], loc="outside right upper", frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


def _draw_model(panel: Axes, rows: Sequence[ProtocolRow]) -> None:
    epochs = sorted({row.epoch for row in rows})
    at_epoch = [[row for row in rows if row.epoch == epoch] for epoch in epochs]
    kinds = [kind for kind in DOOR_COLORS if kind in {row.kind for row in rows}]
    shares = np.array([
        [total([row for row in at if row.kind == kind], "opened_300") / total(at, "trials") for at in at_epoch]
        for kind in kinds
    ])  # (kinds, epochs)  # fmt: skip
    # One epoch has no width to fill: it becomes a bar.
    x = epochs if len(epochs) > 1 else [epochs[0] - 0.4, epochs[0] + 0.4]
    stacks = panel.stackplot(x, np.broadcast_to(shares, (len(kinds), len(x))), labels=kinds, linewidth=0)
    for stack, kind in zip(stacks, kinds, strict=True):
        stack.set_facecolor(DOOR_COLORS[kind])
    for number, seed in enumerate(sorted({row.train_seed for row in rows})):
        of_seed = [[row for row in at if row.train_seed == seed] for at in at_epoch]
        points = [
            (epoch, total(at, "opened_300") / total(at, "trials"))
            for epoch, at in zip(epochs, of_seed, strict=True)
            if at
        ]
        panel.plot(
            *zip(*points, strict=True),
            color="black",
            linewidth=0.6,
            clip_on=False,
            marker="o",
            markersize=3 if len(epochs) == 1 else 1,
            label="each training seed" if number == 0 else None,
        )
    panel.set(ylim=(0, 1), xlim=(0, x[-1]) if len(epochs) > 1 else (x[0] - 0.6, x[-1] + 0.6))
    panel.grid(axis="y", color="0.9", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.yaxis.set_major_formatter(PercentFormatter(1))
    if len(epochs) == 1:
        panel.set_xticks(epochs)
    else:
        panel.xaxis.set_major_locator(MaxNLocator(3, integer=True, steps=[1, 2, 5, 10]))
