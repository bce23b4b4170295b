"""A door that a robot arm opens by pushing, pulling or sliding, and that does not tell which before it is tried.

Importing this package registers the Gymnasium environment `env_door/Door-v0` (10 Hz, 300 steps).
"""

from env_door.rendering import choose_backend

choose_backend()  # before anything imports mujoco, which reads the choice only once

import gymnasium as gym  # noqa: E402

from env_door.env import DoorEnv  # noqa: E402
from env_door.latch import KINDS  # noqa: E402

__all__ = ["KINDS", "DoorEnv"]

gym.register(id="env_door/Door-v0", entry_point="env_door.env:DoorEnv", max_episode_steps=300)
