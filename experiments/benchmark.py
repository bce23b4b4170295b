"""What does it cost to train and to act? UF-RNN beside the readable code, an XLA scan, ACT and Diffusion Policy.

    python experiments/benchmark.py --quick                    # under a minute; the last line is a JSON object
    python experiments/benchmark.py --parts=[update,growth]    # tables and numbers in outputs/benchmark

What is compared takes turns in one process on one core, so that a busy machine disturbs all of it alike; medians, and
ratios of the pairs of each round.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from script import run
from timing import describe_machine, one_core, take_turns, text, write
from torch import Tensor

from env_door.checks import check_range
from lerobot_ufrnn.configuration_ufrnn import AutoencoderConfig, ForesightConfig, RecallConfig, UFRNNConfig
from lerobot_ufrnn.foresight import UFRNN
from lerobot_ufrnn.kernels.unroll import FastUFRNN
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy
from lerobot_ufrnn.networks import gaussian_nll

NUM_JOINTS, IMAGE_SIZE, CAMERA = 7, 128, f"{OBS_IMAGES}.front"
FEATURES: dict[str, Any] = {
    "input_features": {
        OBS_STATE: PolicyFeature(FeatureType.STATE, (NUM_JOINTS,)),
        CAMERA: PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIZE, IMAGE_SIZE)),
    },
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (NUM_JOINTS,))},
    "device": "cpu",
}
# Stated, so that another default does not change what is measured. The scan knows these readings of the paper only.
PAPER = UFRNNConfig(
    joint_hidden_dim=50,
    image_hidden_dim=50,
    shared_hidden_dim=20,
    foresight=ForesightConfig(
        num_samples=5,
        horizon=10,
        horizon_mode="fixed",
        noise_unit="std",
        noise_scale="linear",
        perturbed_states="hidden",
        variance_baseline="common",
        variance_aggregation="variance",
    ),
    autoencoder=AutoencoderConfig(feature_dim=10),
    **FEATURES,
)
BATCH_SIZE, LENGTH = 5, 149  # an episode of 150 frames has 149 next ones to predict
FAST, REFERENCE, SCAN = "fast kernel", "readable code", "XLA scan"
CYCLE = 100  # ticks of UF-RNN in a round
START, STOP, STOP_TICK = 0.3, 0.5, 75  # joints between which the arm moves, and the tick at which it stops


# ── The training update ───────────────────────────────────────────────


def make_model(kernel: type[UFRNN], config: UFRNNConfig) -> UFRNN:
    """Untrained model, the same for every kernel, whose noise knows the range of variances."""
    torch.manual_seed(0)
    model = kernel(config)
    model.foresight.schedule.observe(torch.tensor([[0.5, 0.5], [1.5, 1.5]]))
    return model


def make_episodes(config: UFRNNConfig, batch_size: int, length: int) -> tuple[Tensor, Tensor, Tensor]:
    """Smooth random inputs and their next values, (B, L, D) each, and commands a step ahead, (B, L, D_j)."""
    dim = config.joint_dim + config.image_dim
    phase = 2 * torch.pi * torch.rand(batch_size, 1, dim, generator=torch.Generator().manual_seed(0))
    values = 0.8 * torch.sin(0.1 * torch.arange(length + 2)[None, :, None] + phase)
    inputs, targets, commands = values[:, :-2], values[:, 1:-1], values[:, 2:, : config.joint_dim]
    return inputs.contiguous(), targets.contiguous(), commands.contiguous()


def loss_of(model: UFRNN, inputs: Tensor, targets: Tensor, commands: Tensor, generator: torch.Generator) -> Tensor:
    """Loss of the recurrent network's training, without what is only logged."""
    prediction, _ = model(inputs, generator)
    nll = gaussian_nll(targets, prediction.mean, prediction.log_variance).sum(-1)
    joint_log_variance = prediction.log_variance[..., : model.network.joint_dim]
    return (nll + gaussian_nll(commands, prediction.command, joint_log_variance).sum(-1)).mean()


