"""The ports of a robot with a Robotiq gripper and a camera, and how the twin listens on them."""

import asyncio
import errno
from collections.abc import AsyncIterator, Awaitable, Callable

RTDE = 30004
SCRIPT = (30001, 30002, 30003)
DASHBOARD = 29999
GRIPPER = 63352
CAMERA = 5555
TWIN = 5556  # what no real robot offers: new trials, the door's state, and making things fail

MAX_MESSAGE = 1_000_000  # bytes after which a client that does not end its message is hung up on

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Port:
    """A listening port: `serve` talks with each client. Shut, it refuses all."""

    def __init__(self, address: str, number: int, serve: Serve):
        self._address, self._number, self._serve = address, number, serve
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()

    async def open(self) -> None:
        """Listens; an open port stays as it is."""
        if self._server is not None:
            return
        try:
            self._server = await asyncio.start_server(self._accept, self._address, self._number, limit=MAX_MESSAGE)
        except OSError as error:
            advice = "choose an address of this machine"
            if error.errno == errno.EADDRINUSE:
                advice = "another twin or a robot's simulator may run there; end it, or choose another address"
            where, why = f"{self._address}:{self._number}", error.strerror or error
            raise OSError(f"cannot listen on {where} ({why}): {advice} such as 127.0.0.3") from None

    def shut(self) -> None:
        """Ends all connections and refuses new ones, until it is opened again."""
        if self._server is not None:
            self._server.close()
            self._server = None
        for writer in self._writers:
            writer.transport.abort()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        try:
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
