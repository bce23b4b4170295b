"""What all pictures share."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

DOOR_COLORS = {
    "push": "#4477aa",
    "pull": "#ee9955",
    "slide": "#66aa88",
    "slide_right": "#aa6699",
    "push_ccw": "#223b55",
    "pull_ccw": "#8a5020",
    "slide_ccw": "#335544",
    "slide_right_ccw": "#5f3054",
    "turn_cw": "#888888",
    "turn_ccw": "#555555",
}
"""Colour of each kind of door, which is also a direction in which one can be tried, and of turns of its knob."""


@contextmanager
def picture(path: Path, width: float, height: float, dpi: int = 150) -> Iterator[Figure]:
    """An empty figure of so many inches, which is then written to `path`; its ending chooses the format."""
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=dpi)
