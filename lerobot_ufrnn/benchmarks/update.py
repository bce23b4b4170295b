"""Time of one whole training update: noise, foresight, loss, gradients, clipping and Adam."""

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ..configuration_ufrnn import UFRNNConfig
from ..foresight import Foresight, NoiseSchedule
from ..kernels.unroll import FastUFRNN
from ..networks import SHLSTM, gaussian_nll
from ..recurrent import UFRNN
from .timing import Rounds, bind_this_thread, one_thread, take_turns

if TYPE_CHECKING:
    from .scan import ScanSizes

logger = logging.getLogger(__name__)

# Stated, so that another default does not change what is measured. The scan knows these readings of the paper only.
PAPER: dict[str, Any] = {
    "exploration": "foresight",
    "num_samples": 5,
    "horizon": 10,
    "horizon_mode": "fixed",
    "noise_unit": "std",
    "noise_scale": "linear",
    "perturbed_states": "hidden",
    "variance_baseline": "common",
    "variance_aggregation": "variance",
    "keep_unperturbed": False,
    "joint_hidden_dim": 50,
    "image_hidden_dim": 50,
    "shared_hidden_dim": 20,
    "feature_dim": 10,
    "command_target": "action",
}
FAST, REFERENCE, SCAN = "fast kernel", "reference", "XLA scan"


@dataclass(frozen=True)
class Problem:
    """What is computed; the paper's sizes by default.

    Attributes:
        batch_size (`int`): episodes B.
        length (`int`): steps L; an episode of 150 frames has 149 next ones to predict.
        joint_dim (`int`): joints, gripper included.
        config (`UFRNNConfig`): everything else.
    """

    batch_size: int = 5
    length: int = 149
    joint_dim: int = 7
    config: UFRNNConfig = field(default_factory=lambda: UFRNNConfig(device="cpu", **PAPER))

    def make_model(self, kernel: type[UFRNN] = FastUFRNN) -> UFRNN:
        """Untrained model, the same for every kernel, with a noise schedule that knows a range."""
        config = self.config
        torch.manual_seed(0)
        network = SHLSTM(
            self.joint_dim,
            config.feature_dim,
            config.joint_hidden_dim,
            config.image_hidden_dim,
            config.shared_hidden_dim,
            config.log_variance_range,
        )
        schedule = NoiseSchedule(config.noise_range, config.noise_unit, log_scale=False)
        schedule.observe(torch.tensor([[0.5, 0.5], [1.5, 1.5]]))
        return kernel(network, Foresight(config.exploration, schedule, config.num_samples, config.horizon))

    def make_episodes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Smooth random inputs and their next values, (B, L, D) each, and commands a step ahead, (B, L, D_j)."""
        generator = torch.Generator().manual_seed(0)
        phase = 2 * torch.pi * torch.rand(self.batch_size, 1, self._dim, generator=generator)
        values = 0.8 * torch.sin(0.1 * torch.arange(self.length + 2)[None, :, None] + phase)
        inputs, targets, commands = values[:, :-2], values[:, 1:-1], values[:, 2:, : self.joint_dim]
        return inputs.contiguous(), targets.contiguous(), commands.contiguous()

    @property
    def scan_sizes(self) -> "ScanSizes":
        """`ScanSizes`: what the scan must know when it is compiled; needs JAX."""
        from .scan import ScanSizes

        config = self.config
        return ScanSizes(
            self.joint_dim,
            config.feature_dim,
            config.joint_hidden_dim,
            config.image_hidden_dim,
            config.shared_hidden_dim,
            config.horizon,
            config.log_variance_range,
            config.noise_range,
        )

    @property
    def _dim(self) -> int:
        return self.joint_dim + self.config.feature_dim


def torch_loss(model: UFRNN, inputs: Tensor, targets: Tensor, commands: Tensor, generator: torch.Generator) -> Tensor:
    """Loss of the recurrent network's training, without what is only logged."""
    prediction, _ = model(inputs, generator)
    nll = gaussian_nll(targets, prediction.mean, prediction.log_variance).sum(-1)
    joint_log_variance = prediction.log_variance[..., : model.network.joint_dim]
    return (nll + gaussian_nll(commands, prediction.command, joint_log_variance).sum(-1)).mean()


def make_torch_update(problem: Problem, kernel: type[UFRNN]) -> Callable[[], object]:
    """One update with PyTorch's optimiser, as `lerobot-train` makes it."""
    model = problem.make_model(kernel)
    episodes = problem.make_episodes()
    preset = problem.config.get_optimizer_preset()
    optimizer = preset.build(list(model.parameters()))
    generator = torch.Generator().manual_seed(0)

    def update() -> float:
        loss = torch_loss(model, *episodes, generator)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), preset.grad_clip_norm)
        optimizer.step()
        return loss.item()

    return update


def make_scan_update(problem: Problem) -> Callable[[], object]:
    """The same with XLA; its noise, too, is drawn by PyTorch, which is quicker at it.

    Raises:
        ImportError: Without JAX.
    """
    from . import scan

    config, model = problem.config, problem.make_model(UFRNN)
    episodes = [scan.jnp.array(values.transpose(0, 1).numpy()) for values in problem.make_episodes()]
    state = scan.start_adam({name: value.detach().numpy() for name, value in model.network.named_parameters()})
    schedule = model.foresight.schedule
    noise_bounds = scan.jnp.array(np.stack((schedule.low.numpy(), schedule.high.numpy())))
    sizes = problem.scan_sizes
    shape = (problem.length, config.num_samples, problem.batch_size, sum(model.network.state_sizes[::2]))
    generator = torch.Generator().manual_seed(0)

    def update() -> float:
        nonlocal state
        noise = torch.randn(shape, generator=generator).numpy()
        state, loss = scan.update(
            state, *episodes, noise, noise_bounds, sizes, config.optimizer_lr, config.optimizer_grad_clip_norm
        )
        return float(loss)

    return update


@dataclass(frozen=True)
class UpdateTimes:
    """Times of an update, each competitor in turns with the fast kernel alone.

    Attributes:
        with_reference (`Rounds`): under the names `FAST` and `REFERENCE`.
        with_scan (`Rounds`, *optional*): under the names `FAST` and `SCAN`; `None` without JAX.
    """

    with_reference: Rounds
    with_scan: Rounds | None


def measure_update(seconds: float = 60.0, problem: Problem | None = None) -> UpdateTimes:
    """Times the fast kernel, the reference and, with JAX, the scan, all on one thread of the same CPU.

    Args:
        seconds (`float`, *optional*, defaults to `60.0`):
            Time to measure for, after compiling; half of it against each competitor.
        problem (`Problem`, *optional*):
            What is computed; the paper's sizes when not given.

    Returns:
        `UpdateTimes`: what was measured.
    """
    problem = problem or Problem()
    try:
        scan = make_scan_update(problem)
    except ImportError:
        logger.info("JAX cannot be imported: no comparison with an XLA scan (`pip install jax`).")
        scan = None
    # XLA sizes its thread pool by the CPUs of the thread that first uses it; and it compiles while Numba does.
    with ThreadPoolExecutor(1, initializer=bind_this_thread) as pool:
        compiled = pool.submit(scan) if scan is not None else None
        fast = make_torch_update(problem, FastUFRNN)
        fast()
        if compiled is not None:
            compiled.result()
    reference = make_torch_update(problem, UFRNN)
    with one_thread(pin=True):
        with_scan = None if scan is None else take_turns({FAST: fast, SCAN: scan}, seconds / 2, warm_up=2)
        return UpdateTimes(take_turns({FAST: fast, REFERENCE: reference}, seconds / 2), with_scan)
