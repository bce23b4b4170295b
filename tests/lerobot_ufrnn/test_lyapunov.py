import math

import pytest
import torch
from torch.func import jacrev

from lerobot_ufrnn.analysis.lyapunov import (
    closed_loop,
    divergence_exponent,
    flatten,
    local_lyapunov_exponents,
    lyapunov_exponents,
)
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


def starts(count: int, size: int, scale: float = 0.1, centre: float = 0.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return centre + scale * (2 * torch.rand(count, size, dtype=torch.float64, generator=generator) - 1)


def shlstm(scale: float) -> SHLSTM:
    """A small network whose dynamics `scale` makes livelier."""
    torch.manual_seed(0)
    network = SHLSTM(3, 4, 6, 5, 2, (-9.0, 3.0)).double().requires_grad_(False)
    for parameter in network.parameters():
        parameter *= scale
    return network


@pytest.fixture(params=[1.0, 6.0], ids=["calm", "lively"])
def network(request) -> SHLSTM:
    return shlstm(request.param)


def test_logistic_map():
    """r = 4: ln 2."""
    start = starts(2000, 1, 0.4, 0.5)
    assert lyapunov_exponents(logistic, start, 100, warm_up=20).mean() == pytest.approx(math.log(2), abs=3e-3)
    assert divergence_exponent(logistic, start, 100, warm_up=20).mean() == pytest.approx(math.log(2), abs=3e-3)


def test_henon_map():
    """a = 1.4, b = 0.3: 0.419; areas shrink by b at every step, so the sum is ln b."""
    start = starts(300, 2)
    exponents = lyapunov_exponents(henon, start, 200, num_exponents=2, warm_up=50)
    assert exponents[:, 0].mean() == pytest.approx(0.419, abs=2e-3)
    torch.testing.assert_close(exponents.sum(-1), torch.full((300,), math.log(0.3), dtype=torch.float64))
    assert divergence_exponent(henon, start, 200, warm_up=50).mean() == pytest.approx(0.419, abs=2e-3)


def test_linear_map():
    """Logarithms of the absolute eigenvalues; over a few steps, of the singular values."""
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(4, 4, dtype=torch.float64, generator=generator)
    matrix = basis @ torch.diag(torch.tensor([-1.3, 0.9, -0.5, 0.1], dtype=torch.float64)) @ basis.inverse()
    start = starts(3, 4)
    exponents = lyapunov_exponents(lambda state: state @ matrix.T, start, 100, num_exponents=4, warm_up=200)
    expected = torch.tensor([1.3, 0.9, 0.5, 0.1], dtype=torch.float64).log()
    torch.testing.assert_close(exponents, expected.expand(3, 4), atol=1e-6, rtol=0)
    local = local_lyapunov_exponents(lambda state: state @ matrix.T, start, 5, num_exponents=4, num_sweeps=50)
    expected = torch.linalg.svdvals(torch.linalg.matrix_power(matrix, 5)).log() / 5
    torch.testing.assert_close(local, expected.expand(3, 4), atol=1e-6, rtol=0)


def test_lorenz_system():
    """Lorenz-63 by fourth-order Runge-Kutta: 0.9056, 0 and -14.57 per unit of time (Sprott 2003)."""
    start = starts(300, 3, 2.0) + torch.tensor([1, 1, 20])
    first, second, third = (lyapunov_exponents(lorenz, start, 400, 3, warm_up=400).mean(0) / 0.02).tolist()
    assert first == pytest.approx(0.9056, abs=0.03)
    assert second == pytest.approx(0, abs=0.03)
    assert third == pytest.approx(-14.57, abs=0.06)
    assert first + second + third == pytest.approx(-(10 + 1 + 8 / 3), abs=5e-3)  # volumes shrink at a constant rate


def test_the_map_of_a_network_is_what_foresight_rolls_out(network):
    step = closed_loop(network)
    state = HiddenState(*(torch.randn(5, size, dtype=torch.float64) for size in network.state_sizes))
    flat = flatten(state)
    for _ in range(3):
        flat = step(flat)
    imagined = network.predict(HiddenState(*flat.split(network.state_sizes, dim=-1)))
    for ours, theirs in zip(imagined, roll_out(network, state, 3), strict=True):
        torch.testing.assert_close(ours, theirs[-1])


def test_both_methods_agree_on_a_network(network):
    step, start = closed_loop(network), starts(4, sum(network.state_sizes), 0.5)
    for settings in ({"num_steps": 10}, {"num_steps": 100, "warm_up": 100}):
        exponents = lyapunov_exponents(step, start, **settings).squeeze(-1)
        torch.testing.assert_close(divergence_exponent(step, start, **settings), exponents, atol=1e-5, rtol=0)


def test_local_exponents_are_those_of_the_whole_stretch(network):
    step, start = closed_loop(network), starts(3, sum(network.state_sizes), 0.5)

    def ten_steps(state):
        for _ in range(10):
            state = step(state)
        return state.sum(0)

    expected = torch.linalg.svdvals(jacrev(ten_steps)(start).movedim(1, 0))[:, :2].log() / 10
    exponents = local_lyapunov_exponents(step, start, 10, num_exponents=2)
    torch.testing.assert_close(exponents, expected, atol=1e-3, rtol=0)
    assert (exponents <= expected + 1e-9).all()
