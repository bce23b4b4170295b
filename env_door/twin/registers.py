"""General-purpose registers: the letter box between a client and the program that runs on the controller."""

from env_door.twin.rtde_variables import NUM_REGISTERS, register


class Registers:
    """48 registers of each type and direction. As on the controller they keep their values when a client leaves.

    Attributes:
        updated (`dict[str, float]`): Controller time in s at which an input variable was last written.
        owners (`dict[str, object]`): Which connection writes an input variable; a second one is refused.
    """

    def __init__(self) -> None:
        self.input_int = [0] * NUM_REGISTERS
        self.input_double = [0.0] * NUM_REGISTERS
        self.output_int = [0] * NUM_REGISTERS
        self.output_double = [0.0] * NUM_REGISTERS
        self.updated: dict[str, float] = {}
        self.owners: dict[str, object] = {}

    def write_input(self, name: str, value: float, time: float) -> None:
        """Takes one variable of a client's data package.

        Args:
            name (`str`):
                Name of the RTDE variable; any but an input register has no effect.
            value (`float`):
                What was written.
            time (`float`):
                Controller time in s.
        """
        known = register(name)
        if known is not None:
            getattr(self, known[0])[known[1]] = value
            self.updated[name] = time

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
