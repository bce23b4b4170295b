"""A picture of hidden states on their plane: demonstrations dotted, a trial solid (UF-RNN, Figs. 5 and 7)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..networks import HiddenState
from .colors import DOOR_COLORS
from .hidden_states import Plane
from .trial import TrialHistory

OTHER_COLOR = "#999999"
HELD_COLOR = "#ffcc33"
PANELS_PER_ROW = 3
DOT_SPACING = 4.5
"""From dot to dot of a dotted line, in line widths."""


@dataclass(frozen=True)
class HiddenPaths:
    """`h_shared` of one model on the plane of its demonstrations.

    Attributes:
        label (`str`): name of the model.
        kinds (`list[str]`): kind of each demonstration.
        demonstrations (`list[np.ndarray]`): path of each, (L, 2).
        trial (`np.ndarray`): path of the trial, (L, 2).
        shares (`tuple[float, float]`): share of the demonstrations' variance along each axis.
        history (`TrialHistory`): the trial.
    """

    label: str
    kinds: list[str]
    demonstrations: list[np.ndarray]
    trial: np.ndarray
    shares: tuple[float, float]
    history: TrialHistory

    @classmethod
    def of(cls, label: str, kinds: list[str], states: Sequence[HiddenState], history: TrialHistory) -> "HiddenPaths":
        """Fits the plane to the states along demonstrations and puts them and a trial on it."""
        plane = Plane.fit(torch.cat([of_episode.h_shared for of_episode in states]))
        first, second = plane.shares.tolist()
        return cls(
            label,
            kinds,
            [plane.project(of_episode.h_shared).cpu().numpy() for of_episode in states],
            plane.project(HiddenState.stack(history.states).h_shared[:, 0]).cpu().numpy(),
            (first, second),
            history,
        )


def draw(models: Sequence[HiddenPaths], path: Path) -> None:
    """Draws a panel a model and writes them to `path`, whose ending chooses the format.

    Each demonstration is a pale line, the mean of each kind a dotted one. The trial is the black line; what it tries
    shows in the colour of that kind, and the time for which somebody held the door is highlighted.
    """
    num_columns = min(len(models), PANELS_PER_ROW)
    num_rows = -(-len(models) // num_columns)
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(3.4 * num_columns, 0.6 + 3.2 * num_rows), layout="constrained")
        panels = figure.subplots(num_rows, num_columns, squeeze=False).flatten()
        for panel, model in zip(panels, models, strict=False):
            _draw_model(panel, model)
        for panel in panels[len(models) :]:
            panel.set_visible(False)
        kinds = dict.fromkeys(
            kind for model in models for kind in (*model.kinds, *(way for _, way in model.history.attempts))
        )
        figure.legend(
            handles=_legend(list(kinds), with_held=any(model.history.held for model in models)),
            loc="outside lower center",
            ncols=min(4, 2 * num_columns),
            frameon=False,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


def _draw_model(panel: Axes, model: HiddenPaths) -> None:
    kinds, history = list(dict.fromkeys(model.kinds)), model.history
    for number, kind in enumerate(kinds):
        color = DOOR_COLORS.get(kind, OTHER_COLOR)
        paths = [path for path, of_kind in zip(model.demonstrations, model.kinds, strict=True) if of_kind == kind]
        for path in paths:
            panel.plot(*path.T, color=color, linewidth=0.5, alpha=0.2)
        shortest = min(map(len, paths))
        mean = np.mean([path[:shortest] for path in paths], axis=0)
        # Dots of one kind fall between those of the others where their paths agree.
        dots = (DOT_SPACING * number / len(kinds), (1, DOT_SPACING - 1))
        panel.plot(*mean.T, color=color, linestyle=dots, linewidth=2)
    if history.held:
        panel.plot(*model.trial[history.held].T, color=HELD_COLOR, linewidth=6, alpha=0.6, solid_capstyle="round")
    panel.plot(*model.trial.T, color="black", linewidth=0.8)
    panel.plot(*model.trial[0], "k.", markersize=8)
    for number, (step, direction) in enumerate(history.attempts):
        panel.plot(
            *model.trial[step],
            marker="o" if number == 0 else "s",
            markersize=9 if number == 0 else 5,
            markerfacecolor=DOOR_COLORS.get(direction, OTHER_COLOR),
            markeredgecolor="black",
        )
    if history.success:
        panel.plot(*model.trial[-1], marker="*", markersize=13, markerfacecolor="white", markeredgecolor="black")
    result = f"opened at step {len(model.trial) - 1}" if history.success else "not opened"
    first_try = "no try"
    if history.attempts:
        first_try = f"first try {history.attempts[0].direction} at step {history.attempts[0].step}"
    panel.set_title(f"{model.label}\n{history.door_kind} door: {first_try},\n{result}", fontsize=9)
    first, second = model.shares
    panel.set(xlabel=f"PC 1 ({first:.0%})", ylabel=f"PC 2 ({second:.0%})")


def _legend(kinds: list[str], with_held: bool) -> list[Line2D]:
    def marker(shape: str, size: float, face: str, label: str) -> Line2D:
        style: dict[str, Any] = {
            "markersize": size,
            "markerfacecolor": face,
            "markeredgecolor": "black",
            "linestyle": "none",
        }
        return Line2D([], [], marker=shape, label=label, **style)

    handles = [
        Line2D([], [], color=DOOR_COLORS.get(kind, OTHER_COLOR), linestyle=":", linewidth=2, label=f"{kind} (offline)")
        for kind in kinds
    ]
    handles.append(Line2D([], [], color="black", linewidth=0.8, label="trial (online)"))
    if with_held:
        handles.append(Line2D([], [], color=HELD_COLOR, linewidth=6, alpha=0.6, label="door held"))
    handles.append(marker(".", 8, "black", "start of the trial"))
    tries = [marker("o", 9, "white", "first try"), marker("s", 5, "white", "further try")]
    return [*handles, *tries, marker("*", 13, "white", "opened")]


def to_table(models: Sequence[HiddenPaths]) -> pd.DataFrame:
    """The numbers: one row a step of a demonstration or of the trial, which says what was tried at it and if held."""
    parts = []
    for model in models:
        names = [str(number) for number in range(len(model.kinds))] + ["trial"]
        kinds = [*model.kinds, model.history.door_kind]
        for name, kind, points in zip(names, kinds, [*model.demonstrations, model.trial], strict=True):
            part = pd.DataFrame({"model": model.label, "path": name, "kind": kind, "step": range(len(points))})
            part[["pc1", "pc2"]] = points
            tried = dict(model.history.attempts) if name == "trial" else {}
            part["tried"] = part["step"].map(tried).fillna("")
            part["held"] = part["step"].isin(model.history.held if name == "trial" else []).astype(int)
            parts.append(part)
    return pd.concat(parts)
