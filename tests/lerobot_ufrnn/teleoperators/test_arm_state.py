"""Against the real client of `ur_rtde`, with the smallest controller that satisfies it."""

import multiprocessing
import socket
import threading
import time

import numpy as np
import pytest
import teleoperators_fakes as fakes
from teleoperators_controller import ADDRESS, CLOSED, ONE_PACKAGE, RUNNING, SILENT, run_controller
from waiting import wait_until

from lerobot_ufrnn.teleoperators import ArmStateError, SpaceMouseTwistConfig
from lerobot_ufrnn.teleoperators.arm_state import ArmState


def make_arm(address=ADDRESS, clock=time.monotonic, **settings):
    return ArmState(SpaceMouseTwistConfig(robot_ip=address, **settings), clock)


@pytest.fixture
def controller():
    """`joints` to be told, and `mode`. In a process of its own: the client holds the GIL while it connects."""
    pytest.importorskip("rtde_receive", reason="needs the extra `ur5e`")
    context = multiprocessing.get_context("spawn")
    joints, mode = context.Array("d", fakes.READY.tolist(), lock=False), context.Value("i", RUNNING)
    ready = context.Event()
    process = context.Process(target=run_controller, args=(joints, mode, ready), daemon=True)
    process.start()
    assert ready.wait(30)
    yield joints, mode
    process.kill()
    process.join()


def answer_gripper(answer):
    """A gripper that gives one answer; returns its port."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve():
        connection, _ = server.accept()
        assert connection.recv(64) == b"GET PRE\n"
        connection.sendall(answer)
        connection.close()
        server.close()

    threading.Thread(target=serve, daemon=True).start()
    return server.getsockname()[1]


@pytest.fixture
def arm(controller):
    """The arm of that controller, told of its joints."""
    arm = make_arm()
    arm.open()
    yield arm
    arm.close()
    arm.close()


def test_joints_are_the_controllers_and_follow_it(controller, arm):
    joints, _ = controller
    wait_until(lambda: np.array_equal(arm.joints(), fakes.READY))
    joints[2] = 1.25
    wait_until(lambda: arm.joints()[2] == 1.25)


@pytest.mark.parametrize(
    ("mode_after", "told"), [(SILENT, r"has sent nothing for 0\.|broke"), (CLOSED, "start the command again")]
)
def test_a_controller_that_falls_silent_or_away_is_told_although_the_client_goes_on_answering(
    controller, arm, mode_after, told
):
    _, mode = controller
    wait_until(lambda: np.array_equal(arm.joints(), fakes.READY))
    mode.value = mode_after
    with pytest.raises(ArmStateError, match=told):
        wait_until(lambda: arm.joints() is None, 3.0)


def test_silence_before_the_first_look_is_told_too(controller):
    _, mode = controller
    clock = fakes.Clock()
    arm = make_arm(clock=clock)
    mode.value = ONE_PACKAGE
    arm.open()
    try:
        clock.now += 30.0
        with pytest.raises(ArmStateError, match=r"has sent nothing for 30\.0 s"):
            arm.joints()
    finally:
        arm.close()


def test_without_a_controller_it_says_which_flag_to_look_at():
    pytest.importorskip("rtde_receive", reason="needs the extra `ur5e`")
    with pytest.raises(ArmStateError, match=r"127\.0\.0\.10:30004.*--teleop\.robot_ip"):
        make_arm("127.0.0.10").open()


@pytest.mark.parametrize(("reading", "closure"), [(3, 0.0), (0, 0.0), (230, 1.0), (255, 1.0), (117, 114 / 227)])
def test_the_grippers_target_is_read_from_its_socket(reading, closure):
    arm = make_arm("127.0.0.1", gripper_port=answer_gripper(f"PRE {reading}".encode()))
    assert arm.gripper_target() == pytest.approx(closure)


@pytest.mark.parametrize("answer", [b"", b"?", b"POS 3", b"PRE x", b"\xff\xfe"])
def test_a_gripper_that_talks_nonsense_is_told(answer):
    with pytest.raises(ArmStateError, match=r"--teleop\.gripper_port=0"):
        make_arm("127.0.0.1", gripper_port=answer_gripper(answer)).gripper_target()


def test_no_gripper_counts_as_open():
    assert make_arm("127.0.0.1", gripper_port=0).gripper_target() == 0.0
