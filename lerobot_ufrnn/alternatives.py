"""What else could be done: futures of perturbed copies, which of them are open, and the one to try."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from .foresight import perturb, sample_noise
from .networks import HiddenState, Prediction
from .recurrent import UFRNN

SETTLE = 6
"""Imagined steps in which a perturbation settles, before a future counts."""

SAME_FUTURE = 0.2
"""Standard deviation of the kernel that calls two futures the same, as a fraction of how far futures lead."""

REFUTED = 0.3
"""Likeness to a failed try above which a future is refuted."""

FEWEST_ALIKE = 3
"""Copies, itself included, that must share a future."""


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
        moments: HiddenState,
        num_samples: int,
        noise_range: tuple[float, float],
        perturbed: tuple[str, ...],
        horizon: int,
        generator: Generator | None = None,
    ) -> "Alternatives":
        """Plays the futures of perturbed copies in closed loop.

        Copies are taken of all moments, since how far the noise spreads them over the ways to go on depends on the
        moment: early it is forgotten again, late the way is already taken.

        Args:
            model (`UFRNN`):
                The model that imagines.
            moments (`HiddenState`):
                States to perturb, (M, hidden size) each.
            num_samples (`int`):
                Number of copies N, in turn of each moment.
            noise_range (`tuple[float, float]`):
                Range of the standard deviations of their noise, which are uniformly distributed.
            perturbed (`tuple[str, ...]`):
                Names of the `HiddenState` fields to perturb.
            horizon (`int`):
                Number of imagined steps T.
            generator (`torch.Generator`, *optional*):
                Source of randomness.

        Returns:
            `Alternatives`: the futures.
        """
        like, (low, high) = moments.h_joint, noise_range
        first = torch.randint(len(like), (1,), generator=generator, device=like.device)
        rows = (torch.arange(num_samples, device=like.device) + first) % len(like)
        copies = moments.at(rows)
        std = low + (high - low) * torch.rand(num_samples, 1, generator=generator, dtype=like.dtype, device=like.device)
        noise = std * sample_noise(copies, 1, perturbed, generator=generator)
        copies = perturb(copies, noise, like.new_ones(num_samples, 2), perturbed)
        imagined = model.imagine(copies, SETTLE + horizon)
        states = imagined.at(slice(SETTLE, None))
        return cls(states, model.network.predict(states), model.network.joint_dim)

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
        refuted = torch.zeros_like(self.ends[:, 0])
        for weight, end in failures:
            refuted += weight * self._likeness(end[None], here)[:, 0]
        return refuted

    def choose(self, refuted: Tensor, here: Tensor) -> int:
        """The most determined of the futures that are open: those neither refuted nor an accident of the noise.

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
        soon = self.joints[min(SETTLE, len(self.joints) - 1)]
        left = (soon - self.ends).norm(dim=-1) / (self.starts - self.ends).norm(dim=-1).clamp(min=1e-6)
        leap = (self.starts - here).norm(dim=-1) / (self.ends - here).norm(dim=-1).clamp(min=1e-6)
        accidental = self._likeness(self.ends, here).sum(-1) < min(FEWEST_ALIKE, len(self.ends))
        if accidental.all():
            accidental = torch.zeros_like(accidental)  # then none is more so than another
        closed = accidental | (refuted >= REFUTED)
        if closed.all():
            return int(refuted.masked_fill(accidental, math.inf).argmin())
        return int((left + leap).masked_fill(closed, math.inf).argmin())

    def _likeness(self, others: Tensor, here: Tensor) -> Tensor:
        """How alike the ends are to other ends, (N, number of others)."""
        width = (SAME_FUTURE * (self.ends - here).norm(dim=-1).median()).clamp(min=1e-6)
        return torch.exp(-0.5 * (torch.cdist(self.ends, others) / width).square())
