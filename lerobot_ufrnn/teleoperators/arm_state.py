"""Where the arm is, asked of its controller."""

import contextlib
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from lerobot.utils.errors import DeviceNotConnectedError
from numpy.typing import NDArray

from lerobot_ufrnn.robots.ur5e_robotiq.gripper import ask, closure_at
from lerobot_ufrnn.robots.ur5e_robotiq.servo import import_client

from .configuration import TwistTeleoperatorConfig

RTDE_PORT = 30004  # where the controller tells its state
RECEIVE_FREQUENCY = 125.0  # packages a second that it is asked for
STALE_SECONDS = 0.2  # without a new one after which nobody knows where the arm is
TIMEOUT_SECONDS = 2.0  # that controller and gripper may take to answer


class ArmStateError(DeviceNotConnectedError):
    """Nobody knows where the arm is, so no target for it can be called safe."""


class ArmState:
    """Reads joints through a connection of its own (the controller serves several), and the gripper's target."""

    def __init__(self, config: TwistTeleoperatorConfig, clock: Callable[[], float] = time.monotonic):
        self._config = config
        self._clock = clock
        self._receive: Any = None

    def open(self) -> None:
        """Connects to the controller; an `ImportError` or an `ArmStateError` says what that lacks."""
        ip = self._config.robot_ip
        _, rtde_receive = import_client("Teleoperating the arm")
        try:
            # The client's constructor cannot be interrupted; find out in a way that can whether anybody is there.
            socket.create_connection((ip, RTDE_PORT), TIMEOUT_SECONDS).close()
            self._receive = rtde_receive.RTDEReceiveInterface(ip, RECEIVE_FREQUENCY, ["timestamp", "actual_q"])
        except (OSError, RuntimeError) as error:
            raise ArmStateError(
                f"The arm's controller at {ip}:{RTDE_PORT} cannot be asked where the arm is ({error}): give "
                "--teleop.robot_ip the address that --robot.ip has, and see that the controller is on."
            ) from error
        # From here on, so that data which have not changed since count as old at the first look too.
        self._stamp, self._stamped = self._receive.getTimestamp(), self._clock()

    def joints(self) -> NDArray[np.float64]:
        """The measured joint angles in rad, (6,); raises an `ArmStateError` if they are not known to be recent."""
        if self._receive is None or not self._receive.isConnected():
            raise self._lost("broke the connection")
        now = self._clock()
        # The client returns its last data for ever when the controller falls silent; only the time in them tells.
        if (stamp := self._receive.getTimestamp()) != self._stamp:
            self._stamp, self._stamped = stamp, now
        if now - self._stamped > STALE_SECONDS:
            raise self._lost(f"has sent nothing for {now - self._stamped:.1f} s")
        joints = np.array(self._receive.getActualQ(), dtype=np.float64)
        if joints.shape != (6,) or not np.isfinite(joints).all():
            raise self._lost(f"sent {joints.tolist()} instead of six joint angles")
        return joints

    def gripper_target(self) -> float:
        """The gripper's target that is in force, 0, open, to 1, closed; 0 without a gripper.

        The measured closure would loosen a grip around something. A gripper that does not answer raises an
        `ArmStateError`.
        """
        ip, port = self._config.robot_ip, self._config.gripper_port
        if port == 0:
            return 0.0
        try:
            with socket.create_connection((ip, port), TIMEOUT_SECONDS) as connection:
                reading = ask(connection, "GET PRE", r"PRE\s+(\d+)")
        except OSError as error:
            raise ArmStateError(
                f"The gripper at {ip}:{port} cannot be asked for its target ({error}), and a wrong one would drop what "
                "it holds: check its cable, or say --teleop.gripper_port=0 if there is none."
            ) from error
        return closure_at(int(reading), self._config.gripper_range)

    def close(self) -> None:
        """Disconnects. Safe to call at any time."""
        if self._receive is not None:
            with contextlib.suppress(Exception):
                self._receive.disconnect()
            self._receive = None

    def _lost(self, trouble: str) -> ArmStateError:
        return ArmStateError(
            f"The arm's controller at {self._config.robot_ip} {trouble}, so nobody knows where the arm is: look at the "
            "pendant, the cable and the network, then start the command again."
        )
