"""Recall: when the world contradicts, go back to where another demonstrated way leaves, and take it.

The paper's foresight keeps the future that looks least uncertain. A robot that pushes against a door that must be
pulled is certain and wrong: its hidden state plays the motion to its end, and no noise that it was trained with leads
out of it. Recall, our addition to the paper, takes *remembered* hidden states as candidates instead of perturbed ones:
those in which the network was while it watched the demonstrations. So every demonstrated way is a candidate, whatever
the network makes of it, and foresight stays the judge. At run time only:

1. **Contradicted?** The arm stays at a place for longer than any demonstration that looked like this did, or the scene
   looks for a while like none that was demonstrated there. Nothing is asked of the predicted variance.
2. **Which way was barred?** Where demonstrations part, each is weighed by how well it explains what was sensed and
   commanded since. The way that does is *refuted* by that weight, with all demonstrations that go the same way.
3. **Where to?** The latest moment of the trail where a demonstration is near that is not refuted and leads elsewhere:
   the fork, found without looking for forks. Forks in a row are searched depth first. If all ways are refuted, the way
   may have been barred for a while only, so that they count as open once more. If there never was another, go on.
4. **Select** (Sec. III-C): candidates imagine T steps in closed loop. Of those refuted least, the one whose predicted
   variance falls most is kept, or one that goes the same way and whose scene is nearest.
5. **Retrace** the trail to there, pose by pose, not letting go of what is held.
6. **Carry out** the kept demonstration at the arm's own pace. Behind the fork the network is in command again as long
   as it goes the same way. If the arm is blocked, that way is refuted, too, and it is known which one it was.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from .demonstrations import Demonstrations, Moments
from .foresight import UFRNN, ForesightTrace, Memory, uncertainty
from .networks import HiddenState, Prediction
from .trail import LONGEST_TRAIL, AlignedTrail, Trail

if TYPE_CHECKING:
    from .configuration_ufrnn import UFRNNConfig

# 1. Contradicted?
GRACE = 0.3  # seconds in addition
NO_PROGRESS = 0.5  # seconds in addition for being no further along any demonstration, wherever the arm is
STRANGE_SECONDS = 0.5  # for which the scene must look strange
PAUSE = 1.0  # seconds for which nothing is asked again if there was no other way

# 2. Which way was barred?
LIKELY = 0.02  # probability from which a demonstration may have been followed
BARRED = 5.0  # length of a way that is refuted with it, in units of `near`
REFUTED = 0.5  # weight from which a way is refuted
NEVER_ENTERED = 0.75  # weight against a way whose beginning could not be reached

# 5. and 6. Retrace and carry out.
RUN_UP = 1.0  # distance before the fork from which a way is entered, in units of `near`
LONGEST_LEAD = 4  # moments by which commands may be ahead of an arm that lags, so that they press on against a load
SAME_DIRECTION = 0.8  # cosine from which network and demonstration command the same
AGREED = 0.3  # seconds for which they must, until the network is in command
ON_WAY = 2.0  # distance from the demonstration up to which it may be, in units of `near`
OFF_WAY = 4.0  # distance from which on the arm makes no progress, and may not rest as if it were at an end
FADING = 0.9  # of the offset between arm and demonstration, what is left after a moment


@dataclass(frozen=True)
class RecallEvent:
    """One time that an episode went back, for analysis.

    Attributes:
        step (`int`): step of the episode at which it was contradicted, or found its way blocked.
        reason (`str`): `stayed`, `strange`, `blocked` or `never entered`.
        moments_back (`int`): by how many moments, a tenth of a second each, it went back.
        demonstrations (`list[int]`): the candidates, by their index in the data set.
        refuted (`Tensor`): weight against each, (N,).
        chosen (`int`): which of them was kept.
        futures (`Prediction`, *optional*): what they imagine, (T, N, ...); only with `Recall.keep_futures`.
    """

    step: int
    reason: str
    moments_back: int
    demonstrations: list[int]
    refuted: Tensor
    chosen: int
    futures: Prediction | None


@dataclass
class _Plan:
    """A demonstration that is being returned to, then carried out."""

    which: int
    at: int  # its moment that is carried out
    parted: int  # its moment from which on it has parted from what was refuted
    retrace: list[tuple[Tensor, Tensor]]  # joints to go back through, and what to command for each
    offset: Tensor  # of the arm from the demonstration, once that is carried out
    begun: bool = False  # whether it is
    waited: int = 0  # control steps without progress
    agreed: int = 0  # steps for which the network has commanded the same


@dataclass
class _Episode:
    """What one episode of the batch remembers."""

    trail: Trail
    refuted: Tensor  # weight against each demonstration, (n,)
    rounds: int = 0  # how often all ways were refuted
    plan: _Plan | None = None
    step: int = -1
    place: Tensor | None = None  # joints near which the arm has been for `stayed` steps
    stayed: int = 0
    least_left: int = 1 << 30  # moments to the end of the demonstration that the trail was aligned best with, at least
    no_progress: int = 0  # moments for which it has not become less
    strangeness: deque[float] = field(default_factory=lambda: deque(maxlen=LONGEST_TRAIL))
    strange: int = 0  # moments for which the scene has looked strange
    silent_until: int = 0
    failed_entries: dict[int, int] = field(default_factory=dict)
    events: list[RecallEvent] = field(default_factory=list)


class Recall:
    """Steps a model and goes back when contradicted; state lives from `reset` to `reset`.

    The baselines go back, too: without `exploration=foresight` the first of the candidates refuted least is taken.

    Args:
        model (`UFRNN`):
            The model to step.
        config (`UFRNNConfig`):
            Its `recall`, `exploration` and `foresight.variance_aggregation`.
        demonstrations (`Demonstrations`):
            What is remembered. If there are fewer than two ways in it, this never goes back.
    """

    moments: Moments

    def __init__(self, model: UFRNN, config: "UFRNNConfig", demonstrations: Demonstrations):
        self.model = model
        self.config = config
        self.demonstrations = demonstrations
        self.keep_futures = False
        self.reset()

    def reset(self) -> None:
        """Forgets all episodes."""
        self._episodes: list[_Episode] = []

    @property
    def events(self) -> list[list[RecallEvent]]:
        """`list[list[RecallEvent]]`: of each episode of the batch, when it went back."""
        return [episode.events for episode in self._episodes]

    @property
    def _fps(self) -> float:
        return float(self.demonstrations.fps)

    @torch.no_grad()
    def advance(
        self, inputs: Tensor, memory: Memory, generator: Generator | None = None
    ) -> tuple[Memory, ForesightTrace | None]:
        """One time step, as [`UFRNN.advance`]; there is never a trace of foresight."""
        after, trace = self.model.advance(inputs, memory, generator, explore=False)
        moments = self.demonstrations.moments(self.model.network)
        if moments is None:
            return after, trace
        if not self._episodes:
            self.moments = moments
            self._episodes = [_Episode(Trail(moments), inputs.new_zeros(moments.size)) for _ in inputs]
        state = HiddenState(*(values.clone() for values in after.state))
        command, replaced = after.prediction.command.clone(), False
        for row, episode in enumerate(self._episodes):
            new_state, command[row] = self._follow(episode, inputs[row], command[row].clone())
            if new_state is not None:
                replaced = True
                for values, new in zip(state, new_state, strict=True):
                    values[row] = new[0]
        prediction = self.model.network.predict(state) if replaced else after.prediction
        return Memory(state, prediction._replace(command=command)), trace

    def _follow(self, episode: _Episode, sensed: Tensor, command: Tensor) -> tuple[HiddenState | None, Tensor]:
        """Moves one episode on by a step: the state that is to replace its own, if any, and what to command."""
        joints = self._joints(sensed)
        episode.step += 1
        if episode.place is None or (joints - episode.place).norm() > self.moments.near:
            episode.place, episode.stayed = joints, 0
        episode.stayed += 1
        if episode.plan is not None and (back := self._retrace(episode.plan, joints)) is not None:
            return None, back
        if episode.step % self.demonstrations.stride == 0:
            episode.trail.append(sensed, command)
            if episode.plan is None and (reason := self._contradiction(episode)):
                self._reconsider(episode, reason)
                if episode.plan is not None and (back := self._retrace(episode.plan, joints)) is not None:
                    return None, back
        if episode.plan is None:
            return None, command
        return self._carry_out(episode, episode.plan, sensed, command)

    def _joints(self, sensed: Tensor) -> Tensor:
        return sensed[: self.model.network.joint_dim]

    def _features(self, sensed: Tensor) -> Tensor:
        return sensed[self.model.network.joint_dim :]

    def _contradiction(self, episode: _Episode) -> str:
        """1. What contradicts, or nothing."""
        moments, last = self.moments, episode.trail.last
        here = last.gaps <= moments.near + last.gaps.min()
        least = last.looks[here].min()
        episode.strangeness.append(float(least))
        usual = sorted(episode.strangeness)[len(episode.strangeness) // 4]
        episode.strange = episode.strange + 1 if float(least) > self.config.recall.strange * max(usual, 1.0) else 0
        best = int(last.costs.argmin())
        left = int(moments.end[moments.owner[best]]) - best
        episode.no_progress = 0 if left < episode.least_left else episode.no_progress + 1
        episode.least_left = min(left, episode.least_left)
        if episode.step < episode.silent_until:
            return ""
        if episode.strange * moments.spacing >= STRANGE_SECONDS:
            return "strange"
        rested = moments.dwell[here & (last.looks <= self.config.recall.strange + least)].max()
        longest = float(rested) if last.gaps.min() <= OFF_WAY * moments.near else 0.0
        too_long = self.config.recall.stay * longest + GRACE
        if episode.stayed / self._fps > too_long or episode.no_progress * moments.spacing > too_long + NO_PROGRESS:
            return "stayed"
        return ""

    def _reconsider(self, episode: _Episode, reason: str, tried: tuple[int, int] | None = None) -> None:
        """2. to 4. Plans another way, if there is one. `tried` is what was followed, where known, and its moment."""
        trail = episode.trail.aligned()
        weight = NEVER_ENTERED if reason == "never entered" else 1.0
        episode.stayed, episode.strange, episode.plan = 0, 0, None
        episode.no_progress, episode.least_left = 0, 1 << 30
        while True:
            ways_part = False
            for at in range(len(trail.sensed) - 1, -1, -max(1, len(trail.sensed) // 50)):
                against = self._refute(trail, at, tried)
                if against is None:
                    continue
                ways_part = True
                refuted = episode.refuted + weight * against
                is_open = trail.near(at) & (refuted < episode.rounds + REFUTED)
                if is_open.any():
                    episode.refuted = refuted
                    return self._take(episode, reason, trail, at, is_open.nonzero()[:, 0])
            if not ways_part or (tried is None and not (episode.refuted >= episode.rounds + REFUTED).any()):
                episode.silent_until = episode.step + round(PAUSE * self._fps)  # there never was another way
                return None
            episode.rounds += 1

    def _refute(self, trail: AlignedTrail, at: int, tried: tuple[int, int] | None) -> Tensor | None:
        """2. Weight against each demonstration (n,) if ways part at a moment of the trail; `None` if they do not."""
        near = trail.near(at)
        if near.sum() < 2:
            return None
        if tried is None:
            followed = trail.followed(at)
        else:
            followed = torch.zeros_like(trail.away[at])
            followed[tried[0]] = 1.0
        likely = (followed > LIKELY).nonzero()[:, 0].tolist()
        pieces = [self._barred(which, int(trail.phases[-1, which]) if tried is None else tried[1]) for which in likely]
        same = torch.stack(pieces, dim=1)  # (n, likely)
        if tried is None and bool(same[near].min() > REFUTED):
            return None
        return same @ followed[likely]

    def _barred(self, which: int, at: int) -> Tensor:
        """How much each demonstration (n,) passes where one was barred at a moment of it, and goes on the same way."""
        moments = self.moments
        before = (moments.owner == which) & (moments.arc >= moments.arc[at] - moments.near)
        return moments.same_way(which, int(before.nonzero()[0, 0]), BARRED * moments.near)

    def _take(self, episode: _Episode, reason: str, trail: AlignedTrail, at: int, candidates: Tensor) -> None:
        """3. and 4. Keeps one of the candidates (N,) that leave at a moment of the trail, and plans the way there."""
        chosen, futures = self._select(episode.refuted[candidates], candidates, trail.phases[at], trail.sensed[at])
        which = int(candidates[chosen])
        run_up = RUN_UP * self.moments.near * (1 + 2 * episode.failed_entries.get(which, 0))
        start = trail.entry(at, which, run_up)
        barred = trail.near(at) & (episode.refuted >= episode.rounds + REFUTED)
        others = [other for other in barred.nonzero()[:, 0].tolist() if other != which]
        parted = self.moments.parting(which, trail.phases[start], others)
        episode.plan = _Plan(
            which, int(trail.phases[start, which]), parted, trail.way_back(start), torch.zeros_like(trail.joints[0])
        )
        event = RecallEvent(
            episode.step,
            reason,
            len(trail.sensed) - 1 - start,
            self.demonstrations.indices[candidates].tolist(),
            episode.refuted[candidates],
            chosen,
            futures if self.keep_futures else None,
        )
        episode.events.append(event)
        episode.trail.take_back(start, which)

    def _select(self, refuted: Tensor, candidates: Tensor, phases: Tensor, sensed: Tensor) -> tuple[int, Prediction]:
        """4. Which of the candidates (N,) to keep, and what they imagine over the horizon, (T, N, ...)."""
        moments, network, at = self.moments, self.model.network, phases[candidates]
        # From where each has parted from all other ways: before, a state does not know which one it will go.
        same = torch.stack([moments.same_way(int(which), int(phases[which]), math.inf) for which in candidates])
        known = torch.tensor(
            [
                moments.parting(int(which), phases, (alike < REFUTED).nonzero()[:, 0].tolist())
                for which, alike in zip(candidates, same, strict=True)
            ],
            device=at.device,
        )
        remembered = torch.cat((moments.joints[known], moments.features[known]), dim=-1)
        state = network.step(remembered, moments.before.at(known))
        horizon = max(1, round(self.config.recall.horizon * self._fps))
        futures = network.predict(self.model.imagine(state, horizon).at(slice(1, None)))
        unsure = uncertainty(futures.log_variance[-1], network.joint_dim, self.config.foresight.variance_aggregation)
        if self.config.exploration != "foresight":
            unsure = torch.zeros_like(unsure)
        looks = (moments.features[at] - self._features(sensed)).norm(dim=-1)
        strange = looks > self.config.recall.strange * looks.min().clamp(min=moments.alike)
        # Weights are rounded: small ones are no reason to prefer a way.
        keys = list(zip(strange.tolist(), (4 * refuted).round().tolist(), unsure.tolist(), strict=True))
        best = min(range(len(keys)), key=keys.__getitem__)
        # Of the demonstrations that go its way, one whose scene is as near as any: objects may have moved.
        fits = same[best][candidates] > REFUTED
        fits &= torch.tensor([key[:2] == keys[best][:2] for key in keys], device=fits.device)
        fits &= looks <= looks[fits].min() + moments.alike
        return int(unsure.masked_fill(~fits, math.inf).argmin()), futures

    def _retrace(self, plan: _Plan, joints: Tensor) -> Tensor | None:
        """5. What to command on the way back; `None` if the arm is there, or gets no nearer."""
        close = max(self.moments.near, 2 * self.moments.pace)
        plan.waited += 1
        while plan.retrace:
            reached = (plan.retrace[0][0] - joints).norm() < (close if len(plan.retrace) > 1 else 0.6 * close)
            if not reached and plan.waited <= self._fps:
                return plan.retrace[:3][-1][1]
            plan.retrace.pop(0)
            plan.waited = 0
        return None

    def _carry_out(
        self, episode: _Episode, plan: _Plan, sensed: Tensor, command: Tensor
    ) -> tuple[HiddenState | None, Tensor]:
        """6. State and command of a demonstration that is carried out, or the network's own."""
        moments, joints = self.moments, self._joints(sensed)
        begin, last = int(moments.begin[plan.which]), int(moments.end[plan.which])
        if not plan.begun:
            low = max(plan.at - 6, begin)
            plan.at = low + int((moments.joints[low : min(plan.at + 6, last) + 1] - joints).norm(dim=-1).argmin())
            plan.offset = joints - moments.joints[plan.at]
            plan.begun, plan.waited, episode.stayed = True, 0, 0
        off_way = self._keep_up(plan, joints, last)
        if plan.at >= last:
            episode.plan = None
            return None, command
        waited = plan.waited / self._fps
        if waited > self.config.recall.patience:
            beside = float((moments.joints[begin : last + 1] - joints).norm(dim=-1).min())
            entered = plan.at >= plan.parted or beside < 0.5 * moments.near
            if not entered:
                episode.failed_entries[plan.which] = episode.failed_entries.get(plan.which, 0) + 1
            self._reconsider(episode, "blocked" if entered else "never entered", (plan.which, plan.at))
            back = None if episode.plan is None else self._retrace(episode.plan, joints)
            return None, command if back is None else back
        wanted = moments.commands[min(plan.at + min(round(waited / moments.spacing), LONGEST_LEAD), last)] + plan.offset
        asked, own = moments.pull(joints, wanted), moments.pull(joints, command)
        agrees = float(asked @ own) > SAME_DIRECTION * float(asked.norm() * own.norm())
        agrees &= off_way <= ON_WAY * moments.near
        plan.agreed = plan.agreed + 1 if agrees and plan.at > plan.parted else 0
        if plan.agreed >= AGREED * self._fps:
            return None, command
        episode.trail.last.command = wanted
        state = self.model.network.step(sensed[None], moments.before.at(slice(plan.at, plan.at + 1)))
        return state, wanted

    def _keep_up(self, plan: _Plan, joints: Tensor, last: int) -> float:
        """Moves a plan on to where the arm is, which is waited for; how far it is from its way."""
        moments = self.moments
        path = moments.joints[plan.at : min(plan.at + 4, last) + 1] + plan.offset
        off_way, index = (path - joints).norm(dim=-1).min(0)
        ahead = int(index)
        if ahead == 0 and plan.at < last and plan.waited >= self.demonstrations.stride - 1:
            # Where the demonstration stood still there is nothing to wait for.
            ahead = int((path[1] - path[0]).norm() < 0.2 * moments.pace)
        if off_way > OFF_WAY * moments.near:
            ahead = 0
        plan.waited = 0 if ahead else plan.waited + 1
        plan.at += ahead
        plan.offset = plan.offset * FADING**ahead
        return float(off_way)
