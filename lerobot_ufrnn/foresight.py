"""Foresight: imagine noisy futures, keep the state whose future is least uncertain (UF-RNN, Sec. III-C, Fig. 2(C)).

Three functions read like the figure: `perturb` the hidden state, `roll_out` each candidate in closed loop, `select` the
candidate whose predicted variance falls most. `Foresight` joins them. Candidates are stacked candidate-major: row
`n * B + b` of a stacked tensor is candidate n of sequence b.
"""

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
) -> dict[str, Tensor]:
    """Standard normal noise for the perturbed states.

    Args:
        state (`HiddenState`):
            The state to perturb, (B, hidden size) each.
        num_samples (`int`):
            Number of candidates N.
        perturbed (`tuple[str, ...]`):
            Names of the `HiddenState` fields to perturb.
        keep_unperturbed (`bool`, *optional*, defaults to `False`):
            Leave the first candidate as it is.
        generator (`torch.Generator`, *optional*):
            Source of randomness; PyTorch's global one when not given.

    Returns:
        `dict[str, Tensor]`: field name to noise, (N, B, hidden size).
    """
    sizes = [getattr(state, name).shape[-1] for name in perturbed]
    like = state.h_joint
    joined = torch.randn(
        num_samples, like.shape[0], sum(sizes), dtype=like.dtype, device=like.device, generator=generator
    )
    if keep_unperturbed:
        joined[0] = 0
    return dict(zip(perturbed, joined.split(sizes, dim=-1), strict=True))


def perturb(state: HiddenState, noise: dict[str, Tensor], noise_std: Tensor) -> HiddenState:
    """Candidates `H^n ~ N(H_t, f(var))`.

    Args:
        state (`HiddenState`):
            H_t, (B, hidden size) each.
        noise (`dict[str, Tensor]`):
            Field name to standard normal noise, (N, B, hidden size).
        noise_std (`Tensor`):
            Standard deviation for the joint and the image LSTM, (B, 2); the shared LSTM takes their mean.

    Returns:
        `HiddenState`: stacked candidates, (N * B, hidden size) each.
    """
    std = {"joint": noise_std[:, :1], "image": noise_std[:, 1:], "shared": noise_std.mean(-1, keepdim=True)}
    num_samples = next(iter(noise.values())).shape[0]

    def candidates(name: str) -> Tensor:
        value = getattr(state, name)
        if name not in noise:
            return value.repeat(num_samples, 1)
        return (value + std[name.split("_")[1]] * noise[name]).flatten(0, 1)

    return HiddenState(*(candidates(name) for name in HiddenState._fields))


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
    states = []
    for _ in range(horizon):
        state = network.step(network.predict_mean(state), state)
        states.append(state)
    return network.predict(HiddenState(*(torch.stack(values) for values in zip(*states, strict=True))))


def select(baseline: Tensor, final: Tensor) -> Tensor:
    """Index of the candidate whose uncertainty fell most: `argmax_n (o_t^var - o_{t+T}^{n,var})`.

    Args:
        baseline (`Tensor`):
            Uncertainty now, (1, B) if common to all candidates or (N, B).
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
    """What foresight saw at one step, for analysis.

    Attributes:
        noise_std (`Tensor`): standard deviation of the noise for the joint and the image LSTM, (B, 2).
        chosen (`Tensor`): index of the kept candidate, int64 (B,).
        baseline (`Tensor`): uncertainty before foresight, (1, B), or (N, B) where each candidate has its own.
        final (`Tensor`): uncertainty of each candidate at its horizon, (N, B).
        horizon (`Tensor`): number of imagined steps that counted, int64 (N, B).
        means (`Tensor`): imagined scaled sensor values, (T, N, B, D).
        log_variances (`Tensor`): their log-variances, (T, N, B, D).
    """

    noise_std: Tensor
    chosen: Tensor
    baseline: Tensor
    final: Tensor
    horizon: Tensor
    means: Tensor
    log_variances: Tensor


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
            noise = sample_noise(state, self.num_samples, self.perturbed, self.keep_unperturbed, generator)
        if self.exploration == "noise":
            return perturb(state, noise, noise_std), None
        with torch.no_grad():
            trace = self._imagine(network, perturb(state, noise, noise_std), previous, noise_std)
        sequences = torch.arange(trace.chosen.shape[0], device=trace.chosen.device)
        chosen_noise = {name: value[trace.chosen, sequences].unsqueeze(0) for name, value in noise.items()}
        return perturb(state, chosen_noise, noise_std), trace

    def _imagine(
        self, network: SHLSTM, candidates: HiddenState, previous: Prediction, noise_std: Tensor
    ) -> ForesightTrace:
        batch_size = noise_std.shape[0]

        def unstack(values: Tensor) -> Tensor:  # (..., N * B, D) -> (..., N, B, D)
            return values.unflatten(-2, (self.num_samples, batch_size))

        futures = roll_out(network, candidates, self.horizon)
        log_variances = unstack(futures.log_variance)  # (T, N, B, D)
        horizon = torch.full((self.num_samples, batch_size), self.horizon, device=noise_std.device)
        if self.baseline == "candidate" or self.learned_horizon:
            now = network.predict(candidates)
        if self.learned_horizon:
            fraction = torch.sigmoid(unstack(now.step)).amax(-1)  # (N, B)
            horizon = (fraction * self.horizon).ceil().long().clamp(1, self.horizon)
        reached = log_variances.gather(
            0, (horizon - 1)[None, :, :, None].expand(1, -1, -1, log_variances.shape[-1])
        ).squeeze(0)
        final = uncertainty(reached, network.joint_dim, self.aggregation)  # (N, B)
        start = unstack(now.log_variance) if self.baseline == "candidate" else previous.log_variance.unsqueeze(0)
        baseline = uncertainty(start, network.joint_dim, self.aggregation)
        return ForesightTrace(
            noise_std, select(baseline, final), baseline, final, horizon, unstack(futures.mean), log_variances
        )
