"""General-purpose registers: the letter box between a client and the program that runs on the controller."""

import time
from collections import deque
from collections.abc import Iterable

from env_door.twin.rtde_variables import NUM_REGISTERS, register

MAX_ARRIVALS = 100_000
"""How many arrivals are kept, more than 13 minutes of set-points."""


class Registers:
    """48 registers of each type and direction. As on the controller they keep their values when a client leaves.

    Attributes:
        updated (`dict[str, float]`): Controller time in s at which an input variable was last written.
        arrivals (`deque[float]`): Real time in s, `time.monotonic()`, at which the last data packages came.
        owners (`dict[str, object]`): Which connection writes an input variable; a second one is refused.
    """

    def __init__(self) -> None:
        self.input_int = [0] * NUM_REGISTERS
        self.input_double = [0.0] * NUM_REGISTERS
        self.output_int = [0] * NUM_REGISTERS
        self.output_double = [0.0] * NUM_REGISTERS
        self.updated: dict[str, float] = {}
        self.arrivals: deque[float] = deque(maxlen=MAX_ARRIVALS)
        self.owners: dict[str, object] = {}

    def write_inputs(self, values: Iterable[tuple[str, float]], now: float) -> None:
        """Takes a client's data package.

        Args:
            values (`Iterable[tuple[str, float]]`):
                Names of RTDE variables and what was written; any but an input register has no effect.
            now (`float`):
                Controller time in s.
        """
        self.arrivals.append(time.monotonic())
        for name, value in values:
            known = register(name)
            if known is not None:
                getattr(self, known[0])[known[1]] = value
                self.updated[name] = now

    def read(self, name: str) -> float:
        """Value of a register.

        Args:
            name (`str`):
                Name of the RTDE variable.

        Returns:
            `float`: an `int` for integer registers.

        Raises:
            KeyError: If the name means no register.
        """
        known = register(name)
        if known is None:
            raise KeyError(name)
        return getattr(self, known[0])[known[1]]

    def release(self, owner: object) -> None:
        """Lets other connections write what one of them wrote.

        Args:
            owner (`object`):
                The connection that has ended.
        """
        self.owners = {name: holder for name, holder in self.owners.items() if holder is not owner}
