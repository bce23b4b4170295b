"""What a teleoperator cannot go on from by itself."""

from lerobot.utils.errors import DeviceNotConnectedError


class DeviceUnavailableError(ConnectionError):
    """The input device cannot be opened: a library, a permission or the device itself is missing."""


class DeviceLostError(DeviceNotConnectedError):
    """The input device was there and is gone."""


class ArmStateError(DeviceNotConnectedError):
    """Nobody knows where the arm is, so no target for it can be called safe."""
