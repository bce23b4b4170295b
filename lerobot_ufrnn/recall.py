"""Recall: when the world contradicts what was foreseen, go back to where another future was still open.

The paper's foresight keeps the future that looks least uncertain. A robot that pushes against a door that must be
pulled is certain and wrong: its hidden state plays the motion to its end, and no noise that it was trained with leads
out of it. What does show is *surprise*: the joints do not move as they were predicted to, by many times the predicted
standard deviation. Recall, our addition to the paper, acts on it, at run time only:

1. **Contradicted?** The normalised innovation of the joints is smoothed over a few steps and compared with a threshold.
   It counts only while the arm does not make the foreseen movement: one that lags under a load is not wrong. A rest
   where no demonstration began or ended contradicts, too, even if it was foreseen ([`RestDetector`]).
2. **Go back.** The arm returns to its pose of the last moment before the surprise. What it was doing is refuted.
3. **Imagine.** Copies of that moment imagine to sense something other than expected, by as much as the network was
   uncertain of it, and play their futures to a long horizon, in closed loop ([`Alternatives`]).
4. **Select.** Futures that end where a try has failed are refuted. Of the rest the most determined is kept.
5. **Carry out** its first steps as imagined, at the arm's pace ([`Plan`]); then listen again. If the arm is blocked,
   that future is refuted, too, and 2 follows again.
"""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor, nn

from .foresight import UFRNN, ForesightTrace, Memory
from .networks import HiddenState, Prediction

if TYPE_CHECKING:
    from .configuration_ufrnn import UFRNNConfig

# 1. Contradicted?
SMOOTHING = 0.5  # weight of the past in the running surprise
STALLED = 0.15  # share of the movement foreseen for a step below which the arm does not do as foreseen
REST_STEPS = 20  # steps of standstill that are a rest
STANDSTILL = 0.15  # share of the least that demonstrations moved in as many steps below which an arm stands still
MOST_PLACES = 64  # remembered places where demonstrations began or ended; of more, those that differ most
NEAR = 0.15  # distance from such a place that is still there, as a fraction of how far demonstrations led

# 2. Go back.
CALM = 0.5  # fraction of the threshold below which a moment counts as unsurprised
LONGEST_RETURN = 6  # steps that the arm has for going back to the remembered pose
LONGEST_TRAIL = 32  # remembered steps; the last calm moment is looked for in these

# 3. Imagine.
DEVIATION_STEPS = 8  # imagined steps for which a copy senses something other than expected, before its future counts

# 4. Select.
SOON = 6  # imagined steps after which a future that is determined is well on its way
SAME_FUTURE = (
    0.2  # standard deviation of the kernel that calls two futures the same, as a fraction of how far futures lead
)
REFUTED = 0.3  # likeness to a failed try above which a future is refuted

# 5. Carry out.
LEAD = 8  # imagined steps that a plan may be ahead of the arm, so that its commands press on against a load
PATIENCE = 5  # steps that it waits for the arm
FIRST_STEPS = 3  # imagined steps before which it asks for too little to tell whether the arm follows
LEAST_PROGRESS = (
    0.15  # share of the movement asked for that an arm makes which is not blocked; its flexing makes some, too
)


def surprise(joints: Tensor, prediction: Prediction) -> Tensor:
    """Normalised innovation: the joints' squared prediction error in units of the predicted variance.

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


def progress(before: Tensor, joints: Tensor, asked: Tensor) -> Tensor:
    """How much of the movement from `before` to `asked` an arm at `joints` has made, (..., D_j) each.

    The result (...) is 1 for an arm that is there, 0 for one that has not moved that way at all.
    """
    movement = asked - before
    return ((joints - before) * movement).sum(-1) / movement.square().sum(-1).clamp(min=1e-12)


class RestDetector(nn.Module):
    """Has the arm come to a standstill where no demonstration began or ended?

    Where demonstrations part, a network that has learned both ways can be led to the mean of them. If they are
    opposites, that is no movement at all, and it is foreseen: nothing surprises. But demonstrations rest before they
    begin and after they end only; where one paused on its way for as long, a rest says nothing, and none is detected.
    What is remembered of demonstrations is saved in the checkpoint.

    Args:
        joint_dim (`int`):
            Number of joints D_j.
    """

    places: Tensor
    extent: Tensor
    least_movement: Tensor

    def __init__(self, joint_dim: int):
        super().__init__()
        self.register_buffer("places", torch.zeros(MOST_PLACES, joint_dim))
        self.register_buffer("extent", torch.zeros(()))
        self.register_buffer("least_movement", torch.zeros(()))

    @torch.no_grad()
    def observe(self, joints: Tensor) -> None:
        """Learns from a demonstration's scaled joints (L, D_j); one that was seen before teaches nothing new."""
        both = joints[[0, -1]]
        is_first = not self.extent > 0
        self.places.copy_(_most_different(both if is_first else torch.cat((self.places, both)), MOST_PLACES))
        self.extent.copy_(torch.maximum(self.extent, (joints - joints[-1]).norm(dim=-1).max()))
        # A demonstration too short to judge counts as one that rests, so that nothing else does.
        least = joints.new_zeros(())
        if len(joints) > REST_STEPS:
            distances = (joints[:, None] - both).norm(dim=-1).amin(-1)
            elsewhere = distances.unfold(0, REST_STEPS + 1, 1).amin(-1) > NEAR * self.extent
            movements = _movement(joints.unfold(0, REST_STEPS + 1, 1).movedim(-1, 0))[elsewhere]
            if len(movements) > 0:
                least = movements.min()
        self.least_movement.copy_(least if is_first else torch.minimum(self.least_movement, least))

    def detects(self, joints: Tensor) -> bool:
        """Whether the arm rests at no such place, from its scaled joints of the last steps, (REST_STEPS + 1, D_j)."""
        if not bool(_movement(joints) < STANDSTILL * self.least_movement):
            return False
        return bool((self.places - joints[-1]).norm(dim=-1).min() > NEAR * self.extent)


