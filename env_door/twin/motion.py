"""How the controller turns commands into joint targets, one every 2 ms.

`servo` is URScript's `servoj`. The manual says that the lookahead time T projects the current position forward and
that the gain k acts on what is left to the target, which is the second-order system

    acceleration = k (target - (position + T velocity)),

with a damping ratio of T sqrt(k) / 2: 0.87 at the usual k = 300 and T = 0.1 s. A moving target is trailed by T, as
users of real arms report. Speeds and accelerations are limited; the maker does not publish its filter.
"""

import math

import numpy as np
from numpy.typing import NDArray

TIME_STEP = 0.002  # seconds between two targets (500 Hz, the e-Series' own rate)
MAX_ACCELERATION = 40.0  # of a joint in rad/s^2; also the largest that the client lets one ask for
STILL = 1e-3  # joint speed in rad/s below which a motion counts as stopped


class JointMotion:
    """The joint target, its velocity (rad, rad/s), and the one motion that changes them.

    Attributes:
        kind (`str`): `"hold"`, `"servo"`, `"move"` or `"stop"`.
    """

    def __init__(self, low: NDArray[np.float64], high: NDArray[np.float64], max_speed: NDArray[np.float64]):
        self._low, self._high, self._max_speed = low, high, max_speed
        self.hold(np.zeros_like(low))

    def hold(self, position: NDArray[np.float64]) -> None:
        """Stays somewhere from now on, at once and without a motion."""
        self.position = np.array(position, dtype=np.float64)
        self.velocity = np.zeros_like(self.position)
        self.kind = "hold"

    def servo(self, target: NDArray[np.float64], lookahead: float, gain: float) -> None:
        """Follows a target, within the joint ranges, with a lookahead in s and a gain in 1/s^2."""
        self._goal = np.clip(target, self._low, self._high)
        self._lookahead, self._gain = lookahead, gain
        self.kind = "servo"

    def move(self, target: NDArray[np.float64], speed: float, acceleration: float) -> None:
        """Moves on a straight line in joint space; speed and acceleration are of the joint with the longest way."""
        self._start, self._goal = self.position.copy(), np.clip(target, self._low, self._high)
        self._distance = float(np.abs(self._goal - self._start).max())
        self._acceleration = min(max(acceleration, 1e-3), MAX_ACCELERATION)
        # A short way never reaches the speed that was asked for.
        reachable = math.sqrt(self._distance * self._acceleration)
        self._cruise = min(max(speed, 1e-3), float(self._max_speed.min()), reachable)
        self._elapsed = 0.0
        self.kind = "move" if self._distance > 0 else "hold"

    def stop(self, deceleration: float) -> None:
        """Brakes each joint."""
        self._acceleration = min(max(deceleration, 0.1), MAX_ACCELERATION)
        self.kind = "hold" if not self.velocity.any() else "stop"

    def step(self) -> None:
        """Goes on by 2 ms."""
        if self.kind == "servo":
            ahead = self.position + self._lookahead * self.velocity
            self._accelerate(self._gain * (self._goal - ahead), MAX_ACCELERATION)
        elif self.kind == "stop":
            self._accelerate(-self.velocity / TIME_STEP, self._acceleration)
            if np.abs(self.velocity).max() < STILL:
                self.hold(self.position)
        elif self.kind == "move":
            self._follow_trapezoid()

    def _accelerate(self, acceleration: NDArray[np.float64], limit: float) -> None:
        velocity = self.velocity + np.clip(acceleration, -limit, limit) * TIME_STEP
        velocity = np.clip(velocity, -self._max_speed, self._max_speed)
        position = np.clip(self.position + velocity * TIME_STEP, self._low, self._high)
        self.velocity = (position - self.position) / TIME_STEP
        self.position = position

    def _follow_trapezoid(self) -> None:
        self._elapsed += TIME_STEP
        speed, acceleration, distance = self._cruise, self._acceleration, self._distance
        ramp = speed / acceleration
        total = distance / speed + ramp
        if self._elapsed >= total:
            self.hold(self._goal)
            return
        if self._elapsed < ramp:
            way = 0.5 * acceleration * self._elapsed**2
        elif self._elapsed < total - ramp:
            way = speed * (self._elapsed - 0.5 * ramp)
        else:
            way = distance - 0.5 * acceleration * (total - self._elapsed) ** 2
        position = self._start + (self._goal - self._start) * (way / distance)
        self.velocity = (position - self.position) / TIME_STEP
        self.position = position
