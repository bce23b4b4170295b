"""An imagined future, carried out at the arm's own pace."""

from enum import Enum

from torch import Tensor

from .networks import HiddenState

LEAD = 8
"""Imagined steps that an attempt may be ahead of the arm, so that its commands press on against a load."""

PATIENCE = 5
"""Steps that it waits for the arm."""

FIRST_STEPS = 3
"""Imagined steps before which it asks for too little to tell whether the arm follows."""

LEAST_PROGRESS = 0.15
"""Share of the movement asked for that an arm makes which is not blocked; its flexing makes some, too."""


class Outcome(Enum):
    """How an attempt is doing."""

    UNDER_WAY = "under way"
    DONE = "done"
    BLOCKED = "blocked"


def progress(before: Tensor, joints: Tensor, asked: Tensor) -> Tensor:
    """How much of a movement the arm has made.

    Args:
        before (`Tensor`):
            Scaled joints where it began, (..., D_j).
        joints (`Tensor`):
            Scaled joints now, (..., D_j).
        asked (`Tensor`):
            Scaled joints where it was to lead, (..., D_j).

    Returns:
        `Tensor`: (...); 1 for an arm that is there, 0 for one that has not moved that way at all.
    """
    movement = asked - before
    return ((joints - before) * movement).sum(-1) / movement.square().sum(-1).clamp(min=1e-12)


class Attempt:
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
            Scaled joints where the future ends, (D_j,).
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
        """Goes on by a step, or waits.

        Args:
            joints (`Tensor`):
                Scaled measured joints, (D_j,).
            as_predicted (`bool`):
                Whether they are where the present state predicted them to be.

        Returns:
            `Outcome`: `UNDER_WAY` if `state` is to be carried out now.
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
