"""One affine scaling for everything that enters and leaves the recurrent network."""

import torch
from torch import Tensor, nn

# Tanh outputs reach a target of 0.8 without saturating, and keep 12.5 % of the range as margin at either end.
SCALED_LIMIT = 0.8


class RangeScaler(nn.Module):
    """Maps a vector from its measured range `[low, high]` to `[-0.8, 0.8]` and back, per dimension.

    The same scaler serves measured joints, commanded joints and predictions of either, so that a prediction that is
    fed back as the next input means the same as a measurement. The range is saved with the checkpoint.

    Args:
        dim (`int`):
            Number of dimensions D of the vector.
    """

    low: Tensor
    high: Tensor

    def __init__(self, dim: int):
        super().__init__()
        self.register_buffer("low", torch.zeros(dim))
        self.register_buffer("high", torch.zeros(dim))

    @property
    def is_fitted(self) -> bool:
        """`bool`: whether `fit` was called or a fitted range was loaded."""
        return not torch.equal(self.high, self.low)

    @torch.no_grad()
    def fit(self, low: Tensor, high: Tensor, floor: float = 1e-3, relative_floor: float = 0.0) -> None:
        """Sets the range.

        Args:
            low (`Tensor`):
                Smallest value of each dimension, shape (D,).
            high (`Tensor`):
                Largest value of each dimension, shape (D,).
            floor (`float`, *optional*, defaults to `1e-3`):
                Narrowest range allowed, in the unit of the data: a dimension that never moves must not blow its
                measurement noise up to full scale.
            relative_floor (`float`, *optional*, defaults to `0.0`):
                The same as a fraction of the widest dimension's range.

        Raises:
            ValueError: If a bound is not finite or `high` is below `low`.
        """
        low = torch.as_tensor(low, dtype=self.low.dtype, device=self.low.device).reshape(self.low.shape)
        high = torch.as_tensor(high, dtype=self.high.dtype, device=self.high.device).reshape(self.high.shape)
        if not (torch.isfinite(low).all() and torch.isfinite(high).all()):
            raise ValueError(f"A range must be finite, got low={low.tolist()}, high={high.tolist()}.")
        if (high < low).any():
            raise ValueError(f"A range needs low <= high, got low={low.tolist()}, high={high.tolist()}.")
        narrowest = max(floor, relative_floor * float((high - low).max()))
        margin = (narrowest - (high - low)).clamp(min=0) / 2
        self.low.copy_(low - margin)
        self.high.copy_(high + margin)

    def scale(self, value: Tensor) -> Tensor:
        """Maps `value` (..., D) from its own unit into the network's range."""
        self._require_fitted()
        return (value - self.low) * (2 * SCALED_LIMIT / (self.high - self.low)) - SCALED_LIMIT

    def unscale(self, value: Tensor) -> Tensor:
        """Maps `value` (..., D) from the network's range back to its own unit."""
        self._require_fitted()
        return (value + SCALED_LIMIT) * ((self.high - self.low) / (2 * SCALED_LIMIT)) + self.low

    def _require_fitted(self) -> None:
        if not self.is_fitted:
            raise RuntimeError(
                "This policy has no data range yet. Train it, load a trained checkpoint, or build it with the "
                "dataset's statistics (`make_policy(cfg, ds_meta=...)`)."
            )
