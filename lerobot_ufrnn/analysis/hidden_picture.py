"""A picture of hidden states on their plane: demonstrations dotted, a trial solid (UF-RNN, Figs. 5 and 7)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ..networks import HiddenState
from .hidden_states import Plane
from .picture import DOOR_COLORS, picture
from .trial import TrialHistory

OTHER_COLOR = "#999999"
HELD: dict[str, Any] = {"color": "#ffcc33", "linewidth": 6.0, "alpha": 0.6}
MARKERS: dict[str, dict[str, Any]] = {
    "start of the trial": {"marker": ".", "markersize": 8, "markerfacecolor": "black"},
    "first try": {"marker": "o", "markersize": 9},
    "further try": {"marker": "s", "markersize": 5},
    "opened": {"marker": "*", "markersize": 13},
}
DOT_SPACING = 4.5
"""From dot to dot of a dotted line, in line widths."""


class HiddenPaths(NamedTuple):
    """`h_shared` of one model on the plane of its demonstrations."""

    table: pd.DataFrame  # a row a step: path (number of the demonstration, or trial), kind, step, pc1, pc2, tried, held
    shares: Sequence[float]  # share of the demonstrations' variance along each axis
    history: TrialHistory

    @property
    def demonstrations(self) -> pd.DataFrame:
        """`pd.DataFrame`: the table without the trial."""
        return self.table[self.table["path"] != "trial"]

    @classmethod
    def of(cls, kinds: Sequence[str], states: Sequence[HiddenState], history: TrialHistory) -> "HiddenPaths":
        """Fits the plane to the states along demonstrations of these kinds, and puts them and a trial on it."""
        plane = Plane.fit(torch.cat([of_episode.h_shared for of_episode in states]))
        paths = [(str(number), *path) for number, path in enumerate(zip(kinds, states, strict=True))]
        paths.append(("trial", history.door_kind, HiddenState.stack(history.states).at((slice(None), 0))))
        parts = []
        for name, kind, of_path in paths:
            points = plane.project(of_path.h_shared).cpu().numpy()
            part = pd.DataFrame({"path": name, "kind": kind, "step": range(len(points))})
            parts.append(part.assign(pc1=points[:, 0], pc2=points[:, 1]))
        table = pd.concat(parts, ignore_index=True)
        in_trial = table["path"] == "trial"
        table["tried"] = table["step"].where(in_trial).map(dict(history.attempts)).fillna("")
        table["held"] = (in_trial & table["step"].isin(history.held)).astype(int)
        return cls(table, plane.shares.tolist(), history)


def draw(models: Mapping[str, HiddenPaths], path: Path) -> None:
    """Draws a panel a model and writes them to `path`.

    Each demonstration is a pale line, the mean of each kind a dotted one. The trial is the black line; what it tries
    shows in the colour of that kind, and the time for which somebody held the door is highlighted.
    """
    with picture(path, 3.4 * len(models), 3.8) as figure:
        panels = figure.subplots(1, len(models), squeeze=False)[0]
        for panel, (label, model) in zip(panels, models.items(), strict=True):
            _draw_model(panel, label, model)
        kinds = dict.fromkeys(
            kind
            for model in models.values()
            for kind in (*model.demonstrations["kind"], *(way for _, way in model.history.attempts))
        )
        handles = [
            Line2D([], [], color=_color(kind), linestyle=":", linewidth=2, label=f"{kind} (offline)") for kind in kinds
        ]
        handles.append(Line2D([], [], color="black", linewidth=0.8, label="trial (online)"))
        if any(model.history.held for model in models.values()):
            handles.append(Line2D([], [], label="door held", **HELD))
        handles += [Line2D([], [], label=name, **_marker(name)) for name in MARKERS]
        figure.legend(handles=handles, loc="outside lower center", ncols=min(4, 2 * len(models)), frameon=False)


def _draw_model(panel: Axes, label: str, model: HiddenPaths) -> None:
    history, trial = model.history, model.table.loc[model.table["path"] == "trial", ["pc1", "pc2"]].to_numpy()
    kinds = model.demonstrations.groupby("kind", sort=False)
    for number, (kind, of_kind) in enumerate(kinds):
        paths = of_kind.pivot(index="step", columns="path", values=["pc1", "pc2"])
        panel.plot(paths["pc1"], paths["pc2"], color=_color(kind), linewidth=0.5, alpha=0.2)
        mean = [paths.dropna()[axis].mean(axis=1) for axis in ("pc1", "pc2")]  # as long as the shortest
        # Dots of one kind fall between those of the others where their paths agree.
        dots = (DOT_SPACING * number / len(kinds), (1, DOT_SPACING - 1))
        panel.plot(*mean, color=_color(kind), linestyle=dots, linewidth=2)
    panel.plot(*trial[history.held].T, solid_capstyle="round", **HELD)
    panel.plot(*trial.T, color="black", linewidth=0.8)
    panel.plot(*trial[0], **_marker("start of the trial"))
    for number, (step, direction) in enumerate(history.attempts):
        panel.plot(*trial[step], **_marker("further try" if number else "first try", markerfacecolor=_color(direction)))
    if history.success:
        panel.plot(*trial[-1], **_marker("opened"))
    first_try = "first try {1} at step {0}".format(*history.attempts[0]) if history.attempts else "no try"
    result = f"opened at step {len(trial) - 1}" if history.success else "not opened"
    panel.set_title(f"{label}\n{history.door_kind} door: {first_try},\n{result}", fontsize=9)
    first, second = model.shares
    panel.set(xlabel=f"PC 1 ({first:.0%})", ylabel=f"PC 2 ({second:.0%})")


def _color(kind: str) -> str:
    return DOOR_COLORS.get(kind, OTHER_COLOR)


def _marker(name: str, **style: Any) -> dict[str, Any]:
    return {"linestyle": "none", "markeredgecolor": "black", "markerfacecolor": "white"} | MARKERS[name] | style
