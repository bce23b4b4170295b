"""Local Lyapunov exponents of imagination: how fast futures part that begin with nearly the same state (Sec. IV-F).

Over few steps a result depends on the perturbation to start from. This is the one that grows most over just these
steps: the exponent is the logarithm of the largest singular value of the whole stretch's Jacobian (Abarbanel, Brown and
Kennel 1991, J. Nonlinear Sci. 1, 175-199). That is never built: Jacobians push a frame of tangent vectors along the
trajectory, their transposes pull it back, and it is re-orthonormalised at every step (after Benettin et al. 1980,
Meccanica 15, 9-30).
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.func import jvp, vjp

from ..networks import SHLSTM, HiddenState

Map = Callable[[Tensor], Tensor]
"""One step of a dynamical system: a differentiable function of states (M, S), each row by itself."""
NUM_VECTORS = 3
"""Vectors of a frame: one would do, more turn faster towards the one that grows most."""


def exponents_over_time(network: SHLSTM, states: Sequence[HiddenState], num_steps: int) -> list[np.ndarray]:
    """Largest local Lyapunov exponent of the imagined future at each moment of some episodes.

    From each state that the model had, (L, hidden size) each, the closed loop runs for `num_steps`, as in foresight but
    without noise. Returns the exponents of each episode in 1/step, (L,).
    """
    step = closed_loop(network)
    return [local_lyapunov_exponent(step, flatten(of_episode), num_steps).cpu().numpy() for of_episode in states]


def closed_loop(network: SHLSTM) -> Map:
    """The map that foresight iterates, of flat states: predict, and take the predicted means for what was measured."""

    def step(flat: Tensor) -> Tensor:
        state = HiddenState(*flat.split(network.state_sizes, dim=-1))
        return flatten(network.step(network.predict_mean(state), state))

    return step


def flatten(state: HiddenState) -> Tensor:
    """The fields of a hidden state side by side: (..., hidden size) each -> (..., S)."""
    return torch.cat(state, dim=-1)


@torch.no_grad()
def local_lyapunov_exponent(step: Map, start: Tensor, num_steps: int, num_sweeps: int = 4) -> Tensor:
    """How fast the perturbation grows that grows most over `num_steps`, in 1/step: (M, S) -> (M,).

    Each sweep there and back (subspace iteration) brings the result, which is too small at first, closer.
    """
    frame = _random_frame(start, min(NUM_VECTORS, start.shape[-1]))
    for sweep in range(num_sweeps + 1):
        state, states = start, []
        stretch = torch.eye(frame.shape[-1]).to(start)  # the Jacobian of the steps so far within the frames
        for _ in range(num_steps):
            states.append(state)
            state, tangents = _push(step, state, frame)
            frame, lengths = torch.linalg.qr(tangents)
            stretch = lengths @ stretch
        if sweep < num_sweeps:
            for state in reversed(states):
                frame = torch.linalg.qr(_pull(step, state, frame)).Q
    return torch.linalg.svdvals(stretch)[:, 0].log() / num_steps


def _random_frame(start: Tensor, num_vectors: int) -> Tensor:
    """Orthonormal vectors (M, S, K) in random directions, always the same."""
    generator = torch.Generator().manual_seed(0)
    return torch.linalg.qr(torch.randn(*start.shape, num_vectors, dtype=start.dtype, generator=generator).to(start)).Q


def _push(step: Map, state: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
    """The next states (M, S), and tangent vectors (M, S, K) carried there by the Jacobians."""
    states, tangents = jvp(step, (_of_each_vector(state, frame),), (frame.mT.flatten(0, 1),))  # type: ignore[misc]
    return states[:: frame.shape[-1]], tangents.unflatten(0, (len(state), -1)).mT


def _pull(step: Map, state: Tensor, frame: Tensor) -> Tensor:
    """Vectors (M, S, K) at the next states carried back by the transposed Jacobians."""
    (vectors,) = vjp(step, _of_each_vector(state, frame))[1](frame.mT.flatten(0, 1))
    return vectors.unflatten(0, (len(state), -1)).mT


def _of_each_vector(state: Tensor, frame: Tensor) -> Tensor:
    """States (M, S) once for each vector of their frames: (M * K, S)."""
    return state.repeat_interleave(frame.shape[-1], dim=0)
