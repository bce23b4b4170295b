"""Foresight: imagine noisy futures, keep the state whose future is least uncertain (UF-RNN, Sec. III-C, Fig. 2(C)).

Three functions read like the figure: `perturb` the hidden state, `roll_out` each candidate in closed loop, `select` the
candidate whose predicted variance falls most. `Foresight` joins them, and `UFRNN` runs network and foresight step by
step. Candidates are stacked candidate-major: row `n * B + b` of a stacked tensor is candidate n of sequence b.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Generator, Tensor, nn

from .networks import SHLSTM, HiddenState, Prediction

if TYPE_CHECKING:
    from .configuration_ufrnn import ForesightConfig, UFRNNConfig

PERTURBED_STATES: dict[str, tuple[str, ...]] = {
    "hidden": ("h_joint", "h_image", "h_shared"),
    "shared": ("h_shared",),
    "hidden_and_cell": HiddenState._fields,
}
MODALITIES = ("joint", "image")
RANGE_QUANTILES = (0.05, 0.95)
RANGE_MOMENTUM = 0.05
"""Weight of the newest update in the moving average of the variance's range."""


def modality_means(values: Tensor, joint_dim: int) -> Tensor:
    """Mean over the dimensions of each modality: (..., D) -> (..., 2), joints first."""
    return torch.stack((values[..., :joint_dim].mean(-1), values[..., joint_dim:].mean(-1)), dim=-1)


def uncertainty(log_variance: Tensor, joint_dim: int, aggregation: str) -> Tensor:
    """One number for how uncertain a prediction is, (..., D) -> (...): the sum of both modalities' means.

    `aggregation` is `variance`, or `entropy` for log-variances (the entropy up to a constant).
    """
    values = log_variance if aggregation == "entropy" else log_variance.exp()
    return modality_means(values, joint_dim).sum(-1)


def perturb(state: HiddenState, noise: Tensor, noise_std: Tensor, perturbed: tuple[str, ...]) -> HiddenState:
    """Candidates `H^n ~ N(H_t, f(var))` (Sec. III-C.1).

    Args:
        state (`HiddenState`):
            H_t, (B, hidden size) each.
        noise (`Tensor`):
            Standard normal noise of the perturbed fields side by side, (N, B, sum of their hidden sizes).
        noise_std (`Tensor`):
            Standard deviation for the joint and the image LSTM, (B, 2); the shared LSTM takes their mean.
        perturbed (`tuple[str, ...]`):
            Names of the `HiddenState` fields to perturb, in their order.

    Returns:
        `HiddenState`: stacked candidates, (N * B, hidden size) each.
    """
    std = {"joint": noise_std[:, :1], "image": noise_std[:, 1:], "shared": noise_std.mean(-1, keepdim=True)}
    sizes = [getattr(state, name).shape[-1] for name in perturbed]
    noise_of = dict(zip(perturbed, noise.split(sizes, dim=-1), strict=True))

    def candidates(name: str) -> Tensor:
        value = getattr(state, name)
        if name not in noise_of:
            return value.repeat(len(noise), 1)
        return (value + std[name.split("_")[1]] * noise_of[name]).flatten(0, 1)

    return HiddenState(*(candidates(name) for name in HiddenState._fields))


def imagine_states(network: SHLSTM, state: HiddenState, num_steps: int) -> list[HiddenState]:
    """Closed loop: a state (M, hidden size) and the T states that follow when predicted means are fed back."""
    states = [state]
    for _ in range(num_steps):
        states.append(network.step(network.predict_mean(states[-1]), states[-1]))
    return states


def roll_out(network: SHLSTM, state: HiddenState, horizon: int) -> Prediction:
    """What states (M, hidden size) imagine: predictions after each of T steps in closed loop, (T, M, ...) each."""
    return network.predict(HiddenState.stack(imagine_states(network, state, horizon)[1:]))


