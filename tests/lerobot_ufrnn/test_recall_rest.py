"""Demonstrations on a line: they lead from 0 to their end and may wait on the way or there."""

import pytest
import torch

from lerobot_ufrnn.recall import MOST_PLACES, NEAR, REST_STEPS, STANDSTILL, RestDetector

STEPS, SPEED = 60, 0.02
END = STEPS * SPEED
LEAST = REST_STEPS * SPEED


def demonstration(*parts: tuple[int, float], steady: float = 0.3) -> torch.Tensor:
    """Joints (L, 2) that move at each of the given speeds for so many steps; the second joint keeps its place."""
    speeds = torch.cat([torch.zeros(1), *(torch.full((steps,), speed) for steps, speed in parts)]).double()
    return torch.stack((speeds.cumsum(0), torch.full_like(speeds, steady)), dim=1)


def detector(*demonstrations: torch.Tensor) -> RestDetector:
    rest = RestDetector(2).double()
    for joints in demonstrations:
        rest.observe(joints)
    return rest


def window(place: float, movement: float = 0.0) -> torch.Tensor:
    """The last steps of an arm that has gone to its place from as far off as given, and evenly."""
    first = torch.linspace(place - movement, place, REST_STEPS + 1).double()
    return torch.stack((first, torch.full_like(first, 0.3)), dim=1)


@pytest.mark.parametrize("before", [0, 5, 50])
@pytest.mark.parametrize("after", [0, 5, 50])
@pytest.mark.parametrize(("share", "rests"), [(0.0, True), (0.99, True), (1.01, False), (3.0, False)])
def test_a_rest_is_far_less_movement_than_demonstrations_ever_made_on_their_way(before, after, share, rests):
    rest = detector(demonstration((before, 0.0), (STEPS, SPEED), (after, 0.0)))
    assert rest.detects(window(END / 2, share * STANDSTILL * LEAST)) == rests


@pytest.mark.parametrize(("off", "rests"), [(0.0, False), (0.99, False), (1.01, True)])
def test_where_a_demonstration_began_or_ended_an_arm_may_rest(off, rests):
    rest = detector(demonstration((STEPS, SPEED)), demonstration((STEPS, -SPEED)))
    for place in (END, 0.0, -END):
        for side in (1, -1):
            assert rest.detects(window(place + side * off * NEAR * END)) == rests


def test_how_far_a_demonstration_led_is_what_counts_also_if_it_came_back():
    rest = detector(demonstration((STEPS, SPEED), (STEPS, -SPEED)))
    assert not rest.detects(window(0.99 * NEAR * END))
    assert rest.detects(window(1.01 * NEAR * END))


def test_to_and_fro_is_no_rest():
    rest = detector(demonstration((STEPS, SPEED)))
    swinging = window(END / 2)
    swinging[::2, 0] += 1.01 * STANDSTILL * LEAST
    assert not rest.detects(swinging)
    swinging[:, 0] = END / 2
    swinging[7, 1] += 1.01 * STANDSTILL * LEAST
    assert not rest.detects(swinging)


def test_after_demonstrations_that_paused_for_as_long_no_standstill_is_a_rest():
    moving, pausing = demonstration((STEPS, SPEED)), demonstration((30, SPEED), (REST_STEPS, 0.0), (30, SPEED))
    for demonstrations in ((moving, pausing), (pausing, moving)):
        assert not detector(*demonstrations).detects(window(END / 2))
    shorter = demonstration((30, SPEED), (REST_STEPS // 2, 0.0), (30, SPEED))
    rest = detector(moving, shorter)
    assert rest.detects(window(END / 2, 0.99 * STANDSTILL * LEAST / 2))
    assert not rest.detects(window(END / 2, 1.01 * STANDSTILL * LEAST / 2))


@pytest.mark.parametrize("lengths", [(), (REST_STEPS - 1,), (STEPS, REST_STEPS - 1), (0,)])
def test_without_a_demonstration_long_enough_nothing_is_a_rest(lengths):
    rest = detector(*(demonstration((length, SPEED)) for length in lengths))
    assert not rest.detects(window(-5.0))


def test_a_demonstration_seen_again_teaches_nothing_new():
    generator = torch.Generator().manual_seed(0)
    demonstrations = [torch.rand(50, 2, dtype=torch.float64, generator=generator).cumsum(0) for _ in range(9)]
    once, again = detector(*demonstrations), detector(*demonstrations, *reversed(demonstrations))
    assert once.extent == again.extent
    assert once.least_movement == again.least_movement
    assert set(map(tuple, once.places.tolist())) == set(map(tuple, again.places.tolist()))
    places = {tuple(joints[step].tolist()) for joints in demonstrations for step in (0, -1)}
    assert set(map(tuple, once.places.tolist())) == places


@pytest.mark.parametrize("first", [True, False])
def test_of_very_many_places_the_rare_ones_are_kept(first):
    common = [demonstration((STEPS, SPEED + 1e-5 * number)) for number in range(2 * MOST_PLACES)]
    rare = demonstration((STEPS, -SPEED))
    rest = detector(*((rare, *common) if first else (*common, rare)))
    assert not rest.detects(window(-END))
    assert not rest.detects(window(END))
    assert not rest.detects(window(0.0))
    assert rest.detects(window(-END / 2))


def test_what_was_observed_is_saved_with_the_weights():
    saved = detector(demonstration((STEPS, SPEED))).state_dict()
    rest = detector()
    assert not rest.detects(window(END / 2))
    rest.load_state_dict(saved)
    assert rest.detects(window(END / 2))
    assert not rest.detects(window(END))
