"""Draws the plane from above, in numpy: the same pixels on every machine, and no OpenGL."""

import numpy as np

from env_forks.tasks import Task

WALL, FLOOR, GATE, DISC = (60, 60, 60), (200, 200, 200), (120, 80, 40), (220, 30, 30)
LAMP_OFF, LAMP_ON = (30, 30, 30), (250, 240, 60)
CUES = ((240, 40, 40), (40, 240, 40), (40, 40, 240))
SIGN = np.array([-0.25, 0.1])  # where lamp and cue are, seen from the start
GATE_RADIUS, DISC_RADIUS, SIGN_RADIUS = 0.03, 0.035, 0.09
HALF_BLOCK = (0.045, 0.03)  # across its way and along it
EDGE = 0.03  # by which the floor is wider than where the middle of the disc may be


class Picture:
    """Draws one trial; what does not move is drawn once."""

    def __init__(self, task: Task, nodes: np.ndarray, way: int, size: int):
        self._size = size
        rows, columns = np.mgrid[0:size, 0:size]
        self._points = np.stack(((columns + 0.5) / size, 1 - (rows + 0.5) / size), -1)
        self._sign = nodes[0] + SIGN
        self._lamp = task.lamp
        self._floor = np.full((size, size, 3), WALL, float)
        gap = np.full((size, size), np.inf)
        for node, parent in enumerate(task.tree.parents[1:], start=1):
            along = nodes[node] - nodes[parent]
            fraction = np.clip((self._points - nodes[parent]) @ along / (along @ along), 0, 1)
            middles = nodes[parent] + fraction[..., None] * along
            gap = np.minimum(gap, np.linalg.norm(self._points - middles, axis=-1))
        self._paint(self._floor, task.play + EDGE - gap, FLOOR)
        gates = task.gates(nodes)
        along = nodes[list(task.tree.ends)] - gates
        self._headings = along / np.linalg.norm(along, axis=1, keepdims=True) if task.contact else None
        if not task.contact:
            for gate in gates:
                self._disc(self._floor, gate, GATE_RADIUS, GATE)
        if task.cue:
            self._disc(self._floor, self._sign, SIGN_RADIUS, CUES[way])

    def draw(self, position: np.ndarray, gates: np.ndarray, lit: bool) -> np.ndarray:
        """The picture `(size, size, 3)` now; of the gates only blocks move."""
        canvas = self._floor.copy()
        if self._headings is not None:
            for block, (x, y) in zip(gates, self._headings, strict=True):
                near = self._near(block, np.hypot(*HALF_BLOCK))
                turned = np.abs((self._points[near] - block) @ np.array([[y, x], [-x, y]]))
                self._paint(canvas[near], (HALF_BLOCK - turned).min(-1), GATE)
        if self._lamp:
            self._disc(canvas, self._sign, SIGN_RADIUS, LAMP_ON if lit else LAMP_OFF)
        self._disc(canvas, position, DISC_RADIUS, DISC)
        return canvas.astype(np.uint8)

    def _disc(self, canvas: np.ndarray, center: np.ndarray, radius: float, color: tuple[int, int, int]) -> None:
        near = self._near(center, radius)
        self._paint(canvas[near], radius - np.linalg.norm(self._points[near] - center, axis=-1), color)

    def _near(self, center: np.ndarray, radius: float) -> tuple[slice, slice]:
        """Rows and columns of all pixels within a radius: the others need not be painted."""
        column, row = center[0] * self._size, (1 - center[1]) * self._size
        reach = radius * self._size + 1
        low, high = (np.clip(np.array([row, column]) + side, 0, self._size).astype(int) for side in (-reach, reach + 1))
        return slice(low[0], high[0]), slice(low[1], high[1])

    def _paint(self, canvas: np.ndarray, depth: np.ndarray, color: tuple[int, int, int]) -> None:
        """Colours what lies `depth` > 0 inside of an outline, with a soft edge one pixel wide."""
        cover = np.clip(depth * self._size + 0.5, 0, 1)[..., None]
        canvas += cover * (np.array(color) - canvas)
