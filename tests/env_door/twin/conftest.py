"""A twin whose clock the test turns, and sockets beside it in the same thread."""

import asyncio
import socket
import struct
from functools import partial

import pytest

from env_door.twin import free_address, ports
from env_door.twin.server import Twin, TwinConfig


class TurnedTwin(Twin):
    """Nothing happens to it but in `turn`."""

    def __init__(self):
        self.address = free_address()
        super().__init__(TwinConfig(address=self.address, kind="pull", seed=5, camera=False, unlock_seconds=1.0))
        self._loop = asyncio.new_event_loop()
        self._loop.run_until_complete(self.open())

    def turn(self, ticks=1):
        """Serves what has arrived, and goes on by some times 2 ms."""
        self._loop.run_until_complete(self._turn(ticks))

    async def _turn(self, ticks):
        for remaining in range(ticks, -1, -1):
            for _ in range(10):  # enough for the loop to accept, read, answer and hang up
                await asyncio.sleep(0)
            if remaining:
                self.tick()

    def close(self):
        super().close()
        self.turn(0)
        self._loop.close()


class Client:
    """A socket: waiting for an answer turns the twin's clock."""

    def __init__(self, twin, port):
        self.twin = twin
        self.socket = socket.create_connection((twin.address, port))
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.received = b""

    def put(self, data):
        self.socket.sendall(data)
        self.twin.turn(0)

    def turn(self, ticks=1):
        """Whether the connection still stands after some ticks."""
        self.twin.turn(ticks)
        try:
            while data := self.socket.recv(65536):
                self.received += data
        except BlockingIOError:
            return True
        except ConnectionError:
            pass
        return False

    def take(self):
        answer, self.received = self.received, b""
        return answer.decode(errors="replace")

    def ask(self, text):
        """Answer to a line of text."""
        self.put(text.encode() + b"\n")
        self.turn(2)
        return self.take()

    def packages(self):
        """The packages of RTDE that have come."""
        found = []
        while len(self.received) >= 3:
            size, kind = struct.unpack_from(">HB", self.received)
            found.append((chr(kind), self.received[3:size]))
            self.received = self.received[size:]
        return found

    def exchange(self, kind, body=b""):
        """Answer to a package of RTDE."""
        self.put(struct.pack(">HB", 3 + len(body), ord(kind)) + body)
        self.turn(2)
        return next(answer for name, answer in self.packages() if name == kind)

    def command(self, number, *values):
        """A command to the control script, through the first recipe of inputs."""
        self.put(struct.pack(">HBBi11d", 96, ord("U"), 1, number, *values, *[0.0] * (11 - len(values))))


@pytest.fixture
def twin():
    made = TurnedTwin()
    yield made
    made.close()


@pytest.fixture
def connect(twin):
    return partial(Client, twin)


@pytest.fixture
def upload(twin, connect):
    def upload(name="rtde_control"):
        client = connect(ports.SCRIPT[-1])
        client.put(f"def {name}():\n    global reg_offset_int = # int register offset\n0\n    end\n".encode())
        client.turn(20)
        assert twin.state()["program"] == "STOPPED"
        client.put(b"end\n")
        client.turn(20)

    return upload
