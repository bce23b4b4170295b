"""An arm that follows, lags, sticks and comes free while an imagined future is carried out."""

import numpy as np
import pytest
import torch

from lerobot_ufrnn.networks import HiddenState
from lerobot_ufrnn.recall import FIRST_STEPS, LEAD, LEAST_PROGRESS, PATIENCE, Outcome, Plan, progress

STEPS = 30
UNTIL_BLOCKED = 1 + FIRST_STEPS + PATIENCE + 1
"""Calls for an arm that never moves: the first state, those that ask for too little, the patience, one too many."""


DIRECTION = torch.tensor([0.03, -0.04], dtype=torch.float64)
ORIGIN = torch.tensor([0.3, 0.1], dtype=torch.float64)


def on_the_line(place: float | torch.Tensor) -> torch.Tensor:
    return ORIGIN + place * DIRECTION


def plan_on_the_line(steps: int = STEPS) -> Plan:
    """Two joints that are to go straight on; a hidden state is how many steps they have gone."""
    gone = torch.arange(steps + 1, dtype=torch.float64)[:, None]
    return Plan(HiddenState(*(gone for _ in HiddenState._fields)), on_the_line(gone), on_the_line(100))


class Arm:
    """Calls a plan with places on the line, and keeps which of its states it was at and what came out."""

    def __init__(self, steps: int = STEPS):
        self.plan = plan_on_the_line(steps)
        self.outcomes: list[Outcome] = []

    def goes_to(self, place: float, as_predicted: bool = False) -> Outcome:
        self.outcomes.append(self.plan.advance(on_the_line(place), as_predicted))
        return self.outcomes[-1]

    def stays_at(self, place: float, calls: int) -> list[Outcome]:
        return [self.goes_to(place) for _ in range(calls)]

    def is_stuck_at(self, place: float) -> int:
        """Calls until it is blocked."""
        for call in range(1, 100):
            if self.goes_to(place) is Outcome.BLOCKED:
                return call
        raise AssertionError("never blocked")

    @property
    def at(self) -> int:
        return int(self.plan.state.h_joint)


# ── Progress ──────────────────────────────────────────────────────────


def test_progress_is_one_at_the_goal_none_sideways_or_still_and_negative_backwards():
    before, asked = torch.tensor([1.0, 2.0]), torch.tensor([4.0, 6.0])  # a movement of (3, 4)
    for moved, expected in (
        ((3.0, 4.0), 1),
        ((1.5, 2.0), 0.5),
        ((6.0, 8.0), 2),
        ((4.0, -3.0), 0),
        ((0.0, 0.0), 0),
        ((-3.0, -4.0), -1),
        ((1.5 - 4.0, 2.0 + 3.0), 0.5),
    ):
        assert progress(before, before + torch.tensor(moved), asked).item() == pytest.approx(expected, abs=1e-6)


def test_progress_is_how_much_of_the_way_the_foot_of_the_perpendicular_is():
    rng = np.random.default_rng(0)
    before, joints, asked = rng.normal(size=(3, 50, 4))
    found = progress(*map(torch.from_numpy, (before, joints, asked)))
    for row in range(50):
        share = found[row].item()
        foot = before[row] + share * (asked[row] - before[row])
        assert np.dot(joints[row] - foot, asked[row] - before[row]) == pytest.approx(0, abs=1e-9)


def test_where_nothing_was_asked_there_is_no_progress():
    before = torch.rand(5, 3)
    assert torch.equal(progress(before, before + torch.rand(5, 3), before), torch.zeros(5))


# ── An arm that follows ───────────────────────────────────────────────


def test_it_begins_with_the_first_state_wherever_the_arm_is():
    for place in (0.0, -20.0, 50.0):
        arm = Arm()
        assert not arm.plan.has_begun
        assert arm.goes_to(place, as_predicted=True) is Outcome.UNDER_WAY
        assert arm.plan.has_begun
        assert arm.at == 0


def test_an_arm_that_follows_gets_one_state_after_the_other():
    arm = Arm()
    for step in range(STEPS + 1):
        assert arm.goes_to(step, as_predicted=True) is Outcome.UNDER_WAY
        assert arm.at == step
    assert all(values.shape == (1, 1) for values in arm.plan.state)
    assert arm.goes_to(STEPS, as_predicted=True) is Outcome.DONE


@pytest.mark.parametrize("lag", range(1, LEAD))
def test_an_arm_that_lags_by_less_than_the_lead_is_not_held(lag):
    arm = Arm()
    for step in range(STEPS + 1):
        assert arm.goes_to(max(0, step - lag)) is Outcome.UNDER_WAY
        assert arm.at == step


