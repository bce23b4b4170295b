"""The competitor of benchmark.py: UF-RNN's training update as one XLA program, with `lax.scan` over time (JAX).

Written to be as fast as we could make XLA on one CPU thread. Measured at the paper's sizes:

* The roll-out is an inner `lax.scan`; `lax.fori_loop` and unrolled code took as long, and longer to compile.
* Both lower cells are one product with a block matrix, and the mean heads share the upper cell's product: no slower
  than products without the blocks of zeros, and fewer operations to start.
* Sigmoids are hyperbolic tangents of half the argument; the halves are in the weights. Variances take one exponential
  where nothing is differentiated.
* Products with measured inputs, and the heads of the kept states, are taken out of the loop over time.
* Candidates are stacked with the batch. Roll-outs carry no gradient.
* XLA's flags (fast math, oneDNN, vector width) made it no faster.
"""

import os
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lerobot_ufrnn.configuration_ufrnn import UFRNNConfig

# Read when JAX first computes. On one CPU, threads that share the work or start it only cost time.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip()
jax.config.update("jax_cpu_enable_async_dispatch", False)

Parameters = Mapping[str, Any]
State = tuple[jax.Array, jax.Array, jax.Array]
ADAM_BETAS, ADAM_EPSILON = (0.9, 0.999), 1e-8


class ScanSizes(NamedTuple):
    """What must be known when compiling."""

    joint_dim: int
    feature_dim: int
    joint_hidden: int
    image_hidden: int
    shared_hidden: int
    horizon: int
    log_variance_range: tuple[float, float]
    noise_range: tuple[float, float]

    @classmethod
    def of(cls, config: UFRNNConfig) -> "ScanSizes":
        """Those of a configuration with its features filled in."""
        hidden = config.joint_hidden_dim, config.image_hidden_dim, config.shared_hidden_dim
        foresight, bounds = config.foresight, config.log_variance_range
        return cls(config.joint_dim, config.image_dim, *hidden, foresight.horizon, bounds, foresight.noise_range)


class _Packed(NamedTuple):
    """Weights as the loop reads them; lower gates are gate-major over the units of both lower cells."""

    upper: jax.Array
    upper_bias: jax.Array
    from_inputs: jax.Array
    from_shared: jax.Array
    lower_bias: jax.Array
    mean: jax.Array
    mean_bias: jax.Array
    spread: jax.Array
    spread_bias: jax.Array


def _gates(weight: jax.Array) -> jax.Array:
    """PyTorch's gates (4H, ...) in the order input, forget, output, candidate as (4, H, ...), sigmoids' halved."""
    i, f, g, o = jnp.split(weight, 4)
    return jnp.stack((0.5 * i, 0.5 * f, 0.5 * o, g))


def _pack(p: Parameters, sizes: ScanSizes) -> _Packed:
    j, f = sizes.joint_dim, sizes.feature_dim
    from_inputs, from_shared, lower_bias = [], [], []
    down = jnp.split(p["shared_to_lower.weight"], [sizes.joint_hidden])
    down_bias = jnp.split(p["shared_to_lower.bias"], [sizes.joint_hidden])
    for number, name in enumerate(("joint_cell", "image_cell")):
        recurrent = p[f"{name}.weight_hh"]
        padding = ((0, 0), (0, 0), (0, f) if number == 0 else (j, 0))
        from_inputs.append(jnp.pad(_gates(p[f"{name}.weight_ih"]), padding))
        from_shared.append(_gates(recurrent @ down[number]))
        lower_bias.append(_gates(p[f"{name}.bias_ih"] + p[f"{name}.bias_hh"] + recurrent @ down_bias[number]))

    def block(first: jax.Array, second: jax.Array) -> jax.Array:
        """Block-diagonal matrix (hidden of both, outputs of both) of two heads."""
        return jnp.block(
            [
                [first.T, jnp.zeros((first.shape[1], second.shape[0]))],
                [jnp.zeros((second.shape[1], first.shape[0])), second.T],
            ]
        )

    joint, image = p["joint_head.weight"], p["image_head.weight"]
    joint_bias, image_bias = p["joint_head.bias"], p["image_head.bias"]
    upper = jnp.concatenate((p["shared_cell.weight_ih"], p["shared_cell.weight_hh"]), axis=1)
    return _Packed(
        _gates(upper).reshape(-1, upper.shape[1]).T,
        _gates(p["shared_cell.bias_ih"] + p["shared_cell.bias_hh"]).reshape(-1),
        jnp.concatenate(from_inputs, axis=1).reshape(-1, j + f).T,
        jnp.concatenate(from_shared, axis=1).reshape(-1, sizes.shared_hidden).T,
        jnp.concatenate(lower_bias, axis=1).reshape(-1),
        block(joint[:j], image[:f]),
        jnp.concatenate((joint_bias[:j], image_bias[:f])),
        block(joint[j : 2 * j], image[f : 2 * f]),
        jnp.concatenate((joint_bias[j : 2 * j], image_bias[f : 2 * f])),
    )


