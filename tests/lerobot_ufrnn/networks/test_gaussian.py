import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_ufrnn.networks import bound_log_variance, gaussian_nll


def test_nll_equals_torch_distributions():
    generator = torch.Generator().manual_seed(0)
    target, mean, log_variance = torch.randn(3, 4, 5, 6, generator=generator, dtype=torch.float64)
    expected = -torch.distributions.Normal(mean, log_variance.exp().sqrt()).log_prob(target)
    torch.testing.assert_close(gaussian_nll(target, mean, log_variance), expected)


@given(st.floats(-200, 200))
def test_log_variance_stays_within_its_bounds(raw):
    bounded = bound_log_variance(torch.tensor(raw, dtype=torch.float64), -9.0, 3.0)
    assert -9.0 <= bounded <= 3.0 + 1e-4


def test_log_variance_is_unchanged_well_inside_the_bounds_and_never_stuck_outside():
    raw = torch.tensor([-3.0, -15.0, 8.0], dtype=torch.float64, requires_grad=True)
    bounded = bound_log_variance(raw, -9.0, 3.0)
    assert abs(bounded[0].item() + 3.0) < 0.01
    bounded.sum().backward()
    assert (raw.grad > 1e-4).all()
