"""Recall: when the world contradicts what was foreseen, go back to where another future was still open.

The paper's foresight keeps the future that looks least uncertain. A robot that pushes against a door that must be
pulled is certain and wrong: its hidden state plays the motion to its end, and no noise that it was trained with leads
out of it. What does show is *surprise*: the joints are not where they were predicted to be, by many times the predicted
standard deviation. Recall, our addition to the paper, acts on it, at run time only:

1. **Surprised?** The squared prediction error of the joints in units of the predicted variance, one on average while
   all goes as foreseen, is smoothed over a few steps and compared with a threshold.
2. **Go back.** The hidden state returns to a remembered moment some steps before the surprise began; the arm is sent
   back to its pose of that moment.
3. **Imagine.** Many perturbed copies of that state play their futures to a long horizon, in closed loop.
4. **Select.** Futures that end where a try has already failed are refuted, and those that hardly any other copy shares
   are accidents of the noise. Of the rest the least uncertain is kept.
5. **Carry out** its first steps as imagined, deaf to the senses, so that the decision reaches the arm; then listen
   again. If it fails too, its future is refuted, and 2 follows again.
"""

import math
from collections import deque
from dataclasses import dataclass, field

import torch
from torch import Generator, Tensor

from .foresight import Foresight, ForesightTrace, perturb, roll_out, sample_noise, uncertainty
from .networks import HiddenState, Prediction
from .recurrent import UFRNN, Memory

SMOOTHING = 0.5
"""Weight of the past in the running surprise."""

CALM = 0.5
"""Fraction of the threshold below which a moment counts as unsurprised."""

LONGEST_RETURN = 6
"""Steps that the arm has for going back to the remembered pose."""

SETTLING = 3
"""Steps after a carried-out future in which prediction and senses may disagree."""

TRAIL_MARGIN = 24
"""Remembered steps beyond the horizon."""

SAME_FUTURE = 0.2
"""Standard deviation of the kernel that calls two futures the same, as a fraction of how far futures lead."""

REFUTED = 0.3
"""Likeness to a failed try above which a future is refuted."""

FEWEST_ALIKE = 3
"""Copies, itself included, that must share a future."""


def surprise(joints: Tensor, prediction: Prediction) -> Tensor:
    """Normalised innovation squared: the joints' squared prediction error in units of the predicted variance.

    Args:
        joints (`Tensor`):
            Scaled measured joints, (B, D_j).
        prediction (`Prediction`):
            What the step before predicted for them.

    Returns:
        `Tensor`: mean over the joints, (B,); one on average where the prediction is right about its own errors.
    """
    dim = joints.shape[-1]
    error = (joints - prediction.mean[..., :dim]).square()
    return (error * torch.exp(-prediction.log_variance[..., :dim])).mean(-1)


@dataclass(frozen=True)
class RecallEvent:
    """One time that an episode went back, for analysis.

    Attributes:
        step (`int`): step of the episode at which it was surprised.
        steps_back (`int`): by how many steps the hidden state went back.
        refuted (`Tensor`): likeness of each imagined future to failed tries, (N,).
        chosen (`int`): which future was kept.
        futures (`Prediction`, *optional*): the N futures after `commitment` imagined steps, up to the horizon,
            (horizon - commitment, N, ...); only with `Recall.keep_futures`.
    """

    step: int
    steps_back: int
    refuted: Tensor
    chosen: int
    futures: Prediction | None


@dataclass(frozen=True)
class _Moment:
    state: HiddenState  # (1, hidden size) each
    surprise: float


@dataclass
class _Episode:
    """What one episode of the batch remembers."""

    trail: deque[_Moment]
    step: int = -1
    surprise: float = 0.0
    anchor: _Moment | None = None  # gone back to the last time
    plan: HiddenState | None = None  # where to go on from, once the arm is back
    waited: int = 0
    deaf: int = 0  # steps still to be carried out as imagined
    settling: int = 0
    tried: Tensor | None = None  # where the future that is being tried ends, (D_j,)
    refuted: list[tuple[int, Tensor]] = field(default_factory=list)  # step of failure, where the future ends
    events: list[RecallEvent] = field(default_factory=list)


