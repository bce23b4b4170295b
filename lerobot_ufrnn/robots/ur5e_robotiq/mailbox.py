"""Numbers shared between two processes, of which one writes and the other reads, without a lock to die in."""

from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Mailbox:
    """The latest of a series of vectors.

    The writer fills one of two slots while the other holds the last whole vector, then counts up, which is what makes
    the new one the latest. So a writer that is stopped or killed half-way leaves neither a lock nor a broken vector
    behind, and the reader never waits for it.

    Args:
        context (`BaseContext`):
            Of the processes; the mailbox is handed over when the process starts.
        size (`int`):
            Numbers in a vector.
    """

    def __init__(self, context: BaseContext, size: int):
        self._shared: Any = context.RawArray("d", 1 + 2 * size)

    def write(self, values: NDArray[np.float64]) -> None:
        """Replaces the vector.

        Args:
            values (`NDArray[np.float64]`):
                The numbers, (size,).
        """
        count, slots = self._parts()
        number = int(count[0]) + 1
        slots[number % 2] = values
        count[0] = number

    def read(self) -> tuple[int, NDArray[np.float64]]:
        """The vector, and how many were written so far.

        Returns:
            `tuple[int, NDArray[np.float64]]`: number of writes, 0 before the first, and the numbers, (size,).
        """
        count, slots = self._parts()
        while True:
            number = int(count[0])
            values = slots[number % 2].copy()
            # Unless one more was written meanwhile, the writer was busy with the other slot at most.
            if count[0] == number:
                return number, values

    def _parts(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        numbers = np.frombuffer(self._shared)
        return numbers[:1], numbers[1:].reshape(2, -1)
