"""What else could be done: futures that begin with other sensations, which of them are open, and the one to try.

Where several ways were demonstrated, the network is uncertain of what it will sense next: its predicted variance spans
them. So a copy that imagines to sense something other than expected, by as much as the network is uncertain of each
value, is led into one of the ways, and the wider they part the better it gets there. The deviation is held for some
steps, as that of a door that has begun to move would be. Noise on the hidden state itself gets there much more rarely
the better the network has learned to lead back to its way.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from .networks import HiddenState, Prediction
from .recurrent import UFRNN

DEVIATION_STEPS = 8
"""Imagined steps for which a copy senses something other than expected, before its future counts."""

SOON = 6
"""Imagined steps after which a future that is determined is well on its way."""

SAME_FUTURE = 0.2
"""Standard deviation of the kernel that calls two futures the same, as a fraction of how far futures lead."""

REFUTED = 0.3
"""Likeness to a failed try above which a future is refuted."""


@dataclass(frozen=True)
class Alternatives:
    """Futures that were imagined at one time.

    Attributes:
        states (`HiddenState`): first state of each future and those after, (T + 1, N, hidden size) each.
        predictions (`Prediction`): what each of these states predicts, (T + 1, N, ...) each.
        joint_dim (`int`): how many of the predicted values are joints, D_j.
    """

    states: HiddenState
    predictions: Prediction
    joint_dim: int

    @property
    def joints(self) -> Tensor:
        """`Tensor`: scaled joints that are predicted, (T + 1, N, D_j)."""
        return self.predictions.mean[..., : self.joint_dim]

    @property
    def starts(self) -> Tensor:
        """`Tensor`: scaled joints where the futures start, (N, D_j)."""
        return self.joints[0]

    @property
    def ends(self) -> Tensor:
        """`Tensor`: scaled joints where the futures end, (N, D_j)."""
        return self.joints[-1]

    @classmethod
    def imagine(
        cls,
        model: UFRNN,
        state: HiddenState,
        num_samples: int,
        noise_range: tuple[float, float],
        horizon: int,
        generator: Generator | None = None,
    ) -> "Alternatives":
        """Plays the futures of copies of one state, each of which begins with sensations of its own.

        Args:
            model (`UFRNN`):
                The model that imagines.
            state (`HiddenState`):
                State to copy, (1, hidden size) each.
            num_samples (`int`):
                Number of copies N.
            noise_range (`tuple[float, float]`):
                Range of how far sensations deviate from the predicted means, in predicted standard deviations; a
                copy's is uniformly distributed over it and times a standard normal number for each sensor value.
            horizon (`int`):
                Number of imagined steps T after the deviation.
            generator (`torch.Generator`, *optional*):
                Source of randomness.

        Returns:
            `Alternatives`: the futures.
        """
        network, (low, high) = model.network, noise_range
        copies = HiddenState(*(values.expand(num_samples, -1) for values in state))
        like = network.predict_mean(copies)
        scale = torch.rand(num_samples, 1, generator=generator, dtype=like.dtype, device=like.device)
        deviation = torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)
        deviation *= low + (high - low) * scale
        for _ in range(DEVIATION_STEPS):
            expected = network.predict(copies)
            copies = network.step(expected.mean + deviation * (expected.log_variance / 2).exp(), copies)
        states = model.imagine(copies, horizon)
        return cls(states, network.predict(states), network.joint_dim)

    def refuted(self, failures: Iterable[tuple[float, Tensor]], here: Tensor) -> Tensor:
        """How much each future is like a failed one.

        Args:
            failures (`Iterable[tuple[float, Tensor]]`):
                Weight of each failure, and the scaled joints where it was to end, (D_j,).
            here (`Tensor`):
                Scaled joints where the arm is to start from, (D_j,).

        Returns:
            `Tensor`: sum of the weighted likenesses, (N,).
        """
        width = (SAME_FUTURE * (self.ends - here).norm(dim=-1).median()).clamp(min=1e-6)
        refuted = torch.zeros_like(self.ends[:, 0])
        for weight, end in failures:
            refuted += weight * torch.exp(-0.5 * ((self.ends - end).norm(dim=-1) / width).square())
        return refuted

    def choose(self, refuted: Tensor, here: Tensor) -> int:
        """The most determined of the futures that are open: those that are not refuted.

        A determined future is soon well on its way from where it starts to where it ends, and does not start far from
        the arm. One that wavers between two ways, as those in between do, cannot be carried out against a load.

        Args:
            refuted (`Tensor`):
                Likeness to failed tries, (N,).
            here (`Tensor`):
                Scaled joints where the arm is to start from, (D_j,).

        Returns:
            `int`: index of the future.
        """
        soon = self.joints[min(SOON, len(self.joints) - 1)]
        left = (soon - self.ends).norm(dim=-1) / (self.starts - self.ends).norm(dim=-1).clamp(min=1e-6)
        leap = (self.starts - here).norm(dim=-1) / (self.ends - here).norm(dim=-1).clamp(min=1e-6)
        closed = refuted >= REFUTED
        if closed.all():
            return int(refuted.argmin())
        return int((left + leap).masked_fill(closed, math.inf).argmin())
