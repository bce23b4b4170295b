"""One episode through the SH-LSTM: forth with foresight at every step, and back with exact gradients.

The formulas are those of `networks/sh_lstm.py` and `foresight.py`. A state is two rows, hidden and cell, with the parts
`[joint | image | shared]`. Gates are in the order input, forget, output, candidate; the weights of the first three are
halved (see `packing.py`), since `sigmoid(a) = (1 + tanh(a / 2)) / 2`: so every gate is stored as a hyperbolic tangent.
"""

import math
from typing import NamedTuple

import numpy as np

from .activations import tanh, tanh_all
from .compile import compiled
from .matmul import PANEL, multiply_add


class Weights(NamedTuple):
    """Weights as the compiled functions read them: panels of inputs x outputs, see `multiply_add`.

    Attributes:
        shared (`np.ndarray`): gates of the shared cell from `[h_joint | h_image | h_shared]`.
        joint (`np.ndarray`): gates of the joint cell from `[joints | h_shared]`.
        image (`np.ndarray`): gates of the image cell from `[features | h_shared]`.
        joint_mean (`np.ndarray`): joint means before tanh, from `h_joint`.
        image_mean (`np.ndarray`): feature means before tanh, from `h_image`.
        joint_spread (`np.ndarray`): unbounded log-variances of the joints and the step scalar, from `h_joint`.
        image_spread (`np.ndarray`): the same of the features, from `h_image`.
    """

    shared: np.ndarray
    shared_bias: np.ndarray
    joint: np.ndarray
    joint_bias: np.ndarray
    image: np.ndarray
    image_bias: np.ndarray
    joint_mean: np.ndarray
    joint_mean_bias: np.ndarray
    image_mean: np.ndarray
    image_mean_bias: np.ndarray
    joint_spread: np.ndarray
    joint_spread_bias: np.ndarray
    image_spread: np.ndarray
    image_spread_bias: np.ndarray


class Sizes(NamedTuple):
    """Sizes of the network: dimensions of joints and features, hidden sizes of the three cells."""

    joint_dim: int
    feature_dim: int
    joint_hidden: int
    image_hidden: int
    shared_hidden: int


class Options(NamedTuple):
    """What `UFRNNConfig` says of prediction and foresight, in numbers.

    Attributes:
        log_variance_low (`float`), log_variance_high (`float`): bounds of predicted log-variances.
        perturbs (`bool`): whether any noise is added.
        selects (`bool`): whether futures are imagined to select by.
        horizon (`int`): steps imagined ahead, T.
        learned_horizon (`bool`), own_baseline (`bool`), entropy (`bool`): see `Foresight`.
        noise_low (`float`), noise_high (`float`), noise_is_variance (`bool`), log_scale (`bool`): see `NoiseSchedule`.
        noise_columns (`tuple`): first column of the noise of each `HiddenState` field, -1 where it is not perturbed.
    """

    log_variance_low: float
    log_variance_high: float
    perturbs: bool
    selects: bool
    horizon: int
    learned_horizon: bool
    own_baseline: bool
    entropy: bool
    noise_low: float
    noise_high: float
    noise_is_variance: bool
    log_scale: bool
    noise_columns: tuple[int, int, int, int, int, int]


class Steps(NamedTuple):
    """Everything that a pass through an episode of L steps leaves behind; filled in place.

    Attributes:
        hidden (`np.ndarray`), cell (`np.ndarray`): state that is kept after each step, (L, H).
        raw_cell (`np.ndarray`): cell state before it was perturbed, (L, H).
        joint_input (`np.ndarray`): input of the joint cell, `[joints | h_shared]` (L, D_j + H_s).
        image_input (`np.ndarray`): input of the image cell, `[features | h_shared]` (L, D_f + H_s).
        shared_gates (`np.ndarray`), joint_gates (`np.ndarray`), image_gates (`np.ndarray`): (L, 4 hidden, padded).
        noise_std (`np.ndarray`): standard deviation of the noise, joints first, (L, 2).
        chosen (`np.ndarray`): kept candidate, (L,).
        baseline (`np.ndarray`), final (`np.ndarray`): uncertainty before and at the horizon, (L, N).
        horizon (`np.ndarray`): imagined steps that counted, (L, N).
        calmest (`np.ndarray`): imagined step of least uncertainty, from 1, (L, N); with a learned horizon.
    """

    hidden: np.ndarray
    cell: np.ndarray
    raw_cell: np.ndarray
    joint_input: np.ndarray
    image_input: np.ndarray
    shared_gates: np.ndarray
    joint_gates: np.ndarray
    image_gates: np.ndarray
    noise_std: np.ndarray
    chosen: np.ndarray
    baseline: np.ndarray
    final: np.ndarray
    horizon: np.ndarray
    calmest: np.ndarray


