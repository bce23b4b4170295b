"""Exact gradients of a walk: back-propagation through time."""

import numpy as np

from .activations import tanh
from .compile import compiled
from .layout import GateGradients, Sizes, Steps, TransposedWeights
from .matmul import PANEL, multiply_add


@compiled
def _cell_backward(
    gates: np.ndarray,
    previous_cell: np.ndarray,
    raw_cell: np.ndarray,
    start: int,
    size: int,
    grad_hidden: np.ndarray,
    grad_cell: np.ndarray,
    grad_gates: np.ndarray,
) -> None:
    """Back through `_cell`: fills the gradient of the gates before tanh; `grad_cell` becomes that of the last cell."""
    one, half = gates.dtype.type(1), gates.dtype.type(0.5)
    stop = start + size
    for row in range(gates.shape[0]):
        gate, grad_gate = gates[row], grad_gates[row]
        before, after = previous_cell[row, start:stop], raw_cell[row, start:stop]
        grad_h, grad_c = grad_hidden[row, start:stop], grad_cell[row, start:stop]
        for unit in range(size):
            i, f, o, candidate = gate[unit], gate[size + unit], gate[2 * size + unit], gate[3 * size + unit]
            squashed = tanh(after[unit])
            grad = grad_c[unit] + grad_h[unit] * (half + half * o) * (one - squashed * squashed)
            grad_gate[unit] = grad * candidate * half * (one - i * i)
            grad_gate[size + unit] = grad * before[unit] * half * (one - f * f)
            grad_gate[2 * size + unit] = grad_h[unit] * squashed * half * (one - o * o)
            grad_gate[3 * size + unit] = grad * (half + half * i) * (one - candidate * candidate)
            grad_c[unit] = grad * (half + half * f)


@compiled
def walk_back(
    weights: TransposedWeights,
    sizes: Sizes,
    steps: Steps,
    first_cell: np.ndarray,
    grad_kept: np.ndarray,
    gradients: GateGradients,
    first: int,
    last: int,
) -> None:
    """Back-propagation through time along `walk`; noise and selection carry no gradient.

    Args:
        weights (`TransposedWeights`):
            The network.
        sizes (`Sizes`):
            Its sizes.
        steps (`Steps`):
            What `walk` left behind.
        first_cell (`np.ndarray`):
            Cell states before the first step, (B, H).
        grad_kept (`np.ndarray`):
            Gradient of the loss by `steps.hidden`, (L, B, H).
        gradients (`GateGradients`):
            Where to write; holds zeros before.
        first (`int`), last (`int`):
            Which episodes.
    """
    number, num_episodes = grad_kept.dtype, last - first
    joint, image, shared = sizes.joint_hidden, sizes.image_hidden, sizes.shared_hidden
    grad_hidden = np.empty((num_episodes, joint + image + shared), number)
    grad_cell = np.zeros((num_episodes, joint + image + shared), number)
    from_next = np.zeros((num_episodes, weights.shared.shape[0] * PANEL), number)
    to_shared = np.empty((num_episodes, weights.joint.shape[0] * PANEL), number)
    for t in range(grad_kept.shape[0] - 1, -1, -1):
        for episode in range(num_episodes):
            for unit in range(grad_hidden.shape[1]):
                grad_hidden[episode, unit] = grad_kept[t, first + episode, unit] + from_next[episode, unit]
        previous_cell = steps.cell[t - 1, first:last] if t > 0 else first_cell[first:last]
        raw_cell = steps.raw_cell[t, first:last]

        gates, grad_gates = steps.joint_gates[t, first:last], gradients.joint[t, first:last]
        _cell_backward(gates, previous_cell, raw_cell, 0, joint, grad_hidden, grad_cell, grad_gates)
        multiply_add(grad_gates, weights.joint, weights.zeros, to_shared)
        _add_columns(to_shared, grad_hidden, joint + image, shared)

        gates, grad_gates = steps.image_gates[t, first:last], gradients.image[t, first:last]
        _cell_backward(gates, previous_cell, raw_cell, joint, image, grad_hidden, grad_cell, grad_gates)
        multiply_add(grad_gates, weights.image, weights.zeros, to_shared)
        _add_columns(to_shared, grad_hidden, joint + image, shared)

        gates, grad_gates = steps.shared_gates[t, first:last], gradients.shared[t, first:last]
        _cell_backward(gates, previous_cell, raw_cell, joint + image, shared, grad_hidden, grad_cell, grad_gates)
        multiply_add(grad_gates, weights.shared, weights.zeros, from_next)


@compiled
def _add_columns(values: np.ndarray, out: np.ndarray, start: int, size: int) -> None:
    for row in range(values.shape[0]):
        part = out[row, start : start + size]
        for column in range(size):
            part[column] += values[row, column]
