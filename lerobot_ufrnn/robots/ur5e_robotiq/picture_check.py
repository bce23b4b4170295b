"""Pictures that arrive in time and still show nothing: black ones, and one that never changes."""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .errors import Fault, RobotFaultError

DARK = 4.0
"""Mean of a picture, of 255, below which it shows nothing."""

WRONG_SECONDS = 1.0
"""For how long a picture must be wrong; a camera may lose a frame or adjust itself."""

MOVED = 0.05
"""Distance in rad, of any joint, that cannot leave a picture of the arm the same to the last bit."""


class PictureCheck:
    """Looks at the pictures of one camera.

    Args:
        camera (`str`):
            Its name.
        clock (`Callable[[], float]`, *optional*, defaults to `time.monotonic`):
            Time in seconds.
    """

    def __init__(self, camera: str, clock: Callable[[], float] = time.monotonic):
        self._camera = camera
        self._clock = clock
        self._dark_since: float | None = None
        self._last: NDArray[np.uint8] | None = None
        self._last_since = 0.0
        self._last_joints: NDArray[np.float64] = np.empty(0)

    def check(self, image: NDArray[np.uint8], joints: NDArray[np.float64]) -> None:
        """Looks at one picture.

        Args:
            image (`NDArray[np.uint8]`):
                The picture, (height, width, 3).
            joints (`NDArray[np.float64]`):
                Measured joints in rad, (6,).

        Raises:
            RobotFaultError: If pictures have been black, or the same although the arm moved, for a second.
        """
        now = self._clock()
        if image.mean() >= DARK:
            self._dark_since = None
        elif self._dark_since is None:
            self._dark_since = now
        elif now - self._dark_since >= WRONG_SECONDS:
            raise RobotFaultError(
                Fault.CAMERA, f"camera '{self._camera}' has been black for {now - self._dark_since:.1f} s"
            )
        if self._last is None or not np.array_equal(image, self._last):
            self._last, self._last_since, self._last_joints = image.copy(), now, joints.copy()
        elif now - self._last_since >= WRONG_SECONDS and np.abs(joints - self._last_joints).max() >= MOVED:
            raise RobotFaultError(
                Fault.CAMERA,
                f"camera '{self._camera}' has sent the same picture for {now - self._last_since:.1f} s, in which the "
                f"arm moved by {np.abs(joints - self._last_joints).max():.2f} rad",
            )
