"""Arm, gripper and device without hardware, a clock that a test moves, and the UR5e's kinematics without MuJoCo."""

import contextlib
import socket
import threading

import numpy as np
from scipy.spatial.transform import Rotation

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
FEATURES = [f"{name}.pos" for name in (*JOINTS, "gripper")]
READY = np.array([2.80, -1.60, 1.57, 0.03, 1.23, 1.57])
LEVEL = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # orientation of a level tool: z ahead, x up


def tool_pose(joints):
    """Position and rotation of the tool by Universal Robots' published Denavit-Hartenberg table."""
    offsets, lengths = (0.1625, 0, 0, 0.1333, 0.0997, 0.0996 + 0.15), (0, -0.425, -0.3922, 0, 0, 0)
    twists = (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0)
    position, rotation = np.zeros(3), Rotation.identity()
    for angle, offset, length, twist in zip(joints, offsets, lengths, twists, strict=True):
        turn = rotation * Rotation.from_euler("z", angle)
        position = position + turn.apply([length, 0, offset])
        rotation = turn * Rotation.from_euler("x", twist)
    return position, rotation


class Clock:
    """Seconds that pass when a test says so."""

    def __init__(self):
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class FakeArmState:
    """Stands in for `ArmState`; asked for its joints it raises `fault`, if there is one."""

    def __init__(self, joints=READY, gripper=0.0):
        self.measured = np.array(joints, dtype=np.float64)
        self.gripper = gripper
        self.is_open = False
        self.fault: Exception | None = None

    def open(self):
        self.is_open = True

    def close(self):
        self.is_open = False

    def joints(self):
        if self.fault is not None:
            raise self.fault
        return self.measured.copy()

    def gripper_target(self):
        return self.gripper


class FakeGripper:
    """Answers on a socket as the gripper's URCap does, or with `answer`, which may be nothing; moves at once."""

    def __init__(self, **values):
        self.values = {"STA": 3, "FLT": 0, "POS": 3, "PRE": 3, "ACT": 1, "GTO": 0, "SPE": 0, "FOR": 0, **values}
        self.commands: list[str] = []
        self.answer: bytes | None = None
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def sets(self, name=""):
        """Commands so far that set something."""
        return [command for command in self.commands if command.startswith(f"SET {name}")]

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                while data := connection.recv(1024):
                    for line in data.decode().splitlines():
                        connection.sendall(self._reply(line) if self.answer is None else self.answer)

    def _reply(self, line: str) -> bytes:
        self.commands.append(line)
        verb, *words = line.split()
        if verb == "GET":
            return f"{words[0]} {self.values[words[0]]}".encode()
        self.values |= zip(words[::2], map(int, words[1::2]), strict=True)
        if self.values["ACT"] == 1 and "ACT" in words:
            self.values |= {"STA": 3, "FLT": self.values["FLT"] if self.values["FLT"] >= 8 else 0}
        return b"ack"

    def close(self):
        self._listener.close()