@compiled
def _cell(gates: np.ndarray, cell: np.ndarray, hidden: np.ndarray, start: int, size: int) -> None:
    """LSTM cell, given its gates: updates columns `start : start + size` of cell and hidden state."""
    half = gates.dtype.type(0.5)
    for row in range(gates.shape[0]):
        for unit in range(size):
            input_gate = half + half * gates[row, unit]
            forget_gate = half + half * gates[row, size + unit]
            output_gate = half + half * gates[row, 2 * size + unit]
            value = forget_gate * cell[row, start + unit] + input_gate * gates[row, 3 * size + unit]
            cell[row, start + unit] = value
            hidden[row, start + unit] = output_gate * tanh(value)


@compiled
def _step(
    weights: Weights,
    sizes: Sizes,
    hidden: np.ndarray,
    cell: np.ndarray,
    joint_input: np.ndarray,
    image_input: np.ndarray,
    shared_gates: np.ndarray,
    joint_gates: np.ndarray,
    image_gates: np.ndarray,
) -> None:
    """One SH-LSTM step of R states in place; the sensor columns of the two inputs are given, the others are filled."""
    joint_start, image_start = 0, sizes.joint_hidden
    shared_start = image_start + sizes.image_hidden
    multiply_add(hidden, weights.shared, weights.shared_bias, shared_gates)
    tanh_all(shared_gates)
    _cell(shared_gates, cell, hidden, shared_start, sizes.shared_hidden)
    for row in range(hidden.shape[0]):
        for unit in range(sizes.shared_hidden):
            joint_input[row, sizes.joint_dim + unit] = hidden[row, shared_start + unit]
            image_input[row, sizes.feature_dim + unit] = hidden[row, shared_start + unit]
    multiply_add(joint_input, weights.joint, weights.joint_bias, joint_gates)
    tanh_all(joint_gates)
    _cell(joint_gates, cell, hidden, joint_start, sizes.joint_hidden)
    multiply_add(image_input, weights.image, weights.image_bias, image_gates)
    tanh_all(image_gates)
    _cell(image_gates, cell, hidden, image_start, sizes.image_hidden)


@compiled
def _imagine_inputs(
    weights: Weights,
    sizes: Sizes,
    hidden: np.ndarray,
    joint_input: np.ndarray,
    image_input: np.ndarray,
    scratch: np.ndarray,
) -> None:
    """Writes the predicted means to the sensor columns of the two inputs."""
    image_start, image_stop = sizes.joint_hidden, sizes.joint_hidden + sizes.image_hidden
    multiply_add(hidden[:, :image_start], weights.joint_mean, weights.joint_mean_bias, scratch)
    for row in range(hidden.shape[0]):
        for index in range(sizes.joint_dim):
            joint_input[row, index] = tanh(scratch[row, index])
    multiply_add(hidden[:, image_start:image_stop], weights.image_mean, weights.image_mean_bias, scratch)
    for row in range(hidden.shape[0]):
        for index in range(sizes.feature_dim):
            image_input[row, index] = tanh(scratch[row, index])


