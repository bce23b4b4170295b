"""The contact sheet of suite.py: every task, and the path of one trial in which it was found out."""

import contextlib
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from networks import Network

from env_door.trials import Trial, read_trials
from env_forks.env import ForksEnv
from env_forks.tasks import TASKS

COLUMNS = 6
COLORS = "plasma"  # of a path, from its beginning to its end


def draw(table: pd.DataFrame, networks: Sequence[Network], path: Path) -> None:
    """Draws a panel for each task, with what the models opened after the most updates."""
    last = table[table.updates == table.updates.max()]
    names = [name for name in TASKS if name in set(last.task)]
    columns = min(COLUMNS, len(names))
    with matplotlib.rc_context({"font.size": 8}):
        figure = Figure(figsize=(2.1 * columns, 2.5 * math.ceil(len(names) / columns)), layout="constrained")
        for number, name in enumerate(names, start=1):
            panel = figure.add_subplot(math.ceil(len(names) / columns), columns, number)
            draw_trial(panel, name, telling_trial(name, networks))
            rates = [
                f"{model}: {100 * (rows.opened / rows.trials).mean():.0f} %"
                for model, rows in last[last.task == name].groupby("model")
            ]
            panel.set_title(name, fontsize=9, parse_math=False)
            panel.set_xlabel("\n".join(rates), fontsize=7, parse_math=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


def draw_trial(panel: Axes, name: str, trial: Trial | None) -> None:
    """Draws the task as it was when the trial began, its path from dark to bright, and the tries in their order."""
    task = TASKS[name]
    with contextlib.closing(ForksEnv(name, render_size=384)) as env:
        way = task.suites.index(trial.door_kind) if trial else 0
        env.reset(seed=trial.seed if trial else 0, options={"way": way})
        panel.imshow(env.render(), extent=(0, 1, 0, 1))
        ends = env.nodes[list(task.tree.ends)]
    panel.set(xticks=[], yticks=[], xlim=(0, 1), ylim=(0, 1))
    if trial is None:
        return
    points = np.array(trial.path)
    pieces = LineCollection(list(np.stack((points[:-1], points[1:]), 1)), cmap=COLORS, linewidths=2, capstyle="round")
    pieces.set_array(np.arange(len(points) - 1))
    panel.add_collection(pieces)
    for number, attempt in enumerate(dict.fromkeys(trial.attempts), start=1):
        x, y = ends[task.suites.index(attempt)]
        color = "tab:green" if attempt == trial.door_kind else "tab:red"
        panel.text(x, y, str(number), color="w", ha="center", va="center", bbox={"boxstyle": "circle", "color": color})


def telling_trial(name: str, networks: Iterable[Network]) -> Trial | None:
    """Of a task the trial with the most tries, those that were opened first: with the last checkpoint, unchanged."""
    trials = [
        trial
        for network in networks
        for tried in network.trials
        if tried.environment["task"] == name and tried.step == network.model.settings["steps"]
        if not tried.policy_flags and not network.missing(tried)
        for trial in read_trials(network.log_of(tried))
    ]
    return max(trials, key=lambda trial: (trial.success, len(set(trial.attempts)), -trial.steps), default=None)
