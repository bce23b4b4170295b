"""Convolutional autoencoder (CAE): one camera image in, a handful of features out."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from .scaling import RangeScaler

if TYPE_CHECKING:
    from ..configuration_ufrnn import AutoencoderConfig


class ConvAutoencoder(nn.Module):
    """Compresses one camera's image to `feature_dim` numbers in (-1, 1) and back.

    Strided convolutions, a hidden linear layer and a tanh bottleneck, mirrored by the decoder. With `first_stride=2`
    this is the layout of the public deep-predictive-learning code of the paper's group. A large first stride makes one
    point of each patch of the image: convolving single pixels takes nearly all of the time and slows down learning.
    Only the difference from a fixed background image goes through the network: a decoder this narrow otherwise spends
    its first hundreds of updates on drawing the room.

    Args:
        config (`AutoencoderConfig`):
            Its `image_size`, `feature_dim`, `conv_channels`, `conv_first_stride` and `hidden_dim`.
    """

    background: Tensor

    def __init__(self, config: "AutoencoderConfig"):
        super().__init__()
        image_size, channels, first_stride = config.image_size, config.conv_channels, config.conv_first_stride
        self.register_buffer("background", torch.zeros(3, *image_size))
        sizes = [(math.ceil(image_size[0] / first_stride), math.ceil(image_size[1] / first_stride))]
        # What sticks out of the image is filled up with background (left, right, top, bottom) and cut off again.
        self.padding = (0, sizes[0][1] * first_stride - image_size[1], 0, sizes[0][0] * first_stride - image_size[0])
        for _ in channels[1:]:
            height, width = sizes[-1]
            sizes.append(((height + 1) // 2, (width + 1) // 2))
        flat_dim = channels[-1] * sizes[-1][0] * sizes[-1][1]

        kernel = max(first_stride, 3)
        first = nn.Conv2d(3, channels[0], kernel, stride=first_stride, padding=(kernel - first_stride + 1) // 2)
        encoder: list[nn.Module] = [first, nn.ReLU()]
        for inside, outside in pairwise(channels):
            encoder += [nn.Conv2d(inside, outside, 3, stride=2, padding=1), nn.ReLU()]
        bottleneck = nn.Linear(config.hidden_dim, config.feature_dim)
        encoder += [nn.Flatten(), nn.Linear(flat_dim, config.hidden_dim), nn.ReLU(), bottleneck]
        self.encoder = nn.Sequential(*encoder, nn.Tanh())

        self.expander = nn.Sequential(
            nn.Linear(config.feature_dim, config.hidden_dim),
            nn.ReLU(),
            nn.Linear(config.hidden_dim, flat_dim),
            nn.ReLU(),
            nn.Unflatten(1, (channels[-1], *sizes[-1])),
        )
        decoder: list[nn.Module] = []
        for level in range(len(channels) - 1, 0, -1):
            # An odd side was rounded up on the way down; output_padding restores exactly the size it had.
            (height, width), (full_height, full_width) = sizes[level], sizes[level - 1]
            padding = (full_height - (2 * height - 1), full_width - (2 * width - 1))
            inside, outside = channels[level], channels[level - 1]
            decoder.append(nn.ConvTranspose2d(inside, outside, 3, stride=2, padding=1, output_padding=padding))
            decoder.append(nn.ReLU())
        last: nn.Module
        if first_stride == 2:
            last = nn.ConvTranspose2d(channels[0], 3, 3, stride=2, padding=1, output_padding=1)
            decoder.append(last)
        else:
            # Where patches do not overlap this equals a transposed convolution, at a third of its time on a CPU.
            last = nn.Conv2d(channels[0], 3 * first_stride**2, 1)
            decoder += [last, nn.PixelShuffle(first_stride)]
        self.decoder = nn.Sequential(*decoder)
        self.apply(_keep_variance)
        for parameter in last.parameters():  # so that the first reconstruction is the background itself
            nn.init.zeros_(parameter)
        # A feature that starts in the flat ends of tanh tends to stay there and tells little.
        nn.init.normal_(bottleneck.weight, std=0.25 * math.sqrt(2 / config.hidden_dim))

    @torch.no_grad()
    def fit_background(self, images: Tensor) -> None:
        """Takes the mean of `images` (M, 3, height, width) in [0, 1] as the background."""
        self.background.copy_(images.mean(dim=0))

    def encode(self, images: Tensor) -> Tensor:
        """Features (B, feature_dim) of `images` (B, 3, height, width) in [0, 1]."""
        difference = images - self.background
        if any(self.padding):
            difference = nn.functional.pad(difference, self.padding)
        return self.encoder(difference)

    def decode(self, features: Tensor) -> Tensor:
        """Images (B, 3, height, width), about in [0, 1], of `features` (B, feature_dim)."""
        _, height, width = self.background.shape
        return self.decoder(self.expander(features))[..., :height, :width] + self.background


def _keep_variance(layer: nn.Module) -> None:
    """Initialises a layer so that the signal keeps its size (He et al. 2015) over the ten layers of an autoencoder."""
    if isinstance(layer, nn.Conv2d | nn.Linear):
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    elif isinstance(layer, nn.ConvTranspose2d):
        # A stride of two leaves each output pixel 9 / 4 of the nine weights.
        nn.init.normal_(layer.weight, std=math.sqrt(2 / (layer.in_channels * 9 / 4)))
    if isinstance(layer, nn.Conv2d | nn.Linear | nn.ConvTranspose2d) and layer.bias is not None:
        nn.init.zeros_(layer.bias)


class ImageEncoder(nn.Module):
    """The autoencoders of all cameras and the scaling of their features into the recurrent network's range.

    Args:
        cameras (`Sequence[str]`):
            Camera keys, e.g. `observation.images.front`; their order is the order of the features.
        config (`AutoencoderConfig`):
            What every camera's autoencoder looks like.
    """

    def __init__(self, cameras: Sequence[str], config: "AutoencoderConfig"):
        super().__init__()
        self.cameras = tuple(cameras)
        self.image_size = tuple(config.image_size)
        self.feature_dim = config.feature_dim
        self.autoencoders = nn.ModuleList(ConvAutoencoder(config) for _ in self.cameras)
        self.scaler = RangeScaler(self.feature_dim * len(self.cameras))

    def by_camera(self) -> Iterator[tuple[str, ConvAutoencoder]]:
        """Camera keys with their autoencoders, in the order of the features."""
        for camera, autoencoder in zip(self.cameras, self.autoencoders, strict=True):
            assert isinstance(autoencoder, ConvAutoencoder)
            yield camera, autoencoder

    def resize(self, images: Tensor) -> Tensor:
        """Float images (B, 3, height, width) in [0, 1], resized to `image_size`; uint8 images are divided by 255."""
        if images.dtype == torch.uint8:
            images = images.to(torch.get_default_dtype()) / 255
        if tuple(images.shape[-2:]) != self.image_size:
            images = nn.functional.interpolate(images, self.image_size, mode="bilinear", antialias=True)
        return images

    def encode(self, images: dict[str, Tensor]) -> Tensor:
        """Unscaled features of all cameras.

        Args:
            images (`dict[str, Tensor]`):
                Camera key to images (B, 3, height, width), uint8 or float in [0, 1].

        Returns:
            `Tensor`: features (B, feature_dim x cameras) in (-1, 1).
        """
        encoded = [autoencoder.encode(self.resize(images[camera])) for camera, autoencoder in self.by_camera()]
        return torch.cat(encoded, dim=-1)

    def forward(self, images: dict[str, Tensor]) -> Tensor:
        """Scaled features (B, feature_dim x cameras) of all cameras: the image half of the network's input."""
        return self.scaler.scale(self.encode(images))

    def decode(self, scaled_features: Tensor) -> dict[str, Tensor]:
        """Images (B, 3, height, width) in [0, 1] of each camera, from scaled features (B, feature_dim x cameras)."""
        features = self.scaler.unscale(scaled_features).split(self.feature_dim, dim=-1)
        return {
            camera: autoencoder.decode(part)
            for (camera, autoencoder), part in zip(self.by_camera(), features, strict=True)
        }
