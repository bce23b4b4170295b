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

POSITION_TOLERANCE = 1e-5
ROTATION_TOLERANCE = 1e-4
MIN_DAMPING = 1e-8


class UnreachableError(ValueError):
    """The arm cannot bring its tool to the pose that was asked for."""


class InverseKinematics:
    """Solver for one arm; keeps its own `MjData`, so the simulation is never disturbed.

    Args:
        model (`mujoco.MjModel`):
            The scene.
        joints (`tuple[str, ...]`):
            Names of the arm's joints.
        damping (`float`, *optional*, defaults to `0.01`):
            Damping per squared error; keeps steps small near singular poses.
        max_iterations (`int`, *optional*, defaults to `200`):
            Iterations after which a pose counts as unreachable.
    """

    def __init__(
        self, model: "mujoco.MjModel", joints: tuple[str, ...], damping: float = 0.01, max_iterations: int = 200
    ):
        import mujoco

        self._mujoco = mujoco
        self._model = model
        self._data = mujoco.MjData(model)
        self._qpos = np.array([model.joint(name).qposadr[0] for name in joints])
        self._dofs = np.array([model.joint(name).dofadr[0] for name in joints])
        self._ranges = np.array([model.joint(name).range for name in joints])
        self._site = int(model.site("tool").id)
        self._damping = damping
        self._max_iterations = max_iterations

    def forward(self, joints: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pose of the tool at some joint angles.

        Args:
            joints (`NDArray[np.float64]`):
                Joint angles in rad, shape `(num_joints,)`.

        Returns:
            `tuple[NDArray, NDArray]`: position in m `(3,)` and rotation matrix `(3, 3)` in the world frame.
        """
        self._data.qpos[self._qpos] = joints
        self._mujoco.mj_kinematics(self._model, self._data)
        return self._data.site_xpos[self._site].copy(), self._data.site_xmat[self._site].reshape(3, 3).copy()

    def jacobian(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Velocity (m/s) and angular velocity (rad/s) of the tool, in the world frame, for each joint's speed.

        Args:
            joints (`NDArray[np.float64]`):
                Joint angles in rad, shape `(num_joints,)`.

        Returns:
            `NDArray[np.float64]`: the Jacobian, shape `(6, num_joints)`.
        """
        self.forward(joints)
        return self._jacobian_here()

    def solve(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64], start: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Joint angles that bring the tool to a pose.

        Args:
            position (`NDArray[np.float64]`):
                Wanted tool position in m, shape `(3,)`, world frame.
            rotation (`NDArray[np.float64]`):
                Wanted tool rotation matrix, shape `(3, 3)`.
            start (`NDArray[np.float64]`):
                Joint angles in rad from which to search; the solution stays on their branch.

        Returns:
            `NDArray[np.float64]`: joint angles in rad, within the joint limits.

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
            jacobian = self._jacobian_here()
            damping = self._damping * (error @ error) + MIN_DAMPING
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), error)
            joints = np.clip(joints + np.clip(step, -0.3, 0.3), self._ranges[:, 0], self._ranges[:, 1])
        raise UnreachableError(
            f"the tool cannot reach position {np.round(position, 3).tolist()} m with the wanted orientation: after "
            f"{self._max_iterations} iterations it is {position_error * 1000:.1f} mm and {rotation_error:.3f} rad off; "
            "move the target closer to the middle of the workspace, or start from another pose"
        )

    def _jacobian_here(self) -> NDArray[np.float64]:
        jacobian = np.zeros((6, self._model.nv))
        self._mujoco.mj_comPos(self._model, self._data)
        self._mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._site)
        return jacobian[:, self._dofs]


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
