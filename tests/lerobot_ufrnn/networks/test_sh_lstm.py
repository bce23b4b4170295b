import numpy as np
import pytest
import torch
from oracle import Oracle
from small_network import network_config

from lerobot_ufrnn.networks import SHLSTM


def make_network(command_target: str = "action") -> SHLSTM:
    torch.manual_seed(0)
    return SHLSTM(network_config(command_target=command_target)).double()


@pytest.mark.parametrize("command_target", ["action", "next_state"])
def test_steps_and_predictions_equal_the_oracle(command_target):
    network = make_network(command_target)
    oracle = Oracle(network)
    inputs = torch.rand(9, 2, 7, dtype=torch.float64) * 1.6 - 0.8
    state = network.initial_state(2)
    expected = [[np.zeros(value.shape[1]) for value in state] for _ in range(2)]
    for step_inputs in inputs:
        state = network.step(step_inputs, state)
        prediction = network.predict(state)
        for row in range(2):
            expected[row] = oracle.step(step_inputs[row].numpy(), expected[row])
            for ours, theirs in zip(state, expected[row], strict=True):
                np.testing.assert_allclose(ours[row].detach().numpy(), theirs, atol=1e-12)
            for ours, theirs in zip(prediction, oracle.predict(expected[row]), strict=True):
                np.testing.assert_allclose(ours[row].detach().numpy(), theirs, atol=1e-12)


def test_predict_mean_is_the_mean_of_predict():
    network = make_network()
    state = network.step(torch.rand(4, 7, dtype=torch.float64), network.initial_state(4))
    torch.testing.assert_close(network.predict_mean(state), network.predict(state).mean)


def test_modalities_meet_only_in_the_shared_lstm():
    """What the camera shows reaches the joints one step later, through the upper cell."""
    network = make_network()
    state = network.initial_state(1)
    inputs = torch.zeros(1, 7, dtype=torch.float64)
    other = inputs.clone()
    other[:, 3:] = 0.5
    first, second = network.step(inputs, state), network.step(other, state)
    torch.testing.assert_close(first.h_joint, second.h_joint)
    assert not torch.allclose(network.step(inputs, first).h_joint, network.step(inputs, second).h_joint)


def test_every_sequence_starts_from_the_same_state():
    assert all((value == 0).all() for value in make_network().initial_state(3))
