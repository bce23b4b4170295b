"""What every input device looks like to the teleoperator, and what it cannot go on from by itself."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from lerobot.utils.errors import DeviceNotConnectedError
from numpy.typing import NDArray

OPEN, CLOSE = "open", "close"
BUTTONS = (OPEN, CLOSE)
"""Buttons that mean something: the gripper opens or closes while they are held."""


class DeviceUnavailableError(ConnectionError):
    """The input device cannot be opened: a library, a permission or the device itself is missing."""


class DeviceLostError(DeviceNotConnectedError):
    """The input device was there and is gone."""


class ArmStateError(DeviceNotConnectedError):
    """Nobody knows where the arm is, so no target for it can be called safe."""


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
        """`str | None`: what is wrong with the state, if anything, so that nothing may be done with it."""
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
        """Gets ready to be read; a `DeviceUnavailableError` says what is missing."""

    @abstractmethod
    def read(self) -> DeviceState:
        """What the operator wants now, at once; at rest where the device has not been heard of lately.

        Raises a `DeviceLostError` if the device is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Lets go of the device. Safe to call at any time."""
