"""The tasks: a tree of corridors each, and what is special about it. Lengths are fractions of the picture's side."""

import math
from dataclasses import dataclass

import numpy as np

FPS = 10  # control steps a second
EPISODE_STEPS = 300  # control steps after which a trial is cut
IMAGE_SIZE = 64  # height and width in pixels of the picture that a policy sees


@dataclass(frozen=True)
class Tree:
    """Corridors from the start, node 0, over forks to the ends of the ways."""

    nodes: tuple[tuple[float, float], ...]
    parents: tuple[int, ...]  # of each node; of the start -1
    ends: tuple[int, ...]  # node at the end of each way


def fan(
    *angles: float,
    length: float = 0.35,
    fork: tuple[float, float] = (0.5, 0.4),
    start: tuple[float, float] = (0.5, 0.08),
    bend: float = 0.0,
) -> Tree:
    """Ways that leave one fork at these angles, in degrees from straight on; each may bend further half-way."""
    nodes, parents, ends = [start, fork], [-1, 0], []
    for angle in map(math.radians, angles):
        legs = [(length, angle)]
        if bend:
            legs = [(0.6 * length, angle), (0.55 * length, angle + math.radians(bend))]
        (x, y), parent = fork, 1
        for distance, heading in legs:
            x, y = x + distance * math.sin(heading), y + distance * math.cos(heading)
            nodes.append((x, y))
            parents.append(parent)
            parent = len(nodes) - 1
        ends.append(parent)
    return Tree(tuple(nodes), tuple(parents), tuple(ends))


TWO_FORKS = Tree(
    nodes=(
        *((0.5, 0.06), (0.5, 0.3), (0.27, 0.52), (0.73, 0.52)),
        *((0.1, 0.75), (0.38, 0.85), (0.62, 0.85), (0.9, 0.75)),
    ),
    parents=(-1, 0, 1, 1, 2, 2, 3, 3),
    ends=(4, 5, 6, 7),
)
THREE_WAYS = fan(-60, 0, 60)


@dataclass(frozen=True)
class Task:
    """One ambiguous task."""

    name: str
    special: str  # about it, in a few words
    tree: Tree = THREE_WAYS
    gate: float = 0.5  # where on the last corridor of a way its gate stands
    play: float = 0.02  # how far the disc may be from the middle of a corridor
    speed: float = 0.018  # of a demonstration, for each step
    start: float = 0.02  # half-width of the range in which the disc starts, sideways
    shift: float = 0.0  # half-width of the range in which everything is shifted
    matched: bool = True  # whether the ways share the seeds of their demonstrations
    cue: bool = False  # a colour tells the way, and a wrong try ends the trial
    lamp: bool = False  # no gate is shut; a lamp goes on at the end of the right way
    back: bool = False  # whether to go back to the start in the end
    end_radius: float = 0.03  # within which the disc is at the end of a way
    shut_steps: int = 0  # for which the right gate stays shut, too
    noise: float = 0.0  # standard deviation on the measured position
    delay: int = 0  # steps by which observations are late
    contact: bool = False  # blocks in MuJoCo instead of gates

    @property
    def ways(self) -> range:
        """Numbers of the ways."""
        return range(len(self.tree.ends))

    @property
    def is_ambiguous(self) -> bool:
        """Whether only trying tells the way: there are several, and no colour tells which."""
        return len(self.ways) > 1 and not self.cue

    @property
    def suites(self) -> list[str]:
        """Names of the task with each way as the one that goes on, such as `three_ways_0`."""
        return [f"{self.name}_{way}" for way in self.ways]

    def path(self, way: int) -> list[int]:
        """Nodes from the start to the end of a way."""
        nodes = [self.tree.ends[way]]
        while nodes[-1]:
            nodes.append(self.tree.parents[nodes[-1]])
        return nodes[::-1]

    def gates(self, nodes: np.ndarray) -> np.ndarray:
        """Where the gates of the ways stand `(W, 2)`, given where the nodes are `(N, 2)`."""
        ends = list(self.tree.ends)
        before = nodes[[self.tree.parents[end] for end in ends]]
        return before + self.gate * (nodes[ends] - before)


TASKS = {
    task.name: task
    for task in (
        Task("three_ways", "one of three gates gives way"),
        Task("two_ways", "opposite ways", fan(-90, 90)),
        Task("five_ways", "five ways", fan(-100, -50, 0, 50, 100)),
        Task("eight_ways", "eight ways, near to each other", fan(-122, -87, -52, -17, 17, 52, 87, 122)),
        Task("two_forks", "two forks in a row", TWO_FORKS),
        Task("bends", "ways that bend before the gate", fan(-60, 0, 60, length=0.4, bend=60)),
        Task(
            "long_ways",
            "long ways to the gate",
            fan(-60, 0, 60, length=0.55, fork=(0.5, 0.25), start=(0.5, 0.06)),
            gate=0.75,
            speed=0.014,
        ),
        Task("gate_at_fork", "gates right behind the fork", gate=0.06),
        Task("slack", "wide corridors", play=0.06),
        Task(
            "out_and_back", "all ways end alike, at the start", back=True, end_radius=0.08
        ),  # it may turn a little early
        Task("shown", "a colour tells the way: trying is wrong", cue=True),
        Task("no_fork", "a single way: going back is needless", fan(40)),
        Task("gives_way_later", "the right gate is shut for the first 12 s", shut_steps=120),
        Task("moved", "everything is shifted, otherwise than in any demonstration", shift=0.03, end_radius=0.05),
        Task("unmatched", "each demonstration starts elsewhere", start=0.03, matched=False),
        Task("noise_and_delay", "noisy position, observations 0.2 s late", noise=0.004, delay=2),
        Task("lamp", "nothing blocks: only a lamp tells", lamp=True),
        Task("blocks", "one of three blocks slides between walls: contact in MuJoCo", contact=True),
    )
}
"""All tasks by their names."""
