"""A small SH-LSTM, and how its states compare with those of the oracle."""

import numpy as np
import torch
from oracle import Oracle

from lerobot_ufrnn.foresight import Foresight, NoiseSchedule
from lerobot_ufrnn.networks import SHLSTM, HiddenState
from lerobot_ufrnn.recurrent import UFRNN

JOINTS, FEATURES = 3, 4


def small_network(hidden_dim: int = 6) -> SHLSTM:
    """Larger weights than at the start, so that its states move; it is equally certain of its joints everywhere."""
    torch.manual_seed(0)
    network = SHLSTM(JOINTS, FEATURES, hidden_dim, 5, 4, (-9.0, 3.0)).double()
    for parameter in network.parameters():
        parameter.data.mul_(2)
    network.joint_head.weight.data[JOINTS : 2 * JOINTS] = 0
    network.joint_head.bias.data[JOINTS : 2 * JOINTS] = torch.tensor([-4.0, -4.5, -5.0])
    return network.requires_grad_(False)


def small_model(hidden_dim: int = 6) -> UFRNN:
    """The small network in a model that does not explore."""
    schedule = NoiseSchedule((0.05, 0.15), "std", False)
    return UFRNN(small_network(hidden_dim), Foresight("none", schedule, num_samples=1, horizon=1))


def random_state(network: SHLSTM, rows: int, seed: int = 0) -> HiddenState:
    generator = torch.Generator().manual_seed(seed)
    return HiddenState(
        *(torch.randn(rows, size, generator=generator, dtype=torch.float64) for size in network.state_sizes)
    )


def row_of(state: HiddenState, row: int = 0) -> list[np.ndarray]:
    """One row as the oracle takes it."""
    return [values[row].numpy() for values in state]


def in_closed_loop(network: SHLSTM, state: list[np.ndarray], steps: int) -> list[list[np.ndarray]]:
    """This state and those after each of some steps in closed loop, by the oracle."""
    oracle, states = Oracle(network), [state]
    for _ in range(steps):
        states.append(oracle.step(oracle.predict(states[-1])[0], states[-1]))
    return states


def is_close(state: HiddenState, expected: list[np.ndarray], row: int = 0) -> bool:
    return all(np.allclose(ours, theirs, atol=1e-10) for ours, theirs in zip(row_of(state, row), expected, strict=True))


def is_equal(state: HiddenState, expected: HiddenState) -> bool:
    return all(torch.equal(ours, theirs) for ours, theirs in zip(state, expected, strict=True))
