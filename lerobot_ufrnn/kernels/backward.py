"""Exact gradients of a pass through episodes: back-propagation through time."""

import numpy as np

from .compile import compiled
from .forward import tanh
from .layout import Gradients, Sizes, Steps


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
def pass_back(
    weights: Gradients,
    sizes: Sizes,
    steps: Steps,
    first_cell: np.ndarray,
    grad_kept: np.ndarray,
    gradients: Gradients,
    first: int,
    last: int,
) -> None:
    """Fills `gradients` of episodes `first` to `last - 1` along what `pass_through` left; noise and choice carry none.

    `weights` lead from the gradients of the gates to that of what they read: for the shared cell the whole hidden state
    (4 H_shared, H), for the lower ones `h_shared` (4 hidden size, H_shared). `first_cell` are the cell states before
    the first step, (B, H); `grad_kept` is the gradient of the loss by `steps.hidden`, (L, B, H).
    """
    joint, image, shared = sizes.joint, sizes.image, sizes.shared
    grad_hidden = np.empty(first_cell[first:last].shape, grad_kept.dtype)
    grad_cell, from_next = np.zeros_like(grad_hidden), np.zeros_like(grad_hidden)
    for t in range(grad_kept.shape[0] - 1, -1, -1):
        grad_hidden[:] = grad_kept[t, first:last] + from_next
        before = steps.cell[t - 1, first:last] if t > 0 else first_cell[first:last]
        after = steps.raw_cell[t, first:last]

        gates, grad_gates = steps.joint_gates[t, first:last], gradients.joint[t, first:last]
        _cell_backward(gates, before, after, 0, joint, grad_hidden, grad_cell, grad_gates)
        grad_hidden[:, joint + image :] += np.dot(grad_gates, weights.joint)

        gates, grad_gates = steps.image_gates[t, first:last], gradients.image[t, first:last]
        _cell_backward(gates, before, after, joint, image, grad_hidden, grad_cell, grad_gates)
        grad_hidden[:, joint + image :] += np.dot(grad_gates, weights.image)

        gates, grad_gates = steps.whole[t, first:last], gradients.shared[t, first:last]
        _cell_backward(gates, before, after, joint + image, shared, grad_hidden, grad_cell, grad_gates)
        np.dot(grad_gates, weights.shared, from_next)
