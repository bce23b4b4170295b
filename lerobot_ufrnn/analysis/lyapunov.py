"""Local Lyapunov exponents of imagination: how fast futures part that begin with nearly the same state.

Over few steps a result depends on the perturbation to start from. This is the one that grows most over just these
steps: the exponent is the logarithm of the largest singular value of the whole stretch's Jacobian (Abarbanel, Brown and
Kennel 1991, J. Nonlinear Sci. 1, 175-199). UF-RNN, Sec. IV-F and Fig. 6.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from ..networks import SHLSTM, HiddenState
from .picture import picture

Map = Callable[[Tensor], Tensor]
"""One step of a dynamical system: a differentiable function of a state (S,)."""
Curves = Mapping[str, Sequence[np.ndarray]]
"""For each model its largest local exponent in 1/step at each step of each demonstration, (L,) each."""
STYLES = (("#cc3311", "-"), ("#0077bb", "--"), ("#555555", "-."), ("#009988", ":"), ("#ee7733", "-"), ("#aa3377", "--"))


def exponents_over_time(network: SHLSTM, states: Sequence[HiddenState], num_steps: int) -> list[np.ndarray]:
    """Largest local exponent of the imagined future at each moment of some episodes, in 1/step, (L,) each.

    From each state that the model had, (L, hidden size) each, the closed loop runs for `num_steps`, as in foresight but
    without noise.
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
def local_lyapunov_exponent(step: Map, start: Tensor, num_steps: int) -> Tensor:
    """How fast the perturbation grows that grows most over `num_steps`, in 1/step: (M, S) -> (M,)."""

    def ahead(state: Tensor) -> Tensor:
        for _ in range(num_steps):
            state = step(state)
        return state

    jacobians = vmap(jacfwd(ahead), chunk_size=64)(start)  # (M, S, S)
    return torch.linalg.svdvals(jacobians)[:, 0].log() / num_steps


def draw(curves: Curves, phases: Mapping[str, Sequence[int]], num_steps: int, path: Path) -> None:
    """Draws mean and standard deviation over the demonstrations for each model and writes them to `path`.

    `phases` has the steps at which phases of the task begin in the demonstrations, and may be empty; `num_steps` is the
    number of imagined steps.
    """
    with picture(path, 7, 3) as figure:
        axes = figure.subplots()
        for name, starts in phases.items():
            axes.axvspan(min(starts) - 0.5, max(starts) + 0.5, color="#dddddd", linewidth=0, zorder=0)
            axes.text(float(np.mean(starts)), 1.02, name, transform=axes.get_xaxis_transform(), ha="center", fontsize=7)
        axes.axhline(0, color="black", linewidth=0.6)
        for number, (label, exponents) in enumerate(curves.items()):
            color, line = STYLES[number % len(STYLES)]
            mean, deviation = statistics(exponents)
            axes.fill_between(mean.index, mean - deviation, mean + deviation, color=color, alpha=0.2, linewidth=0)
            axes.plot(mean, color=color, linestyle=line, linewidth=1.5, label=label)
        axes.set(xlabel="step", ylabel=f"largest Lyapunov exponent\nover {num_steps} imagined steps (1/step)")
        axes.margins(x=0.01)
        axes.legend(frameon=False)


def statistics(exponents: Sequence[np.ndarray]) -> tuple[pd.Series, pd.Series]:
    """Mean and standard deviation over demonstrations of any length, by step."""
    over_time = pd.DataFrame([*exponents])  # missing where a demonstration is over
    return over_time.mean(), over_time.std(ddof=0)


def to_table(curves: Curves) -> pd.DataFrame:
    """The numbers: one row a step of a demonstration."""
    demonstrations = {
        (label, number): pd.Series(values, name="exponent")
        for label, exponents in curves.items()
        for number, values in enumerate(exponents)
    }
    return pd.concat(demonstrations, names=("model", "demonstration", "step")).reset_index()
