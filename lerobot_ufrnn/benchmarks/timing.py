"""Times several things in turns, so that a busy machine disturbs all of them alike."""

import gc
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

Clock = Callable[[], float]


@dataclass(frozen=True)
class Spread:
    """Median and middle 80 % of measured values.

    Attributes:
        median (`float`): the 50th percentile.
        low (`float`): the 10th percentile.
        high (`float`): the 90th percentile.
        count (`int`): number of values.
    """

    median: float
    low: float
    high: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Spread of at least one value."""
        low, median, high = np.percentile(values, (10, 50, 90))
        return cls(float(median), float(low), float(high), len(values))

    def text(self, scale: float = 1.0) -> str:
        """`median [low, high]` of the values times `scale`, with three digits."""
        return f"{scale * self.median:.3g} [{scale * self.low:.3g}, {scale * self.high:.3g}]"


@dataclass(frozen=True)
class Rounds:
    """Seconds that several calls took, round by round.

    Attributes:
        seconds (`dict[str, list[float]]`): name to the seconds of each round; all have the same number of rounds.
    """

    seconds: dict[str, list[float]]

    def spread(self, name: str) -> Spread:
        """Seconds of one call."""
        return Spread.of(self.seconds[name])

    def ratio(self, name: str, other: str) -> Spread:
        """How many times as long `name` took as `other`, from the pairs of each round."""
        pairs = zip(self.seconds[name], self.seconds[other], strict=True)
        return Spread.of([mine / theirs for mine, theirs in pairs])


def take_turns(
    calls: Mapping[str, Callable[[], object]],
    seconds: float,
    min_rounds: int = 3,
    warm_up: int = 1,
    clock: Clock = time.perf_counter,
) -> Rounds:
    """Calls each in turn, round after round, with the garbage collector off.

    Args:
        calls (`Mapping[str, Callable]`):
            What to time, by name.
        seconds (`float`):
            No round starts after this time.
        min_rounds (`int`, *optional*, defaults to `3`):
            Rounds that are made even if they take longer.
        warm_up (`int`, *optional*, defaults to `1`):
            Calls of each beforehand that are not counted.
        clock (`Callable`, *optional*, defaults to `time.perf_counter`):
            Seconds since some moment.

    Returns:
        `Rounds`: the time of each call in each round.
    """
    for call in calls.values():
        for _ in range(warm_up):
            call()
    taken: dict[str, list[float]] = {name: [] for name in calls}
    end = clock() + seconds
    rounds = 0
    with collector_off():
        while rounds < min_rounds or clock() < end:
            for name, call in calls.items():
                start = clock()
                call()
                taken[name].append(clock() - start)
            rounds += 1
    return Rounds(taken)


@contextmanager
def collector_off() -> Iterator[None]:
    """Collects garbage now, and not again before the end."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@contextmanager
def one_thread(pin: bool = False) -> Iterator[None]:
    """Keeps PyTorch to one thread.

    Args:
        pin (`bool`, *optional*, defaults to `False`):
            Keep, where the system can, all threads of this process to one and the same CPU, too: for others than
            PyTorch, whose own settings do not reach all their threads.
    """
    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _one_cpu() if pin else nullcontext():
            yield
    finally:
        torch.set_num_threads(num_threads)


def bind_this_thread() -> None:
    """Keeps the calling thread, and those that it starts, to the CPU that `one_thread(pin=True)` uses."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {_last_cpu()})


@contextmanager
def _one_cpu() -> Iterator[None]:
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    _bind_threads({_last_cpu()})
    try:
        yield
    finally:
        _bind_threads(allowed)


def _last_cpu() -> int:
    # The first CPU is the one that usually serves interrupts.
    return max(os.sched_getaffinity(0))


def _bind_threads(cpus: set[int]) -> None:
    for thread in Path("/proc/self/task").iterdir():
        try:
            os.sched_setaffinity(int(thread.name), cpus)
        except ProcessLookupError:  # it ended meanwhile
            continue
