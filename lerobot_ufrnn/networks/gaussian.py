"""Diagonal Gaussians given by mean and log-variance."""

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor


def bound_log_variance(raw: Tensor, low: float, high: float) -> Tensor:
    """Bounds a log-variance softly to `[low, high]`.

    The slope is about one inside the bounds and never exactly zero outside, so that a variance which has become too
    small can still be raised by the loss; a hard clamp would leave it stuck.

    Args:
        raw (`Tensor`):
            Unbounded log-variance, any shape.
        low (`float`):
            Smallest log-variance.
        high (`float`):
            Largest log-variance.

    Returns:
        `Tensor`: bounded log-variance, same shape.
    """
    below_high = high - F.softplus(high - raw)
    return low + F.softplus(below_high - low)


def gaussian_nll(target: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
    """Negative log-likelihood of a diagonal Gaussian, per element (UF-RNN, Sec. III-D, sign turned for minimising).

    Args:
        target (`Tensor`):
            Observed values, any shape.
        mean (`Tensor`):
            Predicted means, same shape.
        log_variance (`Tensor`):
            Predicted log-variances, same shape.

    Returns:
        `Tensor`: `(target - mean)^2 / (2 var) + ln(2 pi var) / 2`, same shape.
    """
    return 0.5 * ((target - mean).square() * torch.exp(-log_variance) + log_variance + math.log(2 * math.pi))
