"""Episodes through the SH-LSTM, with foresight at every step: `networks/sh_lstm.py` and `foresight.py`, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from .compile import compiled
from .layout import Episodes, Model, Options, Sizes, Steps, Weights

# Beyond this, tanh is 1 to float32's precision.
_LIMIT = np.float32(8.3)
# Rational minimax fit on [0, 8.3] (least squares, re-weighted by the error): 3e-8 off, before rounding.
_P1, _P3, _P5, _P7, _P9, _P11 = (
    np.float32(value)
    for value in (9.99999973e-01, 1.29618009e-01, 2.96682815e-03, 9.69610243e-06, -1.41079706e-08, 2.17991528e-11)
)
_Q0, _Q2, _Q4, _Q6 = (np.float32(value) for value in (1.0, 4.62951100e-01, 2.39508891e-02, 2.34518795e-04))


def tanh(x: float) -> float:
    """Vectorisable hyperbolic tangent: 3e-7 relative error in float32, exact to rounding in float64."""
    raise NotImplementedError("only for compiled code")


@overload(tanh, inline="always")
def _tanh_of_type(x):
    if x == types.float32:

        def rational(x):
            x = min(max(x, -_LIMIT), _LIMIT)
            y = x * x
            numerator = ((((_P11 * y + _P9) * y + _P7) * y + _P5) * y + _P3) * y + _P1
            denominator = ((_Q6 * y + _Q4) * y + _Q2) * y + _Q0
            return x * numerator / denominator

        return rational
    if x == types.float64:
        return lambda x: math.tanh(x)
    return None


class Room(NamedTuple):
    """Where R states are worked on: rows of what `_step` fills, see `Steps`."""

    joint_input: np.ndarray
    image_input: np.ndarray
    whole: np.ndarray
    joint_gates: np.ndarray
    image_gates: np.ndarray


@compiled
def _room(weights: Weights, num_rows: int, number: np.dtype) -> Room:
    """Uninitialised."""
    return Room(
        np.empty((num_rows, weights.joint.shape[0]), number),
        np.empty((num_rows, weights.image.shape[0]), number),
        np.empty((num_rows, weights.whole.shape[1]), number),
        np.empty((num_rows, weights.joint.shape[1]), number),
        np.empty((num_rows, weights.image.shape[1]), number),
    )


@compiled
def _squash(values: np.ndarray, bias: np.ndarray) -> None:
    """`tanh(values + bias)` in place, row by row."""
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            values[row, column] = tanh(values[row, column] + bias[column])


@compiled
def _cell(gates: np.ndarray, hidden: np.ndarray, cell: np.ndarray, start: int, size: int) -> None:
    """LSTM cell, given its gates: updates columns `start : start + size` of cell and hidden state."""
    half = gates.dtype.type(0.5)
    for row in range(gates.shape[0]):
        input_gate, forget_gate = gates[row, :size], gates[row, size : 2 * size]
        output_gate, candidate = gates[row, 2 * size : 3 * size], gates[row, 3 * size : 4 * size]
        c, h = cell[row, start : start + size], hidden[row, start : start + size]
        for unit in range(size):
            c[unit] = (half + half * forget_gate[unit]) * c[unit] + (half + half * input_gate[unit]) * candidate[unit]
        for unit in range(size):
            h[unit] = (half + half * output_gate[unit]) * tanh(c[unit])


@compiled
def _step(model: Model, hidden: np.ndarray, cell: np.ndarray, room: Room, imagines: bool) -> None:
    """One SH-LSTM step of R states in place; it reads the sensor columns of both inputs, or imagines them first."""
    weights, sizes = model.weights, model.sizes
    first_image, first_shared, gates = sizes.joint, sizes.joint + sizes.image, 4 * sizes.shared
    np.dot(hidden, weights.whole, room.whole)
    _squash(room.whole, weights.whole_bias)
    _cell(room.whole, hidden, cell, first_shared, sizes.shared)
    for row in range(hidden.shape[0]):
        joint_input, image_input, shared = room.joint_input[row], room.image_input[row], hidden[row, first_shared:]
        if imagines:
            for index in range(sizes.joint_dim):
                joint_input[index] = room.whole[row, gates + index]
            for index in range(sizes.feature_dim):
                image_input[index] = room.whole[row, gates + sizes.joint_dim + index]
        for unit in range(sizes.shared):
            joint_input[sizes.joint_dim + unit] = shared[unit]
            image_input[sizes.feature_dim + unit] = shared[unit]
    np.dot(room.joint_input, weights.joint, room.joint_gates)
    _squash(room.joint_gates, weights.joint_bias)
    _cell(room.joint_gates, hidden, cell, 0, sizes.joint)
    np.dot(room.image_input, weights.image, room.image_gates)
    _squash(room.image_gates, weights.image_bias)
    _cell(room.image_gates, hidden, cell, first_image, sizes.image)


@compiled
def _variances(model: Model, hidden: np.ndarray) -> np.ndarray:
    """Mean predicted variance of each modality (R, 2): `bound_log_variance` and its exponential in one."""
    weights, sizes, options = model.weights, model.sizes, model.options
    least, most = math.exp(options.log_variance_low), math.exp(options.log_variance_high)
    by_modality, raw = np.empty((hidden.shape[0], 2), hidden.dtype), np.dot(hidden, weights.spread)
    for row in range(hidden.shape[0]):
        for modality in range(2):
            start = modality * sizes.joint_dim
            size = sizes.feature_dim if modality else sizes.joint_dim
            total = 0.0
            for index in range(start, start + size):
                total += least + most / (1 + most * math.exp(-raw[row, index] - weights.spread_bias[index]))
            by_modality[row, modality] = total / size
    return by_modality


@compiled
def _noise_std(options: Options, bounds: np.ndarray, variance: float) -> float:
    """`NoiseSchedule`: standard deviation of the noise of one modality, given its range of variances (2,)."""
    place = min(max((variance - bounds[0]) / max(bounds[1] - bounds[0], 1e-12), 0.0), 1.0)
    noise = options.noise_low + (options.noise_high - options.noise_low) * place
    return math.sqrt(noise) if options.noise_is_variance else noise


@compiled
def _perturb(sizes: Sizes, noise: np.ndarray, std: np.ndarray, hidden: np.ndarray, out: np.ndarray) -> None:
    """Writes a noisy copy of one hidden state (H,), given standard normal noise (H,) and both modalities' std (2,)."""
    for part in range(3):
        start = (0, sizes.joint, sizes.joint + sizes.image)[part]
        stop = start + (sizes.joint, sizes.image, sizes.shared)[part]
        scale = std[part] if part < 2 else (std[0] + std[1]) / std.dtype.type(2)
        for unit in range(start, stop):
            out[unit] = hidden[unit] + scale * noise[unit]


