"""A door that a robot arm opens by pushing, pulling or sliding, and that does not tell which before it is tried.

Importing this package registers the Gymnasium environment `env_door/Door-v0`; MuJoCo comes with the first one made.
"""

import gymnasium as gym

from env_door.limits import EPISODE_STEPS

gym.register(id="env_door/Door-v0", entry_point="env_door.env:DoorEnv", max_episode_steps=EPISODE_STEPS)