def select(baseline: Tensor, final: Tensor) -> Tensor:
    """Index (B,) of the candidate whose uncertainty fell most: `argmax_n (o_t^var - o_{t+T}^{n,var})` (Sec. III-C.3).

    `baseline` (N, B) is the uncertainty now, `final` (N, B) that at the horizon.
    """
    return (baseline - final).argmax(dim=0)


class NoiseSchedule(nn.Module):
    """`f`: maps the predicted variance of each modality to the standard deviation of the hidden-state noise.

    The variance is placed within the range it has lately run through, and that place within `noise_range`. The range
    follows training by an exponential moving average of two quantiles of each update: variances shrink by orders of
    magnitude while a network learns, and a range that never forgot would switch exploration off; the true extremes
    would let an episode's very first step, of which nothing can be known, dwarf all others.

    Args:
        config (`ForesightConfig`):
            Its `noise_range`, `noise_unit` and `noise_scale`.
    """

    low: Tensor
    high: Tensor
    is_initialized: Tensor

    def __init__(self, config: "ForesightConfig"):
        super().__init__()
        self.config = config
        self.register_buffer("low", torch.zeros(len(MODALITIES)))
        self.register_buffer("high", torch.zeros(len(MODALITIES)))
        self.register_buffer("is_initialized", torch.zeros((), dtype=torch.bool))

    def forward(self, variance: Tensor) -> Tensor:
        """Standard deviation of the noise (..., 2), from the mean predicted variance of each modality (..., 2)."""
        value = variance.log() if self.config.noise_scale == "log" else variance
        place = ((value - self.low) / (self.high - self.low).clamp(min=1e-12)).clamp(0, 1)
        low, high = self.config.noise_range
        noise = low + (high - low) * place
        return noise.sqrt() if self.config.noise_unit == "variance" else noise

    @torch.no_grad()
    def observe(self, variance: Tensor) -> None:
        """Moves the range towards that of `variance` (M, 2), one training update's worth of variances."""
        value = variance.log() if self.config.noise_scale == "log" else variance
        low, high = value.quantile(value.new_tensor(RANGE_QUANTILES), dim=0)
        if not self.is_initialized:
            self.low.copy_(low)
            self.high.copy_(high)
            self.is_initialized.fill_(True)
        else:
            self.low.lerp_(low, RANGE_MOMENTUM)
            self.high.lerp_(high, RANGE_MOMENTUM)


@dataclass(frozen=True)
class ForesightTrace:
    """What foresight saw at one step, for analysis; of L steps, each tensor has a first dimension more.

    Attributes:
        noise_std (`Tensor`): standard deviation of the noise for the joint and the image LSTM, (B, 2).
        chosen (`Tensor`): index of the kept candidate, int64 (B,).
        baseline (`Tensor`): uncertainty before foresight, (N, B).
        final (`Tensor`): uncertainty of each candidate at its horizon, (N, B).
        horizon (`Tensor`): number of imagined steps that counted, int64 (N, B).
        calmest (`Tensor`, *optional*): number of imagined steps after which each candidate was least uncertain, int64
            (N, B); only where the horizon is learned.
        futures (`Prediction`, *optional*): what each candidate imagined, (T, N, B, ...); only the reference kernel
            keeps it.
    """

    noise_std: Tensor
    chosen: Tensor
    baseline: Tensor
    final: Tensor
    horizon: Tensor
    calmest: Tensor | None
    futures: Prediction | None

    @classmethod
    def stack(cls, traces: "Sequence[ForesightTrace]") -> "ForesightTrace":
        """One trace of L steps from those of the reference kernel."""

        def over_time(name: str) -> Tensor:
            return torch.stack([getattr(trace, name) for trace in traces])

        return cls(
            over_time("noise_std"),
            over_time("chosen"),
            over_time("baseline"),
            over_time("final"),
            over_time("horizon"),
            None if traces[0].calmest is None else over_time("calmest"),
            Prediction(*map(torch.stack, zip(*(trace.imagined for trace in traces), strict=True))),
        )

    @property
    def imagined(self) -> Prediction:
        """`Prediction`: `futures`; a RuntimeError if they were not kept."""
        if self.futures is None:
            raise RuntimeError("The fast kernel keeps no imagined futures; load the policy with kernel='reference'.")
        return self.futures

    def at(self, step: int) -> "ForesightTrace":
        """The trace of one step of L."""
        calmest, futures = self.calmest, self.futures
        return ForesightTrace(
            self.noise_std[step],
            self.chosen[step],
            self.baseline[step],
            self.final[step],
            self.horizon[step],
            None if calmest is None else calmest[step],
            None if futures is None else Prediction(*(values[step] for values in futures)),
        )


