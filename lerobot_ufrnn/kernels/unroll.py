"""UF-RNN with the compiled kernel: same signature, same numbers, a fraction of the time."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor
from torch.autograd.function import once_differentiable

from ..configuration_ufrnn import UFRNNConfig
from ..foresight import UFRNN, Foresight, ForesightTrace, Memory
from ..networks import SHLSTM, HiddenState, Prediction
from .layout import GateGradients, Options, Sizes, Steps, TransposedWeights, Weights
from .matmul import PANEL
from .packing import Cells, Heads, pack_cells, pack_heads, to_panels
from .walk import imagine, walk
from .walk_back import walk_back


def unsupported(config: UFRNNConfig) -> str | None:
    """Name of a field whose value is not compiled."""
    return None


class _Packed(NamedTuple):
    """Weights on the CPU: the cells' as tensors that know where they come from, and all as `walk` reads them."""

    cells: Cells
    weights: Weights


class FastUFRNN(UFRNN):
    """[`UFRNN`] with compiled code for the CPU.

    Sequences are independent of each other and share PyTorch's number of threads; each comes out the same bit for bit,
    whatever that number and the rest of the batch. With weights on another device, weights and inputs visit the CPU for
    the recurrence: it is so small and so sequential that a GPU would spend its time on starting kernels.

    Imagined futures are not kept: `ForesightTrace.futures` is `None`. Arguments are those of [`UFRNN`].
    """

    def __init__(self, config: UFRNNConfig):
        super().__init__(config)
        network = self.network
        self._sizes = Sizes(
            network.joint_dim,
            network.feature_dim,
            network.joint_cell.hidden_size,
            network.image_cell.hidden_size,
            network.shared_cell.hidden_size,
        )
        self._packed: tuple[tuple[tuple[int, int], ...], _Packed] | None = None
        # Compiled code is made or loaded now, so that a robot's first tick does not wait for it.
        inputs = torch.zeros(1, network.joint_dim + network.feature_dim)
        self.advance(inputs, self.initial_memory(1), torch.Generator().manual_seed(0))

    def advance(
        self, inputs: Tensor, memory: Memory, generator: Generator | None = None, explore: bool = True
    ) -> tuple[Memory, ForesightTrace | None]:
        """See [`UFRNN.advance`]; carries no gradient."""
        with torch.no_grad(), torch.autocast(inputs.device.type, enabled=False):
            packed = self._pack_once()
            prediction, state, trace = self._walk(inputs.unsqueeze(1), memory.state, generator, packed, explore)
        now = Prediction(*(values[0] for values in prediction))
        return Memory(state, now), None if trace is None else trace.at(0)

    def forward(self, inputs: Tensor, generator: Generator | None = None) -> tuple[Prediction, ForesightTrace | None]:
        """See [`UFRNN.forward`]."""
        start = self.network.initial_state(inputs.shape[0])
        with torch.autocast(inputs.device.type, enabled=False):
            prediction, _, trace = self._walk(inputs, start, generator, self._pack())
        return Prediction(*(values.transpose(0, 1) for values in prediction)), trace

    @torch.no_grad()
    def imagine(self, state: HiddenState, num_steps: int) -> HiddenState:
        """See [`UFRNN.imagine`]."""
        weights = self._pack_once().weights
        starts = (_host(values).numpy() for values in _to_rows(state))
        hidden, cell = (np.repeat(start[None], num_steps + 1, axis=0) for start in starts)
        _share(lambda first, last: imagine(weights, self._sizes, hidden, cell, first, last), hidden.shape[1])
        device = state.h_joint.device
        return self._to_state(torch.from_numpy(hidden).to(device), torch.from_numpy(cell).to(device))

    def _to_state(self, hidden: Tensor, cell: Tensor) -> HiddenState:
        """Inverse of `_to_rows`."""
        h_joint, h_image, h_shared = hidden.split(self._sizes[2:], dim=-1)
        c_joint, c_image, c_shared = cell.split(self._sizes[2:], dim=-1)
        return HiddenState(h_joint, c_joint, h_image, c_image, h_shared, c_shared)

    def _walk(
        self,
        inputs: Tensor,
        start: HiddenState,
        generator: Generator | None,
        packed: _Packed,
        explore: bool = True,
    ) -> tuple[Prediction, HiddenState, ForesightTrace | None]:
        """Predictions over time (L, B, ...), the last state (B, ...) and the trace of all steps."""
        foresight, device = self.foresight, inputs.device
        options = _options(self.network, foresight)
        options = options._replace(perturbs=explore and options.perturbs, selects=explore and options.selects)
        batch_size, length = inputs.shape[:2]
        noise = torch.empty(length, 1, batch_size, 0)
        if options.perturbs:
            noise = torch.stack([foresight.sample_noise(start, generator) for _ in range(length)])  # (L, N, B, S)
        hidden, cell = _to_rows(start)
        schedule = foresight.schedule
        episodes = _Episodes(
            self._sizes,
            options,
            packed.weights,
            _host(torch.stack((schedule.low, schedule.high))).numpy(),
            _host(noise).numpy(),
            _host(hidden).numpy(),
            _host(cell).numpy(),
        )
        steps, inputs = episodes.steps, _host(inputs.transpose(0, 1))
        if torch.is_grad_enabled():
            kept = _Walk.apply(episodes, inputs, *packed.cells)
        else:
            episodes.walk(inputs.numpy())
            kept = torch.from_numpy(steps.hidden)
        states = self._to_state(kept.to(device), torch.from_numpy(steps.cell).to(device))  # (L, B, hidden size) each
        prediction = self.network.predict(states)
        last = HiddenState(*(values[-1] for values in states))
        return prediction, last, _trace(steps, options, device) if options.selects else None

    def _pack(self) -> _Packed:
        cells = Cells(*map(_host, pack_cells(self.network)))
        heads = Heads(*map(_host, pack_heads(self.network)))
        return _Packed(cells, Weights(*(weight.detach().numpy() for weight in (*cells, *heads))))

    def _pack_once(self) -> _Packed:
        """Packed weights, made anew only when a parameter was changed in place or replaced."""
        versions = tuple(
            (parameter.data_ptr(), parameter._version)
            for layer in self.network.children()
            for parameter in layer._parameters.values()
            if parameter is not None
        )
        if self._packed is None or self._packed[0] != versions:
            self._packed = versions, self._pack()
        return self._packed[1]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_packed": None}


