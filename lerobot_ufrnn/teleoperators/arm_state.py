"""Where the arm is, asked of its controller."""

import contextlib
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_ufrnn.robots.ur5e_robotiq.gripper import closure_at
from lerobot_ufrnn.robots.ur5e_robotiq.servo import import_client

from .configuration import TwistTeleoperatorConfig
from .device import ArmStateError

RTDE_PORT = 30004
"""Where the controller tells its state."""

RECEIVE_FREQUENCY = 125.0
"""Packages a second that it is asked for."""

STALE_SECONDS = 0.2
"""Time without a new one after which nobody knows where the arm is."""

TIMEOUT_SECONDS = 2.0
"""Time that controller and gripper may take to answer."""


class ArmState:
    """Reads joints through a connection of its own (the controller serves several), and the gripper's target."""

    def __init__(self, config: TwistTeleoperatorConfig, clock: Callable[[], float] = time.monotonic):
        self._ip = config.robot_ip
        self._gripper_port = config.gripper_port
        self._gripper_range = config.gripper_range
        self._clock = clock
        self._receive: Any = None
        self._stamp: float | None = None
        self._stamped = 0.0

    def open(self) -> None:
        """Connects to the controller; an `ImportError` or an `ArmStateError` says what that lacks."""
        _, rtde_receive, _ = import_client("Teleoperating the arm")
        try:
            # The client's constructor cannot be interrupted; find out in a way that can whether anybody is there.
            socket.create_connection((self._ip, RTDE_PORT), TIMEOUT_SECONDS).close()
            self._receive = rtde_receive.RTDEReceiveInterface(self._ip, RECEIVE_FREQUENCY, ["timestamp", "actual_q"])
        except (OSError, RuntimeError) as error:
            raise ArmStateError(
                f"The arm's controller at {self._ip}:{RTDE_PORT} cannot be asked where the arm is ({error}): give "
                "--teleop.robot_ip the address that --robot.ip has, and see that the controller is on."
            ) from error
        # From here on, so that data which have not changed since count as old at the first look too.
        self._stamp, self._stamped = self._receive.getTimestamp(), self._clock()

    def joints(self) -> NDArray[np.float64]:
        """The measured joint angles in rad, (6,); raises an `ArmStateError` if they are not known to be recent."""
        if self._receive is None or not self._receive.isConnected():
            raise ArmStateError(
                f"The connection to the arm's controller at {self._ip} broke, so nobody knows where the arm is: "
                "check the cable, look at the pendant and start the command again."
            )
        now = self._clock()
        # The client returns its last data for ever when the controller falls silent; only the time in them tells.
        stamp = self._receive.getTimestamp()
        if stamp != self._stamp:
            self._stamp, self._stamped = stamp, now
        if now - self._stamped > STALE_SECONDS:
            raise ArmStateError(
                f"The arm's controller at {self._ip} has sent nothing for {now - self._stamped:.1f} s, so nobody knows "
                "where the arm is: look at the pendant and the network, then start the command again."
            )
        joints = np.array(self._receive.getActualQ(), dtype=np.float64)
        if joints.shape != (6,) or not np.isfinite(joints).all():
            raise ArmStateError(
                f"The arm's controller at {self._ip} sent {joints.tolist()} instead of six joint angles."
            )
        return joints

    def gripper_target(self) -> float:
        """The gripper's target that is in force, 0, open, to 1, closed; 0 without a gripper.

        The measured closure would loosen a grip around something. A gripper that does not answer raises an
        `ArmStateError`.
        """
        if self._gripper_port == 0:
            return 0.0
        try:
            with socket.create_connection((self._ip, self._gripper_port), TIMEOUT_SECONDS) as connection:
                connection.settimeout(TIMEOUT_SECONDS)
                connection.sendall(b"GET PRE\n")
                answer = connection.recv(64).decode(errors="replace").split()
            if len(answer) != 2 or answer[0] != "PRE" or not answer[1].isdigit():
                raise ValueError(f"it answered {' '.join(answer)!r} to GET PRE")
        except (OSError, ValueError) as error:
            raise ArmStateError(
                f"The gripper at {self._ip}:{self._gripper_port} cannot be asked for its target ({error}), and a wrong "
                "one would drop what it holds: check its cable, or say --teleop.gripper_port=0 if there is none."
            ) from error
        return closure_at(int(answer[1]), self._gripper_range)

    def close(self) -> None:
        """Disconnects. Safe to call at any time."""
        if self._receive is not None:
            with contextlib.suppress(Exception):
                self._receive.disconnect()
            self._receive = None