@compiled
def _mean_spread(raw: np.ndarray, size: int, low: float, high: float, entropy: bool) -> float:
    """Mean variance (or log-variance) of `size` dimensions; `bound_log_variance` and its exponential in one."""
    total = 0.0
    for index in range(size):
        variance = math.exp(low) + math.exp(high) / (1 + math.exp(high - raw[index]))
        total += math.log(variance) if entropy else variance
    return total / size


@compiled
def _uncertainty(
    weights: Weights,
    sizes: Sizes,
    options: Options,
    entropy: bool,
    hidden: np.ndarray,
    scratch: np.ndarray,
    by_modality: np.ndarray,
    steps: np.ndarray,
) -> None:
    """Mean variance (or log-variance) of each modality (R, 2), and their step scalars (R, 2), of R hidden states."""
    low, high = options.log_variance_low, options.log_variance_high
    image_start, image_stop = sizes.joint_hidden, sizes.joint_hidden + sizes.image_hidden
    multiply_add(hidden[:, :image_start], weights.joint_spread, weights.joint_spread_bias, scratch)
    for row in range(hidden.shape[0]):
        by_modality[row, 0] = _mean_spread(scratch[row], sizes.joint_dim, low, high, entropy)
        steps[row, 0] = scratch[row, sizes.joint_dim]
    multiply_add(hidden[:, image_start:image_stop], weights.image_spread, weights.image_spread_bias, scratch)
    for row in range(hidden.shape[0]):
        by_modality[row, 1] = _mean_spread(scratch[row], sizes.feature_dim, low, high, entropy)
        steps[row, 1] = scratch[row, sizes.feature_dim]


@compiled
def _schedule(options: Options, low: float, high: float, variance: float) -> float:
    """`NoiseSchedule`: standard deviation of the noise of one modality."""
    value = math.log(variance) if options.log_scale else variance
    place = min(max((value - low) / max(high - low, 1e-12), 0.0), 1.0)
    noise = options.noise_low + (options.noise_high - options.noise_low) * place
    return math.sqrt(noise) if options.noise_is_variance else noise


@compiled
def _perturb(
    options: Options,
    sizes: Sizes,
    noise: np.ndarray,
    noise_std: np.ndarray,
    from_hidden: np.ndarray,
    from_cell: np.ndarray,
    hidden: np.ndarray,
    cell: np.ndarray,
) -> None:
    """Writes a noisy copy of one state; `noise` is a row of standard normal numbers."""
    start = 0
    for part in range(3):
        size = (sizes.joint_hidden, sizes.image_hidden, sizes.shared_hidden)[part]
        std = noise_std[part] if part < 2 else (noise_std[0] + noise_std[1]) / noise_std.dtype.type(2)
        column = options.noise_columns[2 * part]
        for unit in range(size):
            hidden[start + unit] = from_hidden[start + unit]
            if column >= 0:
                hidden[start + unit] += std * noise[column + unit]
        column = options.noise_columns[2 * part + 1]
        for unit in range(size):
            cell[start + unit] = from_cell[start + unit]
            if column >= 0:
                cell[start + unit] += std * noise[column + unit]
        start += size


