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
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import block_diag

from lerobot_ufrnn.configuration_ufrnn import UFRNNConfig

# Read when JAX first computes. On one CPU, threads that share the work or start it only cost time.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip()
jax.config.update("jax_cpu_enable_async_dispatch", False)

Parameters = Mapping[str, Any]
State = tuple[jax.Array, ...]  # hidden states of all cells, lower cell states, upper cell state
ADAM_BETAS, ADAM_EPSILON = (0.9, 0.999), 1e-8


def _gates(weight: jax.Array) -> jax.Array:
    """PyTorch's gates (4H, ...) in the order input, forget, output, candidate as (4, H, ...), sigmoids' halved."""
    i, f, g, o = jnp.split(weight, 4)
    return jnp.stack((0.5 * i, 0.5 * f, 0.5 * o, g))


def _pack(p: Parameters, config: UFRNNConfig) -> dict[str, jax.Array]:
    """Weights as the loop reads them; lower gates are gate-major over the units of both lower cells."""
    j, f = config.joint_dim, config.image_dim
    from_inputs, from_shared, lower_bias = [], [], []
    down = jnp.split(p["shared_to_lower.weight"], [config.joint_hidden_dim])
    down_bias = jnp.split(p["shared_to_lower.bias"], [config.joint_hidden_dim])
    for number, name in enumerate(("joint_cell", "image_cell")):
        recurrent = p[f"{name}.weight_hh"]
        padding = ((0, 0), (0, 0), (0, f) if number == 0 else (j, 0))
        from_inputs.append(jnp.pad(_gates(p[f"{name}.weight_ih"]), padding))
        from_shared.append(_gates(recurrent @ down[number]))
        lower_bias.append(_gates(p[f"{name}.bias_ih"] + p[f"{name}.bias_hh"] + recurrent @ down_bias[number]))
    joint, image = p["joint_head.weight"], p["image_head.weight"]
    joint_bias, image_bias = p["joint_head.bias"], p["image_head.bias"]
    upper = jnp.concatenate((p["shared_cell.weight_ih"], p["shared_cell.weight_hh"]), axis=1)
    return {
        "upper": _gates(upper).reshape(-1, upper.shape[1]).T,
        "upper_bias": _gates(p["shared_cell.bias_ih"] + p["shared_cell.bias_hh"]).reshape(-1),
        "from_inputs": jnp.concatenate(from_inputs, axis=1).reshape(-1, j + f).T,
        "from_shared": jnp.concatenate(from_shared, axis=1).reshape(-1, config.shared_hidden_dim).T,
        "lower_bias": jnp.concatenate(lower_bias, axis=1).reshape(-1),
        "mean": block_diag(joint[:j].T, image[:f].T),
        "mean_bias": jnp.concatenate((joint_bias[:j], image_bias[:f])),
        "spread": block_diag(joint[j : 2 * j].T, image[f : 2 * f].T),
        "spread_bias": jnp.concatenate((joint_bias[j : 2 * j], image_bias[f : 2 * f])),
    }


def _cell(gates: jax.Array, cell: jax.Array) -> tuple[jax.Array, jax.Array]:
    """LSTM cell of (B, 4H) gates: hidden and cell state."""
    i, f, o, g = jnp.split(jnp.tanh(gates), 4, axis=-1)
    cell = (0.5 + 0.5 * f) * cell + (0.5 + 0.5 * i) * g
    return (0.5 + 0.5 * o) * jnp.tanh(cell), cell


def _nll(values: jax.Array, mean: jax.Array, log_variance: jax.Array) -> jax.Array:
    """Gaussian NLL, summed over the dimensions."""
    return 0.5 * ((values - mean) ** 2 * jnp.exp(-log_variance) + log_variance + np.log(2 * np.pi)).sum(-1)


