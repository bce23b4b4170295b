"""Episodes through the SH-LSTM, with foresight at every step: `networks/sh_lstm.py` and `foresight.py`, compiled."""

import math

import numpy as np

from .activations import tanh, tanh_all
from .compile import compiled
from .layout import Options, Sizes, Steps, Weights
from .matmul import multiply_add


@compiled
def _cell(gates: np.ndarray, cell: np.ndarray, hidden: np.ndarray, start: int, size: int) -> None:
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
        shared = hidden[row, shared_start:]
        to_joint, to_image = joint_input[row, sizes.joint_dim :], image_input[row, sizes.feature_dim :]
        for unit in range(sizes.shared_hidden):
            to_joint[unit] = shared[unit]
            to_image[unit] = shared[unit]
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
    tanh_all(scratch)
    for row in range(hidden.shape[0]):
        for index in range(sizes.joint_dim):
            joint_input[row, index] = scratch[row, index]
    multiply_add(hidden[:, image_start:image_stop], weights.image_mean, weights.image_mean_bias, scratch)
    tanh_all(scratch)
    for row in range(hidden.shape[0]):
        for index in range(sizes.feature_dim):
            image_input[row, index] = scratch[row, index]


@compiled
def _mean_spread(raw: np.ndarray, size: int, low: float, high: float, entropy: bool) -> float:
    """Mean variance (or log-variance) of `size` dimensions; `bound_log_variance` and its exponential in one."""
    least, most = math.exp(low), math.exp(high)
    total = 0.0
    for index in range(size):
        variance = least + most / (1 + most * math.exp(-raw[index]))
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
def _add_noise(values: np.ndarray, std: float, noise: np.ndarray, column: int, out: np.ndarray) -> None:
    """Writes `values` with the noise from `column` on, or without where `column` is -1."""
    if column < 0:
        for unit in range(values.shape[0]):
            out[unit] = values[unit]
    else:
        part = noise[column : column + values.shape[0]]
        for unit in range(values.shape[0]):
            out[unit] = values[unit] + std * part[unit]


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
        stop = start + size
        _add_noise(from_hidden[start:stop], std, noise, options.noise_columns[2 * part], hidden[start:stop])
        _add_noise(from_cell[start:stop], std, noise, options.noise_columns[2 * part + 1], cell[start:stop])
        start = stop