def _movement(joints: Tensor) -> Tensor:
    """How far the joint that moved most did, (...), from joints over time, (L, ..., D_j)."""
    return (joints.amax(0) - joints.amin(0)).amax(-1)


def _most_different(points: Tensor, count: int) -> Tensor:
    """Picks points that are farthest from those picked before (Gonzalez, 1985); repeats them where there are fewer."""
    picked = [0]
    distances = (points - points[0]).norm(dim=-1)
    for _ in range(count - 1):
        picked.append(int(distances.argmax()))
        distances = torch.minimum(distances, (points - points[picked[-1]]).norm(dim=-1))
    return points[picked]


@dataclass(frozen=True)
class Alternatives:
    """What else could be done: futures that begin with other sensations, which are open, and the one to try.

    Where several ways were demonstrated, the network is uncertain of what it will sense next: its predicted variance
    spans them. So a copy that imagines to sense something other than expected, by as much as the network is uncertain
    of each value, is led into one of the ways, and the wider they part the better it gets there. The deviation is held
    for some steps, as that of a door that has begun to move would be. Noise on the hidden state itself gets there much
    more rarely the better the network has learned to lead back to its way.

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
        """Plays T steps of the futures of N copies of one state, each of which begins with sensations of its own.

        Sensations deviate from the predicted means by a standard normal number for each value, times the predicted
        standard deviation, times a factor of the copy's own, uniform over `noise_range`.
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
        """How much each future, from an arm at `here` (D_j,), is like failed ones, (N,).

        A failure is a weight and the scaled joints where it was to end, (D_j,).
        """
        ends = self.joints[-1]
        width = (SAME_FUTURE * (ends - here).norm(dim=-1).median()).clamp(min=1e-6)
        refuted = torch.zeros_like(ends[:, 0])
        for weight, end in failures:
            refuted += weight * torch.exp(-0.5 * ((ends - end).norm(dim=-1) / width).square())
        return refuted

    def choose(self, refuted: Tensor, here: Tensor) -> int:
        """Index of the most determined of the futures that are not refuted (N,), for an arm at `here` (D_j,).

        A determined future is soon well on its way from where it starts to where it ends, and does not start far from
        the arm. One that wavers between two ways, as those in between do, cannot be carried out against a load.
        """
        starts, soon, ends = self.joints[0], self.joints[min(SOON, len(self.joints) - 1)], self.joints[-1]
        left = (soon - ends).norm(dim=-1) / (starts - ends).norm(dim=-1).clamp(min=1e-6)
        leap = (starts - here).norm(dim=-1) / (ends - here).norm(dim=-1).clamp(min=1e-6)
        closed = refuted >= REFUTED
        if closed.all():
            return int(refuted.argmin())
        return int((left + leap).masked_fill(closed, math.inf).argmin())


class Outcome(Enum):
    """How a plan is doing."""

    UNDER_WAY = "under way"
    DONE = "done"
    BLOCKED = "blocked"


