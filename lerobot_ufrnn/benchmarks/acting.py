"""Time of `select_action` at batch 1, image encoder included, beside LeRobot's ACT and Diffusion Policy."""

import itertools
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from torch import Tensor

from ..configuration_ufrnn import UFRNNConfig
from ..modeling_ufrnn import UFRNNPolicy
from .timing import Spread, collector_off, one_thread

logger = logging.getLogger(__name__)

NUM_JOINTS, IMAGE_SIZE, CAMERA = 7, 128, f"{OBS_IMAGES}.front"
FAST, REFERENCE = "UF-RNN, foresight at each step, fast kernel", "UF-RNN, foresight at each step, reference"
RECALL, ACT, DIFFUSION = "UF-RNN, recall, going back whenever it can", "ACT", "Diffusion Policy"
NUM_OBSERVATIONS = 16
WARM_UP_TICKS, TICKS_AFTER_A_TURN = 10, 2
CYCLE = 100
"""Ticks of UF-RNN in one round. With foresight at each step it plans anew at each, with recall in a few of them."""


@dataclass(frozen=True)
class ActingTimes:
    """Seconds a tick of one policy.

    Attributes:
        cycles (`list[list[float]]`): seconds of each tick, cycle by cycle. A policy that commands chunks computes in
            the first tick of a cycle and only reads its queue in the others.
    """

    cycles: list[list[float]]

    @property
    def ticks(self) -> list[float]:
        """`list[float]`: all ticks."""
        return list(itertools.chain.from_iterable(self.cycles))

    def percentile(self, percent: float) -> float:
        """Percentile of all ticks."""
        return float(np.percentile(self.ticks, percent))

    @property
    def worst(self) -> Spread:
        """`Spread`: the longest tick of each cycle; its median is the worst tick of an undisturbed machine."""
        return Spread.of([max(cycle) for cycle in self.cycles])

    def worst_against(self, seconds: float) -> Spread:
        """How many times `seconds` the longest tick of each cycle is."""
        return Spread.of([max(cycle) / seconds for cycle in self.cycles])

    @property
    def amortised(self) -> Spread:
        """`Spread`: mean tick of each cycle."""
        return Spread.of([sum(cycle) / len(cycle) for cycle in self.cycles])


def make_features() -> tuple[dict[str, PolicyFeature], dict[str, PolicyFeature]]:
    """What every policy reads and commands: seven joints and one camera."""
    inputs = {
        OBS_STATE: PolicyFeature(FeatureType.STATE, (NUM_JOINTS,)),
        CAMERA: PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIZE, IMAGE_SIZE)),
    }
    return inputs, {ACTION: PolicyFeature(FeatureType.ACTION, (NUM_JOINTS,))}


def make_ufrnn(kernel: str, recall: bool = False) -> UFRNNPolicy:
    """UF-RNN with default settings and random weights; with recall so sure of itself that everything surprises it."""
    inputs, outputs = make_features()
    torch.manual_seed(0)
    bounds = {"min": -torch.ones(NUM_JOINTS), "max": torch.ones(NUM_JOINTS)}
    config = UFRNNConfig(input_features=inputs, output_features=outputs, device="cpu", kernel=kernel, recall=recall)
    policy = UFRNNPolicy(config, dataset_stats={OBS_STATE: bounds, ACTION: bounds})
    scaler = policy.image_encoder.scaler
    scaler.fit(-torch.ones_like(scaler.low), torch.ones_like(scaler.high))
    policy.model.foresight.schedule.observe(torch.tensor([[0.5, 0.5], [1.5, 1.5]]))
    if recall:
        policy.model.network.joint_head.bias.data[NUM_JOINTS : 2 * NUM_JOINTS] = -100.0
    return policy.eval()


def make_act() -> PreTrainedPolicy:
    """ACT with default settings and random weights."""
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    inputs, outputs = make_features()
    config = ACTConfig(input_features=inputs, output_features=outputs, device="cpu", pretrained_backbone_weights=None)
    return ACTPolicy(config).eval()


def make_diffusion() -> PreTrainedPolicy:
    """Diffusion Policy with default settings and random weights.

    Raises:
        ImportError: Without the package `diffusers`.
    """
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    inputs, outputs = make_features()
    config = DiffusionConfig(
        input_features=inputs, output_features=outputs, device="cpu", pretrained_backbone_weights=None
    )
    return DiffusionPolicy(config).eval()


