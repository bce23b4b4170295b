"""Numbers shared between two processes, of which one writes and the other reads, without a lock to die in."""

from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
from numpy.typing import NDArray

READ_TRIES = 1000


class Mailbox:
    """The latest of a series of vectors.

    A writer that is killed half-way leaves no lock behind, as a shared lock would: the reader sees by two counters,
    one on either side of the numbers, whether it read while they were being written, and reads again.

    Args:
        context (`BaseContext`):
            Of the processes; the mailbox is handed over when the process starts.
        size (`int`):
            Numbers in a vector.
    """

    def __init__(self, context: BaseContext, size: int):
        self._shared: Any = context.RawArray("d", size + 2)

    def write(self, values: NDArray[np.float64]) -> None:
        """Replaces the vector.

        Args:
            values (`NDArray[np.float64]`):
                The numbers, (size,).
        """
        numbers = np.frombuffer(self._shared)
        count = numbers[0] + 1
        numbers[0] = count
        numbers[1:-1] = values
        numbers[-1] = count

    def read(self) -> tuple[int, NDArray[np.float64]]:
        """The vector, and how many were written so far.

        Returns:
            `tuple[int, NDArray[np.float64]]`: number of writes, 0 before the first, and the numbers, (size,).

        Raises:
            RuntimeError: If the writer was stopped while it wrote.
        """
        numbers = np.frombuffer(self._shared)
        for _ in range(READ_TRIES):
            after = numbers[-1]
            values = numbers[1:-1].copy()
            if numbers[0] == after:
                return int(after), values
        raise RuntimeError("The other process was stopped while it wrote; start both anew.")