def _trace(steps: Steps, options: Options, device: torch.device) -> ForesightTrace:
    noise_std, chosen, baseline, final, horizon, calmest = (
        torch.from_numpy(values).to(device)
        for values in (steps.noise_std, steps.chosen, steps.baseline, steps.final, steps.horizon, steps.calmest)
    )
    return ForesightTrace(
        noise_std, chosen, baseline, final, horizon, calmest if options.learned_horizon else None, None
    )


def _to_rows(state: HiddenState) -> tuple[Tensor, Tensor]:
    """Hidden and cell states, (..., H) each."""
    hidden = torch.cat((state.h_joint, state.h_image, state.h_shared), dim=-1)
    return hidden, torch.cat((state.c_joint, state.c_image, state.c_shared), dim=-1)


def _host(values: Tensor) -> Tensor:
    """What compiled code reads: contiguous on the CPU, float64 as it is and anything narrower as float32."""
    number = torch.float64 if values.dtype == torch.float64 else torch.float32
    return values.to("cpu", number).contiguous()


def _options(network: SHLSTM, foresight: Foresight) -> Options:
    low, high = network.log_variance_range
    config = foresight.config
    columns, column = [], 0
    for name, size in zip(HiddenState._fields, network.state_sizes, strict=True):
        columns.append(column if name in foresight.perturbed else -1)
        column += size if name in foresight.perturbed else 0
    return Options(
        float(low),
        float(high),
        foresight.exploration != "none",
        foresight.exploration == "foresight",
        config.horizon,
        config.horizon_mode == "learned",
        config.variance_baseline == "candidate",
        config.variance_aggregation == "entropy",
        float(config.noise_range[0]),
        float(config.noise_range[1]),
        config.noise_unit == "variance",
        config.noise_scale == "log",
        tuple(columns),  # type: ignore[arg-type]
    )


