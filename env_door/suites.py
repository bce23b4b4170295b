"""Environments as `lerobot-eval` takes them: vector environments by suite."""

import multiprocessing
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, _LazyAsyncVectorEnv, freeze_after_episode_end


class WithoutRolloutOption(gym.Wrapper):
    """Keep LeRobot's own reset option from the environment, which refuses options that it does not know."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        own = {name: value for name, value in (options or {}).items() if name != NEW_ROLLOUT_OPTION}
        return self.env.reset(seed=seed, options=own)


def make_suites(
    makers: Mapping[str, Callable[[], gym.Env]], n_envs: int, use_async_envs: bool, preload: list[str]
) -> dict[str, dict[int, Any]]:
    """Make the vector environments of suites, given what makes one environment of each.

    `lerobot-eval` reports its figures, names its videos and labels its `per_group` results by suite. `use_async_envs`
    runs each environment in its own process; these need the modules `preload`.
    """
    suites: dict[str, dict[int, Any]] = {}
    for name, make in makers.items():
        if use_async_envs and n_envs > 1:
            # Imported once by the process that all others fork from, instead of by each of them: half a minute less
            # for each suite. Python 3.12 does not preload the main script itself.
            multiprocessing.set_forkserver_preload([*preload, "lerobot.scripts.lerobot_eval"])
            # Lazy: the processes of one suite start only when its turn has come.
            envs = _LazyAsyncVectorEnv([make] * n_envs)
        else:
            # A finished environment stays frozen through NEXT_STEP's automatic reset and so costs nothing.
            mode = gym.vector.AutoresetMode.NEXT_STEP
            envs = gym.vector.SyncVectorEnv([freeze_after_episode_end(make)] * n_envs, autoreset_mode=mode)
        suites[name] = {0: envs}
    return suites
