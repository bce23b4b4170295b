import numpy as np
import pytest
import torch
from torch import nn

from env_door import KINDS
from lerobot_ufrnn.benchmarks import door_features
from lerobot_ufrnn.benchmarks.door_features import door_separability
from lerobot_ufrnn.networks import ImageEncoder

SEEDS = range(1000, 1003)


class Reader(nn.Module):
    """An encoder whose only feature is any function of the image."""

    cameras = ("observation.images.front",)

    def __init__(self, read):
        super().__init__()
        self.read = read

    def forward(self, images):
        return self.read(images[self.cameras[0]].float()).reshape(-1, 1)


@pytest.fixture(scope="module")
def frames():
    return list(door_features._frames(SEEDS))


@pytest.fixture
def real_frames(frames, monkeypatch):
    """The expert's frames, recorded once for all tests."""
    monkeypatch.setattr(door_features, "_frames", lambda seeds: frames)


@pytest.fixture
def painted_frames(monkeypatch):
    """Frames of 2 x 2 pixels whose red is 10 x class + 0, 1, 2, 3 (the seed) and whose green tells the kind."""
    red = np.arange(4)[:, None, None, None] + 10 * np.arange(3)
    green = 40 * np.arange(3)[:, None]
    images = np.zeros((4, 2, 3, 3, 2, 2, 3), dtype=np.uint8)
    images[..., 0] = red[..., None, None]
    images[..., 1] = green[..., None, None]
    monkeypatch.setattr(door_features, "_frames", lambda seeds: list(images))


def test_frames_come_for_each_kind_and_angle_and_show_the_same_closed_door(frames):
    assert len(frames) == len(SEEDS)
    assert frames[0].shape == (2, 3, 3, 128, 128, 3)
    follows, still = frames[0]
    np.testing.assert_array_equal(follows[:, 0], still[:, 0])


def test_an_arm_that_stays_still_covers_the_same_pixels(frames):
    # The lower right corner shows the arm and the wall beside the door, but no door.
    _, still = frames[0]
    corner = still[:, :, 80:, 100:]
    np.testing.assert_allclose(corner.astype(int), np.broadcast_to(corner[:, :1], corner.shape), atol=1)


def test_an_exact_reading_of_the_opening_separates_it(painted_frames):
    rows = door_separability(Reader(lambda image: image[:, 0, 0, 0]), range(4))
    assert [(row.kind, row.arm) for row in rows] == [(kind, arm) for arm in ("follows", "still") for kind in KINDS]
    for row in rows:
        assert row.accuracy == 1
        assert row.distance_closed_5 == pytest.approx(10)
        # Classes 10 apart; the values 0, 1, 2, 3 have the sample variance 5 / 3.
        assert row.d_prime_closed_5 == pytest.approx(10 / (5 / 3) ** 0.5)
        assert row.d_prime_5_10 == pytest.approx(row.d_prime_closed_5)


def test_a_reading_of_the_kind_alone_separates_only_kinds(painted_frames):
    for row in door_separability(Reader(lambda image: image[:, 1, 0, 0]), range(4)):
        assert row.kind_accuracy == 1
        assert row.d_prime_closed_5 == 0
        assert row.accuracy == 0  # all means are the same: none is nearest


def test_chance_level_without_the_image(real_frames):
    generator = torch.Generator().manual_seed(0)

    def noise(image):
        return torch.randn(len(image), generator=generator)

    rows = door_separability(Reader(noise), SEEDS)
    # 6 x 9 frames at a chance of 1 / 3: four standard deviations are 0.26.
    assert np.mean([row.accuracy for row in rows]) == pytest.approx(1 / 3, abs=0.26)


def test_the_turquoise_behind_a_pushed_door_tells_its_opening(real_frames):
    def turquoise(image):
        red, green, blue = image.unbind(1)
        return ((blue > red + 60) & (green > red + 60)).float().sum((1, 2))

    push = door_separability(Reader(turquoise), SEEDS)[0]
    assert push.d_prime_5_10 > 2


def test_encoders_and_seeds_that_do_not_fit_are_refused(real_frames):
    with pytest.raises(ValueError, match="one camera"):
        door_separability(ImageEncoder(("a", "b"), (32, 32), 4, (4, 4), 8), SEEDS)


def test_too_few_seeds_are_refused():
    with pytest.raises(ValueError, match="at least 2"):
        door_separability(ImageEncoder(("a",), (32, 32), 4, (4, 4), 8), [])
