"""Stochastic hierarchical LSTM (SH-LSTM): UF-RNN Fig. 2(B).

Two lower LSTMs, one for the joints and one for the image features, carry the fast dynamics of their modality; a small
upper LSTM reads both and speaks back to both. Each lower LSTM predicts mean and variance of its modality's next value.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from .gaussian import bound_log_variance

if TYPE_CHECKING:
    from ..configuration_ufrnn import UFRNNConfig


class HiddenState(NamedTuple):
    """Hidden (`h`) and cell (`c`) states of the three LSTMs, each of shape (B, hidden size)."""

    h_joint: Tensor
    c_joint: Tensor
    h_image: Tensor
    c_image: Tensor
    h_shared: Tensor
    c_shared: Tensor

    @classmethod
    def stack(cls, states: Sequence["HiddenState"]) -> "HiddenState":
        """T states of (..., hidden size) each -> (T, ..., hidden size) each."""
        return cls(*map(torch.stack, zip(*states, strict=True)))

    def at(self, index: Any) -> "HiddenState":
        """Each field at an index, as of a tensor."""
        return HiddenState(*(values[index] for values in self))


class Prediction(NamedTuple):
    """What a hidden state predicts of the next sensor values; D = joint_dim + feature_dim, joints first.

    Attributes:
        mean (`Tensor`): scaled next joints and image features, (B, D), in (-1, 1).
        log_variance (`Tensor`): log-variance of each, (B, D).
        step (`Tensor`): one scalar a modality for a learned foresight horizon, (B, 2), unbounded.
        command (`Tensor`): scaled joint targets that bring the next values about, (B, D_j), in (-1, 1).
    """

    mean: Tensor
    log_variance: Tensor
    step: Tensor
    command: Tensor


class SHLSTM(nn.Module):
    """Stochastic hierarchical LSTM.

    Args:
        config (`UFRNNConfig`):
            Its `joint_dim` D_j (gripper included) and `image_dim` D_f, the hidden sizes, `log_variance_range`, and
            whether commands are read off by a head of their own (`command_target`).
    """

    def __init__(self, config: "UFRNNConfig"):
        super().__init__()
        self.joint_dim, self.feature_dim = config.joint_dim, config.image_dim
        self.log_variance_range = config.log_variance_range
        joint_hidden_dim, image_hidden_dim = config.joint_hidden_dim, config.image_hidden_dim
        lower_hidden_dim = joint_hidden_dim + image_hidden_dim
        self.joint_cell = nn.LSTMCell(self.joint_dim, joint_hidden_dim)
        self.image_cell = nn.LSTMCell(self.feature_dim, image_hidden_dim)
        self.shared_cell = nn.LSTMCell(lower_hidden_dim, config.shared_hidden_dim)
        self.shared_to_lower = nn.Linear(config.shared_hidden_dim, lower_hidden_dim)
        self.joint_head = nn.Linear(joint_hidden_dim, 2 * self.joint_dim + 1)
        self.image_head = nn.Linear(image_hidden_dim, 2 * self.feature_dim + 1)
        self.command_head = nn.Linear(joint_hidden_dim, self.joint_dim) if config.command_target == "action" else None

    @property
    def state_sizes(self) -> tuple[int, ...]:
        """`tuple[int, ...]`: hidden size of each field of `HiddenState`."""
        return tuple(
            cell.hidden_size for cell in (self.joint_cell, self.image_cell, self.shared_cell) for _ in ("h", "c")
        )

    def initial_state(self, batch_size: int) -> HiddenState:
        """Zeros, the same for every sequence: a learned state per sequence would leak what is to be found out."""
        weight = self.joint_head.weight
        return HiddenState(*(weight.new_zeros(batch_size, size) for size in self.state_sizes))

    def step(self, inputs: Tensor, state: HiddenState) -> HiddenState:
        """Advances the hidden state by one time step.

        The upper cell reads both lower `h`; its own `h`, mapped back, replaces them, while their cell states are kept;
        then the lower cells read the inputs.

        Args:
            inputs (`Tensor`):
                Scaled joints and image features of this step, (B, D).
            state (`HiddenState`):
                State after the previous step.

        Returns:
            `HiddenState`: state after this step.
        """
        lower_h = torch.cat((state.h_joint, state.h_image), dim=-1)
        h_shared, c_shared = self.shared_cell(lower_h, (state.h_shared, state.c_shared))
        h_joint, h_image = self.shared_to_lower(h_shared).split(
            (self.joint_cell.hidden_size, self.image_cell.hidden_size), dim=-1
        )
        joints, features = inputs.split((self.joint_dim, self.feature_dim), dim=-1)
        h_joint, c_joint = self.joint_cell(joints, (h_joint, state.c_joint))
        h_image, c_image = self.image_cell(features, (h_image, state.c_image))
        return HiddenState(h_joint, c_joint, h_image, c_image, h_shared, c_shared)

    def predict(self, state: HiddenState) -> Prediction:
        """Reads the prediction of the next sensor values off a hidden state (B, hidden size)."""
        joint = self.joint_head(state.h_joint)
        image = self.image_head(state.h_image)
        j, f = self.joint_dim, self.feature_dim
        mean = torch.tanh(torch.cat((joint[..., :j], image[..., :f]), dim=-1))
        raw_log_variance = torch.cat((joint[..., j : 2 * j], image[..., f : 2 * f]), dim=-1)
        step = torch.cat((joint[..., 2 * j :], image[..., 2 * f :]), dim=-1)
        command = mean[..., :j] if self.command_head is None else torch.tanh(self.command_head(state.h_joint))
        return Prediction(mean, bound_log_variance(raw_log_variance, *self.log_variance_range), step, command)

    def predict_mean(self, state: HiddenState) -> Tensor:
        """Only the means of `predict`, (B, D): all that a closed loop feeds back."""
        joint = nn.functional.linear(
            state.h_joint, self.joint_head.weight[: self.joint_dim], self.joint_head.bias[: self.joint_dim]
        )
        image = nn.functional.linear(
            state.h_image, self.image_head.weight[: self.feature_dim], self.image_head.bias[: self.feature_dim]
        )
        return torch.tanh(torch.cat((joint, image), dim=-1))
