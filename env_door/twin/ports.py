"""The ports of a robot with a Robotiq gripper and a camera, and how the twin listens on them."""

import asyncio
import errno
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

RTDE = 30004
SCRIPT = (30001, 30002, 30003)
DASHBOARD = 29999
GRIPPER = 63352
CAMERA = 5555
TWIN = 5556  # what no real robot offers: new trials, the door's state, and making things fail

MAX_MESSAGE = 1_000_000  # bytes after which a client that does not end its message is hung up on

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Port:
    """A listening port: `serve` talks with each client. Shut, it refuses all; frozen, it takes nothing in."""

    def __init__(self, address: str, number: int, serve: Serve):
        self._address, self._number, self._serve = address, number, serve
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._frozen = False

    async def open(self) -> None:
        """Listens; an open port stays as it is."""
        if self._server is not None:
            return
        try:
            listener = socket.create_server((self._address, self._number))
        except OSError as error:
            advice = "another twin or a robot's simulator may run there; end it, or choose another address"
            if error.errno != errno.EADDRINUSE:
                advice = "choose an address of this machine"
            message = f"cannot listen on {self._address}:{self._number} ({error.strerror}): {advice} such as 127.0.0.3"
            raise OSError(error.errno, message) from error
        self._server = await asyncio.start_server(self._accept, sock=listener, limit=MAX_MESSAGE)

    def shut(self) -> None:
        """Ends all connections and refuses new ones, until it is opened again."""
        if self._server is not None:
            self._server.close()
            self._server = None
        for writer in self._writers:
            writer.transport.abort()

    def freeze(self, frozen: bool) -> None:
        """Takes nothing in while all connections stay open and new ones wait, or goes on doing so."""
        self._frozen = frozen
        for writer in self._writers:
            self._pause_if_frozen(writer.transport)

    def _pause_if_frozen(self, transport: Any) -> None:
        if not transport.is_closing():
            (transport.pause_reading if self._frozen else transport.resume_reading)()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        self._pause_if_frozen(writer.transport)
        try:
            # asyncio does this only for listeners that it has made itself.
            writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._server is not None:
                await self._serve(reader, writer)
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, OSError):
            pass  # the client left, or sends without end
        finally:
            self._writers.discard(writer)
            writer.close()


async def lines(reader: asyncio.StreamReader) -> AsyncIterator[str]:
    """Lines that a client sends, each once it is whole, without its end and blanks around it."""
    while True:
        yield (await reader.readuntil(b"\n")).decode("utf-8", "replace").strip()
