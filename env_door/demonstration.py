"""One run of the scripted expert, kept in memory."""

import math
from dataclasses import dataclass

import numpy as np

from env_door.env import DoorEnv
from env_door.expert import DoorExpert
from env_door.kinematics import UnreachableError

GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
TIMING_STREAM = 1  # keeps the expert's random numbers apart from those of the environment


@dataclass(frozen=True)
class Demonstration:
    """What was seen and commanded while the expert opened one door."""

    kind: str
    seed: int
    images: np.ndarray  # (T, H, W, 3), uint8
    states: np.ndarray  # (T, D), measured joints in rad, the gripper last in 0..1
    actions: np.ndarray  # (T, D), joint targets applied at the frame of the same index
    branch_step: int  # first step whose action depends on the kind, among those with the same turn of the knob
    success_step: int  # first step after which the door counted as open


def spread(seed: int) -> float:
    """Where in its range, -1 to 1, a door may stand, so that a few demonstrations cover the range.

    A few random positions leave gaps, in which a policy has seen nothing; who demonstrates spreads them. Those of
    successive seeds, from any one on, fall far from each other (the golden-ratio sequence, of low discrepancy).
    """
    return 2 * ((0.5 + seed * GOLDEN_RATIO) % 1) - 1


def demonstrate(
    env: DoorEnv, kind: str, seed: int, num_steps: int, door_offset: float | None = None
) -> Demonstration | None:
    """Let the expert open a door and hold it open to the last step; `None` if it opens too late or is out of reach.

    Everything random hangs on `seed` alone, so that two kinds with the same seed are alike up to `branch_step`, or
    to the twist if they turn the knob unlike. Without a `door_offset` in m the environment draws where the door stands.
    """
    options = {"kind": kind} if door_offset is None else {"kind": kind, "door_offset": door_offset}
    observation, _ = env.reset(seed=seed, options=options)
    expert = DoorExpert(env, directions=(kind,))
    try:
        expert.reset(np.random.default_rng([seed, TIMING_STREAM]))
    except UnreachableError:
        return None
    if num_steps <= expert.branch_step:
        raise ValueError(
            f"num_steps={num_steps} ends before the door is tried, at step {expert.branch_step} with seed {seed}. "
            "Use more steps; 150 is enough for every kind."
        )
    images, states, actions = [], [], []
    success_step = None
    for step in range(num_steps):
        action = expert.act()
        images.append(observation["pixels"]["front"])
        states.append(observation["agent_pos"])
        actions.append(action)
        observation, _, _, _, info = env.step(action)
        if success_step is None and info["is_success"]:
            success_step = step
    if success_step is None:
        return None
    frames = np.stack(images), np.stack(states), np.stack(actions)
    return Demonstration(kind, seed, *frames, expert.branch_step, success_step)
