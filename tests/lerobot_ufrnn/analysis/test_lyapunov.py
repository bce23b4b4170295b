import math

import numpy as np
import pandas as pd
import pytest
import torch
from oracle import Oracle
from small_network import random_state, row_of, small_model

from lerobot_ufrnn.analysis.lyapunov import draw, exponents_over_time, local_lyapunov_exponent, statistics, to_table


def logistic(state):
    return 4 * state * (1 - state)


def henon(state):
    x, y = state.unbind(-1)
    return torch.stack((1 - 1.4 * x**2 + y, 0.3 * x), dim=-1)


def starts(count: int, size: int, scale: float, centre=0.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return centre + scale * (2 * torch.rand(count, size, dtype=torch.float64, generator=generator) - 1)


@pytest.mark.parametrize(
    ("step", "start", "lengths", "expected"),
    [
        (logistic, starts(2000, 1, 0.4, 0.5), (40, 80), math.log(2)),
        (henon, starts(300, 2, 0.1), (100, 200), 0.419),
    ],
    ids=["logistic", "henon"],
)
def test_over_many_steps_it_is_the_exponent_of_a_known_system(step, start, lengths, expected):
    """Which direction grows most at first gives away a factor, which cancels between two lengths."""
    for _ in range(lengths[1] // 3):
        start = step(start)  # onto the attractor
    growth = [length * local_lyapunov_exponent(step, start, length).mean() for length in lengths]
    assert (growth[1] - growth[0]).item() / (lengths[1] - lengths[0]) == pytest.approx(expected, abs=3e-3)


def test_over_a_few_steps_of_a_linear_map_it_is_that_of_its_largest_singular_value():
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(4, 4, dtype=torch.float64, generator=generator)
    matrix = basis @ torch.diag(torch.tensor([-1.3, 0.9, -0.5, 0.1], dtype=torch.float64)) @ basis.inverse()
    exponents = local_lyapunov_exponent(lambda state: state @ matrix.T, starts(3, 4, 0.1), 5)
    expected = torch.linalg.svdvals(torch.linalg.matrix_power(matrix, 5))[0].log() / 5
    torch.testing.assert_close(exponents, expected.expand(3), atol=1e-6, rtol=0)


@pytest.mark.parametrize("gain", [1.0, 3.0], ids=["calm", "lively"])
def test_that_of_a_network_is_what_finite_differences_of_the_oracle_give(gain):
    """Ten steps of the oracle from a state and from its neighbours: no derivative, and none of the network's code."""
    network = small_model().network
    for parameter in network.parameters():
        parameter *= gain
    oracle, sizes = Oracle(network), np.cumsum(network.state_sizes)[:-1]

    def ten_steps(flat: np.ndarray) -> np.ndarray:
        state = np.split(flat, sizes)
        for _ in range(10):
            state = oracle.step(oracle.predict(state)[0], state)
        return np.concatenate(state)

    states = random_state(network, 3)
    (exponents,) = exponents_over_time(network, [states], 10)
    for row, exponent in enumerate(exponents):
        flat = np.concatenate(row_of(states, row))
        steps = 1e-6 * np.eye(len(flat))
        jacobian = [(ten_steps(flat + step) - ten_steps(flat - step)) / 2e-6 for step in steps]
        assert exponent == pytest.approx(math.log(np.linalg.norm(np.array(jacobian), 2)) / 10, abs=1e-6)


def test_exponents_are_drawn_and_written(tmp_path):
    curves = {"model": [np.array([0.1, 0.2]), np.array([0.3, 0.4, 0.5])]}
    mean, deviation = statistics(curves["model"])
    np.testing.assert_allclose(mean, [0.2, 0.3, 0.5])
    np.testing.assert_allclose(deviation, [0.1, 0.1, 0.0], atol=1e-12)
    for phases in ({}, {"grasp": [0, 1]}):
        draw(curves, phases, 10, tmp_path / "folder" / "lyapunov.png")
    assert (tmp_path / "folder" / "lyapunov.png").read_bytes().startswith(b"\x89PNG")
    rows = [("model", 0, 0, 0.1), ("model", 0, 1, 0.2)] + [("model", 1, step, 0.3 + 0.1 * step) for step in range(3)]
    expected = pd.DataFrame(rows, columns=["model", "demonstration", "step", "exponent"])
    pd.testing.assert_frame_equal(to_table(curves), expected)