def _cell(gates: jax.Array, cell: jax.Array) -> tuple[jax.Array, jax.Array]:
    """LSTM cell of (B, 4H) gates: hidden and cell state."""
    i, f, o, g = jnp.split(jnp.tanh(gates), 4, axis=-1)
    cell = (0.5 + 0.5 * f) * cell + (0.5 + 0.5 * i) * g
    return (0.5 + 0.5 * o) * jnp.tanh(cell), cell


def _log_variance(w: _Packed, lower: jax.Array, sizes: ScanSizes) -> jax.Array:
    low, high = sizes.log_variance_range
    raw = lower @ w.spread + w.spread_bias
    return low + jax.nn.softplus(high - jax.nn.softplus(high - raw) - low)


def _variances(w: _Packed, lower: jax.Array, sizes: ScanSizes) -> jax.Array:
    """Mean variance of each modality (..., 2): the exponential of `_log_variance`, with one exponential in all."""
    low, high = sizes.log_variance_range
    raw = lower @ w.spread + w.spread_bias
    variance = np.exp(low) + np.exp(high) / (1 + jnp.exp(high - raw))
    return jnp.stack((variance[..., : sizes.joint_dim].mean(-1), variance[..., sizes.joint_dim :].mean(-1)), axis=-1)


def _nll(values: jax.Array, mean: jax.Array, log_variance: jax.Array) -> jax.Array:
    """Gaussian NLL, summed over the dimensions."""
    return 0.5 * ((values - mean) ** 2 * jnp.exp(-log_variance) + log_variance + np.log(2 * np.pi)).sum(-1)


