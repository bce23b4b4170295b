"""Ways that fork in the plane, a stand-in for a network, and a point robot: recall without anything learned.

A leaf is named by the ways taken to it, such as (0, 2). All its demonstrations pass its gate, which may be barred.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from small_network import network_config

from lerobot_ufrnn.demonstrations import Demonstrations
from lerobot_ufrnn.foresight import Memory
from lerobot_ufrnn.networks import HiddenState, Prediction
from lerobot_ufrnn.recall import Recall

Leaf = tuple[int, ...]
SPEED = 1.0  # units a second
LEAD = 0.2  # seconds by which commands are ahead
APART = 0.7  # distance of neighbouring leaves
BEYOND = 1.0  # length of the way beyond a gate


def leaves_below(rng: np.random.Generator, depth: int, most_ways: int = 5, above: Leaf = ()) -> list[Leaf]:
    """All leaves of a random tree of forks of 2 ways or more."""
    if depth == 0:
        return [above]
    ways = range(rng.integers(2, most_ways + 1))
    return [leaf for way in ways for leaf in leaves_below(rng, depth - 1, most_ways, (*above, way))]


def path_to(leaf: Leaf, leaves: Sequence[Leaf]) -> np.ndarray:
    """Corners of the way to a leaf, (depth + 3, 2): a trunk, a layer for each fork, and a way beyond its gate."""
    corners = [
        (1.0 + depth, APART * np.mean([place for place, other in enumerate(leaves) if other[:depth] == leaf[:depth]]))
        for depth in range(len(leaf) + 1)
    ]
    return np.array([(0.0, corners[0][1]), *corners, corners[-1] + np.array((BEYOND, 0))])


def walk(corners: np.ndarray, fps: float) -> np.ndarray:
    """Points along corners as passed at `SPEED`, and half a second at the end."""
    arc = np.concatenate(([0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()))
    points = np.arange(0, arc[-1] + 0.5 * SPEED, SPEED / fps).clip(max=arc[-1])
    return np.stack([np.interp(points, arc, column) for column in corners.T], axis=1)


def demonstrate(leaves: Sequence[Leaf], fps: float = 10, repeats: int = 2, noise: float = 0.02) -> Demonstrations:
    """`repeats` demonstrations of each leaf, one leaf after the other; the scene is always the same but for noise."""
    rng, scenes = np.random.default_rng(0), np.random.default_rng(1)
    demonstrations = Demonstrations(2, 1, fps)
    for index in range(repeats * len(leaves)):
        points = walk(path_to(leaves[index // repeats], leaves), fps)
        phases = np.arange(len(points))[:, None] / fps + rng.uniform(0, 6, 2)
        points = points + rng.uniform(0, noise) * np.sin(3 * phases)
        ahead = np.minimum(np.arange(len(points)) + round(LEAD * fps), len(points) - 1)
        sensed = np.column_stack((points, 0.01 * scenes.standard_normal(len(points))))
        demonstrations.remember(index, torch.tensor(sensed).float(), torch.tensor(points[ahead]).float())
    return demonstrations


class StandIn:
    """Network and model in one: the state is what was sensed last, and it always wants the same way.

    The joints that it sensed first are kept in `c_joint`: they tell which demonstration a remembered state is of.
    """

    joint_dim = 2

    def __init__(self, wanted: np.ndarray, fps: float, unsure_of_start=None):
        self.network = self
        self.path = torch.tensor(walk(wanted, fps)).float()
        self.lead = round(LEAD * fps)
        self.unsure_of_start = unsure_of_start or (lambda start: 0 * start[..., :1])

    def initial_state(self, batch_size):
        none, unused = torch.full((batch_size, 2), torch.nan), torch.zeros(batch_size, 1)
        return HiddenState(none, none, unused, unused, unused, unused)

    def step(self, inputs, state):
        first = torch.where(state.c_joint.isnan(), inputs[:, :2], state.c_joint)
        return HiddenState(inputs[:, :2], first, inputs[:, 2:], *state[3:])

    def predict(self, state):
        nearest = torch.cdist(state.h_joint.reshape(-1, 2), self.path).argmin(-1).reshape(state.h_joint.shape[:-1])
        command = self.path[(nearest + self.lead).clamp(max=len(self.path) - 1)]
        mean = torch.cat((command, state.h_image), -1)
        return Prediction(mean, self.unsure_of_start(state.c_joint).expand_as(mean), mean[..., :2], command)

    def advance(self, inputs, memory, generator=None, explore=True):
        assert not explore
        state = self.step(inputs, memory.state)
        return Memory(state, self.predict(state)), None

    def imagine(self, state, num_steps):
        return HiddenState.stack([state] * (num_steps + 1))


class Robot:
    """A point that follows its command at `SPEED`, unless a gate is barred or somebody holds it.

    Attributes:
        tries: the leaves whose gate it has pressed against, one after the other; anew where it had left.
    """

    def __init__(self, leaves: Sequence[Leaf], barred: Sequence[Leaf] = (), fps: float = 10):
        self.paths = {leaf: path_to(leaf, leaves) for leaf in leaves}
        self.barred = set(barred)
        self.most = SPEED / fps
        self.position = next(iter(self.paths.values()))[0]
        self.tries: list[Leaf] = []
        self._pressed_at: np.ndarray | None = None
        self.held = False

    @property
    def arrived(self) -> Leaf | None:
        """The leaf that it is at, if any."""
        return next(
            (leaf for leaf, path in self.paths.items() if np.linalg.norm(self.position - path[-1]) < 0.15), None
        )

    def move(self, command: np.ndarray) -> None:
        asked = command - self.position
        goal = self.position + asked * min(1, self.most / max(np.linalg.norm(asked), 1e-9)) * (not self.held)
        for leaf in self.barred:
            gate = self.paths[leaf][-2]
            if self.position[0] <= gate[0] < goal[0] and abs(goal[1] - gate[1]) < APART / 2:
                goal[0] = gate[0]
                if self._pressed_at is None:
                    self.tries.append(leaf)
                self._pressed_at = goal
        self.position = goal
        if self._pressed_at is not None and np.linalg.norm(goal - self._pressed_at) > APART / 2:
            self._pressed_at = None


class Search:
    """Episodes side by side, one for each robot, of recall with a stand-in that wants the way to one leaf."""

    def __init__(
        self, demonstrations: Demonstrations, wanted: np.ndarray, *robots: Robot, unsure_of_start=None, **config
    ):
        self.fps = float(demonstrations.fps)
        self.robots = robots
        self.model = StandIn(wanted, self.fps, unsure_of_start)
        self.recall = Recall(self.model, network_config(2, 1, **config), demonstrations)
        self.begin()

    def begin(self) -> None:
        state = self.model.initial_state(len(self.robots))
        self.memory = Memory(state, self.model.predict(state))
        self.recall.reset()

    def run(self, seconds: float, tries: float = math.inf) -> "Search":
        """Goes on until all robots have arrived or have tried so often, or the time is over."""
        for _ in range(round(seconds * self.fps)):
            if all(robot.arrived or len(robot.tries) >= tries for robot in self.robots):
                break
            sensed = torch.tensor(np.stack([[*robot.position, 0.0] for robot in self.robots])).float()
            self.memory, _ = self.recall.advance(sensed, self.memory)
            for robot, command in zip(self.robots, self.memory.prediction.command, strict=True):
                if not robot.arrived:
                    robot.move(command.numpy())
        return self