def loss(
    config: UFRNNConfig,
    parameters: Parameters,
    inputs: jax.Array,
    targets: jax.Array,
    commands: jax.Array,
    noise: jax.Array,
    noise_bounds: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Mean Gaussian NLL of the sensor values and the commands of whole episodes, and the chosen candidates (L, B).

    `parameters` under the names of `SHLSTM`, `inputs` and `targets` (L, B, D), `commands` (L, B, D_j), standard normal
    `noise` (L, N, B, hidden sizes), and `low` and `high` of the `NoiseSchedule` in `noise_bounds` (2, 2).
    """
    batch_size, num_samples, joint_dim = inputs.shape[1], noise.shape[1], config.joint_dim
    parts = (config.joint_hidden_dim, config.image_hidden_dim, config.shared_hidden_dim)
    num_lower, num_hidden, num_means = sum(parts[:2]), sum(parts), inputs.shape[2]
    weights = _pack(parameters, config)
    still = jax.tree.map(lax.stop_gradient, weights)
    mean_and_upper = jnp.concatenate((jnp.pad(still["mean"], ((0, parts[2]), (0, 0))), still["upper"]), axis=1)
    mean_and_upper_bias = jnp.concatenate((still["mean_bias"], still["upper_bias"]))
    lower_weight = jnp.concatenate((still["from_inputs"], still["from_shared"]))
    std_of_unit = np.repeat(np.array([[1, 0, 0.5], [0, 1, 0.5]], np.float32), parts, axis=1)  # (2, hidden sizes)
    low, high = config.foresight.noise_range
    lowest, highest = config.log_variance_range

    def variances(lower: jax.Array) -> jax.Array:
        """Mean variance of each modality (..., 2)."""
        raw = lower @ still["spread"] + still["spread_bias"]
        variance = np.exp(lowest) + np.exp(highest) / (1 + jnp.exp(highest - raw))
        return jnp.stack((variance[..., :joint_dim].mean(-1), variance[..., joint_dim:].mean(-1)), axis=-1)

    def imagine(state: State, _: None) -> tuple[State, None]:
        hidden, lower_cell, upper_cell = state
        product = hidden @ mean_and_upper + mean_and_upper_bias
        h_shared, upper_cell = _cell(product[:, num_means:], upper_cell)
        read = jnp.concatenate((jnp.tanh(product[:, :num_means]), h_shared), axis=-1)
        h_lower, lower_cell = _cell(read @ lower_weight + still["lower_bias"], lower_cell)
        return (jnp.concatenate((h_lower, h_shared), axis=-1), lower_cell, upper_cell), None

    def step(state: State, now: tuple[jax.Array, jax.Array]) -> tuple[State, tuple[jax.Array, jax.Array]]:
        hidden, lower_cell, upper_cell = state
        from_inputs, step_noise = now
        variance = variances(lax.stop_gradient(hidden[:, :num_lower]))
        place = jnp.clip((variance - noise_bounds[0]) / jnp.maximum(noise_bounds[1] - noise_bounds[0], 1e-12), 0, 1)
        scaled_noise = (low + (high - low) * place) @ std_of_unit * step_noise  # (N, B, hidden sizes)

        h_shared, upper_cell = _cell(hidden @ weights["upper"] + weights["upper_bias"], upper_cell)
        h_lower, lower_cell = _cell(from_inputs + h_shared @ weights["from_shared"], lower_cell)
        hidden = jnp.concatenate((h_lower, h_shared), axis=-1)

        candidates = (lax.stop_gradient(hidden) + scaled_noise).reshape(-1, num_hidden)
        cells = (jnp.tile(lax.stop_gradient(cell), (num_samples, 1)) for cell in (lower_cell, upper_cell))
        (future, _, _), _ = lax.scan(imagine, (candidates, *cells), length=config.foresight.horizon)
        final = variances(future[:, :num_lower]).sum(-1).reshape(num_samples, batch_size)
        chosen = jnp.argmax(variance.sum(-1) - final, axis=0)
        hidden = hidden + scaled_noise[chosen, jnp.arange(batch_size)]
        return (hidden, lower_cell, upper_cell), (hidden[:, :num_lower], chosen)

    start = tuple(jnp.zeros((batch_size, size), inputs.dtype) for size in (num_hidden, num_lower, parts[2]))
    from_inputs = inputs @ weights["from_inputs"] + weights["lower_bias"]
    _, (lower, chosen) = lax.scan(step, start, (from_inputs, noise))
    mean = jnp.tanh(lower @ weights["mean"] + weights["mean_bias"])
    raw = lower @ weights["spread"] + weights["spread_bias"]
    log_variance = lowest + jax.nn.softplus(highest - jax.nn.softplus(highest - raw) - lowest)
    command_weight = parameters["command_head.weight"].T
    command = jnp.tanh(lower[..., : parts[0]] @ command_weight + parameters["command_head.bias"])
    nll = _nll(targets, mean, log_variance) + _nll(commands, command, log_variance[..., :joint_dim])
    return nll.mean(), chosen


def start_adam(parameters: Mapping[str, np.ndarray]) -> tuple[Any, ...]:
    """State before the first update: parameters, what Adam remembers of each, and the number of updates."""
    weights, first, second = (
        {name: factor * jnp.array(value) for name, value in parameters.items()} for factor in (1, 0, 0)
    )
    return weights, first, second, jnp.zeros((), jnp.int32)


def make_update(config: UFRNNConfig) -> Callable[..., tuple[tuple[Any, ...], jax.Array]]:
    """A training update (loss, gradients, clipping, Adam): of a state and the rest of `loss` the next state and loss.

    The memory of the state is used again.
    """
    beta1, beta2 = ADAM_BETAS

    @partial(jax.jit, donate_argnums=0)
    def update(state, *problem):
        parameters, first, second, count = state
        (value, _), gradients = jax.value_and_grad(partial(loss, config), has_aux=True)(parameters, *problem)
        norm = jnp.sqrt(sum(jnp.vdot(gradient, gradient) for gradient in gradients.values()))
        scale = jnp.minimum(1.0, config.optimizer_grad_clip_norm / (norm + 1e-6))
        rate, count = config.optimizer_lr, count + 1
        first = jax.tree.map(lambda m, g: beta1 * m + (1 - beta1) * scale * g, first, gradients)
        second = jax.tree.map(lambda v, g: beta2 * v + (1 - beta2) * (scale * g) ** 2, second, gradients)
        parameters = jax.tree.map(
            lambda p, m, v: p - rate * m / (1 - beta1**count) / (jnp.sqrt(v / (1 - beta2**count)) + ADAM_EPSILON),
            *(parameters, first, second),
        )
        return (parameters, first, second, count), value

    return update