def test_an_arm_at_half_speed_is_waited_for_but_never_blocked():
    arm = Arm()
    for call in range(2 * STEPS - 2 * LEAD):
        assert arm.goes_to(call / 2) is Outcome.UNDER_WAY
        assert arm.at <= call / 2 + LEAD + 0.5
    assert arm.at == pytest.approx(call / 2 + LEAD, abs=1)


def test_a_place_that_was_reached_stays_reached():
    """An arm that springs back from state 12 to where state 4 was may still be asked for state 12 + LEAD."""
    arm = Arm()
    for step in range(14):
        arm.goes_to(min(step, 12))
    for _ in range(2 * LEAD):
        if arm.goes_to(4) is Outcome.BLOCKED:
            break
    assert arm.at == 12 + LEAD


# ── An arm that does not ──────────────────────────────────────────────


@pytest.mark.parametrize("place", [0, -5])
def test_an_arm_that_never_moves_is_blocked_as_soon_as_that_can_be_told(place):
    arm = Arm()
    arm.goes_to(0)
    assert 1 + arm.is_stuck_at(place) == UNTIL_BLOCKED


def test_an_arm_that_moves_sideways_is_blocked_like_one_that_stands():
    plan, sideways = plan_on_the_line(), torch.tensor([0.04, 0.03], dtype=torch.float64)
    outcomes = [plan.advance(on_the_line(0) + call * sideways, False) for call in range(UNTIL_BLOCKED)]
    assert outcomes == [Outcome.UNDER_WAY] * (UNTIL_BLOCKED - 1) + [Outcome.BLOCKED]


@pytest.mark.parametrize("reached", [2, 4, 10])
def test_a_stuck_arm_is_never_asked_for_more_than_the_lead(reached):
    """It has made enough of the way not to be left behind, and so is waited for only once the lead is used up."""
    arm = Arm()
    for step in range(reached + 1):
        arm.goes_to(step)
    assert arm.at == reached
    assert reached / (reached + LEAD) > LEAST_PROGRESS
    calls = arm.is_stuck_at(reached)
    assert arm.at == reached + LEAD
    assert calls == LEAD + PATIENCE + 1


@pytest.mark.parametrize(("share", "waits"), [(LEAST_PROGRESS - 0.01, True), (LEAST_PROGRESS + 0.01, False)])
def test_an_arm_that_flexes_is_blocked_only_below_the_least_progress(share, waits):
    """It makes the same share of whatever is asked of it."""
    arm = Arm()
    arm.goes_to(0)
    for _ in range(UNTIL_BLOCKED - 1):
        arm.goes_to(share * arm.at)
    assert (arm.outcomes[-1] is Outcome.BLOCKED) == waits
    assert Outcome.BLOCKED not in arm.outcomes[:-1]


def test_an_arm_that_comes_free_is_waited_for_anew():
    arm = Arm()
    arm.goes_to(0)
    arm.stays_at(0, UNTIL_BLOCKED - 2)
    assert arm.goes_to(5) is Outcome.UNDER_WAY  # at 0 it would have been blocked
    lead_left = 5 + LEAD - arm.at
    assert lead_left > 0
    assert arm.is_stuck_at(5) == lead_left + PATIENCE + 1


# ── The end ───────────────────────────────────────────────────────────


def test_it_is_done_at_the_last_state_and_when_the_arm_is_as_predicted():
    arm = Arm(steps=4)
    for step in range(5):
        assert arm.goes_to(step, as_predicted=True) is Outcome.UNDER_WAY
    assert arm.goes_to(4, as_predicted=True) is Outcome.DONE


@pytest.mark.parametrize("waits", range(PATIENCE + 1))
def test_at_the_last_state_it_waits_for_the_arm_as_long_as_it_has_patience(waits):
    arm = Arm(steps=4)
    for step in range(5):
        arm.goes_to(step)
    assert arm.at == 4
    for _ in range(waits):
        assert arm.goes_to(3.5) is Outcome.UNDER_WAY
        assert arm.at == 4
    assert arm.goes_to(3.5, as_predicted=True) is Outcome.DONE


@pytest.mark.parametrize("steps", [0, 1, 4])
def test_an_arm_that_is_never_as_predicted_at_the_last_state_is_blocked(steps):
    arm = Arm(steps)
    for step in range(steps + 1):
        arm.goes_to(step)
    assert arm.stays_at(steps, PATIENCE + 1) == [Outcome.UNDER_WAY] * PATIENCE + [Outcome.BLOCKED]


def test_it_remembers_where_its_future_ends():
    assert torch.equal(plan_on_the_line().end, on_the_line(100))
