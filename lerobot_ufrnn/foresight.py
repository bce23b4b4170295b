"""Foresight: imagine noisy futures, keep the state whose future is least uncertain (UF-RNN, Sec. III-C, Fig. 2(C)).

Three functions read like the figure: `perturb` the hidden state, `roll_out` each candidate in closed loop, `select` the
candidate whose predicted variance falls most. `Foresight` joins them. Candidates are stacked candidate-major: row
`n * B + b` of a stacked tensor is candidate n of sequence b.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor, nn

from .networks import SHLSTM, HiddenState, Prediction

PERTURBED_STATES: dict[str, tuple[str, ...]] = {
    "hidden": ("h_joint", "h_image", "h_shared"),
    "shared": ("h_shared",),
    "hidden_and_cell": HiddenState._fields,
}
MODALITIES = ("joint", "image")
RANGE_QUANTILES = (0.05, 0.95)


def modality_means(values: Tensor, joint_dim: int) -> Tensor:
    """Mean over the dimensions of each modality: (..., D) -> (..., 2), joints first."""
    return torch.stack((values[..., :joint_dim].mean(-1), values[..., joint_dim:].mean(-1)), dim=-1)


def uncertainty(log_variance: Tensor, joint_dim: int, aggregation: str) -> Tensor:
    """One number for how uncertain a prediction is: the sum of both modalities' means.

    Args:
        log_variance (`Tensor`):
            Predicted log-variances, (..., D).
        joint_dim (`int`):
            How many of the D dimensions are joints.
        aggregation (`str`):
            `variance` averages variances, `entropy` averages log-variances (the entropy up to a constant).

    Returns:
        `Tensor`: uncertainty, (...).
    """
    values = log_variance if aggregation == "entropy" else log_variance.exp()
    return modality_means(values, joint_dim).sum(-1)


def sample_noise(
    state: HiddenState,
    num_samples: int,
    perturbed: tuple[str, ...],
    keep_unperturbed: bool = False,
    generator: Generator | None = None,
) -> Tensor:
    """Standard normal noise for the perturbed states.

    Args:
        state (`HiddenState`):
            The state to perturb, (B, hidden size) each.
        num_samples (`int`):
            Number of candidates N.
        perturbed (`tuple[str, ...]`):
            Names of the `HiddenState` fields to perturb, in their order.
        keep_unperturbed (`bool`, *optional*, defaults to `False`):
            Leave the first candidate as it is.
        generator (`torch.Generator`, *optional*):
            Source of randomness; PyTorch's global one when not given.

    Returns:
        `Tensor`: noise of the perturbed fields side by side, (N, B, sum of their hidden sizes).
    """
    size = sum(getattr(state, name).shape[-1] for name in perturbed)
    like = state.h_joint
    noise = torch.randn(num_samples, like.shape[0], size, dtype=like.dtype, device=like.device, generator=generator)
    if keep_unperturbed:
        noise[0] = 0
    return noise


def perturb(state: HiddenState, noise: Tensor, noise_std: Tensor, perturbed: tuple[str, ...]) -> HiddenState:
    """Candidates `H^n ~ N(H_t, f(var))`.

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
    """Closed loop: a state and those that follow when the predicted means are fed back as inputs.

    Args:
        network (`SHLSTM`):
            The network that imagines.
        state (`HiddenState`):
            Where to start from, (M, hidden size) each.
        num_steps (`int`):
            Number of steps T.

    Returns:
        `list[HiddenState]`: `state` and the state after each of the T steps, (M, hidden size) each.
    """
    states = [state]
    for _ in range(num_steps):
        states.append(network.step(network.predict_mean(states[-1]), states[-1]))
    return states


def roll_out(network: SHLSTM, state: HiddenState, horizon: int) -> Prediction:
    """Closed-loop prediction: feeds the predicted means back as inputs for `horizon` steps.

    Args:
        network (`SHLSTM`):
            The network that imagines.
        state (`HiddenState`):
            Where to start from, (M, hidden size) each.
        horizon (`int`):
            Number of steps T.

    Returns:
        `Prediction`: the predictions after each of the T steps, (T, M, ...) each.
    """
    return network.predict(HiddenState.stack(imagine_states(network, state, horizon)[1:]))


def select(baseline: Tensor, final: Tensor) -> Tensor:
    """Index of the candidate whose uncertainty fell most: `argmax_n (o_t^var - o_{t+T}^{n,var})`.

    Args:
        baseline (`Tensor`):
            Uncertainty now, (N, B), or (1, B) if common to all candidates.
        final (`Tensor`):
            Uncertainty at the horizon, (N, B).

    Returns:
        `Tensor`: chosen candidate of each sequence, int64 (B,).
    """
    return (baseline - final).argmax(dim=0)


