"""The door scene of `DoorEnv`, moved 2 ms at a time instead of 0.1 s."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from env_door.env import DoorEnv
from env_door.kinematics import rotation_about, rotation_vector

GRIP_FORCE = 140.0  # largest force in N with which the gripper of the scene can squeeze


class LiveDoor(DoorEnv):
    """The scene with a UR5e, for a controller that sets a new target every 2 ms.

    The targets come from the controller, which has limits of its own: those of `DoorEnv.limit_action` do not apply.
    """

    def __init__(self, kind: str = "random", door_offset: float = 0.0, hold_seconds: float = 0.0):
        super().__init__(kind=kind, arm="ur5e", door_offset=door_offset, hold_seconds=hold_seconds)
        self._dofs = np.array([self.model.joint(name).dofadr[0] for name in self.arm.joints])
        self._base, self._flange = (int(self.model.body(name).id) for name in ("base", "flange"))
        self.joint_low, self.joint_high = self._low[:-1], self._high[:-1]

    def place(self, seed: int | None, kind: str | None, keep_arm: bool) -> None:
        """Starts a trial like `reset`, and draws no picture; `keep_arm` leaves arm and fingers where they are."""
        joints, fingers = self.data.qpos[self._qpos].copy(), self.data.qpos[self._fingers].copy()
        super().reset(seed=seed, options={} if kind is None else {"kind": kind})
        if keep_arm:
            self.data.qpos[self._qpos], self.data.qpos[self._fingers] = joints, fingers
            mujoco.mj_forward(self.model, self.data)

    def _observation(self) -> dict[str, Any]:
        # The camera is a process of its own: `reset` would draw here only to throw the picture away.
        return {}

    def tick(
        self, joints: NDArray[np.float64], velocity: NDArray[np.float64], closure: float, grip_force: float
    ) -> None:
        """Moves the scene by 2 ms towards joint targets (rad, rad/s); raises a RuntimeError if the physics diverged."""
        force = min(grip_force, GRIP_FORCE)
        self.model.actuator_forcerange[self._actuators[-1]] = (-force, force)
        self._step_physics(self._control(np.append(joints, closure), np.append(velocity, 0.0)))
        self._hold_if_due()
        self._check_physics()

    @property
    def joints(self) -> NDArray[np.float64]:
        """Measured joint angles in rad, shape `(6,)`."""
        return self.data.qpos[self._qpos]

    @property
    def joint_speeds(self) -> NDArray[np.float64]:
        """Measured joint speeds in rad/s, shape `(6,)`."""
        return self.data.qvel[self._dofs]

    @property
    def joint_torques(self) -> NDArray[np.float64]:
        """Torques of the drives in N m, shape `(6,)`, gravity not counted."""
        return self.data.actuator_force[self._actuators[:-1]]

    @property
    def closure(self) -> float:
        """Measured closure of the gripper, 0 open to 1 closed."""
        return float(self.measured_joints()[-1])

    def tool_pose(self, offset: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pose in the base frame of a tool centre point in the flange's, both in m and as rotation vector, `(6,)`."""
        to_base = self.data.xmat[self._base].reshape(3, 3).T
        flange = self.data.xmat[self._flange].reshape(3, 3)
        position = self.data.xpos[self._flange] + flange @ offset[:3] - self.data.xpos[self._base]
        angle = float(np.linalg.norm(offset[3:]))
        rotation = rotation_about(offset[3:] / angle, angle) if angle > 0 else np.eye(3)
        return np.concatenate([to_base @ position, rotation_vector(to_base @ flange @ rotation)])
