"""What the controller acts on every 2 ms: the joints' targets, and the scene that follows them.

`servo` is URScript's `servoj`. The manual says that the lookahead time T projects the current position forward and
that the gain k acts on what is left to the target, which is the second-order system

    acceleration = k (target - (position + T velocity)),

with a damping ratio of T sqrt(k) / 2: 0.87 at the usual k = 300 and T = 0.1 s. A moving target is trailed by T, as
users of real arms report. Speeds and accelerations are limited; the maker does not publish its filter.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from env_door.env import DoorEnv
from env_door.kinematics import rotation_about, rotation_vector

Vector = NDArray[np.float64]

TIME_STEP = 0.002  # seconds between two targets (500 Hz, the e-Series' own rate)
MAX_ACCELERATION = 40.0  # of a joint in rad/s^2; also the largest that the client lets one ask for
STILL = 1e-3  # joint speed in rad/s below which a motion counts as stopped
GRIP_FORCE = 140.0  # largest force in N with which the gripper of the scene can squeeze


class JointMotion:
    """Joint target `position` and its `velocity` (rad, rad/s), and the one motion (`kind`) that changes them."""

    def __init__(self, low: Vector, high: Vector, max_speed: Vector):
        self._low, self._high, self._max_speed = low, high, max_speed
        self.hold(np.zeros_like(low))

    def hold(self, position: Vector) -> None:
        """Stays somewhere from now on, at once and without a motion."""
        self.position = np.array(position, dtype=np.float64)
        self.velocity = np.zeros_like(self.position)
        self.kind = "hold"

    def servo(self, target: Vector, lookahead: float, gain: float) -> None:
        """Follows a target, within the joint ranges, with a lookahead in s and a gain in 1/s^2."""
        self._goal = np.clip(target, self._low, self._high)
        self._lookahead, self._gain = lookahead, gain
        self.kind = "servo"

    def move(self, target: Vector, speed: float, acceleration: float) -> None:
        """Moves on a straight line in joint space; speed and acceleration are of the joint with the longest way."""
        self._start, self._goal = self.position, np.clip(target, self._low, self._high)
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

    def _accelerate(self, acceleration: Vector, limit: float) -> None:
        velocity = self.velocity + np.clip(acceleration, -limit, limit) * TIME_STEP
        velocity = np.clip(velocity, -self._max_speed, self._max_speed)
        self._go_to(np.clip(self.position + velocity * TIME_STEP, self._low, self._high))

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
        self._go_to(self._start + (self._goal - self._start) * (way / distance))

    def _go_to(self, position: Vector) -> None:
        self.position, self.velocity = position, (position - self.position) / TIME_STEP


class LiveDoor(DoorEnv):
    """The scene with a UR5e, moved 2 ms at a time instead of 0.1 s.

    The controller has limits of its own: those of `DoorEnv.limit_action` do not apply.
    """

    def __init__(self, kind: str = "random", door_offset: float = 0.0, hold_seconds: float = 0.0):
        super().__init__(kind=kind, arm="ur5e", door_offset=door_offset, hold_seconds=hold_seconds)
        self._dofs = np.array([self.model.joint(name).dofadr[0] for name in self.arm.joints])
        self._base, self._flange = (int(self.model.body(name).id) for name in ("base", "flange"))
        self.joint_low, self.joint_high = self._low[:-1], self._high[:-1]

    def _observation(self) -> dict[str, Any]:
        # The camera is a process of its own: `reset` would draw here only to throw the picture away.
        return {}

    def tick(self, joints: Vector, velocity: Vector, closure: float, grip_force: float) -> None:
        """Moves the scene by 2 ms towards joint targets (rad, rad/s); raises a RuntimeError if the physics diverged."""
        force = min(grip_force, GRIP_FORCE)
        self.model.actuator_forcerange[self._actuators[-1]] = (-force, force)
        self._step_physics(self._control(np.append(joints, closure), np.append(velocity, 0.0)))
        self._hold_if_due()
        self._check_physics()

    @property
    def joints(self) -> Vector:
        """Measured joint angles in rad, shape `(6,)`."""
        return self.data.qpos[self._qpos]

    @property
    def joint_speeds(self) -> Vector:
        """Measured joint speeds in rad/s, shape `(6,)`."""
        return self.data.qvel[self._dofs]

    @property
    def joint_torques(self) -> Vector:
        """Torques of the drives in N m, shape `(6,)`, gravity not counted."""
        return self.data.actuator_force[self._actuators[:-1]]

    @property
    def closure(self) -> float:
        """Measured closure of the gripper, 0 open to 1 closed."""
        return float(self.measured_joints()[-1])

    def tool_pose(self, offset: Vector) -> Vector:
        """Pose in the base frame of a tool centre point in the flange's, both in m and as rotation vector, `(6,)`."""
        to_base = self.data.xmat[self._base].reshape(3, 3).T
        flange = self.data.xmat[self._flange].reshape(3, 3)
        position = self.data.xpos[self._flange] + flange @ offset[:3] - self.data.xpos[self._base]
        angle = float(np.linalg.norm(offset[3:]))
        rotation = rotation_about(offset[3:] / angle, angle) if angle > 0 else np.eye(3)
        return np.concatenate([to_base @ position, rotation_vector(to_base @ flange @ rotation)])
