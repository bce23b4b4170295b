"""Neural networks of UF-RNN: tensors in, tensors out; nothing here knows LeRobot."""

from .autoencoder import ConvAutoencoder, ImageEncoder
from .gaussian import bound_log_variance, gaussian_nll
from .scaling import RangeScaler
from .sh_lstm import SHLSTM, HiddenState, Prediction

__all__ = [
    "SHLSTM",
    "ConvAutoencoder",
    "HiddenState",
    "ImageEncoder",
    "Prediction",
    "RangeScaler",
    "bound_log_variance",
    "gaussian_nll",
]
