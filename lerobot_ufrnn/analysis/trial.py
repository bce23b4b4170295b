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
    """The futures that were imagined at one step of a trial."""

    step: int
    ahead: int  # of how many steps later the first imagined prediction is
    futures: Prediction  # what each of N candidates imagined, (T, N, ...)
    chosen: int  # which was kept
    refuted: np.ndarray | None = None  # weight against each, (N,); with recall


@dataclass
class TrialHistory:
    """One trial, step by step."""

    door_kind: str
    joint_names: tuple[str, ...]  # gripper included
    images: list[np.ndarray] = field(default_factory=list)  # first camera at each step, uint8 (height, width, 3)
    joints: list[np.ndarray] = field(default_factory=list)  # measured at each step, (D_j,)
    variances: list[np.ndarray] = field(default_factory=list)  # mean one of joints and features after each step, (2,)
    states: list[HiddenState] = field(default_factory=list)  # after each step, (1, hidden size) each
    # With recall when contradicted, with foresight alone at each step, otherwise never.
    imaginations: list[Imagination] = field(default_factory=list)
    returns: list[int] = field(default_factory=list)  # steps at which recall went back, for whatever reason
    attempts: list[Attempt] = field(default_factory=list)  # also while the door was held, in order
    held: list[int] = field(default_factory=list)  # steps at which somebody held the door
    success: bool = False  # whether the door was opened, which ends the trial
    film: list[np.ndarray] = field(default_factory=list)  # before the first step and after each, if it was to be filmed

    @property
    def first_try(self) -> int | None:
        """`int | None`: step at which the door was first tried, if it was."""
        return self.attempts[0].step if self.attempts else None

    @property
    def recovered(self) -> bool:
        """`bool`: whether the door was opened although the first direction tried was wrong."""
        return self.success and bool(self.attempts) and self.attempts[0].direction != self.door_kind

    @property
    def outcome(self) -> tuple[str, str]:
        """`tuple[str, str]`: what was tried, and whether the door was opened, in words."""
        tried = ", ".join(direction for _, direction in self.attempts) or "nothing"
        return tried, "opened" if self.success else "not opened"


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
    elif policy.recall is not None and (events := policy.recall.events) and events[0] and events[0][-1].step == step:
        event = events[0][-1]
        history.returns.append(step)
        if policy.config.exploration == "foresight" and event.futures is not None:
            # The arm needs about as long for going back as it took to get here.
            ahead = 2 + event.moments_back * policy.demonstrations.stride
            history.imaginations.append(
                Imagination(step, ahead, event.futures, event.chosen, event.refuted.cpu().numpy())
            )
