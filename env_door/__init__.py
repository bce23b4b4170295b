"""A door that a robot arm opens by pushing, pulling or sliding, and that does not tell which before it is tried.

Importing this package registers the Gymnasium environment `env_door/Door-v0`; MuJoCo comes with the first one made.
"""

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from env_door.latch import KINDS
from env_door.limits import EPISODE_STEPS

if TYPE_CHECKING:
    from env_door.env import DoorEnv

__all__ = ["KINDS", "DoorEnv"]

gym.register(id="env_door/Door-v0", entry_point="env_door.env:DoorEnv", max_episode_steps=EPISODE_STEPS)


def __getattr__(name: str) -> Any:
    if name == "DoorEnv":
        from env_door.env import DoorEnv

        return DoorEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