def make_update(kernel: type[UFRNN], config: UFRNNConfig = PAPER, batch_size: int = BATCH_SIZE, length: int = LENGTH):
    """One update as `lerobot-train` makes it: noise, foresight, loss, gradients, clipping, Adam."""
    model, episodes = make_model(kernel, config), make_episodes(config, batch_size, length)
    optimizer = config.get_optimizer_preset().build(list(model.parameters()))
    generator = torch.Generator().manual_seed(0)

    def update() -> float:
        loss = loss_of(model, *episodes, generator)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.optimizer_grad_clip_norm)
        optimizer.step()
        return loss.item()

    return update


def make_scan_update(config: UFRNNConfig = PAPER, batch_size: int = BATCH_SIZE, length: int = LENGTH):
    """The same with XLA; its noise, too, is drawn by PyTorch, which is quicker at it. An ImportError without JAX."""
    import scan

    model = make_model(UFRNN, config)
    episodes = [scan.jnp.array(part.transpose(0, 1).numpy()) for part in make_episodes(config, batch_size, length)]
    state = scan.start_adam({name: value.detach().numpy() for name, value in model.network.named_parameters()})
    schedule, scan_update = model.foresight.schedule, scan.make_update(config)
    noise_bounds = scan.jnp.array(np.stack((schedule.low.numpy(), schedule.high.numpy())))
    shape = (length, config.foresight.num_samples, batch_size, sum(model.network.state_sizes[::2]))
    generator = torch.Generator().manual_seed(0)

    def update() -> float:
        nonlocal state
        noise = torch.randn(shape, generator=generator).numpy()
        state, loss = scan_update(state, *episodes, noise, noise_bounds)
        return float(loss)

    return update


def measure_update(seconds: float, **problem) -> dict[str, pd.DataFrame]:
    """Milliseconds of an update, each competitor in turns with the fast kernel alone; without JAX no scan."""
    with one_core():
        fast = make_update(FastUFRNN, **problem)
        times = {REFERENCE: take_turns({FAST: fast, REFERENCE: make_update(UFRNN, **problem)}, seconds / 2)}
        try:
            times[SCAN] = take_turns({FAST: fast, SCAN: make_scan_update(**problem)}, seconds / 2, warm_up=2)
        except ImportError:
            print("JAX cannot be imported: no comparison with an XLA scan (`pip install jax`).", file=sys.stderr)
    return times


def of_update(seconds: float) -> pd.DataFrame:
    """A training update at the paper's sizes (5 episodes of 150 frames, N 5, T 10) on one core, in ms."""
    rows = []
    for name, times in measure_update(seconds).items():
        ratio = text(times[name] / times[FAST])
        rows.append({"beside it": name, FAST: text(times[FAST]), "its time": text(times[name]), "ratio": ratio})
    return pd.DataFrame(rows)


# ── Acting ────────────────────────────────────────────────────────────


def make_ufrnn(kernel: str, recall: bool = False) -> UFRNNPolicy:
    """UF-RNN with default settings and random weights; with recall, it remembers demonstrations that part."""
    torch.manual_seed(0)
    bounds = {"min": -torch.ones(NUM_JOINTS), "max": torch.ones(NUM_JOINTS)}
    config = UFRNNConfig(kernel=kernel, recall=RecallConfig(enabled=recall), **FEATURES)
    policy = UFRNNPolicy(config, dataset_stats={OBS_STATE: bounds, ACTION: bounds})
    scaler = policy.image_encoder.scaler
    scaler.fit(-torch.ones_like(scaler.low), torch.ones_like(scaler.high))
    policy.model.foresight.schedule.observe(torch.tensor([[0.5, 0.5], [1.5, 1.5]]))
    if recall:
        remember_three_ways(policy)
    return policy.eval()