@compiled
def _observe(
    model: Model, episodes: Episodes, steps: Steps, t: int, first: int, hidden: np.ndarray, cell: np.ndarray
) -> None:
    """Reads the inputs of step t; the variance that the step before predicted for it sets the noise."""
    last, joint_dim, feature_dim = first + hidden.shape[0], model.sizes.joint_dim, model.sizes.feature_dim
    if model.options.explores:
        variances = _variances(model, hidden)
        for row in range(hidden.shape[0]):
            for modality in range(2):
                bounds = episodes.noise_bounds[:, modality]
                steps.noise_std[t, first + row, modality] = _noise_std(model.options, bounds, variances[row, modality])
            steps.baseline[t, first + row] = variances[row, 0] + variances[row, 1]
    room = Room(
        steps.joint_input[t, first:last],
        steps.image_input[t, first:last],
        steps.whole[t, first:last],
        steps.joint_gates[t, first:last],
        steps.image_gates[t, first:last],
    )
    room.joint_input[:, :joint_dim] = episodes.inputs[t, first:last, :joint_dim]
    room.image_input[:, :feature_dim] = episodes.inputs[t, first:last, joint_dim:]
    _step(model, hidden, cell, room, False)
    steps.raw_cell[t, first:last] = cell


@compiled
def _explore(
    model: Model, episodes: Episodes, steps: Steps, t: int, first: int, hidden: np.ndarray, cell: np.ndarray
) -> None:
    """Plays N noisy candidates of each state forward; the one that ends least uncertain is chosen.

    The candidates of all episodes go through the network together, so that each weight is fetched once a step.
    """
    num_episodes, num_samples = hidden.shape[0], episodes.noise.shape[1]
    room = _room(model.weights, num_samples * num_episodes, hidden.dtype)
    noisy_hidden = np.empty((num_samples * num_episodes, hidden.shape[1]), hidden.dtype)
    noisy_cell = np.empty_like(noisy_hidden)
    for row in range(noisy_hidden.shape[0]):  # candidate-major
        n, episode = row // num_episodes, row % num_episodes
        noise, std = episodes.noise[t, n, first + episode], steps.noise_std[t, first + episode]
        _perturb(model.sizes, noise, std, hidden[episode], noisy_hidden[row])
        noisy_cell[row] = cell[episode]
    for _ in range(model.options.horizon):
        _step(model, noisy_hidden, noisy_cell, room, True)
    variances = _variances(model, noisy_hidden)
    for row in range(noisy_hidden.shape[0]):
        n, episode = row // num_episodes, first + row % num_episodes
        steps.final[t, n, episode] = variances[row, 0] + variances[row, 1]
        now, best = steps.baseline[t, episode], steps.final[t, steps.chosen[t, episode], episode]
        if now - steps.final[t, n, episode] > now - best:
            steps.chosen[t, episode] = n


@compiled
def pass_through(model: Model, episodes: Episodes, steps: Steps, first: int, last: int) -> None:
    """Episodes `first` to `last - 1` of B, step by step: observe, explore, keep the chosen candidate's state."""
    hidden, cell = episodes.hidden[first:last].copy(), episodes.cell[first:last].copy()
    for t in range(episodes.inputs.shape[0]):
        _observe(model, episodes, steps, t, first, hidden, cell)
        steps.chosen[t, first:last] = 0
        if model.options.selects:
            _explore(model, episodes, steps, t, first, hidden, cell)
        if model.options.explores:
            for row in range(hidden.shape[0]):
                noise = episodes.noise[t, steps.chosen[t, first + row], first + row]
                _perturb(model.sizes, noise, steps.noise_std[t, first + row], hidden[row], hidden[row])
        steps.hidden[t, first:last] = hidden
        steps.cell[t, first:last] = cell


@compiled
def imagine(model: Model, hidden_steps: np.ndarray, cell_steps: np.ndarray, first: int, last: int) -> None:
    """Goes on in closed loop from states `first` to `last - 1` of M, (T + 1, M, H), of which the first are given."""
    hidden, cell = hidden_steps[0, first:last].copy(), cell_steps[0, first:last].copy()
    room = _room(model.weights, hidden.shape[0], hidden.dtype)
    for t in range(1, hidden_steps.shape[0]):
        _step(model, hidden, cell, room, True)
        hidden_steps[t, first:last] = hidden
        cell_steps[t, first:last] = cell