class _Episodes:
    """A batch of episodes on their way through `walk` and `walk_back`."""

    def __init__(
        self,
        sizes: Sizes,
        options: Options,
        weights: Weights,
        noise_bounds: np.ndarray,
        noise: np.ndarray,
        first_hidden: np.ndarray,
        first_cell: np.ndarray,
    ):
        self.sizes, self.options, self.weights = sizes, options, weights
        self.noise_bounds, self.noise = noise_bounds, noise
        self.first_hidden, self.first_cell = first_hidden, first_cell
        length, num_samples, batch_size, _ = noise.shape
        number, hidden_size = first_hidden.dtype, first_hidden.shape[-1]

        def of_episodes(*shape: int) -> np.ndarray:
            return np.empty((length, batch_size, *shape), number)

        def of_candidates(dtype: Any) -> np.ndarray:
            return np.empty((length, num_samples, batch_size), dtype)

        self.steps = Steps(
            hidden=of_episodes(hidden_size),
            cell=of_episodes(hidden_size),
            raw_cell=of_episodes(hidden_size),
            joint_input=of_episodes(sizes.joint_dim + sizes.shared_hidden),
            image_input=of_episodes(sizes.feature_dim + sizes.shared_hidden),
            shared_gates=of_episodes(len(weights.shared_bias)),
            joint_gates=of_episodes(len(weights.joint_bias)),
            image_gates=of_episodes(len(weights.image_bias)),
            noise_std=of_episodes(2),
            chosen=np.empty((length, batch_size), np.int64),
            baseline=of_candidates(number),
            final=of_candidates(number),
            horizon=of_candidates(np.int64),
            calmest=of_candidates(np.int64),
        )

    def walk(self, inputs: np.ndarray) -> None:
        def some(first: int, last: int) -> None:
            walk(
                self.weights,
                self.sizes,
                self.options,
                self.noise_bounds,
                inputs,
                self.noise,
                self.first_hidden,
                self.first_cell,
                self.steps,
                first,
                last,
            )

        _share(some, inputs.shape[1])

    def walk_back(self, grad_kept: np.ndarray) -> GateGradients:
        weights, sizes, steps = self.weights, self.sizes, self.steps
        joint, image, shared = (_columns(panels) for panels in (weights.joint, weights.image, weights.shared))
        transposed = TransposedWeights(
            to_panels(shared.T).numpy(),
            to_panels(joint[sizes.joint_dim :].T).numpy(),
            to_panels(image[sizes.feature_dim :].T).numpy(),
            np.zeros(len(shared) + PANEL, weights.shared.dtype),
        )
        gradients = GateGradients(
            *(np.zeros_like(gates) for gates in (steps.shared_gates, steps.joint_gates, steps.image_gates))
        )

        def some(first: int, last: int) -> None:
            walk_back(transposed, sizes, steps, self.first_cell, grad_kept, gradients, first, last)

        _share(some, grad_kept.shape[1])
        return gradients


class _Walk(torch.autograd.Function):
    """Kept hidden states (L, B, H) of a batch of episodes; exact gradients of the inputs and of the cells' weights."""

    @staticmethod
    def forward(ctx: Any, episodes: _Episodes, inputs: Tensor, *cells: Tensor) -> Tensor:
        episodes.walk(inputs.detach().numpy())
        ctx.episodes = episodes
        return torch.from_numpy(episodes.steps.hidden)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_kept: Tensor) -> tuple[Tensor | None, ...]:
        episodes: _Episodes = ctx.episodes
        sizes, weights, steps = episodes.sizes, episodes.weights, episodes.steps
        gates = [torch.from_numpy(values) for values in episodes.walk_back(grad_kept.contiguous().numpy())]
        before = np.concatenate((episodes.first_hidden[None], steps.hidden[:-1]))
        cells: list[Tensor] = []
        for values, gradient in zip((before, steps.joint_input, steps.image_input), gates, strict=True):
            weight = torch.from_numpy(values).flatten(0, 1).T @ gradient.flatten(0, 1)
            cells += [to_panels(weight), gradient.sum((0, 1))]
        inputs = None
        if ctx.needs_input_grad[1]:
            joints = gates[1] @ _columns(weights.joint)[: sizes.joint_dim].T
            features = gates[2] @ _columns(weights.image)[: sizes.feature_dim].T
            inputs = torch.cat((joints, features), dim=-1)
        return None, inputs, *cells


def _columns(panels: np.ndarray) -> Tensor:
    """Panels (P, K, `PANEL`) -> matrix (K, P * `PANEL`)."""
    return torch.from_numpy(panels).transpose(0, 1).flatten(1)


@cache
def _pool(num_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads, thread_name_prefix="ufrnn")


def _share(function: Callable[[int, int], None], count: int) -> None:
    """Calls `function(first, last)` for shares of `count` episodes, on as many threads as PyTorch uses."""
    num_threads = min(torch.get_num_threads(), count)
    if num_threads == 1:
        function(0, count)
        return
    bounds = [count * index // num_threads for index in range(num_threads + 1)]
    for _ in _pool(num_threads).map(function, bounds[:-1], bounds[1:]):
        pass  # asks for each result, so that an error is raised here
