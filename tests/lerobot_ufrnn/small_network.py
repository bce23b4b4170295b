"""A small SH-LSTM, and how its states compare with those of the oracle."""

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from oracle import Oracle
from small import IMAGE_SIZE, small_config

from lerobot_ufrnn.configuration_ufrnn import UFRNNConfig
from lerobot_ufrnn.foresight import UFRNN
from lerobot_ufrnn.networks import SHLSTM, HiddenState

JOINTS, FEATURES = 3, 4


def network_config(joint_dim: int = JOINTS, feature_dim: int = FEATURES, **overrides) -> UFRNNConfig:
    """A configuration of a small network with so many inputs, `feature_dim` from one camera."""
    joints = PolicyFeature(FeatureType.STATE, (joint_dim,))
    return small_config(
        autoencoder={"feature_dim": feature_dim},
        input_features={
            "observation.state": joints,
            "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIZE, IMAGE_SIZE)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (joint_dim,))},
        **overrides,
    )


def enlarge(network: SHLSTM) -> SHLSTM:
    """In float64 and with larger weights than at the start, so that its states move and candidates part."""
    for parameter in network.double().parameters():
        parameter.data.mul_(2)
    return network


def small_model(kernel: type[UFRNN] = UFRNN, **overrides) -> UFRNN:
    """A model that does not explore unless told to; it is equally certain of its joints everywhere."""
    torch.manual_seed(0)
    model = kernel(network_config(**{"exploration": "none", **overrides})).double()
    head = enlarge(model.network).joint_head
    head.weight.data[JOINTS : 2 * JOINTS] = 0
    head.bias.data[JOINTS : 2 * JOINTS] = torch.tensor([-4.0, -4.5, -5.0])
    return model.requires_grad_(False)


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