@compiled
def walk(
    weights: Weights,
    sizes: Sizes,
    options: Options,
    noise_bounds: np.ndarray,
    inputs: np.ndarray,
    noise: np.ndarray,
    hidden: np.ndarray,
    cell: np.ndarray,
    steps: Steps,
) -> None:
    """Walks one episode: read the inputs, explore, keep the state whose future is least uncertain.

    Args:
        weights (`Weights`):
            The network.
        sizes (`Sizes`):
            Its sizes.
        options (`Options`):
            How it explores.
        noise_bounds (`np.ndarray`):
            `low` and `high` of the `NoiseSchedule`, (2, 2).
        inputs (`np.ndarray`):
            Scaled joints and image features, (L, D).
        noise (`np.ndarray`):
            Standard normal numbers, (L, N, noise columns).
        hidden (`np.ndarray`), cell (`np.ndarray`):
            State before the first step, (1, H); afterwards the state that was kept last.
        steps (`Steps`):
            Where to write what happened.
    """
    number = hidden.dtype
    num_samples, size = noise.shape[1], hidden.shape[1]
    widest = max(weights.joint_spread_bias.shape[0], weights.image_spread_bias.shape[0])
    scratch = np.empty((num_samples, widest), number)
    means, step_scalars = np.empty((num_samples, 2), number), np.empty((num_samples, 2), number)
    noisy_hidden, noisy_cell = np.empty((num_samples, size), number), np.empty((num_samples, size), number)
    joint_input = np.empty((num_samples, steps.joint_input.shape[1]), number)
    image_input = np.empty((num_samples, steps.image_input.shape[1]), number)
    shared_gates = np.empty((num_samples, steps.shared_gates.shape[1]), number)
    joint_gates = np.empty((num_samples, steps.joint_gates.shape[1]), number)
    image_gates = np.empty((num_samples, steps.image_gates.shape[1]), number)
    uncertainties = np.empty((options.horizon, num_samples), number)

    for t in range(inputs.shape[0]):
        noise_std = steps.noise_std[t]
        if options.perturbs:
            # The variance that the step before predicted for this one sets the noise.
            _uncertainty(weights, sizes, options, False, hidden, scratch, means, step_scalars)
            for modality in range(2):
                low, high = noise_bounds[0, modality], noise_bounds[1, modality]
                noise_std[modality] = _schedule(options, low, high, means[0, modality])
            if options.entropy:
                _uncertainty(weights, sizes, options, True, hidden, scratch, means, step_scalars)
            steps.baseline[t, :] = means[0, 0] + means[0, 1]

        now = slice(t, t + 1)
        steps.joint_input[t, : sizes.joint_dim] = inputs[t, : sizes.joint_dim]
        steps.image_input[t, : sizes.feature_dim] = inputs[t, sizes.joint_dim :]
        _step(
            weights,
            sizes,
            hidden,
            cell,
            steps.joint_input[now],
            steps.image_input[now],
            steps.shared_gates[now],
            steps.joint_gates[now],
            steps.image_gates[now],
        )
        steps.raw_cell[t] = cell[0]

        chosen = 0
        if options.selects:
            for n in range(num_samples):
                _perturb(options, sizes, noise[t, n], noise_std, hidden[0], cell[0], noisy_hidden[n], noisy_cell[n])
            steps.horizon[t, :] = options.horizon
            if options.own_baseline or options.learned_horizon:
                _uncertainty(weights, sizes, options, options.entropy, noisy_hidden, scratch, means, step_scalars)
                for n in range(num_samples):
                    if options.own_baseline:
                        steps.baseline[t, n] = means[n, 0] + means[n, 1]
                    if options.learned_horizon:
                        fraction = 1 / (1 + math.exp(-max(step_scalars[n, 0], step_scalars[n, 1])))
                        steps.horizon[t, n] = max(1, math.ceil(options.horizon * fraction))
            for future in range(options.horizon):
                _imagine_inputs(weights, sizes, noisy_hidden, joint_input, image_input, scratch)
                _step(
                    weights,
                    sizes,
                    noisy_hidden,
                    noisy_cell,
                    joint_input,
                    image_input,
                    shared_gates,
                    joint_gates,
                    image_gates,
                )
                if options.learned_horizon or future == options.horizon - 1:
                    _uncertainty(weights, sizes, options, options.entropy, noisy_hidden, scratch, means, step_scalars)
                    for n in range(num_samples):
                        uncertainties[future, n] = means[n, 0] + means[n, 1]
            for n in range(num_samples):
                steps.final[t, n] = uncertainties[steps.horizon[t, n] - 1, n]
                if options.learned_horizon:
                    steps.calmest[t, n] = 1 + np.argmin(uncertainties[:, n])
                if steps.baseline[t, n] - steps.final[t, n] > steps.baseline[t, chosen] - steps.final[t, chosen]:
                    chosen = n
        steps.chosen[t] = chosen
        if options.perturbs:
            _perturb(options, sizes, noise[t, chosen], noise_std, hidden[0], cell[0], hidden[0], cell[0])
        steps.hidden[t] = hidden[0]
        steps.cell[t] = cell[0]


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
    for unit in range(size):
        i, f, o = gates[unit], gates[size + unit], gates[2 * size + unit]
        candidate = gates[3 * size + unit]
        input_gate, forget_gate, output_gate = half + half * i, half + half * f, half + half * o
        squashed = tanh(raw_cell[start + unit])
        grad_h = grad_hidden[start + unit]
        grad_c = grad_cell[start + unit] + grad_h * output_gate * (one - squashed * squashed)
        grad_gates[unit] = grad_c * candidate * half * (one - i * i)
        grad_gates[size + unit] = grad_c * previous_cell[start + unit] * half * (one - f * f)
        grad_gates[2 * size + unit] = grad_h * squashed * half * (one - o * o)
        grad_gates[3 * size + unit] = grad_c * input_gate * (one - candidate * candidate)
        grad_cell[start + unit] = grad_c * forget_gate