class Plan:
    """The states of an imagined future one after the other, each as soon as the arm is near enough.

    The network's clock runs on while a loaded arm lags; an arm that followed it would be asked to stop before it is
    there. So the imagined states wait for the arm, and only when it is where they predict it to be does the policy
    listen to its senses again.

    Args:
        states (`HiddenState`):
            The states to carry out, (K, hidden size) each.
        joints (`Tensor`):
            Scaled joints that each of them predicts, (K, D_j).
        end (`Tensor`):
            Scaled joints where the whole future ends, (D_j,).
    """

    def __init__(self, states: HiddenState, joints: Tensor, end: Tensor):
        self._states = states
        self._joints = joints
        self._begun_at: Tensor | None = None
        self._at = -1  # the state that is carried out
        self._reached = 0  # the one whose joints the arm is nearest to
        self._waited = 0
        self.end = end

    @property
    def has_begun(self) -> bool:
        """`bool`: whether its first state has been carried out."""
        return self._at >= 0

    @property
    def state(self) -> HiddenState:
        """`HiddenState`: the state to carry out now, (1, hidden size) each."""
        return self._states.at(slice(self._at, self._at + 1))

    def advance(self, joints: Tensor, as_predicted: bool) -> Outcome:
        """Goes on by a step, or waits; `UNDER_WAY` if `state` is to be carried out now.

        `joints` (D_j,) are the scaled measured ones, `as_predicted` says whether they are where the present state
        predicted them to be.
        """
        last = len(self._joints) - 1
        if self._begun_at is None:
            self._begun_at, self._at = joints, 0
            return Outcome.UNDER_WAY
        asked = self._joints[self._reached : self._at + 1]
        self._reached += int((asked - joints).norm(dim=-1).argmin())
        if self._at == last and as_predicted:
            return Outcome.DONE
        must_wait = self._at >= min(self._reached + LEAD, last)
        made = float(progress(self._begun_at, joints, self._joints[self._at]))
        left_behind = self._at >= FIRST_STEPS and made < LEAST_PROGRESS
        self._waited = self._waited + 1 if must_wait or left_behind else 0
        if self._waited > PATIENCE:
            return Outcome.BLOCKED
        if not must_wait:
            self._at += 1
        return Outcome.UNDER_WAY


@dataclass(frozen=True)
class RecallEvent:
    """One time that an episode went back, for analysis.

    Attributes:
        step (`int`): step of the episode at which it was surprised, or found a plan blocked.
        steps_back (`int`): by how many steps the arm went back.
        refuted (`Tensor`): likeness of each imagined future to failed tries, (N,).
        chosen (`int`): which future was kept.
        futures (`Prediction`, *optional*): the N futures, (horizon, N, ...); only with `Recall.keep_futures`.
    """

    step: int
    steps_back: int
    refuted: Tensor
    chosen: int
    futures: Prediction | None


@dataclass(frozen=True)
class _Moment:
    step: int
    state: HiddenState  # (1, hidden size) each
    surprise: float


@dataclass
class _Episode:
    """What one episode of the batch remembers."""

    trail: deque[_Moment] = field(default_factory=lambda: deque(maxlen=LONGEST_TRAIL))
    poses: deque[Tensor] = field(default_factory=lambda: deque(maxlen=REST_STEPS + 1))  # joints outside of plans
    step: int = -1
    surprise: float = 0.0
    anchor: _Moment | None = None  # the last one before the surprise
    plan: Plan | None = None
    refuted: list[tuple[int, Tensor]] = field(default_factory=list)  # step of failure, where the future ends
    events: list[RecallEvent] = field(default_factory=list)


