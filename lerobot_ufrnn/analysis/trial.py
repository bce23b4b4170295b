"""One trial of a policy, with all that it saw, remembered and foresaw."""

from dataclasses import dataclass, field
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.policies import make_pre_post_processors
from lerobot.utils.random_utils import set_seed

from ..modeling_ufrnn import UFRNNPolicy
from ..networks import HiddenState, Prediction


class Attempt(NamedTuple):
    """A direction in which the door was tried, and the step whose action made the try count."""

    step: int
    direction: str


class Imagination(NamedTuple):
    """The futures that were imagined at one step of a trial.

    Attributes:
        step (`int`): the step.
        ahead (`int`): of how many steps later the first imagined prediction is.
        futures (`Prediction`): what each of N candidates imagined, (T, N, ...).
        chosen (`int`): which was kept.
        refuted (`np.ndarray`, *optional*): likeness of each to failed tries, (N,); with recall.
    """

    step: int
    ahead: int
    futures: Prediction
    chosen: int
    refuted: np.ndarray | None = None


@dataclass
class TrialHistory:
    """One trial, step by step.

    Attributes:
        door_kind (`str`): kind of the door.
        joint_names (`tuple[str, ...]`): names of the joints, gripper included.
        images (`list[np.ndarray]`): first camera at each step, uint8 (height, width, 3).
        joints (`list[np.ndarray]`): measured joints at each step, (D_j,).
        variances (`list[np.ndarray]`): mean predicted variance of joints and image features after each step, (2,).
        states (`list[HiddenState]`): hidden state after each step, (1, hidden size) each.
        imaginations (`list[Imagination]`): what was imagined: with recall when surprised, with foresight alone at each
            step, otherwise never.
        returns (`list[int]`): steps at which recall was surprised, or found a try blocked, and went back.
        attempts (`list[Attempt]`): directions tried, also while the door was held, in order.
        held (`list[int]`): steps at which somebody held the door.
        success (`bool`): whether the door was opened, which ends the trial.
        film (`list[np.ndarray]`): the scene before the first step and after each, if it was to be filmed.
    """

    door_kind: str
    joint_names: tuple[str, ...]
    images: list[np.ndarray] = field(default_factory=list)
    joints: list[np.ndarray] = field(default_factory=list)
    variances: list[np.ndarray] = field(default_factory=list)
    states: list[HiddenState] = field(default_factory=list)
    imaginations: list[Imagination] = field(default_factory=list)
    returns: list[int] = field(default_factory=list)
    attempts: list[Attempt] = field(default_factory=list)
    held: list[int] = field(default_factory=list)
    success: bool = False
    film: list[np.ndarray] = field(default_factory=list)

    @property
    def first_try(self) -> int | None:
        """`int | None`: step at which the door was first tried, if it was."""
        return self.attempts[0].step if self.attempts else None

    @property
    def recovered(self) -> bool:
        """`bool`: whether the door was opened although the first direction tried was wrong."""
        return self.success and bool(self.attempts) and self.attempts[0].direction != self.door_kind


def run_trial(policy: UFRNNPolicy, env: gym.Env, seed: int, film: bool = False) -> TrialHistory:
    """Runs one trial in a door environment with a time limit; `seed` is that of environment and exploration noise."""
    set_seed(seed)
    preprocess, postprocess = make_pre_post_processors(policy.config)
    policy.reset()
    if policy.recall is not None:
        policy.recall.keep_futures = True
    observation, info = env.reset(seed=seed)
    history = TrialHistory(info["door_kind"], tuple(env.get_wrapper_attr("joint_names")))
    camera = policy.config.cameras[0].rsplit(".", 1)[-1]
    done = False
    while not done:
        step, before = len(history.states), info
        if film:
            history.film.append(np.asarray(env.render()))
        if info["held"]:
            history.held.append(step)
        history.images.append(observation["pixels"][camera])
        history.joints.append(np.asarray(observation["agent_pos"]))
        with torch.inference_mode():
            action = policy.select_action(preprocess(preprocess_observation(observation)))
        assert policy.memory is not None  # `select_action` sets it
        history.variances.append(policy.model.modality_variance(policy.memory.prediction)[0].cpu().numpy())
        history.states.append(policy.memory.state)
        _look_into(policy, step, history)
        observation, _, terminated, truncated, info = env.step(postprocess(action).numpy()[0])
        done = terminated or truncated
        for tried in ("attempts", "tried_while_held"):
            history.attempts += [Attempt(step, direction) for direction in info[tried][len(before[tried]) :]]
    if film:
        history.film.append(np.asarray(env.render()))
    history.success = bool(info["is_success"])
    return history


def _look_into(policy: UFRNNPolicy, step: int, history: TrialHistory) -> None:
    """Notes what the policy imagined at the step that it has just taken, and whether it went back."""
    # The state after a step predicts the next one, and the first imagined state the one after that.
    if (trace := policy.last_trace) is not None:
        futures = Prediction(*(values[:, :, 0] for values in trace.imagined))
        history.imaginations.append(Imagination(step, 2, futures, int(trace.chosen[0])))
    elif policy.recall is not None and policy.recall.events[0] and policy.recall.events[0][-1].step == step:
        event = policy.recall.events[0][-1]
        history.returns.append(step)
        if policy.recall.exploration == "foresight" and event.futures is not None:
            # A step later at the earliest the arm is back and the plan begins.
            refuted = event.refuted.cpu().numpy()
            history.imaginations.append(Imagination(step, 3, event.futures, event.chosen, refuted))
