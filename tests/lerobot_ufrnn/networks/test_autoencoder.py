import pytest
import torch
from small import small_config
from torchvision.transforms.v2.functional import resize

from lerobot_ufrnn.configuration_ufrnn import AutoencoderConfig
from lerobot_ufrnn.networks import ConvAutoencoder, ImageEncoder


def make_autoencoder(size=(32, 32), feature_dim=4, channels=(4, 4), hidden_dim=8, first_stride=16) -> ConvAutoencoder:
    return ConvAutoencoder(AutoencoderConfig(size, feature_dim, channels, first_stride, hidden_dim))


@pytest.mark.parametrize("size", [(16, 16), (32, 32), (33, 47), (128, 128), (30, 64)])
@pytest.mark.parametrize(("first_stride", "channels"), [(2, (4, 4, 4)), (8, (4, 4)), (16, (4,)), (5, (4, 4))])
def test_reconstruction_has_the_size_of_the_image(size, first_stride, channels):
    autoencoder = make_autoencoder(size, 4, channels, 8, first_stride)
    features = autoencoder.encode(torch.rand(2, 3, *size))
    assert features.shape == (2, 4)
    assert (features.abs() <= 1).all()
    assert autoencoder.decode(features).shape == (2, 3, *size)


def test_the_first_reconstruction_is_the_background():
    images = torch.rand(6, 3, 32, 32)
    autoencoder = make_autoencoder()
    autoencoder.fit_background(images)
    reconstruction = autoencoder.decode(autoencoder.encode(images))
    torch.testing.assert_close(reconstruction, images.mean(0).expand_as(images), atol=1e-5, rtol=0)


def test_every_pixel_reaches_the_features():
    """Also those of the patches at the right and lower edges, which stick out of an image of this size."""
    torch.manual_seed(0)
    autoencoder = make_autoencoder((17, 19), 8, (8,), 16)
    images = torch.rand(1, 3, 17, 19, requires_grad=True)
    autoencoder.encode(images).sum().backward()
    assert (images.grad.abs().sum(1) > 0).all()


def test_a_first_stride_of_two_gives_the_layout_of_the_paper():
    autoencoder = make_autoencoder((128, 128), 10, (64, 32, 16, 12, 8), 50, first_stride=2)
    weights = autoencoder.state_dict()
    assert weights["encoder.0.weight"].shape == (64, 3, 3, 3)
    assert weights["decoder.8.weight"].shape == (64, 3, 3, 3)
    assert weights["expander.2.weight"].shape == (8 * 4 * 4, 50)


def test_the_weights_are_laid_out_as_safetensors_stores_them():
    assert all(weight.is_contiguous() for weight in make_autoencoder().state_dict().values())


@pytest.mark.parametrize("first_stride", [2, 16])
def test_it_learns_where_a_bright_square_is(first_stride):
    """A moving square has variance about its mean image; a trained autoencoder explains nearly all of it."""
    torch.manual_seed(0)
    images = torch.zeros(24, 3, 32, 32)
    for index in range(24):
        images[index, :, 12:20, index : index + 8] = 1
    autoencoder = make_autoencoder((32, 32), 3, (8, 8), 16, first_stride)
    autoencoder.fit_background(images)
    optimizer = torch.optim.Adam(autoencoder.parameters(), lr=3e-3)
    for _ in range(300):
        loss = (autoencoder.decode(autoencoder.encode(images)) - images).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.25 * images.var(dim=0, unbiased=False).mean()


def make_encoder() -> ImageEncoder:
    encoder = ImageEncoder(("observation.images.a", "observation.images.b"), small_config().autoencoder)
    encoder.scaler.fit(torch.full((8,), -0.5), torch.full((8,), 0.5))
    return encoder


def test_each_camera_fills_its_own_features():
    encoder = make_encoder()
    images = {camera: torch.rand(2, 3, 32, 32) for camera in encoder.cameras}
    other = {**images, "observation.images.b": torch.rand(2, 3, 32, 32)}
    first, second = encoder(images), encoder(other)
    assert torch.equal(first[:, :4], second[:, :4])
    assert not torch.equal(first[:, 4:], second[:, 4:])


def test_uint8_and_float_images_mean_the_same():
    encoder = make_encoder()
    pixels = {camera: torch.randint(0, 256, (2, 3, 32, 32), dtype=torch.uint8) for camera in encoder.cameras}
    torch.testing.assert_close(encoder(pixels), encoder({key: value / 255 for key, value in pixels.items()}))


def test_images_of_another_size_are_resized():
    encoder = make_encoder()
    large = {camera: torch.rand(1, 3, 120, 160) for camera in encoder.cameras}
    small = {key: resize(value, [32, 32], antialias=True) for key, value in large.items()}
    torch.testing.assert_close(encoder(large), encoder(small), atol=1e-5, rtol=0)


def test_decode_undoes_the_scaling_of_the_features():
    encoder = make_encoder()
    images = {camera: torch.rand(2, 3, 32, 32) for camera in encoder.cameras}
    for camera, autoencoder in zip(encoder.cameras, encoder.autoencoders, strict=True):
        expected = autoencoder.decode(autoencoder.encode(images[camera]))
        torch.testing.assert_close(encoder.decode(encoder(images))[camera], expected)
