"""How many control steps a second the door environment makes, with and without pictures, alone and in batches."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from env_door.configuration_door import DoorEnvConfig
from env_door.env import DoorEnv
from env_door.expert import DoorExpert

from .timing import Spread, take_turns

WARM_UP_CALLS = 3
"""Calls of each kind that are not counted: the first one makes renderers and processes."""


@dataclass(frozen=True)
class Speed:
    """Steps a second of one way to run the environment.

    Args:
        name (`str`):
            What was run.
        median (`float`):
            Median of the environment steps a second; a batch of 5 counts as 5 steps.
        low (`float`):
            10th percentile.
        high (`float`):
            90th percentile.
        calls (`int`):
            Number of timed calls.
    """

    name: str
    median: float
    low: float
    high: float
    calls: int


def measure_env(seconds: float = 20.0, batch_size: int = 5, with_async: bool = True) -> list[Speed]:
    """Measures the environment in several ways, taking turns so that a busy machine disturbs all of them alike.

    The gripper holds the knob, because contact makes the physics slower than free movement. The time of starting up is
    not part of the budget; that of asynchronous environments, whose processes import LeRobot, can be long.

    Args:
        seconds (`float`, *optional*, defaults to 20.0):
            Time to measure for.
        batch_size (`int`, *optional*, defaults to 5):
            Environments in a vector environment.
        with_async (`bool`, *optional*, defaults to `True`):
            Whether to measure environments in processes of their own, too.

    Returns:
        `list[Speed]`: physics only, with the policy's picture, with a video frame on top, and batches, in this order.

    Raises:
        ValueError: If the time is not positive or the batch has less than two environments.
    """
    if not seconds > 0:
        raise ValueError(f"seconds={seconds!r} must be positive")
    if batch_size < 2:
        raise ValueError(f"batch_size={batch_size!r} must be at least 2")
    with ExitStack() as stack:
        env = DoorEnv(start_variation=0.0)
        stack.callback(env.close)
        grasp = _grasp(env)
        size = env.observation_size

        def step_and_render() -> None:
            env.step(grasp[-1])
            env.render()

        ways: dict[str, tuple[int, Callable[[], object]]] = {
            "physics only": (1, lambda: env.advance(grasp[-1])),
            f"with {size} px picture": (1, lambda: env.step(grasp[-1])),
            f"with {size} px picture and {env.render_size} px video frame": (1, step_and_render),
            f"batch of {batch_size}, sync": (batch_size, stack.enter_context(_batch(grasp, batch_size, False))),
        }
        if with_async:
            ways[f"batch of {batch_size}, async"] = (
                batch_size,
                stack.enter_context(_batch(grasp, batch_size, True)),
            )
        rounds = take_turns({name: call for name, (_, call) in ways.items()}, seconds, warm_up=WARM_UP_CALLS)
    rows = []
    for name, (steps, _) in ways.items():
        rate = Spread.of([steps / duration for duration in rounds.seconds[name]])
        rows.append(Speed(name, rate.median, rate.low, rate.high, rate.count))
    return rows


def _grasp(env: DoorEnv) -> list[NDArray[np.float32]]:
    """Brings the gripper to the knob, grips and twists it; returns the actions that did so."""
    env.reset(seed=0, options={"kind": "slide"})
    expert = DoorExpert(env, ("push",))
    expert.reset(np.random.default_rng(0))
    actions = []
    for _ in range(expert.branch_step):
        actions.append(expert.act())
        env.advance(actions[-1])
    return actions


@contextmanager
def _batch(actions: list[NDArray[np.float32]], batch_size: int, use_async_envs: bool) -> Iterator[Callable[[], object]]:
    """Step of a vector environment as LeRobot makes it, after the given actions, which keep their door shut."""
    # No episode may end while it is measured: LeRobot's finished environments cost nothing.
    config = DoorEnvConfig(task="slide", episode_length=10**9, start_variation=0.0)
    (tasks,) = config.create_envs(batch_size, use_async_envs).values()
    vector_env: gym.vector.VectorEnv = tasks[0]
    try:
        vector_env.reset(seed=0)
        for action in actions:
            vector_env.step(np.stack([action] * batch_size))
        last = np.stack([actions[-1]] * batch_size)
        yield lambda: vector_env.step(last)
    finally:
        vector_env.close()