class Recall:
    """Steps a model and goes back on surprise; state lives from `reset` to `reset`.

    The hidden state is perturbed when surprised and only then: noise at every step would look like a contradiction.
    With `exploration=foresight` futures are imagined and selected. The baselines go back too: `noise` goes on with any
    one perturbed copy, `none` with the remembered state itself.

    Args:
        model (`UFRNN`):
            The model to step.
        threshold (`float`):
            Surprise from which to go back.
        rewind (`int`):
            Steps to go back to from the last unsurprised one.
        num_samples (`int`):
            Number of perturbed copies.
        noise_range (`tuple[float, float]`):
            Standard deviation of the perturbation of the first and of the last copy; evenly spaced between.
        horizon (`int`):
            Imagined steps by whose end futures are compared.
        commitment (`int`):
            Imagined steps skipped, in which the perturbation settles, and as many carried out after them.
        memory (`float`):
            Steps in which the memory of a failed try fades to 1/e; 0 forgets at once.
    """

    def __init__(
        self,
        model: UFRNN,
        threshold: float,
        rewind: int,
        num_samples: int,
        noise_range: tuple[float, float],
        horizon: int,
        commitment: int,
        memory: float,
    ):
        self.exploration = model.foresight.exploration
        self.perturbed = model.foresight.perturbed
        self.model = type(model)(model.network, Foresight("none", model.foresight.schedule, num_samples=1, horizon=1))
        self.threshold = threshold
        self.rewind = rewind
        self.num_samples = num_samples if self.exploration == "foresight" else 1
        self.noise_range = noise_range
        self.horizon = horizon
        self.commitment = commitment
        self.memory = memory
        self.keep_futures = False
        self.reset()

    def reset(self) -> None:
        """Forgets all episodes."""
        self._episodes: list[_Episode] = []

    @property
    def events(self) -> list[list[RecallEvent]]:
        """`list[list[RecallEvent]]`: of each episode of the batch, when it went back."""
        return [episode.events for episode in self._episodes]

    @torch.no_grad()
    def advance(
        self, inputs: Tensor, memory: Memory, generator: Generator | None = None
    ) -> tuple[Memory, ForesightTrace | None]:
        """One time step, as [`UFRNN.advance`].

        Args:
            inputs (`Tensor`):
                Scaled joints and image features, (B, D).
            memory (`Memory`):
                Memory after the previous step.
            generator (`torch.Generator`, *optional*):
                Source of the exploration noise.

        Returns:
            `tuple[Memory, ForesightTrace | None]`: memory after this step, and what foresight saw.
        """
        if not self._episodes:
            # As long as the horizon, so that the moment gone back to is not lost before its future has had its time.
            longest = self.horizon + self.rewind + TRAIL_MARGIN
            self._episodes = [_Episode(deque(maxlen=longest)) for _ in range(len(inputs))]
        surprises = surprise(inputs[:, : self.model.network.joint_dim], memory.prediction).tolist()
        if any(episode.deaf for episode in self._episodes):
            deaf = torch.tensor([[episode.deaf > 0] for episode in self._episodes], device=inputs.device)
            inputs = torch.where(deaf, memory.prediction.mean, inputs)
        after, trace = self.model.advance(inputs, memory, generator)
        replacements = {}
        for row, episode in enumerate(self._episodes):
            other = self._follow(episode, surprises[row], _row(after.state, row), generator)
            if other is not None:
                replacements[row] = other
        if not replacements:
            return after, trace
        state = HiddenState(*(values.clone() for values in after.state))
        for row, other in replacements.items():
            for values, new in zip(state, other, strict=True):
                values[row] = new[0]
        return Memory(state, self.model.network.predict(state)), trace

    def _follow(
        self, episode: _Episode, now: float, state: HiddenState, generator: Generator | None
    ) -> HiddenState | None:
        """Moves one episode on by a step; the state that is to replace its own, if any."""
        episode.step += 1
        replacement = None
        if episode.plan is not None:  # on the way back
            episode.waited += 1
            if now > self.threshold and episode.waited < LONGEST_RETURN:
                return episode.trail[-1].state
            state = replacement = episode.plan
            episode.plan, episode.deaf = None, self.commitment
        elif episode.deaf > 0:
            episode.deaf -= 1
            episode.settling = SETTLING
        elif episode.settling > 0:
            episode.settling -= 1
        else:
            episode.surprise = SMOOTHING * episode.surprise + (1 - SMOOTHING) * now
            if episode.surprise > self.threshold and len(episode.trail) > self.rewind:
                return self._go_back(episode, generator)
        episode.trail.append(_Moment(state, episode.surprise))
        return replacement

    def _go_back(self, episode: _Episode, generator: Generator | None) -> HiddenState:
        """Returns to a remembered moment, from where another future is planned."""
        trail = episode.trail
        length = len(trail)
        if episode.tried is not None and episode.step - episode.events[-1].step <= self.horizon:
            episode.refuted.append((episode.step, episode.tried))
            while trail[-1] is not episode.anchor:
                trail.pop()
        else:
            while len(trail) > 1 and trail[-1].surprise > CALM * self.threshold:
                trail.pop()
            for _ in range(min(self.rewind, len(trail) - 1)):
                trail.pop()
            episode.anchor = trail[-1]
        anchor = trail[-1].state
        self._plan(episode, anchor, length - len(trail) + 1, generator)
        episode.surprise, episode.waited = 0.0, 0
        return anchor

    def _plan(self, episode: _Episode, anchor: HiddenState, steps_back: int, generator: Generator | None) -> None:
        """Imagines what could be done from `anchor` and decides on a future."""
        network, joint_dim = self.model.network, self.model.network.joint_dim
        begun = self._perturb(anchor, generator)
        for _ in range(self.commitment):
            begun = network.step(network.predict_mean(begun), begun)
        futures = roll_out(network, begun, self.horizon - self.commitment)  # (T, N, ...)
        ends = futures.mean[-1, :, :joint_dim]
        present = network.predict_mean(anchor)[:, :joint_dim]
        width = (SAME_FUTURE * (ends - present).norm(dim=-1).median()).clamp(min=1e-6)

        def likeness(others: Tensor) -> Tensor:
            return torch.exp(-0.5 * (torch.cdist(ends, others) / width).square())

        refuted = torch.zeros_like(ends[:, 0])
        if self.memory > 0:
            for step, failed in episode.refuted:
                refuted += math.exp((step - episode.step) / self.memory) * likeness(failed[None])[:, 0]
        accidental = likeness(ends).sum(-1) < min(FEWEST_ALIKE, self.num_samples)
        # Its own present must be ours: a copy that believes itself elsewhere is uncertain, whatever it predicts.
        cost = uncertainty(futures.log_variance[-1], joint_dim, "variance")
        cost = cost + (network.predict_mean(begun)[:, :joint_dim] - present).square().mean(-1)
        chosen = _choose(cost, refuted, accidental)
        episode.plan, episode.tried = _row(begun, chosen), ends[chosen]
        kept = futures if self.keep_futures else None
        episode.events.append(RecallEvent(episode.step, steps_back, refuted, chosen, kept))

    def _perturb(self, anchor: HiddenState, generator: Generator | None) -> HiddenState:
        """Perturbed copies, (N, hidden size) each."""
        like, (low, high) = anchor.h_joint, self.noise_range
        if self.exploration == "none":
            return anchor
        std = torch.linspace(low, high, self.num_samples, dtype=like.dtype, device=like.device)
        if self.exploration == "noise":
            std = low + (high - low) * torch.rand(1, generator=generator, dtype=like.dtype, device=like.device)
        noise = sample_noise(anchor, self.num_samples, self.perturbed, generator=generator) * std[:, None, None]
        return perturb(anchor, noise, like.new_ones(1, 2), self.perturbed)


def _choose(cost: Tensor, refuted: Tensor, accidental: Tensor) -> int:
    """The least costly future that is neither refuted nor accidental; if there is none, the least refuted."""
    if accidental.all():
        accidental = torch.zeros_like(accidental)  # then none is more so than another
    closed = accidental | (refuted >= REFUTED)
    if closed.all():
        cost, closed = refuted, accidental
    return int(cost.masked_fill(closed, math.inf).argmin())


def _row(state: HiddenState, row: int) -> HiddenState:
    return HiddenState(*(values[row : row + 1] for values in state))
