"""The door as a LeRobot environment: `--env.type=door`."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from env_door.checks import check_range
from env_door.latch import EIGHT_KINDS, KINDS, beyond_three
from env_door.limits import EPISODE_STEPS, FPS, IMAGE_SIZE, check_door
from env_door.scene import ARMS
from env_door.suites import WithoutRolloutOption, make_suites
from env_door.trials import TrialLog

SETS = {"all": KINDS, "eight": EIGHT_KINDS}
TASKS = (*EIGHT_KINDS, "random", *SETS)


def make_door(*, trial_log: str | None, **env_kwargs: Any) -> gym.Env:
    """Make one door environment for LeRobot, with a log of its trials when a path is given."""
    env = WithoutRolloutOption(gym.make("env_door/Door-v0", **env_kwargs))
    return env if trial_log is None else TrialLog(env, trial_log)


@EnvConfig.register_subclass("door")
@dataclass
class DoorEnvConfig(EnvConfig):
    """Configuration of the door environment for `lerobot-eval` and `lerobot-train`."""

    task: str | None = "all"
    """Kind of door: push, pull, slide or random (one of these, drawn at each reset). Several, such as push,pull or all,
    are evaluated one after the other, each reported by itself. eight: also slide_right, and these four with _ccw."""
    fps: int = FPS
    """Control steps a second; the environment runs at no other rate."""
    episode_length: int = EPISODE_STEPS
    """Steps after which a trial is cut."""
    arm: str = "ur5e"
    """ur5e or panda."""
    door_offset: float = 0.0
    """Half-width in m of the range of the door's sideways shift."""
    start_variation: float = 0.02
    """Half-width in m of the range of the tool's start position along each axis."""
    command_limit: float = 0.08
    """Largest distance in rad of a command from the measured joints."""
    hold_seconds: float = 0.0
    """For how long somebody holds the door still once it has begun to open."""
    trial_log: str | None = None
    """File that gets one JSON line for every finished trial."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(
        default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE, "pixels/front": f"{OBS_IMAGES}.front"}
    )

    def __post_init__(self) -> None:
        if self.task not in TASKS and sorted(self.kinds) != sorted(set(self.kinds) & set(EIGHT_KINDS)):
            raise ParsingError(
                f"--env.task must be one of {', '.join(TASKS)}, or several kinds such as push,pull, got {self.task!r}."
            )
        check_range(self, "fps", low=FPS, high=FPS, unit="Hz")
        check_range(self, "episode_length", low=1, unit="step")
        check_door(self)
        if self.max_parallel_tasks != 1:
            raise ParsingError(
                f"--env.max_parallel_tasks must be 1, got {self.max_parallel_tasks}: drawing does not work in threads. "
                "Use --eval.batch_size for parallel trials."
            )
        dimension = len(ARMS[self.arm].joints) + 1  # and the gripper
        self.features |= {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(dimension,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(dimension,)),
            "pixels/front": PolicyFeature(type=FeatureType.VISUAL, shape=(IMAGE_SIZE, IMAGE_SIZE, 3)),
        }

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of door, one suite each."""
        task = str(self.task)
        return SETS[task] if task in SETS else tuple(kind.strip() for kind in task.split(","))

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keywords of `gym.make`, but for the kind of the door."""
        names = ("arm", "door_offset", "start_variation", "command_limit", "hold_seconds", "disable_env_checker")
        settings = {name: getattr(self, name) for name in names}
        return settings | {"max_episode_steps": self.episode_length, "eight": beyond_three(self.kinds)}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """Make the vector environments, one suite for each kind of door: `door_push`, `door_pull` and so on."""
        makers = {
            f"door_{kind}": partial(make_door, kind=kind, trial_log=self.trial_log, **self.gym_kwargs)
            for kind in self.kinds
        }
        return make_suites(makers, n_envs, use_async_envs, preload=["env_door.env", __name__])