class NoiseSchedule(nn.Module):
    """`f`: maps the predicted variance of each modality to the standard deviation of the hidden-state noise.

    The variance is placed within the range it has lately run through, and that place within `[low, high]` of the noise.
    The range follows training by an exponential moving average of two quantiles of each update: variances shrink by
    orders of magnitude while a network learns, and a range that never forgot would switch exploration off; the true
    extremes would let an episode's very first step, of which nothing can be known, dwarf all others.

    Args:
        noise_range (`tuple[float, float]`):
            Noise at the least and at the most uncertain moment.
        noise_unit (`str`):
            Whether `noise_range` is a `variance` or a `std` (standard deviation).
        log_scale (`bool`):
            Place the variance on a logarithmic scale.
        momentum (`float`, *optional*, defaults to `0.05`):
            Weight of the newest update in the moving average.
    """

    low: Tensor
    high: Tensor
    is_initialized: Tensor

    def __init__(self, noise_range: tuple[float, float], noise_unit: str, log_scale: bool, momentum: float = 0.05):
        super().__init__()
        self.noise_range = noise_range
        self.noise_unit = noise_unit
        self.log_scale = log_scale
        self.momentum = momentum
        self.register_buffer("low", torch.zeros(len(MODALITIES)))
        self.register_buffer("high", torch.zeros(len(MODALITIES)))
        self.register_buffer("is_initialized", torch.zeros((), dtype=torch.bool))

    def forward(self, variance: Tensor) -> Tensor:
        """Standard deviation of the noise.

        Args:
            variance (`Tensor`):
                Mean predicted variance of each modality, (..., 2).

        Returns:
            `Tensor`: standard deviation, (..., 2).
        """
        value = variance.log() if self.log_scale else variance
        place = ((value - self.low) / (self.high - self.low).clamp(min=1e-12)).clamp(0, 1)
        low, high = self.noise_range
        noise = low + (high - low) * place
        return noise.sqrt() if self.noise_unit == "variance" else noise

    @torch.no_grad()
    def observe(self, variance: Tensor) -> None:
        """Moves the range towards that of `variance` (M, 2), one training update's worth of variances."""
        value = variance.log() if self.log_scale else variance
        low, high = value.quantile(value.new_tensor(RANGE_QUANTILES), dim=0)
        if not self.is_initialized:
            self.low.copy_(low)
            self.high.copy_(high)
            self.is_initialized.fill_(True)
        else:
            self.low.lerp_(low, self.momentum)
            self.high.lerp_(high, self.momentum)


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
        """`Prediction`: `futures`.

        Raises:
            RuntimeError: If they were not kept.
        """
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
        exploration (`str`):
            `foresight`, `noise` or `none`.
        schedule (`NoiseSchedule`):
            Maps predicted variance to noise.
        num_samples (`int`):
            Candidates N; `noise` uses one.
        horizon (`int`):
            Steps T imagined ahead; the longest horizon where it is learned.
        learned_horizon (`bool`):
            Each candidate counts at `ceil(T * sigmoid(step))`, the larger of both modalities, instead of at T.
        perturbed_states (`str`):
            A key of `PERTURBED_STATES`.
        baseline (`str`):
            `common`: the variance predicted for this step, the same for all; `candidate`: each candidate's own.
        aggregation (`str`):
            See `uncertainty`.
        keep_unperturbed (`bool`):
            Whether the unperturbed state is one of the candidates.
    """

    def __init__(
        self,
        exploration: str,
        schedule: NoiseSchedule,
        num_samples: int,
        horizon: int,
        learned_horizon: bool = False,
        perturbed_states: str = "hidden",
        baseline: str = "common",
        aggregation: str = "variance",
        keep_unperturbed: bool = False,
    ):
        super().__init__()
        self.exploration = exploration
        self.schedule = schedule
        self.num_samples = num_samples if exploration == "foresight" else 1
        self.horizon = horizon
        self.learned_horizon = learned_horizon
        self.perturbed = PERTURBED_STATES[perturbed_states]
        self.baseline = baseline
        self.aggregation = aggregation
        self.keep_unperturbed = keep_unperturbed and exploration == "foresight"

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
        """Noise for one step, (N, B, S): see [`sample_noise`]."""
        return sample_noise(state, self.num_samples, self.perturbed, self.keep_unperturbed, generator)

    def _imagine(
        self, network: SHLSTM, candidates: HiddenState, previous: Prediction, noise_std: Tensor
    ) -> ForesightTrace:
        batch_size = noise_std.shape[0]

        def unstack(values: Tensor) -> Tensor:  # (..., N * B, D) -> (..., N, B, D)
            return values.unflatten(-2, (self.num_samples, batch_size))

        futures = Prediction(*map(unstack, roll_out(network, candidates, self.horizon)))  # (T, N, B, ...)
        uncertainties = uncertainty(futures.log_variance, network.joint_dim, self.aggregation)  # (T, N, B)
        horizon, calmest = torch.full_like(uncertainties[0], self.horizon, dtype=torch.int64), None
        baseline = uncertainty(previous.log_variance, network.joint_dim, self.aggregation).expand_as(horizon)
        if self.learned_horizon or self.baseline == "candidate":
            now = network.predict(candidates)
        if self.learned_horizon:
            fraction = torch.sigmoid(unstack(now.step)).amax(-1)  # (N, B)
            horizon = (fraction * self.horizon).ceil().long().clamp(1, self.horizon)
            calmest = uncertainties.argmin(0) + 1
        if self.baseline == "candidate":
            baseline = uncertainty(unstack(now.log_variance), network.joint_dim, self.aggregation)
        final = uncertainties.gather(0, (horizon - 1).unsqueeze(0)).squeeze(0)
        return ForesightTrace(noise_std, select(baseline, final), baseline, final, horizon, calmest, futures)
