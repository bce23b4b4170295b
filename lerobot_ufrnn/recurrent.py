"""The recurrent model: SH-LSTM step, foresight, prediction; over a whole episode or one step at a time."""

from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn

from .foresight import Foresight, ForesightTrace, imagine_states, modality_means
from .networks import SHLSTM, HiddenState, Prediction


class Memory(NamedTuple):
    """What one step hands to the next: the hidden state that was kept and what it predicts."""

    state: HiddenState
    prediction: Prediction


class UFRNN(nn.Module):
    """SH-LSTM whose hidden state foresight refines at every step, in training and at run time.

    Args:
        network (`SHLSTM`):
            The stochastic hierarchical LSTM.
        foresight (`Foresight`):
            What happens to the hidden state at each step.
    """

    def __init__(self, network: SHLSTM, foresight: Foresight):
        super().__init__()
        self.network = network
        self.foresight = foresight

    def initial_memory(self, batch_size: int) -> Memory:
        """Memory of `batch_size` sequences that have seen nothing."""
        state = self.network.initial_state(batch_size)
        return Memory(state, self.network.predict(state))

    def advance(
        self, inputs: Tensor, memory: Memory, generator: Generator | None = None
    ) -> tuple[Memory, ForesightTrace | None]:
        """One time step: read the inputs, explore, predict.

        Args:
            inputs (`Tensor`):
                Scaled joints and image features, (B, D).
            memory (`Memory`):
                Memory after the previous step.
            generator (`torch.Generator`, *optional*):
                Source of the exploration noise.

        Returns:
            `tuple[Memory, ForesightTrace | None]`: memory after this step, and what foresight saw.
        """
        state = self.network.step(inputs, memory.state)
        state, trace = self.foresight(self.network, state, memory.prediction, generator)
        return Memory(state, self.network.predict(state)), trace

    def forward(self, inputs: Tensor, generator: Generator | None = None) -> tuple[Prediction, ForesightTrace | None]:
        """Predicts every next step of whole episodes, reading the measured inputs (teacher forcing).

        Args:
            inputs (`Tensor`):
                Scaled joints and image features, (B, L, D).
            generator (`torch.Generator`, *optional*):
                Source of the exploration noise.

        Returns:
            `tuple[Prediction, ForesightTrace | None]`: predictions stacked over time, (B, L, ...) each, and
                what foresight saw at each of the L steps (`None` without foresight).
        """
        memory = self.initial_memory(inputs.shape[0])
        predictions, traces = [], []
        for step_inputs in inputs.unbind(dim=1):
            memory, trace = self.advance(step_inputs, memory, generator)
            predictions.append(memory.prediction)
            if trace is not None:
                traces.append(trace)
        prediction = Prediction(*(torch.stack(values, dim=1) for values in zip(*predictions, strict=True)))
        return prediction, ForesightTrace.stack(traces) if traces else None

    @torch.no_grad()
    def imagine(self, state: HiddenState, num_steps: int) -> HiddenState:
        """States in closed loop, without exploring: the predicted means are fed back as inputs.

        Args:
            state (`HiddenState`):
                Where to start from, (M, hidden size) each.
            num_steps (`int`):
                Number of steps T.

        Returns:
            `HiddenState`: `state` and the state after each of the T steps, (T + 1, M, hidden size) each.
        """
        return HiddenState.stack(imagine_states(self.network, state, num_steps))

    def modality_variance(self, prediction: Prediction) -> Tensor:
        """Mean predicted variance of each modality, (..., 2), joints first."""
        return modality_means(prediction.log_variance.exp(), self.network.joint_dim)
