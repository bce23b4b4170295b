"""Real-Time Data Exchange, version 2, on port 30004: variables in both directions, in binary packages.

A package is a length of two bytes that counts itself, a type of one byte and a body, in network byte order. The client
first agrees on recipes, lists of variables, and then receives one list of measurements at the rate it asked for.
"""

import logging
import struct
from collections import deque
from enum import IntEnum

from env_door.twin.controller import Controller
from env_door.twin.measurements import Reading, readings
from env_door.twin.motion import TIME_STEP
from env_door.twin.network import Connection
from env_door.twin.rtde_variables import TYPES, input_type, output_type

logger = logging.getLogger(__name__)

VERSION = (5, 15, 0, 126271)
"""Version of the controller's software that clients are told."""

HEADER = struct.Struct(">HB")


class Package(IntEnum):
    """Types of packages."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class RTDESession:
    """One client of RTDE.

    Args:
        connection (`Connection`):
            Its connection.
        controller (`Controller`):
            The controller.
        server (`RTDEServer`):
            Where the session belongs; also knows the faults of the link.
    """

    def __init__(self, connection: Connection, controller: Controller, server: "RTDEServer"):
        self._connection = connection
        self._controller = controller
        self._server = server
        self._bytes = b""
        self._inputs: dict[int, tuple[list[str], struct.Struct]] = {}
        self._readings: list[Reading] = []
        self._format = struct.Struct(">B")
        self._every = 1
        self._started = False
        self._ticks = 0
        self._late: deque[tuple[float, bytes]] = deque()

    def received(self, data: bytes) -> None:
        """Answers the packages of the client."""
        self._bytes += data
        while len(self._bytes) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._bytes)
            if size < HEADER.size:
                self._hang_up(f"a package of length {size}")
                return
            if len(self._bytes) < size:
                return
            body, self._bytes = self._bytes[HEADER.size : size], self._bytes[size:]
            try:
                self._handle(kind, body)
            except (struct.error, UnicodeDecodeError, ValueError) as error:
                self._hang_up(f"a malformed package of type {chr(kind)!r} ({error})")
                return

    def closed(self) -> None:
        """Lets others write the inputs of this client."""
        self._server.sessions.discard(self)
        self._controller.registers.release(self)

    def publish(self) -> None:
        """Sends the measurements if it is time for them; called every 2 ms."""
        self._ticks += 1
        time = self._controller.time
        while self._late and self._late[0][0] <= time:
            self._connection.send(self._late.popleft()[1])
        # A controller that cannot keep up skips packages rather than to send old ones.
        if not self._started or self._ticks % self._every or self._connection.congested:
            return
        values = [value for reading in self._readings for value in reading()]
        package = HEADER.pack(HEADER.size + self._format.size, Package.DATA) + self._format.pack(1, *values)
        if self._server.delay > 0 or self._late:
            self._late.append((time + self._server.delay, package))
        else:
            self._connection.send(package)

    def _handle(self, kind: int, body: bytes) -> None:
        if kind == Package.DATA:
            self._take(body)
        elif kind == Package.PROTOCOL_VERSION:
            self._answer(kind, struct.pack(">?", struct.unpack(">H", body)[0] == 2))
        elif kind == Package.CONTROLLER_VERSION:
            self._answer(kind, struct.pack(">4I", *VERSION))
        elif kind == Package.OUTPUTS:
            self._answer(kind, self._set_up_outputs(body))
        elif kind == Package.INPUTS:
            self._answer(kind, self._set_up_inputs(body))
        elif kind == Package.START:
            self._started = bool(self._readings)
            self._answer(kind, struct.pack(">?", self._started))
        elif kind == Package.PAUSE:
            self._started = False
            self._answer(kind, struct.pack(">?", True))
        else:
            logger.warning("RTDE package of unknown type %d ignored", kind)

    def _set_up_outputs(self, body: bytes) -> bytes:
        frequency = struct.unpack_from(">d", body)[0]
        names = _names(body[8:])
        types = [output_type(name) for name in names]
        if "NOT_FOUND" in types or not names or not 1 <= frequency <= 1 / TIME_STEP:
            self._readings = []
            return b"\x00" + ",".join(types).encode()
        self._every = max(1, round(1 / (TIME_STEP * frequency)))
        self._readings = readings(self._controller, names)
        self._format = struct.Struct(">B" + "".join(TYPES[one] for one in types))
        return b"\x01" + ",".join(types).encode()

    def _set_up_inputs(self, body: bytes) -> bytes:
        names = _names(body)
        owners = self._controller.registers.owners
        types = ["IN_USE" if owners.get(name, self) is not self else input_type(name) for name in names]
        if any(one not in TYPES for one in types):
            return b"\x00" + ",".join(types).encode()
        owners.update(dict.fromkeys(names, self))
        identity = len(self._inputs) + 1
        # One name for each number: no vector is a register, so what its numbers are called does not matter.
        fields = [name for name, one in zip(names, types, strict=True) for _ in range(int(TYPES[one][:-1] or 1))]
        self._inputs[identity] = (fields, struct.Struct(">" + "".join(TYPES[one] for one in types)))
        return bytes([identity]) + ",".join(types).encode()

    def _take(self, body: bytes) -> None:
        if not body or body[0] not in self._inputs:
            raise ValueError(f"unknown input recipe {body[:1].hex() or 'none'}")
        fields, layout = self._inputs[body[0]]
        values = zip(fields, layout.unpack(body[1:]), strict=True)
        self._controller.registers.write_inputs(values, self._controller.time)

    def _answer(self, kind: int, body: bytes) -> None:
        self._connection.send(HEADER.pack(HEADER.size + len(body), kind) + body)

    def _hang_up(self, reason: str) -> None:
        logger.warning("RTDE client sent %s: hung up", reason)
        self._connection.close()


class RTDEServer:
    """All clients of RTDE.

    Args:
        controller (`Controller`):
            The controller.

    Attributes:
        sessions (`set[RTDESession]`): The clients.
        delay (`float`): Seconds by which measurements reach the clients late.
        frozen (`bool`): Whether measurements are sent at all.
    """

    def __init__(self, controller: Controller):
        self._controller = controller
        self.sessions: set[RTDESession] = set()
        self.delay = 0.0
        self.frozen = False

    def accept(self, connection: Connection) -> RTDESession:
        """Takes in a client.

        Args:
            connection (`Connection`):
                Its connection.

        Returns:
            `RTDESession`: its session.
        """
        session = RTDESession(connection, self._controller, self)
        self.sessions.add(session)
        return session

    def publish(self) -> None:
        """Sends measurements to all clients whose turn it is; called every 2 ms."""
        if not self.frozen:
            for session in list(self.sessions):
                session.publish()


def _names(body: bytes) -> list[str]:
    return [name for name in body.decode().split(",") if name]
