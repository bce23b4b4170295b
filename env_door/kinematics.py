"""Kinematics of the arm on the MuJoCo model; importing this module imports no MuJoCo.

Inverse kinematics by damped least squares: each iteration solves, for the pose error ``e`` (position and rotation
vector, 6 values) and the Jacobian ``J``,

    dq = J^T (J J^T + damping * I)^-1 e

and clips the result to the joint limits. The damping falls with the squared error (Sugihara 2011), so that
the last iterations are exact. Steps have the smallest norm, so an arm with a spare joint moves no joint
needlessly either.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mujoco

POSITION_TOLERANCE = 1e-5  # m
ROTATION_TOLERANCE = 1e-4  # rad
DAMPING = 0.01  # per squared error; keeps steps small near singular poses
MIN_DAMPING = 1e-8
MAX_STEP = 0.3  # rad


class UnreachableError(ValueError):
    """The arm cannot bring its tool to the pose that was asked for."""


class InverseKinematics:
    """Solver for the arm whose joints are named; keeps its own `MjData`, so the simulation is never disturbed.

    Joint angles are in rad, shape `(num_joints,)`; poses of the tool are a position in m `(3,)` and a rotation matrix
    `(3, 3)` in the world frame. A pose that is not found after `max_iterations` counts as unreachable.
    """

    def __init__(self, model: "mujoco.MjModel", joints: tuple[str, ...], max_iterations: int = 200):
        import mujoco

        self._mujoco = mujoco
        self._model = model
        self._data = mujoco.MjData(model)
        self._qpos = np.array([model.joint(name).qposadr[0] for name in joints])
        self._dofs = np.array([model.joint(name).dofadr[0] for name in joints])
        self._low, self._high = np.array([model.joint(name).range for name in joints]).T
        self._site = int(model.site("tool").id)
        self._max_iterations = max_iterations

    def forward(self, joints: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pose of the tool at some joint angles."""
        self._data.qpos[self._qpos] = joints
        self._mujoco.mj_kinematics(self._model, self._data)
        return self._data.site_xpos[self._site].copy(), self._data.site_xmat[self._site].reshape(3, 3).copy()

    def jacobian(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Velocity (m/s) and angular velocity (rad/s) of the tool for each joint's speed, `(6, num_joints)`."""
        self.forward(joints)
        jacobian = np.zeros((6, self._model.nv))
        self._mujoco.mj_comPos(self._model, self._data)
        self._mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._site)
        return jacobian[:, self._dofs]

    def solve(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64], start: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Joint angles within their limits that bring the tool to a pose, on the branch of those to `start` from.

        Raises:
            UnreachableError: If no solution is found.
        """
        joints = np.array(start, dtype=np.float64)
        for _ in range(self._max_iterations):
            reached, orientation = self.forward(joints)
            error = np.concatenate([position - reached, rotation_vector(rotation @ orientation.T)])
            position_error, rotation_error = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
            if position_error < POSITION_TOLERANCE and rotation_error < ROTATION_TOLERANCE:
                return joints
            jacobian = self.jacobian(joints)
            damping = DAMPING * (error @ error) + MIN_DAMPING
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), error)
            joints = np.clip(joints + np.clip(step, -MAX_STEP, MAX_STEP), self._low, self._high)
        raise UnreachableError(
            f"the tool cannot reach position {np.round(position, 3).tolist()} m with the wanted orientation: after "
            f"{self._max_iterations} iterations it is {position_error * 1000:.1f} mm and {rotation_error:.3f} rad off; "
            "move the target closer to the middle of the workspace, or start from another pose"
        )


def rotation_vector(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axis times angle (rad) of a rotation matrix `(3, 3)`, shape `(3,)`."""
    import mujoco

    quaternion, vector = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector


def rotation_about(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Rotation matrix `(3, 3)` about a unit axis `(3,)` by an angle in rad."""
    import mujoco

    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quaternion, np.asarray(axis, dtype=np.float64), angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
