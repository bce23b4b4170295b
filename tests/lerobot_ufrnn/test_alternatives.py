"""Futures of perturbed copies against the oracle, and the choice among futures that were made up."""

import math

import numpy as np
import pytest
import torch
from oracle import Oracle
from small_network import FEATURES, JOINTS, in_closed_loop, is_close, random_state, row_of, small_model, small_network

from lerobot_ufrnn import alternatives as alternatives_module
from lerobot_ufrnn.alternatives import FEWEST_ALIKE, REFUTED, SAME_FUTURE, SETTLE, Alternatives
from lerobot_ufrnn.foresight import PERTURBED_STATES
from lerobot_ufrnn.networks import HiddenState, Prediction

HORIZON = 9


def imagine(
    moments: int = 3, num_samples: int = 6, noise=(0.0, 0.0), perturbed="hidden", hidden_dim: int = 6, seed: int = 0
) -> tuple[HiddenState, Alternatives]:
    """Random moments, and the alternatives imagined from them."""
    model = small_model(hidden_dim)
    states = random_state(model.network, moments, seed=1)
    generator = torch.Generator().manual_seed(seed)
    found = Alternatives.imagine(model, states, num_samples, noise, PERTURBED_STATES[perturbed], HORIZON, generator)
    return states, found


# ── Imagining ─────────────────────────────────────────────────────────


@pytest.mark.parametrize("seed", range(3))
def test_without_noise_the_futures_are_those_of_the_moments_in_turn_in_closed_loop(seed):
    network = small_network()
    states, found = imagine(moments=3, num_samples=7, seed=seed)
    futures = [in_closed_loop(network, row_of(states, row), SETTLE + HORIZON) for row in range(3)]
    assert found.predictions.mean.shape == (1 + HORIZON, 7, JOINTS + FEATURES)
    first = next(row for row in range(3) if is_close(found.states.at(0), futures[row][SETTLE]))
    oracle = Oracle(network)
    for copy in range(7):
        future = futures[(first + copy) % 3]
        predicted = [oracle.predict(state) for state in future[SETTLE:]]
        for step, expected in enumerate(predicted):
            assert is_close(found.states.at(step), future[SETTLE + step], row=copy)
            for ours, theirs in zip(found.predictions, expected, strict=True):
                np.testing.assert_allclose(ours[step, copy], theirs, atol=1e-10)
        np.testing.assert_allclose(found.starts[copy], predicted[0][0][:JOINTS], atol=1e-10)
        np.testing.assert_allclose(found.ends[copy], predicted[-1][0][:JOINTS], atol=1e-10)


def test_each_moment_gets_as_many_copies_as_the_others():
    for seed in range(5):
        states, found = imagine(moments=4, num_samples=12, seed=seed)
        begun = [in_closed_loop(small_network(), row_of(states, row), SETTLE)[-1] for row in range(4)]
        copies = [sum(is_close(found.states.at(0), begun[row], copy) for copy in range(12)) for row in range(4)]
        assert copies == [3, 3, 3, 3]


def test_a_single_copy_may_be_of_any_moment():
    starts = {tuple(imagine(num_samples=1, seed=seed)[1].starts[0].tolist()) for seed in range(30)}
    assert len(starts) == 3


def test_the_noise_of_the_copies_is_anywhere_in_the_range(monkeypatch):
    monkeypatch.setattr(alternatives_module, "SETTLE", 0)
    states, found = imagine(moments=1, num_samples=200, noise=(0.2, 1.4), hidden_dim=500)
    noise = found.states.h_joint[0] - states.h_joint
    np.testing.assert_allclose(noise.mean(-1), 0, atol=0.3)  # five standard errors of the most
    np.testing.assert_allclose(noise.std(-1).sort().values, np.linspace(0.2, 1.4, 200), atol=0.15)
    correlation = np.corrcoef(noise.numpy()) - np.eye(200)
    assert np.abs(correlation).max() < 0.3  # each copy has its own


def test_all_perturbed_parts_of_a_copy_get_the_same_noise(monkeypatch):
    monkeypatch.setattr(alternatives_module, "SETTLE", 0)
    states, found = imagine(moments=1, num_samples=4000, noise=(0.7, 0.7), hidden_dim=3)
    for name in PERTURBED_STATES["hidden"]:
        noise = getattr(found.states, name)[0] - getattr(states, name)
        np.testing.assert_allclose(noise.std(0), 0.7, rtol=0.06)  # five standard errors


@pytest.mark.parametrize("perturbed", sorted(PERTURBED_STATES))
def test_only_what_is_to_be_perturbed_is(monkeypatch, perturbed):
    monkeypatch.setattr(alternatives_module, "SETTLE", 0)
    states, found = imagine(moments=1, num_samples=5, noise=(0.5, 0.5), perturbed=perturbed)
    for name, value, copies in zip(HiddenState._fields, states, found.states.at(0), strict=True):
        changed = (copies != value).any(-1)
        assert changed.all() if name in PERTURBED_STATES[perturbed] else not changed.any()


