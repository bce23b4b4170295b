import math

import numpy as np
import pytest
import torch
from oracle import Oracle
from small_network import small_model

from lerobot_ufrnn.analysis.lyapunov import closed_loop, flatten, local_lyapunov_exponent
from lerobot_ufrnn.foresight import roll_out
from lerobot_ufrnn.networks import SHLSTM, HiddenState


def logistic(state):
    return 4 * state * (1 - state)


def henon(state):
    x, y = state.unbind(-1)
    return torch.stack((1 - 1.4 * x**2 + y, 0.3 * x), dim=-1)


def lorenz(state, time_step=0.02):
    def velocity(state):
        x, y, z = state.unbind(-1)
        return torch.stack((10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z), dim=-1)

    first = velocity(state)
    second = velocity(state + time_step / 2 * first)
    third = velocity(state + time_step / 2 * second)
    fourth = velocity(state + time_step * third)
    return state + time_step / 6 * (first + 2 * second + 2 * third + fourth)


def starts(count: int, size: int, scale: float, centre=0.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return centre + scale * (2 * torch.rand(count, size, dtype=torch.float64, generator=generator) - 1)


@pytest.fixture(params=[1.0, 3.0], ids=["calm", "lively"])
def network(request) -> SHLSTM:
    """A small network whose dynamics larger weights make livelier."""
    network = small_model().network
    for parameter in network.parameters():
        parameter *= request.param
    return network


@pytest.mark.parametrize(
    ("step", "start", "lengths", "expected", "tolerance"),
    [
        (logistic, starts(2000, 1, 0.4, 0.5), (40, 80), math.log(2), 3e-3),
        (henon, starts(300, 2, 0.1), (100, 200), 0.419, 3e-3),
        # Sprott (2003), per unit of time
        (lorenz, starts(100, 3, 2.0, torch.tensor([1, 1, 20])), (300, 1300), 0.02 * 0.9056, 0.02 * 0.03),
    ],
    ids=["logistic", "henon", "lorenz"],
)
def test_over_many_steps_it_is_the_exponent_of_a_known_system(step, start, lengths, expected, tolerance):
    """Which direction grows most at first gives away a factor, which cancels between two lengths."""
    for _ in range(lengths[1] // 3):
        start = step(start)  # onto the attractor
    growth = [length * local_lyapunov_exponent(step, start, length, num_sweeps=0).mean() for length in lengths]
    assert (growth[1] - growth[0]).item() / (lengths[1] - lengths[0]) == pytest.approx(expected, abs=tolerance)


def test_over_a_few_steps_of_a_linear_map_it_is_that_of_its_largest_singular_value():
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(4, 4, dtype=torch.float64, generator=generator)
    matrix = basis @ torch.diag(torch.tensor([-1.3, 0.9, -0.5, 0.1], dtype=torch.float64)) @ basis.inverse()
    exponents = local_lyapunov_exponent(lambda state: state @ matrix.T, starts(3, 4, 0.1), 5, num_sweeps=50)
    expected = torch.linalg.svdvals(torch.linalg.matrix_power(matrix, 5))[0].log() / 5
    torch.testing.assert_close(exponents, expected.expand(3), atol=1e-6, rtol=0)


def test_the_map_of_a_network_is_what_foresight_rolls_out(network):
    step = closed_loop(network)
    state = HiddenState(*(torch.randn(5, size, dtype=torch.float64) for size in network.state_sizes))
    flat = flatten(state)
    for _ in range(3):
        flat = step(flat)
    imagined = network.predict(HiddenState(*flat.split(network.state_sizes, dim=-1)))
    for ours, theirs in zip(imagined, roll_out(network, state, 3), strict=True):
        torch.testing.assert_close(ours, theirs[-1])


def test_that_of_a_network_is_what_finite_differences_of_the_oracle_give(network):
    """Ten steps of the oracle from a state and from its neighbours: no derivative, and none of the network's code."""
    oracle, sizes = Oracle(network), np.cumsum(network.state_sizes)[:-1]

    def ten_steps(flat: np.ndarray) -> np.ndarray:
        state = np.split(flat, sizes)
        for _ in range(10):
            state = oracle.step(oracle.predict(state)[0], state)
        return np.concatenate(state)

    start = starts(3, sum(network.state_sizes), 0.5)
    exponents = local_lyapunov_exponent(closed_loop(network), start, 10)
    for flat, exponent in zip(start.numpy(), exponents, strict=True):
        steps = 1e-6 * np.eye(len(flat))
        jacobian = [(ten_steps(flat + step) - ten_steps(flat - step)) / 2e-6 for step in steps]
        expected = math.log(np.linalg.norm(np.array(jacobian), 2)) / 10
        assert exponent == pytest.approx(expected, abs=1e-3)
        assert exponent <= expected + 1e-6  # sweeps approach it from below
