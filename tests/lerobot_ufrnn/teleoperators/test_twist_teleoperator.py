import numpy as np
import pytest
import teleoperators_fakes as fakes
from lerobot.teleoperators import TeleoperatorConfig, make_teleoperator_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from env_door.env import GRASP_ROTATION
from lerobot_ufrnn.teleoperators import KeyboardTwist, SpaceMouseTwist, SpaceMouseTwistConfig, twist_teleoperator
from lerobot_ufrnn.teleoperators.arm_state import ArmStateError
from lerobot_ufrnn.teleoperators.device import DeviceLostError, DeviceState, DeviceUnavailableError

AHEAD = np.array([1.0, 0, 0, 0, 0, 0])


class ScriptedDevice:
    """Gives what a test put into `state`; whatever is asked of it fails with `fault`, if there is one."""

    def __init__(self):
        self.state, self.is_open, self.fault = DeviceState(), False, None

    def open(self):
        self._fail()
        self.is_open = True

    def read(self):
        self._fail()
        return self.state

    def close(self):
        self.is_open = False
        self._fail()

    def _fail(self):
        if self.fault is not None:
            raise self.fault


class Rig:
    """A teleoperator with a device, an arm and a clock that the test moves."""

    def __init__(self, folder):
        self.arm, self.clock, self.device = fakes.FakeArmState(), fakes.Clock(), ScriptedDevice()
        self._folder = folder

    def connect(self, **fields):
        config = SpaceMouseTwistConfig(robot_ip="192.0.2.1", calibration_dir=self._folder, **fields)
        self.teleop = make_teleoperator_from_config(config)
        self.teleop.connect()
        return self.teleop

    def start(self, **fields):
        """Connects and asks for the first action."""
        self.connect(**fields)
        return self.tick()

    def tick(self, twist=None, buttons=(), seconds=0.1, follow=True):
        """One action after some seconds; the arm is there at once."""
        self.clock.now += seconds
        if twist is not None:
            self.device.state = DeviceState(np.array(twist, dtype=np.float64), frozenset(buttons))
        action = self.teleop.get_action()
        joints = np.array([action[name] for name in fakes.FEATURES[:-1]])
        if follow:
            self.arm.measured = joints
        return joints, action["gripper.pos"]


@pytest.fixture
def rig(monkeypatch, tmp_path):
    rig = Rig(tmp_path)
    monkeypatch.setattr(twist_teleoperator, "ArmState", lambda *_: rig.arm)
    monkeypatch.setattr(twist_teleoperator, "monotonic", rig.clock)
    monkeypatch.setattr(SpaceMouseTwist, "make_own_device", lambda _: rig.device)
    return rig


@pytest.mark.parametrize("kind", [SpaceMouseTwist, KeyboardTwist])
def test_lerobot_makes_both_from_their_configurations(tmp_path, kind):
    config_class = TeleoperatorConfig.get_choice_class(kind.name)
    teleop = make_teleoperator_from_config(config_class(robot_ip="192.0.2.1", calibration_dir=tmp_path))
    assert type(teleop) is kind
    assert teleop.config.type == teleop.name == kind.name in ("spacemouse_twist", "keyboard_twist")
    assert list(teleop.action_features) == fakes.FEATURES
    assert (teleop.feedback_features, teleop.is_calibrated, teleop.is_connected) == ({}, True, False)


@pytest.mark.parametrize("gripper", [0.0, 0.62])
@pytest.mark.parametrize("joints", [fakes.READY, fakes.READY + 0.2, [0.3, -1.2, 1.9, -0.5, -1.5, 3.0]])
def test_the_first_action_is_where_the_arm_is_whatever_the_device_says(rig, joints, gripper):
    rig.connect()
    # As late as the robot needs to connect, and perhaps to be moved by hand, after the teleoperator did.
    rig.arm.measured, rig.arm.gripper = np.array(joints), gripper
    action, closure = rig.tick(np.ones(6), ["close"], seconds=20)
    np.testing.assert_array_equal(action, joints)
    assert closure == gripper


def test_after_a_pause_it_starts_from_where_the_arm_is(rig):
    rig.start()
    rig.tick(AHEAD)
    rig.arm.measured, rig.arm.gripper = fakes.READY + 0.03, 0.4
    joints, closure = rig.tick(AHEAD, seconds=1.01)
    np.testing.assert_array_equal(joints, rig.arm.measured)
    assert closure == 0.4


def test_a_loop_that_hangs_does_not_make_the_tool_leap(rig):
    rig.start(linear_speed=0.1)
    before = fakes.tool_pose(rig.arm.measured)[0]
    joints, _ = rig.tick(AHEAD, seconds=0.9)
    assert np.linalg.norm(fakes.tool_pose(joints)[0] - before) <= 0.1 * 0.25 + 1e-5


