"""How the time of forward and backward pass grows with N, T, batch, L and hidden size."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from .timing import Spread, one_thread, take_turns
from .update import Problem, torch_loss

TOLERANCE = 0.1
"""Largest relative distance of a point from the straight line that still counts as linear."""

SIZES: dict[str, tuple[float, ...]] = {
    "N": (1, 2, 5, 10, 20),
    "T": (1, 5, 10, 20, 40),
    "batch": (1, 2, 5, 10, 20),
    "L": (50, 100, 149, 300, 600),
    "hidden size": (0.5, 1, 2, 4),
}
"""What is varied, one at a time around the paper's sizes; hidden sizes as multiples of the paper's."""


@dataclass(frozen=True)
class Growth:
    """Times for several sizes.

    Attributes:
        name (`str`): what was varied.
        sizes (`tuple[float, ...]`): its values, rising; at least three.
        seconds (`tuple[Spread, ...]`): time of a forward and backward pass for each.
    """

    name: str
    sizes: tuple[float, ...]
    seconds: tuple[Spread, ...]

    @property
    def exponent(self) -> float:
        """`float`: slope of log time over log size for the three largest sizes."""
        slope, _ = np.polyfit(np.log(self.sizes[-3:]), np.log(self._medians[-3:]), 1)
        return float(slope)

    @property
    def residuals(self) -> np.ndarray:
        """`np.ndarray`: relative distance of each time from the best `fixed + marginal * size`."""
        sizes, times = np.array(self.sizes), self._medians
        # Divided by the times, so that a small time counts as much as a large one.
        columns = np.stack((1 / times, sizes / times), axis=1)
        line, *_ = np.linalg.lstsq(columns, np.ones_like(times), rcond=None)
        return 1 - columns @ line

    @property
    def verdict(self) -> str:
        """`str`: `linear` if the marginal cost is constant, else `less than linear` or `more than linear`."""
        residuals = self.residuals
        if np.abs(residuals).max() <= TOLERANCE:
            return "linear"
        quadratic = np.polyfit(self.sizes, self._medians, 2, w=1 / self._medians)[0]
        return "more than linear" if quadratic > 0 else "less than linear"

    @property
    def _medians(self) -> np.ndarray:
        return np.array([spread.median for spread in self.seconds])


def resize(problem: Problem, name: str, size: float) -> Problem:
    """A problem in which one of `SIZES` is set.

    Raises:
        ValueError: If `name` is none of them.
    """
    config = problem.config
    if name == "batch":
        return replace(problem, batch_size=int(size))
    if name == "L":
        return replace(problem, length=int(size))
    if name == "N":
        return replace(problem, config=replace(config, num_samples=int(size)))
    if name == "T":
        return replace(problem, config=replace(config, horizon=int(size)))
    if name == "hidden size":
        resized = replace(
            config,
            joint_hidden_dim=int(size * config.joint_hidden_dim),
            image_hidden_dim=int(size * config.image_hidden_dim),
            shared_hidden_dim=int(size * config.shared_hidden_dim),
        )
        return replace(problem, config=resized)
    raise ValueError(f"Nothing is called {name!r}; there are {list(SIZES)}.")


def measure_growth(
    seconds: float = 60.0, problem: Problem | None = None, sizes: dict[str, Sequence[float]] | None = None
) -> list[Growth]:
    """Times forward and backward pass of the fast kernel on one thread, the sizes of each kind in turns.

    Args:
        seconds (`float`, *optional*, defaults to `60.0`):
            Time to measure for, shared by all kinds of size.
        problem (`Problem`, *optional*):
            What is varied; the paper's sizes when not given.
        sizes (`dict[str, Sequence[float]]`, *optional*):
            What to vary; `SIZES` when not given.

    Returns:
        `list[Growth]`: one for each kind of size.
    """
    problem, sizes = problem or Problem(), dict(sizes or SIZES)
    growths = []
    with one_thread():
        for name, values in sizes.items():
            calls = {str(value): _pass(resize(problem, name, value)) for value in values}
            rounds = take_turns(calls, seconds / len(sizes))
            growths.append(Growth(name, tuple(values), tuple(rounds.spread(str(value)) for value in values)))
    return growths


def _pass(problem: Problem) -> Callable[[], None]:
    model = problem.make_model()
    episodes = problem.make_episodes()
    generator = torch.Generator().manual_seed(0)

    def forward_and_backward() -> None:
        model.zero_grad()
        torch_loss(model, *episodes, generator).backward()

    return forward_and_backward
