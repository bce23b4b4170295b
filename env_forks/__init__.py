"""Small ambiguous tasks: a disc in corridors that fork, where only trying tells which way goes on.

Importing this package registers the Gymnasium environment `env_forks/Forks-v0`.
"""

import gymnasium as gym

from env_forks.tasks import EPISODE_STEPS

gym.register(id="env_forks/Forks-v0", entry_point="env_forks.env:ForksEnv", max_episode_steps=EPISODE_STEPS)
