import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from env_door.env import GRASP_ROTATION
from env_door.kinematics import InverseKinematics, UnreachableError, rotation_about, rotation_vector
from env_door.scene import ARMS, PANDA, UR5E, load_model

MODELS = {arm.name: load_model(arm.name) for arm in ARMS.values()}
SOLVERS = {arm.name: InverseKinematics(MODELS[arm.name], arm.joints) for arm in ARMS.values()}
every_arm = pytest.mark.parametrize("arm", ARMS.values(), ids=lambda arm: arm.name)
half_turn = np.pi / 2


def along(translation, axis, angle):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    pose[:3, 3] = translation
    return pose


def ur5e_forward(joints):
    """Tool pose from Universal Robots' published Denavit-Hartenberg table, without MuJoCo."""
    lengths = (0.1625, 0, 0, 0.1333, 0.0997, 0.0996 + 0.15), (0, -0.425, -0.3922, 0, 0, 0)
    pose = along([0, -0.06, 0.5], "X", 0)
    for theta, d, a, alpha in zip(joints, *lengths, (half_turn, 0, 0, half_turn, -half_turn, 0), strict=True):
        pose = pose @ along([0, 0, d], "Z", theta) @ along([a, 0, 0], "X", alpha)
    return pose


def panda_forward(joints):
    """Tool pose from Franka's published (modified) Denavit-Hartenberg table, without MuJoCo."""
    lengths = (0.333, 0, 0.316, 0, 0.384, 0, 0, 0.107 + 0.15), (0, 0, 0, 0.0825, -0.0825, 0, 0.088, 0)
    turns = (0, -half_turn, half_turn, half_turn, -half_turn, half_turn, half_turn, 0)
    pose = along([0.11, -0.05, 0.1], "X", 0)
    for theta, d, a, alpha in zip((*joints, 0.0), *lengths, turns, strict=True):
        pose = pose @ along([a, 0, 0], "X", alpha) @ along([0, 0, d], "Z", theta)
    return pose


@pytest.mark.parametrize(("arm", "oracle"), [(UR5E, ur5e_forward), (PANDA, panda_forward)])
def test_forward_kinematics_is_the_published_one(arm, oracle):
    rng = np.random.default_rng(0)
    for _ in range(20):
        joints = rng.uniform(-1.5, 1.5, len(arm.joints))
        position, rotation = SOLVERS[arm.name].forward(joints)
        expected = oracle(joints)
        np.testing.assert_allclose(position, expected[:3, 3], atol=1e-6)
        np.testing.assert_allclose(rotation, expected[:3, :3], atol=1e-6)


@every_arm
@settings(max_examples=30, deadline=None, derandomize=True)
@given(shift=st.tuples(*[st.floats(-0.06, 0.06)] * 3), twist=st.floats(0.0, 0.95))
def test_solution_reaches_the_pose_within_limits(arm, shift, twist):
    solver = SOLVERS[arm.name]
    position = np.array([0.60, 0.0, 0.95]) + shift
    rotation = Rotation.from_euler("X", twist).as_matrix() @ GRASP_ROTATION
    joints = solver.solve(position, rotation, np.array(arm.ready_pose))
    reached, orientation = solver.forward(joints)
    np.testing.assert_allclose(reached, position, atol=2e-5)
    np.testing.assert_allclose(orientation, rotation, atol=2e-4)
    low, high = np.array([MODELS[arm.name].joint(name).range for name in arm.joints]).T
    assert ((low <= joints) & (joints <= high)).all()


@every_arm
def test_out_of_reach_is_told(arm):
    with pytest.raises(UnreachableError, match="cannot reach"):
        SOLVERS[arm.name].solve(np.array([3.0, 0.0, 1.0]), GRASP_ROTATION, np.array(arm.ready_pose))


def test_joint_limits_make_a_pose_unreachable():
    model, pose = load_model("ur5e"), (np.array([0.6, 0, 0.95]), GRASP_ROTATION, np.array(UR5E.ready_pose))
    free = InverseKinematics(model, UR5E.joints).solve(*pose)
    model.joint("elbow").range = [free[2] + 0.1, 3.1]
    with pytest.raises(UnreachableError):
        InverseKinematics(model, UR5E.joints).solve(*pose)


@every_arm
def test_jacobian_is_the_slope_of_the_forward_kinematics(arm):
    solver, joints = SOLVERS[arm.name], np.array(arm.ready_pose)
    jacobian = solver.jacobian(joints)
    assert jacobian.shape == (6, len(joints))
    for index, column in enumerate(jacobian.T):
        step = 1e-5 * np.eye(len(joints))[index]
        (ahead, turned), (behind, _) = solver.forward(joints + step), solver.forward(joints - step)
        turn = Rotation.from_matrix(turned @ solver.forward(joints - step)[1].T).as_rotvec()
        np.testing.assert_allclose(column, np.append(ahead - behind, turn) / 2e-5, atol=1e-6)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.tuples(*[st.floats(-1.7, 1.7)] * 3))
def test_rotations_are_scipys(vector):
    matrix = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_vector(matrix), vector, atol=1e-7)
    if (angle := np.linalg.norm(vector)) > 1e-6:
        np.testing.assert_allclose(rotation_about(np.array(vector) / angle, angle), matrix, atol=1e-12)