def test_speeds_are_those_of_the_configuration_at_any_rate_and_over_deflection_is_none(rig):
    rig.start(linear_speed=0.04, angular_speed=0.2)
    start, start_rotation = fakes.tool_pose(rig.arm.measured)
    for seconds in (0.1, 0.01, 0.05, 0.14, 0.2):
        joints, _ = rig.tick(7 * AHEAD, seconds=seconds)
    np.testing.assert_allclose(fakes.tool_pose(joints)[0] - start, [0.04 * 0.5, 0, 0], atol=3e-5)
    for _ in range(5):
        joints, _ = rig.tick([0, 0, 0, 0, 0, -1])
    turned = fakes.tool_pose(joints)[1] * start_rotation.inv()
    np.testing.assert_allclose(turned.as_rotvec(), [0, 0, -0.2 * 0.5], atol=3e-4)


@pytest.mark.parametrize("frame", ["base", "tool"])
@pytest.mark.parametrize("twist", [*np.eye(6), *-np.eye(6)])
def test_each_axis_moves_the_tool_along_or_about_itself_and_nothing_else(rig, frame, twist):
    rig.start(frame=frame, linear_speed=0.05, angular_speed=0.3)
    start, start_rotation = fakes.tool_pose(rig.arm.measured)
    for count in range(1, 11):
        joints, _ = rig.tick(twist)
        position, rotation = fakes.tool_pose(joints)
        # The tool's own axes: z ahead, y to the right, x up.
        x, y, z = start_rotation.as_matrix().T
        axis = (np.stack([z, -y, x]).T if frame == "tool" else np.eye(3)) @ (twist[:3] + twist[3:])
        np.testing.assert_allclose(position - start, axis * 0.005 * count * any(twist[:3]), atol=5e-5)
        turned = (rotation * start_rotation.inv()).as_rotvec()
        np.testing.assert_allclose(turned, axis * 0.03 * count * any(twist[3:]), atol=5e-4)


def test_with_the_gripper_level_both_frames_are_one():
    np.testing.assert_array_equal(fakes.LEVEL, GRASP_ROTATION)
    np.testing.assert_array_equal(fakes.LEVEL @ twist_teleoperator.TOOL_FROM_OPERATOR, np.eye(3))


def test_buttons_move_the_gripper_while_they_are_held(rig):
    rig.start(gripper_speed=2.0)
    closures = [rig.tick(buttons=buttons, twist=np.zeros(6))[1] for buttons in [["close"]] * 6 + [["open"]] * 2]
    np.testing.assert_allclose(closures, [0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 0.8, 0.6])
    assert rig.tick(np.zeros(6), ["open", "close"])[1] == pytest.approx(0.6)


def test_nonsense_from_the_device_holds_the_arm_and_is_told_once(rig, caplog):
    rig.start()
    for nonsense in ([np.nan, 0, 0, 0, 0, 0], [np.inf, 0, 0, 0, 0, 0], np.ones(5)):
        for _ in range(5):
            joints, closure = rig.tick(nonsense, ["close"])
            np.testing.assert_array_equal(joints, fakes.READY)
            assert closure == 0.0
    assert ["The arm holds" in message for message in caplog.messages] == [True]
    joints, _ = rig.tick(AHEAD)
    assert (joints != fakes.READY).any()


def test_a_hindrance_is_told_once_and_again_after_it_was_over(rig, caplog):
    rig.start()
    for _ in range(50):
        rig.tick(AHEAD, follow=False)
    assert ["does not follow" in message for message in caplog.messages] == [True]
    for _ in range(25):
        rig.tick(np.zeros(6), follow=False)
    for _ in range(10):
        rig.tick(AHEAD, follow=False)
    assert len(caplog.messages) == 2


def test_a_lost_device_or_arm_ends_it_and_disconnecting_does_not_fail_so_that_the_robot_is_stopped_next(rig):
    teleop = rig.connect()
    rig.tick()
    rig.device.fault = DeviceLostError("gone")
    with pytest.raises(DeviceLostError, match="gone"):
        rig.tick()
    rig.arm.fault = ArmStateError("nobody knows")
    with pytest.raises(ArmStateError, match="nobody knows"):
        rig.tick()
    teleop.disconnect()
    assert (teleop.is_connected, rig.device.is_open, rig.arm.is_open) == (False, False, False)


def test_a_device_that_cannot_be_opened_leaves_nothing_open(rig):
    rig.device.fault = DeviceUnavailableError("not plugged in")
    with pytest.raises(DeviceUnavailableError, match="not plugged in"):
        rig.connect()
    assert (rig.teleop.is_connected, rig.arm.is_open) == (False, False)


def test_it_wants_to_be_connected_once(rig):
    teleop = rig.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        teleop.connect()
    teleop.disconnect()
    for call in (teleop.get_action, teleop.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            call()
    teleop.connect()
    np.testing.assert_array_equal(rig.tick()[0], rig.arm.measured)


def test_the_oracle_of_these_tests_is_the_published_zero_pose():
    position, _ = fakes.tool_pose(np.zeros(6))
    np.testing.assert_allclose(position, [-0.8172, -0.1333 - 0.2496, 0.1625 - 0.0997], atol=1e-12)