def test_noise_settles_before_the_future_begins():
    """What begins is what the network itself goes on to, so that one step more is the first of the future."""
    network = small_network()
    _, found = imagine(noise=(1.0, 2.0))
    for copy in range(6):
        begun = row_of(found.states.at(0), copy)
        after = in_closed_loop(network, begun, 1)[-1]
        np.testing.assert_allclose(found.predictions.mean[1, copy], Oracle(network).predict(after)[0], atol=1e-10)
        np.testing.assert_allclose(found.starts[copy], Oracle(network).predict(begun)[0][:JOINTS], atol=1e-10)


def test_a_generator_makes_it_reproducible():
    first, again, other = (imagine(noise=(0.5, 1.0), seed=seed)[1] for seed in (3, 3, 4))
    assert torch.equal(first.ends, again.ends)
    assert torch.equal(first.states.h_shared, again.states.h_shared)
    assert not torch.equal(first.ends, other.ends)


# ── Refuting ──────────────────────────────────────────────────────────

HERE = torch.tensor([0.1, -0.2], dtype=torch.float64)


def made_up(ends, starts=None, soon=None, horizon: int = 2 * SETTLE) -> Alternatives:
    """Futures of two joints that start at `HERE` and are at their ends from the settling on, unless told otherwise."""
    ends = torch.as_tensor(ends, dtype=torch.float64)
    starts = HERE.expand_as(ends) if starts is None else torch.as_tensor(starts, dtype=torch.float64)
    mean = torch.full((1 + horizon, len(ends), 3), 7.0, dtype=torch.float64)
    mean[..., :2] = 77.0  # what is in between does not count
    mean[0, :, :2] = starts
    mean[-1, :, :2] = ends
    if horizon > SETTLE:
        mean[SETTLE, :, :2] = ends if soon is None else torch.as_tensor(soon, dtype=torch.float64)
    nothing = mean.new_empty(1 + horizon, len(ends), 0)
    states = HiddenState(*(ends.new_zeros(1 + horizon, len(ends), 1) for _ in HiddenState._fields))
    return Alternatives(states, Prediction(mean, mean, nothing, nothing), joint_dim=2)


