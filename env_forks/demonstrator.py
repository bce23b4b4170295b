"""The scripted demonstrator, who knows the way."""

import math

import numpy as np

from env_door.demonstration import Demonstration
from env_forks.env import ForksEnv

TIMING_STREAM = 1  # keeps the demonstrator's random numbers apart from those of the environment
REST_STEPS = 10  # at the end
MAX_STEPS = 400
WOBBLE = 0.002  # standard deviation of each wave that makes a path uneven
WAVES = 4  # along the longest path, each with a sine and a cosine
FADE = 0.05  # distance from both ends of a path over which the waves grow and fade


class Demonstrator:
    """Moves a target along the right way of a task that was reset, and lets it rest at the end."""

    def __init__(self, env: ForksEnv, rng: np.random.Generator):
        self._points = route(env, env.current_way)
        self._lengths = lengths(self._points)
        self._speed = env.task.speed * rng.uniform(0.85, 1.15)
        self._waves = rng.normal(0, WOBBLE, (2, WAVES, 2))
        # The same waves for all ways, so that nothing before the fork tells which one follows.
        self._longest = max(lengths(route(env, way))[-1] for way in env.task.ways)
        paths = [env.task.path(way) for way in env.task.ways]
        shared = sum(len(set(nodes)) == 1 for nodes in zip(*paths, strict=False))
        self._fork = self._lengths[shared - 1] if len(paths) > 1 else math.inf
        self._travelled = 0.0
        self._steps = 0

    @property
    def has_branched(self) -> bool:
        """Whether the target is behind the first fork."""
        return self._travelled > self._fork

    @property
    def has_arrived(self) -> bool:
        """Whether the target is at its end."""
        return self._travelled >= self._lengths[-1]

    def act(self) -> np.ndarray:
        """The next target, float32 `(2,)`."""
        self._steps += 1
        self._travelled = min(self._travelled + self._speed * min(1, self._steps / 5), self._lengths[-1])
        travelled = self._travelled
        target = [np.interp(travelled, self._lengths, coordinate) for coordinate in self._points.T]
        phases = 2 * math.pi * np.arange(1, WAVES + 1) * travelled / self._longest
        wobble = (self._waves * np.stack((np.sin(phases), np.cos(phases)), -1)).sum((1, 2))
        fade = min(1, travelled / FADE, (self._lengths[-1] - travelled) / FADE)
        return (target + fade * wobble).astype(np.float32)


def route(env: ForksEnv, way: int) -> np.ndarray:
    """Corners of the path of a way `(P, 2)`, from where the disc starts."""
    points = env.nodes[env.task.path(way)]
    if env.task.back:
        points = np.concatenate((points, points[-2::-1]))
    points[0] = env.world.position
    return points


def lengths(points: np.ndarray) -> np.ndarray:
    """Length of the path up to each of its corners."""
    return np.concatenate(([0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()))


def demonstrate(env: ForksEnv, way: int, seed: int) -> Demonstration | None:
    """Goes a way to its end and rests there; `None` if that fails.

    Everything random hangs on `seed` alone, so that two ways with the same seed are alike up to `branch_step`.
    """
    observation, _ = env.reset(seed=seed, options={"way": way, "demonstration": True})
    demonstrator = Demonstrator(env, np.random.default_rng([seed, TIMING_STREAM]))
    images: list[np.ndarray] = []
    states: list[np.ndarray] = []
    actions: list[np.ndarray] = []
    branch_step = success_step = None
    rested = 0
    while rested < REST_STEPS and len(actions) < MAX_STEPS:
        action = demonstrator.act()
        if branch_step is None and demonstrator.has_branched:
            branch_step = len(actions)
        images.append(observation["pixels"]["front"])
        states.append(observation["agent_pos"])
        actions.append(action)
        observation, _, _, _, info = env.step(action)
        if success_step is None and info["is_success"]:
            success_step = len(actions) - 1
        rested += demonstrator.has_arrived
    if success_step is None:
        return None
    frames = np.stack(images), np.stack(states), np.stack(actions)
    branch_step = len(actions) if branch_step is None else branch_step
    return Demonstration(env.task.suites[way], seed, *frames, branch_step, success_step)
