"""Futures that begin with other sensations against the oracle, and the choice among futures that were made up."""

import math

import numpy as np
import torch
from oracle import Oracle
from small_network import FEATURES, JOINTS, in_closed_loop, is_close, random_state, row_of, small_model

from lerobot_ufrnn.networks import HiddenState, Prediction
from lerobot_ufrnn.recall import DEVIATION_STEPS, REFUTED, SAME_FUTURE, SOON, Alternatives

HORIZON = 9


def imagine(num_samples: int = 6, noise=(0.0, 0.0), seed: int = 0) -> tuple[HiddenState, Alternatives]:
    """A random state, and the alternatives imagined from it."""
    model = small_model()
    state = random_state(model.network, 1, seed=1)
    generator = torch.Generator().manual_seed(seed)
    return state, Alternatives.imagine(model, state, num_samples, noise, HORIZON, generator)


def check_futures(found: Alternatives, begun: list[list[np.ndarray]]) -> None:
    """Each begins with the state that is given and goes on from there in closed loop."""
    network = small_model().network
    oracle = Oracle(network)
    assert found.predictions.mean.shape == (1 + HORIZON, len(begun), JOINTS + FEATURES)
    for copy, first in enumerate(begun):
        future = in_closed_loop(network, first, HORIZON)
        predicted = [oracle.predict(state) for state in future]
        for step, expected in enumerate(predicted):
            assert is_close(found.states.at(step), future[step], row=copy)
            for ours, theirs in zip(found.predictions, expected, strict=True):
                np.testing.assert_allclose(ours[step, copy], theirs, atol=1e-10)
        np.testing.assert_allclose(found.joints[0, copy], predicted[0][0][:JOINTS], atol=1e-10)
        np.testing.assert_allclose(found.joints[-1, copy], predicted[-1][0][:JOINTS], atol=1e-10)


# ── Imagining ─────────────────────────────────────────────────────────


def test_without_noise_the_futures_are_that_of_the_state_in_closed_loop():
    state, found = imagine()
    check_futures(found, [in_closed_loop(small_model().network, row_of(state), DEVIATION_STEPS)[-1]] * 6)


def test_a_copy_senses_what_it_expects_and_its_own_multiples_of_the_predicted_deviation_all_the_time():
    noise = (0.5, 3.0)
    state, found = imagine(num_samples=4, noise=noise, seed=7)
    generator = torch.Generator().manual_seed(7)
    places = torch.rand(4, 1, generator=generator, dtype=torch.float64)
    numbers = torch.randn(4, JOINTS + FEATURES, generator=generator, dtype=torch.float64)
    multiples = ((noise[0] + (noise[1] - noise[0]) * places) * numbers).numpy()
    oracle, begun = Oracle(small_model().network), []
    for multiple in multiples:
        now = row_of(state)
        for _ in range(DEVIATION_STEPS):
            mean, log_variance, *_ = oracle.predict(now)
            now = oracle.step(mean + multiple * np.exp(log_variance) ** 0.5, now)
        begun.append(now)
    check_futures(found, begun)


def test_a_generator_makes_it_reproducible():
    first, again, other = (imagine(noise=(0.5, 1.0), seed=seed)[1] for seed in (3, 3, 4))
    assert torch.equal(first.joints, again.joints)
    assert torch.equal(first.states.h_shared, again.states.h_shared)
    assert not torch.equal(first.joints[-1], other.joints[-1])


# ── Refuting ──────────────────────────────────────────────────────────

HERE = torch.tensor([0.1, -0.2], dtype=torch.float64)


def made_up(ends, starts=None, soon=None, horizon: int = 2 * SOON) -> Alternatives:
    """Futures of two joints that start at `HERE` and are at their ends soon, unless told otherwise."""
    ends = torch.as_tensor(ends, dtype=torch.float64)
    starts = HERE.expand_as(ends) if starts is None else torch.as_tensor(starts, dtype=torch.float64)
    mean = torch.full((1 + horizon, len(ends), 3), 7.0, dtype=torch.float64)
    mean[..., :2] = 77.0  # what is in between does not count
    mean[0, :, :2] = starts
    mean[-1, :, :2] = ends
    if horizon > SOON:
        mean[SOON, :, :2] = ends if soon is None else torch.as_tensor(soon, dtype=torch.float64)
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


def test_a_short_future_is_compared_at_its_end():
    ends = np.array([UP] * 4)
    starts = HERE.numpy() + np.array([0.3, 0.2, 0.1, 0.4])[:, None] * (1.0, 0.0)
    assert made_up(ends, starts, horizon=SOON - 1).choose(torch.zeros(4), HERE) == 2


def test_the_choice_is_that_of_a_search_one_by_one():
    rng = np.random.default_rng(0)
    here = HERE.numpy()
    kinds = set()
    for _ in range(300):
        count = rng.integers(2, 12)
        ends = np.array([UP, DOWN, (0.9, 0.0)])[rng.integers(0, 3, count)] + 0.04 * rng.normal(size=(count, 2))
        starts, soon = here + 0.2 * rng.normal(size=(2, count, 2))
        refuted = rng.uniform(0, 0.6, count)
        candidates = [row for row in range(count) if refuted[row] < REFUTED]
        kinds.add(bool(candidates))

        def cost(row, refuted=refuted, ends=ends, starts=starts, soon=soon, candidates=candidates):
            if not candidates:
                return refuted[row]
            left = math.dist(soon[row], ends[row]) / math.dist(starts[row], ends[row])
            return left + math.dist(starts[row], here) / math.dist(ends[row], here)

        expected = min(candidates or range(count), key=cost)
        assert made_up(ends, starts, soon).choose(torch.from_numpy(refuted), HERE) == expected
    assert kinds == {False, True}