def remember_three_ways(policy: UFRNNPolicy, count: int = 15, length: int = 150) -> None:
    """Gives a policy demonstrations that part three ways where `time_ticks` lets the arm stop."""
    generator = torch.Generator().manual_seed(0)
    fork = policy.joint_scaler.scale(torch.full((1, NUM_JOINTS), STOP))
    start = policy.joint_scaler.scale(torch.full((1, NUM_JOINTS), START))
    along = (torch.arange(length)[:, None] - STOP_TICK) / STOP_TICK
    for index in range(count):
        way = torch.where(along < 0, fork - start, torch.eye(NUM_JOINTS)[index % 3])
        joints = fork + along * way + 0.002 * torch.randn(length, NUM_JOINTS, generator=generator)
        features = 0.05 * torch.randn(length, policy.config.image_dim, generator=generator)
        policy.demonstrations.remember(index, torch.cat((joints, features), dim=-1), joints.roll(-1, 0))


def make_other(name: str) -> PreTrainedPolicy:
    """LeRobot's `act` or `diffusion` with default settings and random weights; an ImportError without `diffusers`."""
    config = make_policy_config(name, pretrained_backbone_weights=None, **FEATURES)
    return get_policy_class(name)(config).eval()


def time_ticks(policies: dict[str, PreTrainedPolicy], seconds: float, min_rounds: int, warm_up: int = 1):
    """Milliseconds of each `select_action` at batch 1, (rounds, ticks) by policy.

    A policy that commands chunks computes in the first tick of a round and only reads its queue in the others.
    """
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(16, 1, 3, IMAGE_SIZE, IMAGE_SIZE, generator=generator)
    # An arm that stops, which contradicts a policy with recall, before changing images.
    joints = [START + (STOP - START) * min(tick / STOP_TICK, 1.0) for tick in range(CYCLE)]
    observations = [
        {OBS_STATE: torch.full((1, NUM_JOINTS), value), CAMERA: images[tick % len(images)]}
        for tick, value in enumerate(joints)
    ]
    ticks: dict[str, list[list[float]]] = {name: [] for name in policies}

    def run_round(name: str, policy: PreTrainedPolicy) -> None:
        for _ in range(2 * warm_up):  # the caches still hold the weights of another policy
            policy.select_action(dict(observations[0]))
        policy.reset()  # drops the chunk that this began
        ticks[name].append([])
        for tick in range(getattr(policy.config, "n_action_steps", CYCLE)):
            batch = dict(observations[tick % CYCLE])
            start = time.perf_counter()
            policy.select_action(batch)
            ticks[name][-1].append(1e3 * (time.perf_counter() - start))

    rounds = {name: partial(run_round, name, policy) for name, policy in policies.items()}
    with one_core(), torch.inference_mode():  # as `lerobot-eval` and `lerobot-rollout` call a policy
        take_turns(rounds, seconds, min_rounds, warm_up)
    return {name: np.array(of_policy[warm_up:]) for name, of_policy in ticks.items()}


def of_acting(seconds: float) -> pd.DataFrame:
    """`select_action` at batch 1, one camera of 128 x 128 pixels, encoder included, random weights, one core, in ms.

    ACT and Diffusion Policy compute a chunk of actions in one tick and only read it in the next ones: the worst tick is
    the longest of each chunk, for UF-RNN the longest of 100; amortised is the mean over it. With recall the worst tick
    is one that goes back, with 4,000 remembered moments.
    """
    policies: dict[str, PreTrainedPolicy] = {"ACT": make_other("act")}
    policies["UF-RNN, foresight at each step, fast kernel"] = make_ufrnn("fast")
    policies["UF-RNN, foresight at each step, readable code"] = make_ufrnn("reference")
    policies["UF-RNN, recall, going back whenever it can"] = make_ufrnn("fast", recall=True)
    times = time_ticks(policies, seconds, min_rounds=10)
    try:
        times |= time_ticks({"Diffusion Policy": make_other("diffusion")}, 0, min_rounds=1, warm_up=0)  # about a minute
    except ImportError as error:
        print(f"No comparison with Diffusion Policy: {error}", file=sys.stderr)
    return pd.DataFrame(
        {
            "policy": name,
            "ticks": ticks.size,
            "p50": f"{np.median(ticks):.3g}",
            "p99": f"{np.percentile(ticks, 99):.3g}",
            "worst tick": text(ticks.max(axis=1)),
            "amortised": text(ticks.mean(axis=1)),
        }
        for name, ticks in times.items()
    )