def kernel_width(ends: np.ndarray) -> float:
    return SAME_FUTURE * sorted(math.dist(end, HERE) for end in ends)[(len(ends) - 1) // 2]


def test_likeness_to_failures_is_a_sum_of_weighted_gaussians_of_how_far_the_ends_are_apart():
    rng = np.random.default_rng(0)
    ends, failures = 0.3 * rng.normal(size=(7, 2)), 0.3 * rng.normal(size=(3, 2))
    weights = (1.0, 0.5, 0.1)
    found = made_up(ends).refuted(zip(weights, torch.from_numpy(failures), strict=True), HERE)
    width = kernel_width(ends)
    expected = [
        sum(
            weight * math.exp(-(math.dist(end, failure) ** 2) / (2 * width**2))
            for weight, failure in zip(weights, failures, strict=True)
        )
        for end in ends
    ]
    assert max(expected) > 0.1
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_nothing_is_refuted_without_failures():
    assert torch.equal(made_up([[1.0, 0.0]] * 4).refuted([], HERE), torch.zeros(4, dtype=torch.float64))


def test_futures_that_lead_nowhere_can_be_compared():
    found = made_up([HERE.tolist()] * 4)
    refuted = found.refuted([(1.0, HERE)], HERE)
    assert torch.equal(refuted, torch.ones(4, dtype=torch.float64))
    assert found.choose(torch.zeros(4), HERE) in range(4)


# ── Choosing ──────────────────────────────────────────────────────────


OPEN = 0.0
UP, DOWN = (0.1, 0.8), (0.1, -1.2)  # both are one away from here


def test_the_one_that_is_soon_well_on_its_way_is_chosen():
    ends = np.array([UP, DOWN] * 4)
    share_left = np.array([0.9, 0.5, 0.3, 0.6, 0.31, 0.29, 1.4, 0.4])
    soon = ends + share_left[:, None] * (HERE.numpy() - ends)
    assert made_up(ends, soon=soon).choose(torch.zeros(8), HERE) == 5


def test_one_that_wavers_is_not_chosen_although_all_end_alike():
    ends = np.array([UP] * 5)
    soon = ends.copy()
    soon[:4] += (0.0, -0.3)
    soon[1] = DOWN
    assert made_up(ends, soon=soon).choose(torch.zeros(5), HERE) == 4


def test_one_that_starts_elsewhere_is_not_chosen_although_it_is_sooner_on_its_way():
    ends = np.array([UP] * 5)
    starts = np.tile(HERE.numpy(), (5, 1))
    starts[1] += (0.5, 0.0)
    soon = ends + 0.2 * (HERE.numpy() - ends)
    soon[1] = ends[1]
    assert made_up(ends, starts, soon).choose(torch.zeros(5), HERE) != 1
    starts[:, 0] += (0.2, 0.0, 0.1, 0.2, 0.3)
    assert made_up(ends, starts, soon).choose(torch.zeros(5), HERE) == 2


def test_those_that_are_refuted_are_not_chosen():
    ends = np.array([UP, DOWN] * 4)
    soon = ends + np.linspace(0.1, 0.8, 8)[:, None] * (HERE.numpy() - ends)
    found = made_up(ends, soon=soon)
    refuted = torch.zeros(8)
    for expected in range(8):
        assert found.choose(refuted, HERE) == expected
        refuted[expected] = REFUTED + 0.01


def test_what_is_refuted_a_little_is_as_open_as_the_rest():
    refuted = torch.tensor([OPEN, REFUTED - 0.01, OPEN, OPEN])
    ends = np.array([UP] * 4)
    soon = ends + np.array([0.4, 0.3, 0.4, 0.4])[:, None] * (HERE.numpy() - ends)
    assert made_up(ends, soon=soon).choose(refuted, HERE) == 1


def test_if_all_are_refuted_the_least_refuted_is_chosen():
    ends = np.array([UP] * 5)
    refuted = torch.tensor([1.5, 0.9, 0.5, 0.4, 0.7])
    soon = ends + np.linspace(0.1, 0.8, 5)[:, None] * (HERE.numpy() - ends)
    assert made_up(ends, soon=soon).choose(refuted, HERE) == 3


def test_one_that_no_other_shares_is_not_chosen_although_it_is_the_best():
    ends = np.array([UP] * 5 + [DOWN])
    soon = ends + np.array([*[0.5] * 4, 0.4, 0.1])[:, None] * (HERE.numpy() - ends)
    found = made_up(ends, soon=soon)
    assert found.choose(torch.zeros(6), HERE) == 4
    # Not even when it alone was never tried.
    assert found.choose(torch.tensor([0.9, 0.8, 0.9, 0.9, 0.9, 0.0]), HERE) == 1


@pytest.mark.parametrize(("alike", "is_chosen"), [(1, False), (FEWEST_ALIKE - 1, False), (FEWEST_ALIKE, True)])
def test_as_many_must_share_a_future_as_are_no_accident(alike, is_chosen):
    ends = np.array([UP] * 6 + [DOWN] * alike)
    soon = ends + np.array([0.5] * 6 + [0.1] * alike)[:, None] * (HERE.numpy() - ends)
    assert (made_up(ends, soon=soon).choose(torch.zeros(6 + alike), HERE) >= 6) == is_chosen


@pytest.mark.parametrize("count", [1, 2, 5])
def test_if_all_are_accidents_they_are_compared_anyway(count):
    angles = 2 * np.pi * np.arange(count) / count
    ends = HERE.numpy() + np.stack((np.cos(angles), np.sin(angles)), -1)
    soon = ends + np.linspace(0.8, 0.4, count)[:, None] * (HERE.numpy() - ends)
    found = made_up(ends, soon=soon)
    assert found.choose(torch.zeros(count), HERE) == count - 1
    assert found.choose(torch.full((count,), 0.8), HERE) == 0


def test_a_short_future_is_compared_at_its_end():
    ends = np.array([UP] * 4)
    starts = HERE.numpy() + np.array([0.3, 0.2, 0.1, 0.4])[:, None] * (1.0, 0.0)
    assert made_up(ends, starts, horizon=SETTLE - 1).choose(torch.zeros(4), HERE) == 2


def test_the_choice_is_that_of_a_search_one_by_one():
    rng = np.random.default_rng(0)
    here = HERE.numpy()
    kinds = set()
    for _ in range(300):
        count = rng.integers(2, 12)
        ends = np.array([UP, DOWN, (0.9, 0.0)])[rng.integers(0, 3, count)] + 0.04 * rng.normal(size=(count, 2))
        starts, soon = here + 0.2 * rng.normal(size=(2, count, 2))
        refuted = rng.uniform(0, 0.6, count)
        width = kernel_width(ends)
        alike = [sum(math.exp(-((math.dist(a, b) / width) ** 2) / 2) for b in ends) for a in ends]
        shared = [row for row in range(count) if alike[row] >= min(FEWEST_ALIKE, count)] or list(range(count))
        candidates = [row for row in shared if refuted[row] < REFUTED]
        kinds.add((len(shared) < count, bool(candidates)))

        def cost(row, refuted=refuted, ends=ends, starts=starts, soon=soon, candidates=candidates):
            if not candidates:
                return refuted[row]
            left = math.dist(soon[row], ends[row]) / math.dist(starts[row], ends[row])
            return left + math.dist(starts[row], here) / math.dist(ends[row], here)

        expected = min(candidates or shared, key=cost)
        assert made_up(ends, starts, soon).choose(torch.from_numpy(refuted), HERE) == expected
    assert kinds == {(False, False), (False, True), (True, False), (True, True)}