@compiled
def _workspace(
    weights: Weights, sizes: Sizes, num_rows: int, number: np.dtype
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Room for imagining R futures: inputs of the two lower cells, gates of the three cells, and what a head reads."""
    mean = max(weights.joint_mean_bias.shape[0], weights.image_mean_bias.shape[0])
    spread = max(weights.joint_spread_bias.shape[0], weights.image_spread_bias.shape[0])
    return (
        np.empty((num_rows, sizes.joint_dim + sizes.shared_hidden), number),
        np.empty((num_rows, sizes.feature_dim + sizes.shared_hidden), number),
        np.empty((num_rows, weights.shared_bias.shape[0]), number),
        np.empty((num_rows, weights.joint_bias.shape[0]), number),
        np.empty((num_rows, weights.image_bias.shape[0]), number),
        np.zeros((num_rows, max(mean, spread)), number),
    )


@compiled
def walk(
    weights: Weights,
    sizes: Sizes,
    options: Options,
    noise_bounds: np.ndarray,
    inputs: np.ndarray,
    noise: np.ndarray,
    first_hidden: np.ndarray,
    first_cell: np.ndarray,
    steps: Steps,
    first: int,
    last: int,
) -> None:
    """Walks episodes `first` to `last - 1` of B: read the inputs, explore, keep the calmest future's state.

    All candidates of all these episodes go through the network together, so that each weight is fetched once a step.

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
            Scaled joints and image features, (L, B, D).
        noise (`np.ndarray`):
            Standard normal numbers, (L, N, B, noise columns).
        first_hidden (`np.ndarray`), first_cell (`np.ndarray`):
            States before the first step, (B, H).
        steps (`Steps`):
            Where to write what happened.
        first (`int`), last (`int`):
            Which episodes.
    """
    hidden, cell = first_hidden[first:last].copy(), first_cell[first:last].copy()
    number = hidden.dtype
    num_samples, num_episodes, size = noise.shape[1], hidden.shape[0], hidden.shape[1]
    num_rows = num_samples * num_episodes  # candidate-major
    joint_input, image_input, shared_gates, joint_gates, image_gates, scratch = _workspace(
        weights, sizes, num_rows, number
    )
    means, step_scalars = np.empty((num_rows, 2), number), np.empty((num_rows, 2), number)
    noisy_hidden, noisy_cell = np.empty((num_rows, size), number), np.empty((num_rows, size), number)
    uncertainties = np.empty((options.horizon, num_rows), number)

    for t in range(inputs.shape[0]):
        noise_std = steps.noise_std[t, first:last]
        if options.perturbs:
            # The variance that the step before predicted for this one sets the noise.
            _uncertainty(weights, sizes, options, False, hidden, scratch, means, step_scalars)
            for episode in range(num_episodes):
                for modality in range(2):
                    low, high = noise_bounds[0, modality], noise_bounds[1, modality]
                    noise_std[episode, modality] = _schedule(options, low, high, means[episode, modality])
            if options.entropy:
                _uncertainty(weights, sizes, options, True, hidden, scratch, means, step_scalars)
            for n in range(num_samples):
                for episode in range(num_episodes):
                    steps.baseline[t, n, first + episode] = means[episode, 0] + means[episode, 1]

        for episode in range(num_episodes):
            for index in range(sizes.joint_dim):
                steps.joint_input[t, first + episode, index] = inputs[t, first + episode, index]
            for index in range(sizes.feature_dim):
                steps.image_input[t, first + episode, index] = inputs[t, first + episode, sizes.joint_dim + index]
        _step(
            weights,
            sizes,
            hidden,
            cell,
            steps.joint_input[t, first:last],
            steps.image_input[t, first:last],
            steps.shared_gates[t, first:last],
            steps.joint_gates[t, first:last],
            steps.image_gates[t, first:last],
        )
        steps.raw_cell[t, first:last] = cell

        for episode in range(num_episodes):
            steps.chosen[t, first + episode] = 0
        if options.selects:
            for row in range(num_rows):
                n, episode = row // num_episodes, row % num_episodes
                _perturb(
                    options,
                    sizes,
                    noise[t, n, first + episode],
                    noise_std[episode],
                    hidden[episode],
                    cell[episode],
                    noisy_hidden[row],
                    noisy_cell[row],
                )
                steps.horizon[t, n, first + episode] = options.horizon
            if options.own_baseline or options.learned_horizon:
                _uncertainty(weights, sizes, options, options.entropy, noisy_hidden, scratch, means, step_scalars)
                for row in range(num_rows):
                    n, episode = row // num_episodes, row % num_episodes
                    if options.own_baseline:
                        steps.baseline[t, n, first + episode] = means[row, 0] + means[row, 1]
                    if options.learned_horizon:
                        fraction = 1 / (1 + math.exp(-max(step_scalars[row, 0], step_scalars[row, 1])))
                        steps.horizon[t, n, first + episode] = max(1, math.ceil(options.horizon * fraction))
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
                    for row in range(num_rows):
                        uncertainties[future, row] = means[row, 0] + means[row, 1]
            for row in range(num_rows):
                n, episode = row // num_episodes, first + row % num_episodes
                steps.final[t, n, episode] = uncertainties[steps.horizon[t, n, episode] - 1, row]
                if options.learned_horizon:
                    steps.calmest[t, n, episode] = 1 + np.argmin(uncertainties[:, row])
                best = steps.chosen[t, episode]
                fall = steps.baseline[t, n, episode] - steps.final[t, n, episode]
                if fall > steps.baseline[t, best, episode] - steps.final[t, best, episode]:
                    steps.chosen[t, episode] = n
        if options.perturbs:
            for episode in range(num_episodes):
                _perturb(
                    options,
                    sizes,
                    noise[t, steps.chosen[t, first + episode], first + episode],
                    noise_std[episode],
                    hidden[episode],
                    cell[episode],
                    hidden[episode],
                    cell[episode],
                )
        steps.hidden[t, first:last] = hidden
        steps.cell[t, first:last] = cell


@compiled
def imagine(
    weights: Weights, sizes: Sizes, hidden_steps: np.ndarray, cell_steps: np.ndarray, first: int, last: int
) -> None:
    """Goes on in closed loop from states `first` to `last - 1` of M, without exploring.

    Args:
        weights (`Weights`):
            The network.
        sizes (`Sizes`):
            Its sizes.
        hidden_steps (`np.ndarray`), cell_steps (`np.ndarray`):
            States, (T + 1, M, H): those to start from are given, the others are filled.
        first (`int`), last (`int`):
            Which states.
    """
    hidden, cell = hidden_steps[0, first:last].copy(), cell_steps[0, first:last].copy()
    joint_input, image_input, shared_gates, joint_gates, image_gates, scratch = _workspace(
        weights, sizes, hidden.shape[0], hidden.dtype
    )
    for t in range(1, hidden_steps.shape[0]):
        _imagine_inputs(weights, sizes, hidden, joint_input, image_input, scratch)
        _step(weights, sizes, hidden, cell, joint_input, image_input, shared_gates, joint_gates, image_gates)
        hidden_steps[t, first:last] = hidden
        cell_steps[t, first:last] = cell
