"""What the compiled functions pass to each other: weights, sizes, options, and what a pass through episodes leaves.

A state is two rows, hidden and cell, with the parts `[joint | image | shared]`. Gates are in the order input, forget,
output, candidate; the weights of the first three are halved, since `sigmoid(a) = (1 + tanh(a / 2)) / 2`: so every gate
is stored as a hyperbolic tangent.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..networks import SHLSTM


class Sizes(NamedTuple):
    """Numbers of joints and features, and hidden sizes of the three LSTMs."""

    joint_dim: int
    feature_dim: int
    joint: int
    image: int
    shared: int


class Options(NamedTuple):
    """What `UFRNNConfig` says of prediction and foresight, in numbers; see `ForesightConfig`."""

    log_variance_low: float
    log_variance_high: float
    explores: bool
    selects: bool
    horizon: int
    noise_low: float
    noise_high: float
    noise_is_variance: bool


class Cells(NamedTuple):
    """Weights (inputs, gates) and biases (gates) of the cells."""

    shared: Tensor  # from `[h_joint | h_image | h_shared]`
    shared_bias: Tensor
    joint: Tensor  # from `[joints | h_shared]`
    joint_bias: Tensor
    image: Tensor  # from `[features | h_shared]`
    image_bias: Tensor


class Weights(NamedTuple):
    """Weights as the compiled functions read them."""

    whole: np.ndarray  # from a whole hidden state: gates of the shared cell, and the means (D) that it predicts
    whole_bias: np.ndarray
    joint: np.ndarray  # this and the next three as of `Cells`
    joint_bias: np.ndarray
    image: np.ndarray
    image_bias: np.ndarray
    spread: np.ndarray  # from a whole hidden state: unbounded log-variances (D)
    spread_bias: np.ndarray


class Model(NamedTuple):
    """A network and how it explores."""

    weights: Weights
    sizes: Sizes
    options: Options


class Episodes(NamedTuple):
    """What a pass through L steps of B episodes reads, N candidates a step."""

    inputs: np.ndarray  # scaled joints and image features, (L, B, D)
    noise: np.ndarray  # standard normal numbers, (L, N, B, H)
    noise_bounds: np.ndarray  # `low` and `high` of the `NoiseSchedule`, (2, 2)
    hidden: np.ndarray  # state before the first step, (B, H)
    cell: np.ndarray


class Steps(NamedTuple):
    """Everything that a pass leaves behind; filled in place."""

    hidden: np.ndarray  # state that is kept after each step, (L, B, H)
    cell: np.ndarray
    raw_cell: np.ndarray  # cell state before it was perturbed, (L, B, H)
    joint_input: np.ndarray  # of the lower cells, (L, B, D_j or D_f + H_shared)
    image_input: np.ndarray
    whole: np.ndarray  # gates of the shared cell, and predicted means, (L, B, 4 H_shared + D)
    joint_gates: np.ndarray  # (L, B, 4 hidden size)
    image_gates: np.ndarray
    noise_std: np.ndarray  # standard deviation of the noise, joints first, (L, B, 2)
    chosen: np.ndarray  # kept candidate, (L, B)
    baseline: np.ndarray  # uncertainty before foresight, (L, B)
    final: np.ndarray  # uncertainty at the horizon, (L, N, B)


class Gradients(NamedTuple):
    """What belongs to the gates of each cell: their gradients before tanh, (L, B, gates), or weights for these."""

    shared: np.ndarray
    joint: np.ndarray
    image: np.ndarray


def pack_cells(network: SHLSTM) -> Cells:
    """The cells' weights; gradients flow back to the network's parameters.

    What the upper cell says to a lower one passes two linear maps in a row, `shared_to_lower` and the lower cell's
    recurrent weights. Here they are one: `W_hh (W_d h + b_d) = (W_hh W_d) h + W_hh b_d`.
    """
    shared = network.shared_cell
    sizes = (network.joint_cell.hidden_size, network.image_cell.hidden_size)
    down = zip(network.shared_to_lower.weight.split(sizes), network.shared_to_lower.bias.split(sizes), strict=True)
    lower: list[Tensor] = []
    for cell, (weight, bias) in zip((network.joint_cell, network.image_cell), down, strict=True):
        lower += (
            _order(torch.cat((cell.weight_ih, cell.weight_hh @ weight), dim=1)).T.contiguous(),
            _order(cell.bias_ih + cell.bias_hh + cell.weight_hh @ bias),
        )
    return Cells(
        _order(torch.cat((shared.weight_ih, shared.weight_hh), dim=1)).T.contiguous(),
        _order(shared.bias_ih + shared.bias_hh),
        *lower,
    )


def _order(values: Tensor) -> Tensor:
    """PyTorch's gates (input, forget, candidate, output) to ours, all but the candidate halved."""
    i, f, candidate, o = values.chunk(4)
    return torch.cat((i / 2, f / 2, o / 2, candidate))


@torch.no_grad()
def pack_weights(network: SHLSTM, cells: Cells) -> Weights:
    """All weights, without gradient."""
    joint, image, j, f = network.joint_head, network.image_head, network.joint_dim, network.feature_dim

    def from_whole_state(of_joints: slice, of_features: slice) -> tuple[Tensor, Tensor]:
        weight = torch.block_diag(joint.weight[of_joints], image.weight[of_features])
        bias = torch.cat((joint.bias[of_joints], image.bias[of_features]))
        return torch.nn.functional.pad(weight, (0, network.shared_cell.hidden_size)).T, bias

    mean, mean_bias = from_whole_state(slice(j), slice(f))
    packed = (
        torch.cat((cells.shared, mean), dim=1),
        torch.cat((cells.shared_bias, mean_bias)),
        *cells[2:],
        *from_whole_state(slice(j, 2 * j), slice(f, 2 * f)),
    )
    return Weights(*(to_host(values).numpy() for values in packed))


def to_host(values: Tensor) -> Tensor:
    """What compiled code reads: contiguous on the CPU, float64 as it is and anything narrower as float32."""
    number = torch.float64 if values.dtype == torch.float64 else torch.float32
    return values.detach().to("cpu", number).contiguous()
