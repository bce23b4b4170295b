"""Where the arm is, asked of the digital twin by the real client of `ur_rtde`, and of sockets that talk nonsense."""

import socket
import time
from types import SimpleNamespace

import numpy as np
import pytest
import teleoperators_fakes as fakes
from waiting import wait_until

from lerobot_ufrnn.teleoperators import SpaceMouseTwistConfig, arm_state
from lerobot_ufrnn.teleoperators.arm_state import RTDE_PORT, ArmState, ArmStateError


def make_arm(address, clock=time.monotonic, **settings):
    return ArmState(SpaceMouseTwistConfig(robot_ip=address, **settings), clock)


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("injection", "told"), [("freeze", r"has sent nothing for 0\.|broke"), ("drop_link", "start the command again")]
)
def test_joints_are_the_controllers_until_it_falls_silent_or_away(injection, told):
    pytest.importorskip("rtde_receive", reason="needs the extra `ur5e`")
    from env_door.twin import TwinProcess

    def agree():
        state = twin.state()["joints"]
        return np.allclose(arm.joints(), [state[name] for name in fakes.JOINTS], atol=1e-3)

    with TwinProcess(kind="push", seed=3) as twin:
        arm = make_arm(twin.address)
        arm.open()
        wait_until(agree)
        before = arm.joints()
        twin.reset("push", 4)
        wait_until(lambda: agree() and np.abs(arm.joints() - before).max() > 0.01)
        twin.inject(injection)
        with pytest.raises(ArmStateError, match=told):  # although the client goes on answering
            wait_until(lambda: arm.joints() is None, 3.0)
        arm.close()
        arm.close()


@pytest.mark.parametrize(
    ("joints", "later", "told"),
    [([0.0] * 6, 30.0, r"has sent nothing for 30\.0 s"), ([0.0] * 5, 0.1, "instead of six")],
)
def test_silence_before_the_first_look_and_nonsense_are_told_too(monkeypatch, joints, later, told):
    client = SimpleNamespace(
        getTimestamp=lambda: 1.0, getActualQ=lambda: joints, isConnected=lambda: True, disconnect=lambda: None
    )
    library = SimpleNamespace(RTDEReceiveInterface=lambda *_: client)
    monkeypatch.setattr(arm_state, "import_client", lambda _: (None, library))
    clock = fakes.Clock()
    with socket.create_server(("127.0.0.9", RTDE_PORT)):
        arm = make_arm("127.0.0.9", clock)
        arm.open()
    clock.now += later
    with pytest.raises(ArmStateError, match=told):
        arm.joints()


def test_without_a_controller_it_says_which_flag_to_look_at():
    pytest.importorskip("rtde_receive", reason="needs the extra `ur5e`")
    with pytest.raises(ArmStateError, match=r"127\.0\.0\.10:30004.*--teleop\.robot_ip"):
        make_arm("127.0.0.10").open()


@pytest.fixture
def gripper(monkeypatch):
    monkeypatch.setattr(arm_state, "TIMEOUT_SECONDS", 0.3)
    gripper = fakes.FakeGripper()
    yield gripper
    gripper.close()


@pytest.mark.parametrize(("reading", "closure"), [(3, 0.0), (0, 0.0), (230, 1.0), (255, 1.0), (117, 114 / 227)])
def test_the_grippers_target_is_read_from_its_socket(gripper, reading, closure):
    gripper.values["PRE"] = reading
    assert make_arm("127.0.0.1", gripper_port=gripper.port).gripper_target() == pytest.approx(closure)
    assert gripper.commands == ["GET PRE"]


@pytest.mark.parametrize("answer", [b"", b"?", b"POS 3", b"PRE x", b"\xff\xfe"])
def test_a_gripper_that_talks_nonsense_is_told(gripper, answer):
    gripper.answer = answer
    with pytest.raises(ArmStateError, match=r"--teleop\.gripper_port=0"):
        make_arm("127.0.0.1", gripper_port=gripper.port).gripper_target()


def test_no_gripper_counts_as_open():
    assert make_arm("127.0.0.1", gripper_port=0).gripper_target() == 0.0
