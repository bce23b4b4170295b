"""Lyapunov exponents of a differentiable map: how fast small perturbations of its state grow (UF-RNN, Sec. IV-F).

Benettin et al. (1980, Meccanica 15, 9-30): carry a frame of tangent vectors along a trajectory, re-orthonormalise it at
every step, and average the logarithms of how much each vector has grown. A second trajectory beside the first, pulled
back to a small distance at every step, cross-checks the largest exponent without any derivative.

Over few steps a result depends on the frame to start from. Local exponents start from the one that grows most over
just these steps: they are the logarithms of the singular values of the whole stretch's Jacobian (Abarbanel, Brown and
Kennel 1991, J. Nonlinear Sci. 1, 175-199), which is never built. All exponents are in 1/step.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.func import jvp, vjp

from ..foresight import imagine_states
from ..networks import SHLSTM, HiddenState

Map = Callable[[Tensor], Tensor]
"""One step of a dynamical system: a differentiable function of states (M, S), each row by itself."""


def closed_loop(network: SHLSTM) -> Map:
    """The map that foresight iterates: a step of `imagine_states`.

    Args:
        network (`SHLSTM`):
            The network that imagines.

    Returns:
        `Map`: a function of flat states, see `flatten`.
    """

    def step(flat: Tensor) -> Tensor:
        state = HiddenState(*flat.split(network.state_sizes, dim=-1))
        return flatten(imagine_states(network, state, 1)[1])

    return step


def flatten(state: HiddenState) -> Tensor:
    """The fields of a hidden state side by side: (..., hidden size) each -> (..., S)."""
    return torch.cat(state, dim=-1)


def exponents_over_time(network: SHLSTM, states: Sequence[HiddenState], num_steps: int) -> list[np.ndarray]:
    """Largest local Lyapunov exponent of the imagined future at each moment.

    From each state that the model had, the closed loop runs for `num_steps`, as in foresight but without noise.

    Args:
        network (`SHLSTM`):
            The network that imagines.
        states (`Sequence[HiddenState]`):
            States over time, (L, hidden size) each, of any number of episodes.
        num_steps (`int`):
            Number of imagined steps T.

    Returns:
        `list[np.ndarray]`: for each episode the exponent at each step in 1/step, (L,).
    """
    step = closed_loop(network)
    return [
        local_lyapunov_exponents(step, flatten(of_episode), num_steps).squeeze(-1).cpu().numpy()
        for of_episode in states
    ]


@torch.no_grad()
def lyapunov_exponents(step: Map, start: Tensor, num_steps: int, num_exponents: int = 1, warm_up: int = 0) -> Tensor:
    """Largest Lyapunov exponents along trajectories: tangent vectors with QR re-orthonormalisation.

    Args:
        step (`Map`):
            One step of the system.
        start (`Tensor`):
            Where M trajectories start, (M, S).
        num_steps (`int`):
            Number of steps to average over.
        num_exponents (`int`, *optional*, defaults to `1`):
            Number K of exponents, at most S.
        warm_up (`int`, *optional*, defaults to `0`):
            Steps to go before these, which turn the frame towards the directions that grow.

    Returns:
        `Tensor`: exponents of each trajectory, (M, K), in decreasing order once the frame has turned.
    """
    state, frame = start, _random_frame(start, num_exponents)
    growth = start.new_zeros(len(start), num_exponents)
    for index in range(warm_up + num_steps):
        state, tangents = _push(step, state, frame)
        frame, lengths = torch.linalg.qr(tangents)
        if index >= warm_up:
            growth += lengths.diagonal(dim1=-2, dim2=-1).abs().log()
    return growth / num_steps


@torch.no_grad()
def local_lyapunov_exponents(
    step: Map, start: Tensor, num_steps: int, num_exponents: int = 1, num_sweeps: int = 4
) -> Tensor:
    """Largest Lyapunov exponents over a few steps from given states, of the perturbations that grow most over them.

    Sweeps forwards with the Jacobians and backwards with their transposes, re-orthonormalised at every step, turn a
    frame towards the leading right singular vectors of the whole stretch's Jacobian (subspace iteration). It has two
    vectors more than exponents are asked for, which speeds this up.

    Args:
        step (`Map`):
            One step of the system.
        start (`Tensor`):
            States to start from, (M, S).
        num_steps (`int`):
            Number of steps T.
        num_exponents (`int`, *optional*, defaults to `1`):
            Number K of exponents, at most S.
        num_sweeps (`int`, *optional*, defaults to `4`):
            Number of sweeps there and back; exponents come out too small by an error that falls fast with it.

    Returns:
        `Tensor`: exponents, (M, K), in decreasing order.
    """
    frame = _random_frame(start, min(num_exponents + 2, start.shape[-1]))
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
    return torch.linalg.svdvals(stretch)[:, :num_exponents].log() / num_steps


@torch.no_grad()
def divergence_exponent(
    step: Map,
    start: Tensor,
    num_steps: int,
    warm_up: int = 0,
    distance: float = 1e-7,
) -> Tensor:
    """Largest Lyapunov exponent without derivatives: how a second trajectory parts from the first.

    Args:
        step (`Map`):
            One step of the system.
        start (`Tensor`):
            Where M trajectories start, (M, S), in double precision.
        num_steps (`int`):
            Number of steps to average over.
        warm_up (`int`, *optional*, defaults to `0`):
            Steps to go before these.
        distance (`float`, *optional*, defaults to `1e-7`):
            Distance from the first trajectory to which the second one is pulled back after every step.

    Returns:
        `Tensor`: exponent of each trajectory, (M,).
    """
    state, direction = start, _random_frame(start, 1).squeeze(-1)
    growth = start.new_zeros(len(start))
    for index in range(warm_up + num_steps):
        beside, state = step(state + distance * direction), step(state)
        length = (beside - state).norm(dim=-1, keepdim=True)
        direction = (beside - state) / length
        if index >= warm_up:
            growth += (length / distance).log().squeeze(-1)
    return growth / num_steps


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