def measure_acting(seconds: float = 60.0, min_ticks: int = 1000) -> ActingTimes:
    """Times UF-RNN with the fast kernel alone.

    Args:
        seconds (`float`, *optional*, defaults to `60.0`):
            Time to measure for.
        min_ticks (`int`, *optional*, defaults to `1000`):
            Ticks that are measured even if they take longer.

    Returns:
        `ActingTimes`: seconds of each tick.
    """
    return _measure({FAST: (make_ufrnn("fast"), CYCLE)}, seconds, -(-min_ticks // CYCLE))[FAST]


def measure_policies(
    seconds: float = 60.0, min_rounds: int = 10, max_diffusion_rounds: int = 1
) -> dict[str, ActingTimes]:
    """Times all policies on the same observations, cycle by cycle in turns, on one thread.

    Args:
        seconds (`float`, *optional*, defaults to `60.0`):
            Time to measure for; Diffusion Policy's comes on top.
        min_rounds (`int`, *optional*, defaults to `10`):
            Cycles of each policy that are measured even if they take longer.
        max_diffusion_rounds (`int`, *optional*, defaults to `1`):
            Cycles of Diffusion Policy, which takes about a minute for each.

    Returns:
        `dict[str, ActingTimes]`: under the names `FAST`, `REFERENCE`, `ACT` and, where it can be imported, `DIFFUSION`.
    """
    act = make_act()
    policies: dict[str, tuple[PreTrainedPolicy, int]] = {
        FAST: (make_ufrnn("fast"), CYCLE),
        REFERENCE: (make_ufrnn("reference"), CYCLE),
        RECALL: (make_ufrnn("fast", recall=True), CYCLE),
        ACT: (act, act.config.n_action_steps),
    }
    times = _measure(policies, seconds, min_rounds)
    try:
        diffusion = make_diffusion()
    except ImportError as error:
        logger.info("No comparison with Diffusion Policy: %s", error)
        return times
    slow = _measure({DIFFUSION: (diffusion, diffusion.config.n_action_steps)}, 0, max_diffusion_rounds)
    return {**times, **slow}


def _measure(
    policies: dict[str, tuple[PreTrainedPolicy, int]], seconds: float, min_rounds: int
) -> dict[str, ActingTimes]:
    times: dict[str, ActingTimes] = {name: ActingTimes([]) for name in policies}
    observations = _observations()

    def warm_up(policy: PreTrainedPolicy, ticks: int) -> None:
        for _ in range(ticks):
            policy.select_action(dict(next(observations)))
        # A chunk that the warm-up began is dropped, so that a cycle begins with a computation.
        policy.reset()

    with one_thread(), torch.inference_mode():  # as `lerobot-eval` and `lerobot-rollout` call a policy
        for policy, _ in policies.values():
            policy.reset()
            warm_up(policy, WARM_UP_TICKS)
        with collector_off():
            end = time.perf_counter() + seconds
            rounds = 0
            while rounds < min_rounds or time.perf_counter() < end:
                for name, (policy, cycle) in policies.items():
                    if len(policies) > 1:  # the caches still hold the weights of another policy
                        warm_up(policy, TICKS_AFTER_A_TURN)
                    times[name].cycles.append([_tick(policy, next(observations)) for _ in range(cycle)])
                rounds += 1
    return times


def _observations() -> Iterator[dict[str, Tensor]]:
    """An arm that does not move, which surprises a policy with recall, before changing images."""
    generator = torch.Generator().manual_seed(0)
    return itertools.cycle(
        [
            {
                OBS_STATE: torch.full((1, NUM_JOINTS), 0.5),
                CAMERA: torch.rand(1, 3, IMAGE_SIZE, IMAGE_SIZE, generator=generator),
            }
            for _ in range(NUM_OBSERVATIONS)
        ]
    )


def _tick(policy: PreTrainedPolicy, observation: dict[str, Tensor]) -> float:
    batch = dict(observation)
    start = time.perf_counter()
    policy.select_action(batch)
    return time.perf_counter() - start
