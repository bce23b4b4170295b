"""The ambiguous tasks as a LeRobot environment: `--env.type=forks`."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from env_door.checks import check_range
from env_door.suites import WithoutRolloutOption, make_suites
from env_door.trials import TrialLog
from env_forks.tasks import EPISODE_STEPS, FPS, IMAGE_SIZE, TASKS


def describe_way(env: gym.Env, info: dict[str, Any]) -> dict[str, Any]:
    """What a task and its last `info` tell of a trial; ways have the names of their suites."""
    suites = env.get_wrapper_attr("task").suites
    attempts = tuple(suites[way] for way in info["attempts"])
    return {"door_kind": suites[info["way"]], "attempts": attempts, "path": tuple(env.get_wrapper_attr("path")[::2])}


def make_task(*, trial_log: str | None, **env_kwargs: Any) -> gym.Env:
    """Make one environment for LeRobot, with a log of its trials when a path is given."""
    env = WithoutRolloutOption(gym.make("env_forks/Forks-v0", **env_kwargs))
    return env if trial_log is None else TrialLog(env, trial_log, describe_way)


@EnvConfig.register_subclass("forks")
@dataclass
class ForksEnvConfig(EnvConfig):
    """Configuration of the ambiguous tasks for `lerobot-eval` and `lerobot-train`."""

    task: str | None = "three_ways"
    """Name of a task, several such as two_ways,five_ways, or all. Each way is evaluated and reported by itself."""
    fps: int = FPS
    """Control steps a second; the environment runs at no other rate."""
    episode_length: int = EPISODE_STEPS
    """Steps after which a trial is cut."""
    render_size: int = 256
    """Height and width of the pictures in videos, 16 to 768. Videos of 64 pixels make trials three times as fast."""
    trial_log: str | None = None
    """File that gets one JSON line for every finished trial."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(
        default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE, "pixels/front": f"{OBS_IMAGES}.front"}
    )

    def __post_init__(self) -> None:
        if sorted(self.tasks) != sorted(set(self.tasks) & set(TASKS)):
            raise ParsingError(
                f"--env.task must be one of {', '.join((*TASKS, 'all'))}, or several such as two_ways,five_ways, "
                f"got {self.task!r}."
            )
        check_range(self, "fps", low=FPS, high=FPS, unit="Hz")
        check_range(self, "episode_length", low=1, unit="step")
        check_range(self, "render_size", low=16, high=768, unit="pixels")
        if self.max_parallel_tasks != 1:
            raise ParsingError(
                f"--env.max_parallel_tasks must be 1, got {self.max_parallel_tasks}: a policy follows one trial at a "
                "time. Use --eval.batch_size for parallel trials."
            )
        self.features |= {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(2,)),
            "pixels/front": PolicyFeature(type=FeatureType.VISUAL, shape=(IMAGE_SIZE, IMAGE_SIZE, 3)),
        }

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks."""
        return tuple(TASKS) if self.task == "all" else tuple(name.strip() for name in str(self.task).split(","))

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keywords of `gym.make`, but for task and way."""
        return {
            "max_episode_steps": self.episode_length,
            "disable_env_checker": self.disable_env_checker,
            "render_size": self.render_size,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """Make the vector environments, one suite for each way of each task: `three_ways_0` and so on."""
        makers = {
            suite: partial(make_task, task=name, way=way, trial_log=self.trial_log, **self.gym_kwargs)
            for name in self.tasks
            for way, suite in enumerate(TASKS[name].suites)
        }
        return make_suites(makers, n_envs, use_async_envs, preload=["env_forks.env", __name__])
