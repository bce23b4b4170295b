"""UF-RNN with the compiled kernel: same signature, same numbers, a fraction of the time."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor
from torch.autograd.function import once_differentiable

from ..configuration_ufrnn import UFRNNConfig
from ..foresight import UFRNN, ForesightTrace, Memory
from ..networks import HiddenState, Prediction
from .backward import pass_back
from .forward import imagine, pass_through
from .layout import Episodes, Gradients, Model, Options, Sizes, Steps, Weights, pack_cells, pack_weights, to_host

COMPILED = {
    "perturbed_states": "hidden",
    "variance_baseline": "common",
    "variance_aggregation": "variance",
    "horizon_mode": "fixed",
    "noise_scale": "linear",
}
"""The one reading that is compiled of fields of `ForesightConfig` that offer several."""

MOST_ROWS = 32
"""States that are multiplied at once; BLAS shares larger products among threads of its own, which fight with ours."""


def unsupported(config: UFRNNConfig) -> str | None:
    """The first setting that is not compiled, such as `foresight.horizon_mode='learned'`; nothing without foresight."""
    if config.exploration == "none":
        return None
    for name, compiled in COMPILED.items():
        if (value := getattr(config.foresight, name)) != compiled:
            return f"foresight.{name}={value!r} (only {compiled!r})"
    return None


class FastUFRNN(UFRNN):
    """[`UFRNN`] with compiled code for the CPU.

    Sequences are independent of each other and share PyTorch's number of threads. With weights on another device,
    weights and inputs visit the CPU for the recurrence: it is so small and so sequential that a GPU would spend its
    time on starting kernels. Imagined futures are not kept: `ForesightTrace.futures` is `None`. Nothing of the
    configuration may be [`unsupported`].
    """

    def __init__(self, config: UFRNNConfig):
        super().__init__(config)
        network, foresight = self.network, config.foresight
        self._sizes = Sizes(network.joint_dim, network.feature_dim, *network.state_sizes[::2])
        explores, selects = config.exploration != "none", config.exploration == "foresight"
        low, high, least, most = map(float, (*config.log_variance_range, *foresight.noise_range))
        in_variance = foresight.noise_unit == "variance"
        self._options = Options(low, high, explores, selects, foresight.horizon, least, most, in_variance)
        self._packed: tuple[tuple[tuple[int, int], ...], Weights] | None = None
        # Compiled code is made or loaded now, so that a robot's first tick does not wait for it.
        inputs = torch.zeros(1, network.joint_dim + network.feature_dim)
        self.advance(inputs, self.initial_memory(1), torch.Generator().manual_seed(0))

    def advance(
        self, inputs: Tensor, memory: Memory, generator: Generator | None = None, explore: bool = True
    ) -> tuple[Memory, ForesightTrace | None]:
        """See [`UFRNN.advance`]; carries no gradient."""
        with torch.no_grad(), torch.autocast(inputs.device.type, enabled=False):
            prediction, state, trace = self._unroll(inputs.unsqueeze(1), memory.state, generator, explore)
        now = Prediction(*(values[0] for values in prediction))
        return Memory(state, now), None if trace is None else trace.at(0)

    @torch.no_grad()
    def imagine(self, state: HiddenState, num_steps: int) -> HiddenState:
        """See [`UFRNN.imagine`]."""
        model = Model(self._pack_once(), self._sizes, self._options)
        starts = (to_host(values).numpy() for values in _to_rows(state))
        hidden, cell = (np.repeat(start[None], num_steps + 1, axis=0) for start in starts)
        _share(lambda *share: imagine(model, hidden, cell, *share), hidden.shape[1])
        device = state.h_joint.device
        return self._to_state(torch.from_numpy(hidden).to(device), torch.from_numpy(cell).to(device))

    def forward(self, inputs: Tensor, generator: Generator | None = None) -> tuple[Prediction, ForesightTrace | None]:
        """See [`UFRNN.forward`]."""
        start = self.network.initial_state(inputs.shape[0])
        with torch.autocast(inputs.device.type, enabled=False):
            prediction, _, trace = self._unroll(inputs, start, generator, explore=True)
        return Prediction(*(values.transpose(0, 1) for values in prediction)), trace

    def _unroll(
        self, inputs: Tensor, start: HiddenState, generator: Generator | None, explore: bool
    ) -> tuple[Prediction, HiddenState, ForesightTrace | None]:
        """Predictions over time (L, B, ...), the last state (B, ...) and the trace of all steps."""
        foresight, device, options = self.foresight, inputs.device, self._options
        options = options._replace(explores=explore and options.explores, selects=explore and options.selects)
        batch_size, length = inputs.shape[:2]
        noise = torch.empty(length, 1, batch_size, 0)
        if options.explores:
            noise = torch.stack([foresight.sample_noise(start, generator) for _ in range(length)])  # (L, N, B, H)
        bounds = torch.stack((foresight.schedule.low, foresight.schedule.high))
        hidden, cell = _to_rows(start)
        time_first = to_host(inputs.transpose(0, 1))
        episodes = Episodes(*(to_host(values).numpy() for values in (time_first, noise, bounds, hidden, cell)))
        cells = pack_cells(self.network) if torch.is_grad_enabled() else None
        weights = pack_weights(self.network, cells) if cells else self._pack_once()
        passage = _Passage(Model(weights, self._sizes, options), episodes)
        kept = _Unroll.apply(passage, inputs.transpose(0, 1), *(cells or ()))
        states = self._to_state(kept, torch.from_numpy(passage.steps.cell).to(device))  # (L, B, hidden size) each
        prediction = self.network.predict(states)
        if not options.selects:
            return prediction, states.at(-1), None
        steps = passage.steps
        noise_std, chosen, baseline, final = (
            torch.from_numpy(values).to(device)
            for values in (steps.noise_std, steps.chosen, steps.baseline, steps.final)
        )
        horizon = torch.full_like(final, options.horizon, dtype=torch.int64)
        trace = ForesightTrace(noise_std, chosen, baseline.unsqueeze(1).expand_as(final), final, horizon, None, None)
        return prediction, states.at(-1), trace

    def _pack_once(self) -> Weights:
        """Packed weights, made anew only when a parameter was changed in place or replaced."""
        versions = tuple(
            (parameter.data_ptr(), parameter._version)
            for layer in self.network.children()
            for parameter in layer._parameters.values()
            if parameter is not None
        )
        if self._packed is None or self._packed[0] != versions:
            self._packed = versions, pack_weights(self.network, pack_cells(self.network))
        return self._packed[1]

    def _to_state(self, hidden: Tensor, cell: Tensor) -> HiddenState:
        """Inverse of `_to_rows`."""
        h_joint, h_image, h_shared = hidden.split(self._sizes[2:], dim=-1)
        c_joint, c_image, c_shared = cell.split(self._sizes[2:], dim=-1)
        return HiddenState(h_joint, c_joint, h_image, c_image, h_shared, c_shared)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_packed": None}


def _to_rows(state: HiddenState) -> tuple[Tensor, Tensor]:
    """Hidden and cell states, (..., H) each."""
    return torch.cat(state[::2], dim=-1), torch.cat(state[1::2], dim=-1)


class _Passage:
    """A batch of episodes on their way forward and back."""

    def __init__(self, model: Model, episodes: Episodes):
        self.model, self.episodes, weights = model, episodes, model.weights
        (length, num_samples, batch_size, _), number = episodes.noise.shape, episodes.hidden.dtype

        def room(*shape: int) -> np.ndarray:
            return np.empty((length, *shape), number)

        self.steps = Steps(
            hidden=room(batch_size, weights.whole.shape[0]),
            cell=room(batch_size, weights.whole.shape[0]),
            raw_cell=room(batch_size, weights.whole.shape[0]),
            joint_input=room(batch_size, weights.joint.shape[0]),
            image_input=room(batch_size, weights.image.shape[0]),
            whole=room(batch_size, weights.whole.shape[1]),
            joint_gates=room(batch_size, weights.joint.shape[1]),
            image_gates=room(batch_size, weights.image.shape[1]),
            noise_std=room(batch_size, 2),
            chosen=np.empty((length, batch_size), np.int64),
            baseline=room(batch_size),
            final=room(num_samples, batch_size),
        )

    def forward(self) -> None:
        whole = self.model, self.episodes, self.steps
        _share(lambda *share: pass_through(*whole, *share), self.steps.hidden.shape[1], self.episodes.noise.shape[1])

    def backward(self, grad_kept: np.ndarray) -> Gradients:
        weights, sizes, steps = self.model.weights, self.model.sizes, self.steps
        back = Gradients(
            np.ascontiguousarray(weights.whole[:, : 4 * sizes.shared].T),
            np.ascontiguousarray(weights.joint[sizes.joint_dim :].T),
            np.ascontiguousarray(weights.image[sizes.feature_dim :].T),
        )
        shape = steps.hidden.shape[:2]
        gradients = Gradients(*(np.empty((*shape, weight.shape[0]), weight.dtype) for weight in back))
        whole = back, sizes, steps, self.episodes.cell, grad_kept, gradients
        _share(lambda *share: pass_back(*whole, *share), shape[1])
        return gradients


class _Unroll(torch.autograd.Function):
    """Kept hidden states (L, B, H) of a batch of episodes; exact gradients of the inputs and of the cells' weights."""

    @staticmethod
    def forward(ctx: Any, passage: _Passage, inputs: Tensor, *cells: Tensor) -> Tensor:
        passage.forward()
        ctx.passage, ctx.like = passage, inputs
        return torch.from_numpy(passage.steps.hidden).to(inputs.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_kept: Tensor) -> tuple[Tensor | None, ...]:
        passage: _Passage = ctx.passage
        steps, weights, sizes = passage.steps, passage.model.weights, passage.model.sizes
        gates = [torch.from_numpy(values) for values in passage.backward(to_host(grad_kept).numpy())]
        before = np.concatenate((passage.episodes.hidden[None], steps.hidden[:-1]))
        cells: list[Tensor] = []
        for values, gradient in zip((before, steps.joint_input, steps.image_input), gates, strict=True):
            cells += [torch.from_numpy(values).flatten(0, 1).T @ gradient.flatten(0, 1), gradient.sum((0, 1))]
        inputs = None
        if ctx.needs_input_grad[1]:
            joints = gates[1] @ torch.from_numpy(weights.joint[: sizes.joint_dim]).T
            features = gates[2] @ torch.from_numpy(weights.image[: sizes.feature_dim]).T
            inputs = torch.cat((joints, features), dim=-1).to(ctx.like)
        return None, inputs, *(cell.to(ctx.like) for cell in cells)


@cache
def _pool(num_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads, thread_name_prefix="ufrnn")


def _share(function: Callable[[int, int], None], count: int, rows_each: int = 1) -> None:
    """Calls `function(first, last)` for shares of `count` sequences, on as many threads as PyTorch uses."""
    num_threads = min(torch.get_num_threads(), count)
    num_shares = min(max(num_threads, -(-count * rows_each // MOST_ROWS)), count)
    if num_shares == 1:
        function(0, count)
        return
    bounds = [count * index // num_shares for index in range(num_shares + 1)]
    for _ in _pool(num_threads).map(function, bounds[:-1], bounds[1:]):
        pass  # asks for each result, so that an error is raised here