class Foresight(nn.Module):
    """Explores around a hidden state: with foresight (UF-RNN), with bare noise (SH-RNN+noise) or not at all (SH-RNN).

    Args:
        config (`UFRNNConfig`):
            Its `exploration` and `foresight`.
    """

    def __init__(self, config: "UFRNNConfig"):
        super().__init__()
        self.config = config.foresight
        self.exploration = config.exploration
        self.num_samples = self.config.num_samples if self.exploration == "foresight" else 1
        self.perturbed = PERTURBED_STATES[self.config.perturbed_states]
        self.schedule = NoiseSchedule(self.config)

    def forward(
        self,
        network: SHLSTM,
        state: HiddenState,
        previous: Prediction,
        generator: Generator | None = None,
    ) -> tuple[HiddenState, ForesightTrace | None]:
        """Replaces `H_t` by the state to go on with.

        The roll-outs carry no gradient; the kept state does, through `H_t`.

        Args:
            network (`SHLSTM`):
                The network that imagines.
            state (`HiddenState`):
                H_t, (B, hidden size) each.
            previous (`Prediction`):
                What step t-1 predicted for step t; its variance sets the noise.
            generator (`torch.Generator`, *optional*):
                Source of randomness.

        Returns:
            `tuple[HiddenState, ForesightTrace | None]`: the kept state, and what was seen (`None` without foresight).
        """
        if self.exploration == "none":
            return state, None
        with torch.no_grad():
            noise_std = self.schedule(modality_means(previous.log_variance.exp(), network.joint_dim))  # (B, 2)
        noise = self.sample_noise(state, generator)  # (N, B, S)
        if self.exploration == "noise":
            return perturb(state, noise, noise_std, self.perturbed), None
        with torch.no_grad():
            candidates = perturb(state, noise, noise_std, self.perturbed)
            trace = self._imagine(network, candidates, previous, noise_std)
        sequences = torch.arange(trace.chosen.shape[0], device=trace.chosen.device)
        chosen_noise = noise[trace.chosen, sequences].unsqueeze(0)
        return perturb(state, chosen_noise, noise_std, self.perturbed), trace

    def sample_noise(self, state: HiddenState, generator: Generator | None = None) -> Tensor:
        """Standard normal noise of the perturbed fields side by side, (N, B, sum of their hidden sizes)."""
        batch_size, like = len(state.h_joint), state.h_joint
        size = sum(getattr(state, name).shape[-1] for name in self.perturbed)
        shape = (self.num_samples, batch_size, size)
        noise = torch.randn(shape, dtype=like.dtype, device=like.device, generator=generator)
        if self.config.keep_unperturbed and self.exploration == "foresight":
            noise[0] = 0
        return noise

    def _imagine(
        self, network: SHLSTM, candidates: HiddenState, previous: Prediction, noise_std: Tensor
    ) -> ForesightTrace:
        config, batch_size = self.config, noise_std.shape[0]

        def unstack(values: Tensor) -> Tensor:  # (..., N * B, D) -> (..., N, B, D)
            return values.unflatten(-2, (self.num_samples, batch_size))

        def uncertainty_of(log_variance: Tensor) -> Tensor:
            return uncertainty(log_variance, network.joint_dim, config.variance_aggregation)

        futures = Prediction(*map(unstack, roll_out(network, candidates, config.horizon)))  # (T, N, B, ...)
        uncertainties = uncertainty_of(futures.log_variance)  # (T, N, B)
        horizon, calmest = torch.full_like(uncertainties[0], config.horizon, dtype=torch.int64), None
        baseline = uncertainty_of(previous.log_variance).expand_as(horizon)
        if config.horizon_mode == "learned":
            fraction = torch.sigmoid(unstack(network.predict(candidates).step)).amax(-1)  # (N, B)
            horizon = (fraction * config.horizon).ceil().long().clamp(1, config.horizon)
            calmest = uncertainties.argmin(0) + 1
        if config.variance_baseline == "candidate":
            baseline = uncertainty_of(unstack(network.predict(candidates).log_variance))
        final = uncertainties.gather(0, (horizon - 1).unsqueeze(0)).squeeze(0)
        return ForesightTrace(noise_std, select(baseline, final), baseline, final, horizon, calmest, futures)


