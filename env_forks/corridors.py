"""A disc that moves in corridors and is stopped by the gates that are shut."""

import numpy as np

from env_forks.tasks import Task

MAX_STEP = 0.03  # furthest movement in a control step
MAX_PULL = 0.12  # a target is held within this distance of the disc
FLEX = 0.15  # of a pull that is resisted, how much is measured as movement
SUBSTEPS = 4
GATE_REACH = 0.012  # how much further than it may leave the middle the disc is at a gate


class Corridors:
    """One trial: where the disc is, what it may do next, which gate it is at."""

    def __init__(self, task: Task, nodes: np.ndarray, position: np.ndarray, way: int):
        self.task = task
        self.position = self.measured = position
        self.gates = task.gates(nodes)
        self._ends = nodes[list(task.tree.ends)]
        self._way = way
        self._tails, self._heads = nodes[list(task.tree.parents[1:])], nodes[1:]
        # Where each corridor stops while all gates are shut, and once the right one gives way.
        self._all_shut, self._one_open = self._heads.copy(), self._heads.copy()
        for other, end in enumerate([] if task.lamp else task.tree.ends):
            self._all_shut[end - 1] = self.gates[other]
            if other != way:
                self._one_open[end - 1] = self.gates[other]

    @property
    def arrived(self) -> bool:
        """Whether the disc is at the end of the right way."""
        return bool(np.linalg.norm(self._ends[self._way] - self.position) < self.task.end_radius)

    def move(self, target: np.ndarray, may_open: bool) -> int | None:
        """Moves towards a target for one control step; returns the way whose gate or end is pressed on, if any."""
        pull = limited(target - self.position, MAX_PULL)
        movement = limited(pull, MAX_STEP)
        before = self.position
        heads = self._one_open if may_open else self._all_shut
        for _ in range(SUBSTEPS):
            self.position = self._inside(self.position + movement / SUBSTEPS, heads)
        self.measured = self.position + FLEX * (pull - (self.position - before))

        distances = np.linalg.norm(self.gates - self.position, axis=1)
        nearest = int(distances.argmin())
        at_gate = distances[nearest] < self.task.play + GATE_REACH
        at_end = np.linalg.norm(self._ends[nearest] - self.position) < self.task.end_radius
        # Where gates stand at the fork, whoever is there is near to all of them: only a pull tells a try.
        pressed = self.task.gate > 0.2 or np.linalg.norm(pull) > 0.02
        return nearest if at_end or (at_gate and pressed) else None

    def _inside(self, point: np.ndarray, heads: np.ndarray) -> np.ndarray:
        """The point itself, or if it is in a wall, the nearest one of the nearest corridor."""
        middles = nearest_on_lines(point, self._tails, heads)
        gaps = np.linalg.norm(point - middles, axis=1)
        nearest = gaps.argmin()
        if gaps[nearest] <= self.task.play:
            return point
        return middles[nearest] + (point - middles[nearest]) * self.task.play / gaps[nearest]


def nearest_on_lines(point: np.ndarray, tails: np.ndarray, heads: np.ndarray) -> np.ndarray:
    """The point `(K, 2)` of each line, from tail to head, that is nearest to a given one."""
    along = heads - tails
    fraction = ((point - tails) * along).sum(1) / np.maximum((along**2).sum(1), 1e-9)
    return tails + np.clip(fraction, 0, 1)[:, None] * along


def limited(vector: np.ndarray, length: float) -> np.ndarray:
    """The vector, shortened to a length if it is longer."""
    return vector * min(1.0, length / max(float(np.linalg.norm(vector)), 1e-9))
