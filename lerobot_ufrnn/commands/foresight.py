"""`ufrnn foresight`: run one trial and draw what foresight imagined at its branch."""

from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import preprocess_observation
from lerobot.policies import make_pre_post_processors
from lerobot.utils.random_utils import set_seed

import env_door  # noqa: F401  registers the environment

from ..analysis.foresight_picture import TrialHistory, draw
from ..modeling_ufrnn import UFRNNPolicy
from .flags import parse_flags


@dataclass
class ForesightConfig:
    """Which trial to draw.

    Args:
        policy_path (`str`):
            Checkpoint folder or Hub repository of a `ufrnn` policy trained with `exploration=foresight`.
        output (`Path`, *optional*, defaults to `foresight.png`):
            Picture to write.
        kind (`str`, *optional*, defaults to `"pull"`):
            Kind of the door: `push`, `pull`, `slide` or `random`.
        arm (`str`, *optional*, defaults to `"ur5e"`):
            `ur5e` or `panda`.
        door_offset (`float`, *optional*, defaults to `0.0`):
            Half-width in metres of the range of the door's shift.
        seed (`int`, *optional*, defaults to `2000`):
            Seed of environment and exploration noise.
        num_steps (`int`, *optional*, defaults to `300`):
            Longest trial in steps.
    """

    policy_path: str
    output: Path = Path("foresight.png")
    kind: str = "pull"
    arm: str = "ur5e"
    door_offset: float = 0.0
    seed: int = 2000
    num_steps: int = 300


def run(arguments: list[str]) -> None:
    """Runs the trial and writes the picture."""
    config = parse_flags(ForesightConfig, arguments)
    draw_trial(config)
    print(f"Foresight at the branch: {config.output}")


def draw_trial(config: ForesightConfig) -> None:
    """Runs one trial with a trained policy and draws its branch.

    Args:
        config (`ForesightConfig`):
            Which policy and which trial.

    Raises:
        ValueError: If the policy is of another type or runs without foresight.
    """
    policy_config = PreTrainedConfig.from_pretrained(config.policy_path)
    if policy_config.type != "ufrnn" or policy_config.exploration != "foresight":
        kind = (
            policy_config.type
            if policy_config.type != "ufrnn"
            else f"ufrnn with exploration={policy_config.exploration}"
        )
        raise ValueError(f"There is foresight only in a ufrnn policy with exploration=foresight; this one is {kind}.")
    policy_config.kernel = "reference"  # which keeps what it imagines
    policy = UFRNNPolicy.from_pretrained(config.policy_path, config=policy_config)
    env = gym.make(
        "env_door/Door-v0",
        kind=config.kind,
        arm=config.arm,
        door_offset=config.door_offset,
        max_episode_steps=config.num_steps,
    )
    try:
        history = run_trial(policy, config.policy_path, env, config.seed)
        draw(policy, history, env.get_wrapper_attr("joint_names"), config.output)
    finally:
        env.close()


def run_trial(policy: UFRNNPolicy, policy_path: str, env: gym.Env, seed: int) -> TrialHistory:
    """Runs one trial and keeps what the policy saw and foresaw.

    Args:
        policy (`UFRNNPolicy`):
            Trained policy.
        policy_path (`str`):
            Where its processors are.
        env (`gym.Env`):
            Door environment with a time limit.
        seed (`int`):
            Seed of environment and exploration noise.

    Returns:
        `TrialHistory`: the trial.
    """
    set_seed(seed)
    preprocess, postprocess = make_pre_post_processors(
        policy.config, policy_path, preprocessor_overrides={"device_processor": {"device": policy.config.device}}
    )
    policy.reset()
    observation, info = env.reset(seed=seed)
    history = TrialHistory(info["door_kind"], [], [], [], [], None, (), False)
    camera = policy.config.cameras[0].rsplit(".", 1)[-1]
    done = False
    while not done:
        history.images.append(observation["pixels"][camera])
        history.joints.append(np.asarray(observation["agent_pos"]))
        with torch.inference_mode():
            action = policy.select_action(preprocess(preprocess_observation(observation)))
        assert policy.memory is not None  # `draw_trial` refuses policies without foresight
        assert policy.last_trace is not None
        history.variances.append(policy.model.modality_variance(policy.memory.prediction)[0].cpu().numpy())
        history.traces.append(policy.last_trace)
        observation, _, terminated, truncated, info = env.step(postprocess(action).numpy()[0])
        done = terminated or truncated
        if info["attempts"] and history.first_try is None:
            history.first_try = len(history.traces) - 1
    history.attempts, history.success = tuple(info["attempts"]), bool(info["is_success"])
    return history
