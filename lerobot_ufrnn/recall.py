"""Recall: when the world contradicts what was foreseen, go back to where another future was still open.

The paper's foresight keeps the future that looks least uncertain. A robot that pushes against a door that must be
pulled is certain and wrong: its hidden state plays the motion to its end, and no noise that it was trained with leads
out of it. What does show is *surprise*: the joints do not move as they were predicted to, by many times the predicted
standard deviation. Recall, our addition to the paper, acts on it, at run time only:

1. **Surprised?** The squared prediction error of the joints in units of the predicted variance, one on average while
   all goes as foreseen, is smoothed over a few steps and compared with a threshold. It counts only while the arm does
   not make the foreseen movement: one that lags under a load is not wrong. A rest where no demonstration began or
   ended counts as a surprise, too, even if it was foreseen (`rest.py`).
2. **Go back.** The arm returns to its pose of the last moment before the surprise. What it was doing is refuted.
3. **Imagine.** Copies of that moment imagine to sense something other than expected, by as much as the network was
   uncertain of it, and play their futures to a long horizon, in closed loop (`alternatives.py`).
4. **Select.** Futures that end where a try has failed are refuted. Of the rest the most determined is kept.
5. **Carry out** its first steps as imagined, at the arm's pace (`attempt.py`); then listen again. If the arm is
   blocked, that future is refuted, too, and 2 follows again.
"""

import math
from collections import deque
from dataclasses import dataclass, field

import torch
from torch import Generator, Tensor

from .alternatives import REFUTED, Alternatives
from .attempt import Attempt, Outcome, progress
from .foresight import Foresight, ForesightTrace
from .networks import HiddenState, Prediction
from .recurrent import UFRNN, Memory
from .rest import REST_STEPS, RestDetector

SMOOTHING = 0.5
"""Weight of the past in the running surprise."""

STALLED = 0.15
"""Share of the movement foreseen for a step below which the arm does not do as foreseen."""

CALM = 0.5
"""Fraction of the threshold below which a moment counts as unsurprised."""

LONGEST_RETURN = 6
"""Steps that the arm has for going back to the remembered pose."""

LONGEST_TRAIL = 32
"""Remembered steps; the last calm moment is looked for in these."""


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
        step (`int`): step of the episode at which it was surprised, or found a try blocked.
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
    poses: deque[Tensor] = field(default_factory=lambda: deque(maxlen=REST_STEPS + 1))  # joints outside of attempts
    step: int = -1
    surprise: float = 0.0
    anchor: _Moment | None = None  # the last one before the surprise
    attempt: Attempt | None = None
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
        threshold (`float`):
            Surprise from which to go back.
        num_samples (`int`):
            Number of imagined futures.
        noise_range (`tuple[float, float]`):
            Range of how far their first sensations deviate, in predicted standard deviations.
        horizon (`int`):
            Imagined steps by whose end futures are compared.
        commitment (`int`):
            Imagined steps that are carried out.
        memory (`float`):
            Steps in which the memory of a failed try fades to 1/e; 0 forgets at once.
        rest (`RestDetector`, *optional*):
            Tells a rest that no demonstration shows; without it only surprise makes an episode go back.
    """

    def __init__(
        self,
        model: UFRNN,
        threshold: float,
        num_samples: int,
        noise_range: tuple[float, float],
        horizon: int,
        commitment: int,
        memory: float,
        rest: RestDetector | None = None,
    ):
        self.exploration = model.foresight.exploration
        self.model = type(model)(model.network, Foresight("none", model.foresight.schedule, num_samples=1, horizon=1))
        self.threshold = threshold
        self.num_samples = num_samples if self.exploration == "foresight" else 1
        self.noise_range = (0.0, 0.0) if self.exploration == "none" else noise_range
        self.horizon = horizon
        self.commitment = commitment
        self.memory = memory
        self.rest = rest
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
        joints = inputs[:, : self.model.network.joint_dim]
        if self._joints is None:
            self._episodes = [_Episode() for _ in range(len(inputs))]
            self._joints = joints
        surprises = surprise(joints, memory.prediction)
        moves = progress(self._joints, joints, memory.prediction.mean[:, : joints.shape[-1]]) >= STALLED
        self._joints = joints
        after, trace = self.model.advance(inputs, memory, generator)
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
        if episode.attempt is None:
            episode.surprise *= SMOOTHING
            if not moves:
                episode.surprise += (1 - SMOOTHING) * surprise_now
            episode.poses.append(joints)
            if (episode.surprise > self.threshold or self._rests(episode)) and episode.trail:
                self._remember(episode, state)
                return self._go_back(episode, generator)
            episode.trail.append(_Moment(episode.step, state, episode.surprise))
            return None
        as_predicted = surprise_now <= self.threshold
        returning = not episode.attempt.has_begun and episode.step - episode.events[-1].step < LONGEST_RETURN
        if returning and moves and not as_predicted:
            assert episode.anchor is not None  # there is one where there is an attempt
            return episode.anchor.state
        match episode.attempt.advance(joints, as_predicted):
            case Outcome.UNDER_WAY:
                return episode.attempt.state
            case Outcome.BLOCKED:
                episode.refuted.append((episode.step, episode.attempt.end))
                return self._go_back(episode, generator)
        episode.attempt = None
        return None

    def _rests(self, episode: _Episode) -> bool:
        if self.rest is None or len(episode.poses) <= REST_STEPS:
            return False
        return self.rest.detects(torch.stack(tuple(episode.poses)))

    def _remember(self, episode: _Episode, state: HiddenState) -> None:
        """Takes what was being done as refuted, and the last calm moment as the one to go on from."""
        episode.refuted.append((episode.step, self._foresee(state)))
        trail = episode.trail
        while len(trail) > 1 and trail[-1].surprise > CALM * self.threshold:
            trail.pop()
        episode.anchor = trail[-1]

    def _foresee(self, state: HiddenState) -> Tensor:
        """Scaled joints where this state is leading, (D_j,)."""
        network, last = self.model.network, self.model.imagine(state, self.horizon).at(-1)
        return network.predict_mean(last)[0, : network.joint_dim]

    def _go_back(self, episode: _Episode, generator: Generator | None) -> HiddenState:
        """Decides on another future and returns to the moment before the surprise."""
        network, anchor = self.model.network, episode.anchor
        assert anchor is not None
        found = Alternatives.imagine(
            self.model, anchor.state, self.num_samples, self.noise_range, self.horizon, generator
        )
        here = network.predict_mean(anchor.state)[0, : network.joint_dim]
        refuted = found.refuted(self._failures(episode), here)
        if (refuted >= REFUTED).all():
            # Nothing is left to try. The way may have been barred for a while only, so start anew.
            episode.refuted.clear()
            refuted.zero_()
        chosen = found.choose(refuted, here)
        begin = slice(self.commitment + 1), chosen
        episode.attempt = Attempt(found.states.at(begin), found.joints[begin], found.ends[chosen])
        episode.surprise = 0.0
        episode.poses.clear()
        kept = Prediction(*(values[1:] for values in found.predictions)) if self.keep_futures else None
        episode.events.append(RecallEvent(episode.step, episode.step - anchor.step, refuted, chosen, kept))
        return anchor.state

    def _failures(self, episode: _Episode) -> list[tuple[float, Tensor]]:
        if self.memory == 0:
            return []
        return [(math.exp((step - episode.step) / self.memory), end) for step, end in episode.refuted]