class Memory(NamedTuple):
    """What one step hands to the next: the hidden state that was kept and what it predicts."""

    state: HiddenState
    prediction: Prediction


class UFRNN(nn.Module):
    """SH-LSTM whose hidden state foresight refines at every step: in training, and in acting without recall.

    Args:
        config (`UFRNNConfig`):
            Configuration with its features filled in.
    """

    def __init__(self, config: "UFRNNConfig"):
        super().__init__()
        self.network = SHLSTM(config)
        self.foresight = Foresight(config)

    def initial_memory(self, batch_size: int) -> Memory:
        """Memory of `batch_size` sequences that have seen nothing."""
        state = self.network.initial_state(batch_size)
        return Memory(state, self.network.predict(state))

    def advance(
        self, inputs: Tensor, memory: Memory, generator: Generator | None = None, explore: bool = True
    ) -> tuple[Memory, ForesightTrace | None]:
        """One time step: read the inputs, explore, predict.

        Args:
            inputs (`Tensor`):
                Scaled joints and image features, (B, D).
            memory (`Memory`):
                Memory after the previous step.
            generator (`torch.Generator`, *optional*):
                Source of the exploration noise.
            explore (`bool`, *optional*, defaults to `True`):
                Whether foresight refines the state.

        Returns:
            `tuple[Memory, ForesightTrace | None]`: memory after this step, and what foresight saw.
        """
        state, trace = self.network.step(inputs, memory.state), None
        if explore:
            state, trace = self.foresight(self.network, state, memory.prediction, generator)
        return Memory(state, self.network.predict(state)), trace

    @torch.no_grad()
    def imagine(self, state: HiddenState, num_steps: int) -> HiddenState:
        """T time steps in closed loop, without exploring: the predicted means are fed back as inputs.

        Args:
            state (`HiddenState`):
                Where to start from, (M, hidden size) each.
            num_steps (`int`):
                Number of steps T.

        Returns:
            `HiddenState`: `state` and the state after each of the T steps, (T + 1, M, hidden size) each.
        """
        return HiddenState.stack(imagine_states(self.network, state, num_steps))

    def forward(self, inputs: Tensor, generator: Generator | None = None) -> tuple[Prediction, ForesightTrace | None]:
        """Predicts every next step of whole episodes, reading the measured inputs (teacher forcing).

        Args:
            inputs (`Tensor`):
                Scaled joints and image features, (B, L, D).
            generator (`torch.Generator`, *optional*):
                Source of the exploration noise.

        Returns:
            `tuple[Prediction, ForesightTrace | None]`: predictions stacked over time, (B, L, ...) each, and
                what foresight saw at each of the L steps (`None` without foresight).
        """
        memory = self.initial_memory(inputs.shape[0])
        predictions, traces = [], []
        for step_inputs in inputs.unbind(dim=1):
            memory, trace = self.advance(step_inputs, memory, generator)
            predictions.append(memory.prediction)
            if trace is not None:
                traces.append(trace)
        prediction = Prediction(*(torch.stack(values, dim=1) for values in zip(*predictions, strict=True)))
        return prediction, ForesightTrace.stack(traces) if traces else None

    def modality_variance(self, prediction: Prediction) -> Tensor:
        """Mean predicted variance of each modality, (..., 2), joints first."""
        return modality_means(prediction.log_variance.exp(), self.network.joint_dim)
