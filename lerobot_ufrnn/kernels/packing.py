"""Lays an SH-LSTM's weights out for the compiled functions, differentiably."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..networks import SHLSTM
from .matmul import PANEL

_PYTORCH_GATES = ("input", "forget", "candidate", "output")
_GATES = ("input", "forget", "output", "candidate")


class Cells(NamedTuple):
    """Weights (panels, inputs, `PANEL`) and biases (padded gates) of the three cells, in the layout of `Weights`."""

    shared: Tensor
    shared_bias: Tensor
    joint: Tensor
    joint_bias: Tensor
    image: Tensor
    image_bias: Tensor


class Heads(NamedTuple):
    """Weights (panels, hidden, `PANEL`) and biases (padded outputs) of the heads, in the layout of `Weights`."""

    joint_mean: Tensor
    joint_mean_bias: Tensor
    image_mean: Tensor
    image_mean_bias: Tensor
    joint_spread: Tensor
    joint_spread_bias: Tensor
    image_spread: Tensor
    image_spread_bias: Tensor


def pack_cells(network: SHLSTM) -> Cells:
    """The cells' weights; gradients flow back to the network's parameters.

    What the upper cell says to a lower one passes two linear maps in a row, `shared_to_lower` and the lower cell's
    recurrent weights. Here they are one: `W_hh (W_d h + b_d) = (W_hh W_d) h + W_hh b_d`.

    Args:
        network (`SHLSTM`):
            The network.

    Returns:
        `Cells`: weights for `walk`, in the network's dtype and on its device.
    """
    shared = network.shared_cell
    sizes = (network.joint_cell.hidden_size, network.image_cell.hidden_size)
    down = network.shared_to_lower.weight.split(sizes), network.shared_to_lower.bias.split(sizes)
    lower: list[Tensor] = []
    for cell, weight, bias in zip((network.joint_cell, network.image_cell), *down, strict=True):
        lower += _gates(
            torch.cat((cell.weight_ih, cell.weight_hh @ weight), dim=1),
            cell.bias_ih + cell.bias_hh + cell.weight_hh @ bias,
        )
    return Cells(
        *_gates(torch.cat((shared.weight_ih, shared.weight_hh), dim=1), shared.bias_ih + shared.bias_hh), *lower
    )


@torch.no_grad()
def pack_heads(network: SHLSTM) -> Heads:
    """The heads' weights, without gradient: only imagination and the size of the noise read them here.

    Args:
        network (`SHLSTM`):
            The network.

    Returns:
        `Heads`: weights for `walk`.
    """
    means, spreads = [], []
    for head, dim in ((network.joint_head, network.joint_dim), (network.image_head, network.feature_dim)):
        means += [to_panels(head.weight[:dim].T), _pad(head.bias[:dim])]
        spreads += [to_panels(head.weight[dim:].T), _pad(head.bias[dim:])]
    return Heads(*means, *spreads)


def _gates(weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """PyTorch's weight (gates, inputs) and bias to ours: gates re-ordered, all but the candidate halved, padded."""
    order = [_PYTORCH_GATES.index(gate) for gate in _GATES]
    halves = weight.new_tensor([0.5, 0.5, 0.5, 1])[:, None, None]
    weight = (weight.unflatten(0, (4, -1))[order] * halves).flatten(0, 1)
    bias = (bias.unflatten(0, (4, -1))[order] * halves[..., 0]).flatten()
    return to_panels(weight.T), _pad(bias)


def to_panels(matrix: Tensor) -> Tensor:
    """(K, C) -> (panels, K, `PANEL`), padded with columns of zeros."""
    return _pad(matrix).unflatten(1, (-1, PANEL)).transpose(0, 1).contiguous()


def _pad(values: Tensor) -> Tensor:
    """Pads the last dimension with zeros to a multiple of `PANEL`."""
    return nn.functional.pad(values, (0, -values.shape[-1] % PANEL))