class TransposedWeights(NamedTuple):
    """Panels of outputs x inputs: from the gradient of the gates to that of their inputs.

    Attributes:
        shared (`np.ndarray`): to `[h_joint | h_image | h_shared]`.
        joint (`np.ndarray`): to `h_shared`.
        image (`np.ndarray`): to `h_shared`.
        zeros (`np.ndarray`): a bias for all.
    """

    shared: np.ndarray
    joint: np.ndarray
    image: np.ndarray
    zeros: np.ndarray


class GateGradients(NamedTuple):
    """Gradients of the gates before tanh over an episode, (L, 4 hidden, padded) each; padding is zero."""

    shared: np.ndarray
    joint: np.ndarray
    image: np.ndarray


@compiled
def walk_back(
    weights: TransposedWeights,
    sizes: Sizes,
    steps: Steps,
    first_cell: np.ndarray,
    grad_kept: np.ndarray,
    gradients: GateGradients,
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
            Cell state before the first step, (H,).
        grad_kept (`np.ndarray`):
            Gradient of the loss by `steps.hidden`, (L, H).
        gradients (`GateGradients`):
            Where to write; holds zeros before.
    """
    number = grad_kept.dtype
    image_start = sizes.joint_hidden
    shared_start = image_start + sizes.image_hidden
    size = shared_start + sizes.shared_hidden
    grad_hidden = np.empty((1, size), number)
    grad_cell = np.zeros(size, number)
    from_next = np.zeros((1, weights.shared.shape[0] * PANEL), number)
    to_shared = np.empty((1, weights.joint.shape[0] * PANEL), number)
    for t in range(grad_kept.shape[0] - 1, -1, -1):
        for unit in range(size):
            grad_hidden[0, unit] = grad_kept[t, unit] + from_next[0, unit]
        previous_cell = steps.cell[t - 1] if t > 0 else first_cell
        raw_cell = steps.raw_cell[t]
        _cell_backward(
            steps.joint_gates[t],
            previous_cell,
            raw_cell,
            0,
            sizes.joint_hidden,
            grad_hidden[0],
            grad_cell,
            gradients.joint[t],
        )
        multiply_add(gradients.joint[t : t + 1], weights.joint, weights.zeros, to_shared)
        for unit in range(sizes.shared_hidden):
            grad_hidden[0, shared_start + unit] += to_shared[0, unit]
        _cell_backward(
            steps.image_gates[t],
            previous_cell,
            raw_cell,
            image_start,
            sizes.image_hidden,
            grad_hidden[0],
            grad_cell,
            gradients.image[t],
        )
        multiply_add(gradients.image[t : t + 1], weights.image, weights.zeros, to_shared)
        for unit in range(sizes.shared_hidden):
            grad_hidden[0, shared_start + unit] += to_shared[0, unit]
        _cell_backward(
            steps.shared_gates[t],
            previous_cell,
            raw_cell,
            shared_start,
            sizes.shared_hidden,
            grad_hidden[0],
            grad_cell,
            gradients.shared[t],
        )
        multiply_add(gradients.shared[t : t + 1], weights.shared, weights.zeros, from_next)
