import pytest
import torch

from lerobot_ufrnn.networks import RangeScaler


def test_the_range_maps_to_plus_minus_0_8_and_back():
    scaler = RangeScaler(2)
    scaler.fit(torch.tensor([-1.0, 2.0]), torch.tensor([3.0, 4.0]))
    ends = torch.tensor([[-1.0, 2.0], [3.0, 4.0], [1.0, 3.0]])
    torch.testing.assert_close(scaler.scale(ends), torch.tensor([[-0.8, -0.8], [0.8, 0.8], [0.0, 0.0]]))
    values = torch.randn(5, 7, 2)
    torch.testing.assert_close(scaler.unscale(scaler.scale(values)), values)


def test_a_dimension_that_never_moves_is_not_blown_up():
    scaler = RangeScaler(1)
    scaler.fit(torch.tensor([2.0]), torch.tensor([2.0]))
    assert scaler.scale(torch.tensor([2.0 + 1e-5])).abs() < 0.02


def test_a_dimension_that_hardly_moves_gets_a_fraction_of_the_widest_range():
    scaler = RangeScaler(3)
    scaler.fit(torch.tensor([-2.0, 0.9, 5.0]), torch.tensor([6.0, 1.1, 5.0]), relative_floor=0.25)
    # The widest range is 8, so none is below 2, around the middle of what was measured.
    torch.testing.assert_close(scaler.low, torch.tensor([-2.0, 0.0, 4.0]))
    torch.testing.assert_close(scaler.high, torch.tensor([6.0, 2.0, 6.0]))
    scaler.fit(torch.zeros(3), torch.full((3,), 1e-4), floor=0.1, relative_floor=0.25)
    torch.testing.assert_close(scaler.high - scaler.low, torch.full((3,), 0.1))


def test_an_unfitted_range_is_refused():
    with pytest.raises(RuntimeError, match="no data range yet"):
        RangeScaler(1).scale(torch.zeros(1))


@pytest.mark.parametrize(("low", "high"), [(float("nan"), 1.0), (0.0, float("inf")), (1.0, 0.0)])
def test_a_senseless_range_is_refused(low, high):
    with pytest.raises(ValueError, match="range"):
        RangeScaler(1).fit(torch.tensor([low]), torch.tensor([high]))
