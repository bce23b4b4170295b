"""What an episode went through, aligned with the demonstrations that the policy remembers."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from .demonstrations import Moments

LONGEST_TRAIL = 600  # moments that are remembered: a minute
INDEPENDENT = 0.2  # of successive moments that many are evidence of their own
LEAST_LIKELY = -10.0  # log-likelihood of a moment that a demonstration does not explain at all
TAKEN = 2.0  # log-odds in favour of the demonstration that was taken over


@dataclass
class _Step:
    sensed: Tensor  # (D,)
    command: Tensor  # what was commanded then, (D_j,)
    gaps: Tensor  # distance of the joints from each remembered moment, (M,)
    looks: Tensor  # difference of the features in units of `alike`, (M,)
    costs: Tensor  # of the best alignment up to here that ends at each remembered moment, (M,)


class Trail:
    """The moments of an episode, a tenth of a second apart; what was taken back is no longer part of it.

    Args:
        moments (`Moments`):
            What is remembered of the demonstrations.
    """

    def __init__(self, moments: Moments):
        self.moments = moments
        self.taken: tuple[int, int] | None = None  # demonstration taken over last, and where on the trail
        self._steps: list[_Step] = []

    def __len__(self) -> int:
        return len(self._steps)

    @property
    def last(self) -> _Step:
        """The newest moment."""
        return self._steps[-1]

    def append(self, sensed: Tensor, command: Tensor) -> None:
        """Adds a moment by what was sensed (D,) and commanded (D_j,).

        The trail is aligned with every demonstration by dynamic time warping, one column of it for each moment.
        """
        moments = self.moments
        dim = moments.joints.shape[-1]
        gaps = moments.gap(sensed[None, :dim])[0]
        looks = (moments.features - sensed[dim:]).norm(dim=-1) / moments.alike
        costs = (gaps / moments.near).square().clamp(max=100)
        costs += 0.1 * looks.square().clamp(max=20)
        index = torch.arange(len(gaps), device=gaps.device) - moments.begin[moments.owner]
        if self._steps:
            so_far = best = self._steps[-1].costs
            for jump in (1, 2, 3):
                later = torch.cat((so_far.new_full((jump,), math.inf), so_far[:-jump])) + 0.1 * (jump > 1)
                best = torch.minimum(best, later.masked_fill(index < jump, math.inf))
            costs = costs + best
        else:
            costs = costs + 0.2 * index
        self._steps.append(_Step(sensed, command, gaps, looks, costs - costs.min()))
        if len(self._steps) > LONGEST_TRAIL:
            del self._steps[0]
            if self.taken is not None:
                self.taken = self.taken[0], max(self.taken[1] - 1, 0)

    def take_back(self, at: int, which: int) -> None:
        """Forgets what came after one of its moments, from where a demonstration is taken over."""
        del self._steps[at + 1 :]
        self.taken = which, at

    def aligned(self) -> "AlignedTrail":
        """The whole trail as tensors."""
        fields = ("sensed", "command", "gaps", "costs")
        stacked = (torch.stack([getattr(step, name) for step in self._steps]) for name in fields)
        return AlignedTrail(self.moments, self.taken, *stacked)


@dataclass(frozen=True)
class AlignedTrail:
    """T moments of a trail, beside M remembered moments of n demonstrations.

    Attributes:
        moments (`Moments`): what is remembered.
        taken (`tuple[int, int]`, *optional*): demonstration that was taken over last, and where on the trail.
        sensed (`Tensor`): (T, D).
        commands (`Tensor`): what was commanded, (T, D_j).
        gaps (`Tensor`): distance of joints from remembered ones, (T, M).
        costs (`Tensor`): of the best alignment that ends there, (T, M).
    """

    moments: Moments
    taken: tuple[int, int] | None
    sensed: Tensor
    commands: Tensor
    gaps: Tensor
    costs: Tensor

    @property
    def joints(self) -> Tensor:
        """Where the arm was, (T, D_j)."""
        return self.sensed[:, : self.moments.joints.shape[-1]]

    @cached_property
    def phases(self) -> Tensor:
        """The moment of each demonstration that the trail is aligned with, (T, n)."""
        bounds = zip(self.moments.begin.tolist(), self.moments.end.tolist(), strict=True)
        return torch.stack([self.costs[:, begin : end + 1].argmin(-1) + begin for begin, end in bounds], dim=1)

    @cached_property
    def away(self) -> Tensor:
        """How far each demonstration is at that moment, (T, n)."""
        return self.gaps.gather(1, self.phases)

    def near(self, at: int) -> Tensor:
        """Which demonstrations pass a moment of the trail, bool (n,)."""
        return self.away[at] <= self.moments.near + self.away[at].min()

    @cached_property
    def _evidence(self) -> Tensor:
        """How well each demonstration, from each of its moments on, explains the trail from each of its on, (T, M).

        It is the sum of log-likelihoods of joints and commands beside those that are remembered.
        """
        moments = self.moments
        pulls = torch.cdist(moments.pull(self.joints, self.commands), moments.pull(moments.joints, moments.commands))
        likelihood = -0.5 * ((self.gaps / moments.near).square() + (2 * pulls / moments.lead).square())
        for begin, end in zip(moments.begin.tolist(), moments.end.tolist(), strict=True):
            of_it = likelihood[:, begin : end + 1]
            of_it.copy_(of_it.flip(1).cummax(1).values.flip(1))
        return likelihood.clamp(min=LEAST_LIKELY).flip(0).cumsum(0).flip(0)

    def followed(self, at: int) -> Tensor:
        """Probability (n,) that a demonstration was followed since a moment of the trail, of those that pass it."""
        near = self.near(at)
        evidence = INDEPENDENT * self._evidence[at, self.phases[at]]
        if self.taken is not None and self.taken[1] <= at:
            evidence[self.taken[0]] += TAKEN
        return torch.softmax(evidence.masked_fill(~near, -math.inf), 0)

    def entry(self, at: int, which: int, run_up: float) -> int:
        """Where on the trail to go back to for entering a demonstration near `at`.

        It is where the demonstration is nearest, so that nothing lies in between, and a little before that.
        """
        joints, away, near = self.joints, self.away[:, which], self.moments.near
        start = at
        for earlier in range(at - 1, -1, -1):
            if away[start] < 0.3 * near or (joints[earlier] - joints[at]).norm() > 3 * near:
                break
            if away[earlier] < away[start] - 0.1 * near:
                start = earlier
        while start > 0 and run_up > 0:
            run_up -= float((joints[start] - joints[start - 1]).norm())
            start -= 1
        return start

    def way_back(self, start: int) -> list[tuple[Tensor, Tensor]]:
        """Joints to go back through to a moment of the trail, and what to command for each.

        What moved goes back to where it was; what did not, such as a gripper that holds, keeps its command.
        """
        joints = self.joints
        moved = joints[start:].amax(0) - joints[start:].amin(0) > 0.5 * self.moments.near
        return [
            (joints[step], torch.where(moved, joints[step], self.commands[max(step - 1, 0)]))
            for step in range(len(joints) - 2, start - 1, -1)
        ]
