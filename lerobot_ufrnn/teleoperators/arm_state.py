"""Where the arm is, asked of its controller."""

import contextlib
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_ufrnn.robots.ur5e_robotiq.client import import_client
from lerobot_ufrnn.robots.ur5e_robotiq.gripper import closure_at

from .errors import ArmStateError

RTDE_PORT = 30004
RECEIVE_FREQUENCY = 125.0
STALE_SECONDS = 0.2
TIMEOUT_SECONDS = 2.0


class ArmState:
    """Reads joints through a connection of its own (the controller serves several), and the gripper's target.

    Args:
        robot_ip (`str`):
            Address of the controller.
        gripper_port (`int`, *optional*, defaults to `63352`):
            Port of the gripper's socket; 0 if there is none.
        gripper_range (`tuple[int, int]`, *optional*, defaults to `(3, 230)`):
            The gripper's readings when it is open and closed.
        clock (`Callable[[], float]`, *optional*, defaults to `time.monotonic`):
            Time in seconds.
    """

    def __init__(
        self,
        robot_ip: str,
        gripper_port: int = 63352,
        gripper_range: tuple[int, int] = (3, 230),
        clock: Callable[[], float] = time.monotonic,
    ):
        self._ip = robot_ip
        self._gripper_port = gripper_port
        self._gripper_range = gripper_range
        self._clock = clock
        self._receive: Any = None
        self._stamp: float | None = None
        self._stamped = 0.0

    def open(self) -> None:
        """Connects to the controller.

        Raises:
            ImportError: If `ur_rtde` is not installed; says how to install it.
            ArmStateError: If the controller cannot be reached.
        """
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
        """The measured joints.

        Returns:
            `NDArray[np.float64]`: joint angles in rad, (6,).

        Raises:
            ArmStateError: If they are not known, or not known to be recent.
        """
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
        """The gripper's target that is in force; the measured closure would loosen a grip around something.

        Returns:
            `float`: 0, open, to 1, closed; 0 without a gripper.

        Raises:
            ArmStateError: If the gripper does not answer.
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