def loss(
    parameters: Parameters,
    inputs: jax.Array,
    targets: jax.Array,
    commands: jax.Array,
    noise: jax.Array,
    noise_bounds: jax.Array,
    sizes: ScanSizes,
) -> tuple[jax.Array, jax.Array]:
    """Mean Gaussian NLL of the sensor values and the commands of whole episodes, and the chosen candidates (L, B).

    `parameters` under the names of `SHLSTM`, `inputs` and `targets` (L, B, D), `commands` (L, B, D_j), standard normal
    `noise` (L, N, B, hidden sizes), and `low` and `high` of the `NoiseSchedule` in `noise_bounds` (2, 2).
    """
    batch_size, num_samples = inputs.shape[1], noise.shape[1]
    parts = (sizes.joint_hidden, sizes.image_hidden, sizes.shared_hidden)
    num_lower, num_hidden, num_means = sum(parts[:2]), sum(parts), sizes.joint_dim + sizes.feature_dim
    weights = _pack(parameters, sizes)
    still = jax.tree.map(lax.stop_gradient, weights)
    mean_and_upper = jnp.concatenate((jnp.pad(still.mean, ((0, sizes.shared_hidden), (0, 0))), still.upper), axis=1)
    mean_and_upper_bias = jnp.concatenate((still.mean_bias, still.upper_bias))
    lower_weight = jnp.concatenate((still.from_inputs, still.from_shared))
    std_of_unit = np.repeat(np.array([[1, 0, 0.5], [0, 1, 0.5]], np.float32), parts, axis=1)  # (2, hidden sizes)
    low, high = sizes.noise_range

    def imagine(state: State, _: None) -> tuple[State, None]:
        hidden, lower_cell, upper_cell = state
        product = hidden @ mean_and_upper + mean_and_upper_bias
        h_shared, upper_cell = _cell(product[:, num_means:], upper_cell)
        read = jnp.concatenate((jnp.tanh(product[:, :num_means]), h_shared), axis=-1)
        h_lower, lower_cell = _cell(read @ lower_weight + still.lower_bias, lower_cell)
        return (jnp.concatenate((h_lower, h_shared), axis=-1), lower_cell, upper_cell), None

    def step(state: State, now: tuple[jax.Array, jax.Array]) -> tuple[State, tuple[jax.Array, jax.Array]]:
        hidden, lower_cell, upper_cell = state
        from_inputs, step_noise = now
        variance = _variances(still, lax.stop_gradient(hidden[:, :num_lower]), sizes)
        place = jnp.clip((variance - noise_bounds[0]) / jnp.maximum(noise_bounds[1] - noise_bounds[0], 1e-12), 0, 1)
        scaled_noise = (low + (high - low) * place) @ std_of_unit * step_noise  # (N, B, hidden sizes)

        h_shared, upper_cell = _cell(hidden @ weights.upper + weights.upper_bias, upper_cell)
        h_lower, lower_cell = _cell(from_inputs + h_shared @ weights.from_shared, lower_cell)
        hidden = jnp.concatenate((h_lower, h_shared), axis=-1)

        candidates = (lax.stop_gradient(hidden) + scaled_noise).reshape(-1, num_hidden)
        lower_cells, upper_cells = (
            jnp.tile(lax.stop_gradient(cell), (num_samples, 1)) for cell in (lower_cell, upper_cell)
        )
        (future, _, _), _ = lax.scan(imagine, (candidates, lower_cells, upper_cells), length=sizes.horizon)
        final = _variances(still, future[:, :num_lower], sizes).sum(-1).reshape(num_samples, batch_size)
        chosen = jnp.argmax(variance.sum(-1) - final, axis=0)
        hidden = hidden + scaled_noise[chosen, jnp.arange(batch_size)]
        return (hidden, lower_cell, upper_cell), (hidden[:, :num_lower], chosen)

    start = (
        jnp.zeros((batch_size, num_hidden), inputs.dtype),
        jnp.zeros((batch_size, num_lower), inputs.dtype),
        jnp.zeros((batch_size, sizes.shared_hidden), inputs.dtype),
    )
    from_inputs = inputs @ weights.from_inputs + weights.lower_bias
    _, (lower, chosen) = lax.scan(step, start, (from_inputs, noise))
    mean = jnp.tanh(lower @ weights.mean + weights.mean_bias)
    log_variance = _log_variance(weights, lower, sizes)
    command_weight = parameters["command_head.weight"].T
    command = jnp.tanh(lower[..., : sizes.joint_hidden] @ command_weight + parameters["command_head.bias"])
    nll = _nll(targets, mean, log_variance) + _nll(commands, command, log_variance[..., : sizes.joint_dim])
    return nll.mean(), chosen


class AdamState(NamedTuple):
    """Parameters with what Adam remembers of each."""

    parameters: Parameters
    first: Parameters
    second: Parameters
    updates: jax.Array


def start_adam(parameters: Mapping[str, np.ndarray]) -> AdamState:
    """State before the first update."""
    weights, first, second = (
        {name: factor * jnp.array(value) for name, value in parameters.items()} for factor in (1, 0, 0)
    )
    return AdamState(weights, first, second, jnp.zeros((), jnp.int32))


@partial(jax.jit, static_argnames=("sizes", "learning_rate", "clip_norm"), donate_argnums=0)
def update(
    state: AdamState,
    inputs: jax.Array,
    targets: jax.Array,
    commands: jax.Array,
    noise: jax.Array,
    noise_bounds: jax.Array,
    sizes: ScanSizes,
    learning_rate: float,
    clip_norm: float,
) -> tuple[AdamState, jax.Array]:
    """One training update (loss, gradients, clipping, Adam): the next state, and the loss before it.

    The memory of `state` is used again; the other arguments are those of `loss`.
    """
    (value, _), gradients = jax.value_and_grad(loss, has_aux=True)(
        state.parameters, inputs, targets, commands, noise, noise_bounds, sizes
    )
    norm = jnp.sqrt(sum(jnp.vdot(gradient, gradient) for gradient in gradients.values()))
    scale = jnp.minimum(1.0, clip_norm / (norm + 1e-6))
    count = state.updates + 1
    beta1, beta2 = ADAM_BETAS
    parameters, first, second = {}, {}, {}
    for name, gradient in gradients.items():
        gradient = scale * gradient
        first[name] = beta1 * state.first[name] + (1 - beta1) * gradient
        second[name] = beta2 * state.second[name] + (1 - beta2) * gradient**2
        root = jnp.sqrt(second[name] / (1 - beta2**count)) + ADAM_EPSILON
        parameters[name] = state.parameters[name] - learning_rate * first[name] / (1 - beta1**count) / root
    return AdamState(parameters, first, second, count), value