class Recall:
    """Steps a model and goes back on surprise; state lives from `reset` to `reset`.

    It explores when surprised and only then: noise at every step would look like a contradiction. With
    `exploration=foresight` futures are imagined and selected. The baselines go back too: `noise` goes on with any one
    copy that deviates, `none` with the moment itself.

    Args:
        model (`UFRNN`):
            The model to step.
        config (`UFRNNConfig`):
            Its `recall` and `exploration`.
        rest (`RestDetector`):
            Detects a rest that no demonstration shows; asked with `recall.at_rest` only.
    """

    def __init__(self, model: UFRNN, config: "UFRNNConfig", rest: RestDetector):
        self.model = model
        self.config = config.recall
        self.exploration = config.exploration
        self.rest = rest
        self.num_samples = self.config.num_samples if self.exploration == "foresight" else 1
        self.noise_range = (0.0, 0.0) if self.exploration == "none" else self.config.noise_range
        self.keep_futures = False
        self.reset()

    def reset(self) -> None:
        """Forgets all episodes."""
        self._episodes: list[_Episode] = []
        self._joints: Tensor | None = None

    @property
    def events(self) -> list[list[RecallEvent]]:
        """`list[list[RecallEvent]]`: of each episode of the batch, when it went back."""
        return [episode.events for episode in self._episodes]

    @torch.no_grad()
    def advance(
        self, inputs: Tensor, memory: Memory, generator: Generator | None = None
    ) -> tuple[Memory, ForesightTrace | None]:
        """One time step, as [`UFRNN.advance`]; there is never a trace of foresight."""
        joints = inputs[:, : self.model.network.joint_dim]
        if self._joints is None:
            self._episodes = [_Episode() for _ in range(len(inputs))]
            self._joints = joints
        surprises = surprise(joints, memory.prediction)
        moves = progress(self._joints, joints, memory.prediction.mean[:, : joints.shape[-1]]) >= STALLED
        self._joints = joints
        after, trace = self.model.advance(inputs, memory, generator, explore=False)
        replacements = {}
        for row, episode in enumerate(self._episodes):
            state = after.state.at(slice(row, row + 1))
            other = self._follow(episode, joints[row], float(surprises[row]), bool(moves[row]), state, generator)
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
        self,
        episode: _Episode,
        joints: Tensor,
        surprise_now: float,
        moves: bool,
        state: HiddenState,
        generator: Generator | None,
    ) -> HiddenState | None:
        """Moves one episode on by a step; the state that is to replace its own, if any."""
        episode.step += 1
        if episode.plan is None:
            # 1. Contradicted?
            episode.surprise *= SMOOTHING
            if not moves:
                episode.surprise += (1 - SMOOTHING) * surprise_now
            episode.poses.append(joints)
            contradicted = episode.surprise > self.config.surprise_threshold or self._rests(episode)
            if contradicted and episode.trail:
                self._remember(episode, state)
                return self._go_back(episode, generator)
            episode.trail.append(_Moment(episode.step, state, episode.surprise))
            return None
        as_predicted = surprise_now <= self.config.surprise_threshold
        returning = not episode.plan.has_begun and episode.step - episode.events[-1].step < LONGEST_RETURN
        if returning and moves and not as_predicted:
            assert episode.anchor is not None  # there is one where there is a plan
            return episode.anchor.state
        # 5. Carry out.
        match episode.plan.advance(joints, as_predicted):
            case Outcome.UNDER_WAY:
                return episode.plan.state
            case Outcome.BLOCKED:
                episode.refuted.append((episode.step, episode.plan.end))
                return self._go_back(episode, generator)
        episode.plan = None
        return None

    def _rests(self, episode: _Episode) -> bool:
        if not self.config.at_rest or len(episode.poses) <= REST_STEPS:
            return False
        return self.rest.detects(torch.stack(tuple(episode.poses)))

    def _remember(self, episode: _Episode, state: HiddenState) -> None:
        """2. Takes what was being done as refuted, and the last calm moment as the one to go on from."""
        episode.refuted.append((episode.step, self._foresee(state)))
        trail = episode.trail
        while len(trail) > 1 and trail[-1].surprise > CALM * self.config.surprise_threshold:
            trail.pop()
        episode.anchor = trail[-1]

    def _foresee(self, state: HiddenState) -> Tensor:
        """Scaled joints where this state is leading, (D_j,)."""
        network, last = self.model.network, self.model.imagine(state, self.config.horizon).at(-1)
        return network.predict_mean(last)[0, : network.joint_dim]

    def _go_back(self, episode: _Episode, generator: Generator | None) -> HiddenState:
        """2. to 4. Decides on another future and returns to the moment before the surprise."""
        config, network, anchor = self.config, self.model.network, episode.anchor
        assert anchor is not None
        found = Alternatives.imagine(
            self.model, anchor.state, self.num_samples, self.noise_range, config.horizon, generator
        )
        here = network.predict_mean(anchor.state)[0, : network.joint_dim]
        refuted = found.refuted(self._failures(episode), here)
        if (refuted >= REFUTED).all():
            # Nothing is left to try. The way may have been barred for a while only, so start anew.
            episode.refuted.clear()
            refuted.zero_()
        chosen = found.choose(refuted, here)
        begin = slice(config.commitment + 1), chosen
        episode.plan = Plan(found.states.at(begin), found.joints[begin], found.joints[-1, chosen])
        episode.surprise = 0.0
        episode.poses.clear()
        kept = Prediction(*(values[1:] for values in found.predictions)) if self.keep_futures else None
        episode.events.append(RecallEvent(episode.step, episode.step - anchor.step, refuted, chosen, kept))
        return anchor.state

    def _failures(self, episode: _Episode) -> list[tuple[float, Tensor]]:
        if self.config.memory == 0:
            return []
        return [(math.exp((step - episode.step) / self.config.memory), end) for step, end in episode.refuted]
