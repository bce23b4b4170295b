"""What every input device looks like to the teleoperator."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

OPEN, CLOSE = "open", "close"
BUTTONS = (OPEN, CLOSE)
"""Buttons that mean something: the gripper opens or closes while they are held."""


@dataclass(frozen=True)
class DeviceState:
    """What the operator wants at one moment.

    Args:
        twist (`NDArray[np.float64]`, *optional*):
            Deflections in -1 to 1, (6,): ahead, left and up, then about those axes by the right-hand rule (the body
            convention of ROS). At rest unless given.
        buttons (`frozenset[str]`, *optional*):
            Those of `BUTTONS` that are held.
    """

    twist: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))
    buttons: frozenset[str] = frozenset()

    def fault(self) -> str | None:
        """What is wrong with the state, if anything.

        Returns:
            `str | None`: the reason why nothing may be done with it.
        """
        if np.shape(self.twist) != (6,):
            return f"the device gave a twist of shape {np.shape(self.twist)} instead of (6,)"
        if not np.isfinite(self.twist).all():
            return f"the device gave the twist {np.asarray(self.twist).tolist()}, which is not finite"
        if unknown := set(self.buttons) - set(BUTTONS):
            return f"the device gave the buttons {sorted(unknown)}; only {', '.join(BUTTONS)} are known"
        return None


class TwistDevice(ABC):
    """An input device with six axes and gripper buttons."""

    @abstractmethod
    def open(self) -> None:
        """Gets ready to be read.

        Raises:
            DeviceUnavailableError: If the device cannot be used; says what is missing.
        """

    @abstractmethod
    def read(self) -> DeviceState:
        """The latest state, at once; at rest where the device has not been heard of lately.

        Returns:
            `DeviceState`: what the operator wants now.

        Raises:
            DeviceLostError: If the device is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Lets go of the device. Safe to call at any time."""
