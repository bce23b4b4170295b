import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_ufrnn.augmentation import augment_images, drifting_noise, hold_end, stall_indices


def test_a_shift_moves_the_image_and_repeats_its_border():
    image = torch.arange(8.0).expand(1, 3, 8, 8) / 10
    shifted = augment_images(image, 2, 0.0, 0.0, torch.Generator().manual_seed(3))
    columns = shifted[0, 0, 0] * 10
    offset = columns[3] - 3
    assert abs(offset) <= 2
    torch.testing.assert_close(columns, (torch.arange(8) + offset).clamp(0, 7))


def test_shifts_cover_their_range():
    image = torch.arange(16.0).expand(400, 3, 16, 16) / 20
    columns = augment_images(image, 2, 0.0, 0.0, torch.Generator().manual_seed(0))[:, 0, 0, 8] * 20 - 8
    assert set(columns.round().int().tolist()) == {-2, -1, 0, 1, 2}


def test_augmented_images_stay_images():
    images = torch.rand(4, 3, 16, 16)
    augmented = augment_images(images, 1, 0.5, 0.5)
    assert augmented.shape == images.shape
    assert augmented.min() >= 0
    assert augmented.max() <= 1


@pytest.mark.parametrize("correlation", [0.0, 0.8, 0.95])
def test_noise_drifts_as_an_autoregressive_process(correlation):
    like = torch.zeros(400, 30, 50, dtype=torch.float64)
    noise = drifting_noise(like, 0.3, correlation, torch.Generator().manual_seed(0))
    first, second, last = noise[:, 0], noise[:, 1], noise[:, -1]
    for step in (first, second, last):
        torch.testing.assert_close(step.std(), torch.tensor(0.3).double(), rtol=0.03, atol=0)
    for lag in (1, 5):
        expected = torch.tensor(correlation**lag).double()
        torch.testing.assert_close((noise[:, lag:] * noise[:, :-lag]).mean() / 0.09, expected, rtol=0, atol=0.02)
    assert abs((noise[..., 0] * noise[..., 1]).mean() / 0.09) < 0.05  # dimensions are independent


@settings(deadline=None)
@given(
    length=st.integers(1, 60),
    probability=st.floats(0, 1),
    max_steps=st.integers(1, 12),
    slack=st.integers(0, 80),
    seed=st.integers(0, 10_000),
)
def test_a_stalled_episode_keeps_every_moment_in_order_and_its_bound(length, probability, max_steps, slack, seed):
    index = stall_indices(length, probability, max_steps, length + slack, torch.Generator().manual_seed(seed))
    assert len(index) <= length + slack
    assert index[0] == 0
    assert set(index.tolist()) == set(range(length))
    assert (index.diff() >= 0).all()
    assert index.bincount().max() <= max_steps + 1


def test_stalls_come_as_often_and_last_as_long_as_asked():
    index = stall_indices(20_000, 0.1, 4, 10**6, torch.Generator().manual_seed(0))
    # A stall lasts 2.5 steps on average and begins at every tenth step.
    assert abs(len(index) / 20_000 - 1.25) < 0.01


def test_no_stalls_leave_the_episode_alone():
    assert stall_indices(9, 0.0, 4, 100).tolist() == list(range(9))


def test_a_held_end_is_the_last_moment_over_and_over():
    values = torch.arange(6.0).reshape(3, 2)
    assert hold_end(values, 2).tolist() == [[0, 1], [2, 3], [4, 5], [4, 5], [4, 5]]
    assert hold_end(values, 0).tolist() == values.tolist()