# ── Growth ────────────────────────────────────────────────────────────


def of_growth(seconds: float) -> pd.DataFrame:
    """An update with the fast kernel on one core, one size varied at a time around the paper's, in ms.

    The exponent is the slope of log time over log size for the three largest.
    """
    foresight = PAPER.foresight
    sizes: dict[str, dict[int, dict[str, Any]]] = {
        "N": {n: {"config": replace(PAPER, foresight=replace(foresight, num_samples=n))} for n in (1, 2, 5, 10, 20)},
        "T": {t: {"config": replace(PAPER, foresight=replace(foresight, horizon=t))} for t in (1, 5, 10, 20, 40)},
        "batch": {size: {"batch_size": size} for size in (1, 2, 5, 10, 20)},
        "L": {length: {"length": length} for length in (50, 100, 149, 300, 600)},
        "hidden size": {
            lower: {"config": replace(PAPER, joint_hidden_dim=lower, image_hidden_dim=lower, shared_hidden_dim=shared)}
            for lower, shared in ((25, 10), (50, 20), (100, 40), (200, 80))
        },
    }
    rows = []
    for name, problems in sizes.items():
        with one_core():
            calls = {size: make_update(FastUFRNN, **problem) for size, problem in problems.items()}
            times = take_turns(calls, seconds / len(sizes))
        slope, _ = np.polyfit(np.log(list(calls)[-3:]), np.log(times.median()[-3:]), 1)
        cells = ", ".join(f"{size}: {text(times[size])}" for size in calls)
        rows.append({"what": name, "size: ms": cells, "exponent": f"{slope:.2f}"})
    return pd.DataFrame(rows)


# ── The command ───────────────────────────────────────────────────────

PARTS: dict[str, Callable[[float], pd.DataFrame]] = {"update": of_update, "acting": of_acting, "growth": of_growth}


@dataclass
class BenchmarkConfig:
    """What to measure."""

    quick: bool = False  # only update and `select_action`, under a minute; ends in a JSON object, writes nothing
    parts: tuple[str, ...] = tuple(PARTS)  # tables to make
    seconds: float = 60.0  # time for each part, after compiling; Diffusion Policy takes a minute more
    output_dir: Path = Path("outputs/benchmark")  # folder for a `.md` and a `.json` file of each part

    def __post_init__(self) -> None:
        if not self.parts or not set(self.parts) <= set(PARTS):
            raise ParsingError(f"--parts must be of {list(PARTS)}, got {list(self.parts)}.")
        check_range(self, "seconds", above=0)


def quick_figures(seconds: float = 4.0, rounds: int = 10, **problem) -> dict[str, float | None]:
    """The figures to watch from day to day; those of the scan are `None` without JAX."""
    times = measure_update(seconds, **problem)
    reference, scan = times[REFERENCE], times.get(SCAN)
    (ticks,) = time_ticks({"": make_ufrnn("fast")}, 0, rounds).values()
    figures = {
        "update_speedup_vs_reference": (reference[REFERENCE] / reference[FAST]).median(),
        "update_ratio_vs_scan": None if scan is None else (scan[FAST] / scan[SCAN]).median(),
        "select_action_p99_ms": np.percentile(ticks, 99),
        "update_ms": (reference if scan is None else scan)[FAST].median(),
        "update_reference_ms": reference[REFERENCE].median(),
        "update_scan_ms": None if scan is None else scan[SCAN].median(),
        "select_action_p50_ms": np.median(ticks),
    }
    return {name: None if value is None else round(float(value), 4) for name, value in figures.items()}


def main(config: BenchmarkConfig) -> None:
    """Measures, prints and writes."""
    if config.quick:
        print(", ".join(f"{name} {value}" for name, value in describe_machine().items()), flush=True)
        print(json.dumps(quick_figures()), flush=True)
        return
    for name in config.parts:
        write(name, PARTS[name].__doc__, PARTS[name](config.seconds), config.output_dir)


if __name__ == "__main__":
    run(main, BenchmarkConfig, ["--quick=true" if word == "--quick" else word for word in sys.argv[1:]])
