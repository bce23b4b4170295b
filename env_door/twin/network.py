"""TCP servers that share one thread: everything of the twin happens between two physics steps.

One thread needs no locks, and a controller answers in its own rhythm of 2 ms anyway.
"""

import contextlib
import errno
import os
import selectors
import socket
from collections.abc import Callable
from typing import Protocol


class Peer(Protocol):
    """What handles the bytes of one connection."""

    def received(self, data: bytes) -> None:
        """Takes what has arrived."""

    def closed(self) -> None:
        """Learns that the connection has ended, whoever ended it."""


class Connection:
    """One accepted connection; made by `Hub`.

    Args:
        hub (`Hub`):
            Its owner.
        sock (`socket.socket`):
            The accepted socket.
        port (`int`):
            Port on which it was accepted.
    """

    def __init__(self, hub: "Hub", sock: socket.socket, port: int):
        self._hub = hub
        self.sock = sock
        self.port = port
        self.peer: Peer | None = None
        self._unsent = bytearray()
        self.is_open = True

    @property
    def congested(self) -> bool:
        """`bool`: whether the other side does not read fast enough."""
        return bool(self._unsent)

    def send(self, data: bytes) -> None:
        """Sends without waiting; keeps what the network does not take yet.

        Args:
            data (`bytes`):
                What to send; dropped when the connection has ended.
        """
        if self.is_open:
            self._unsent += data
            self.flush()

    def flush(self) -> None:
        """Sends as much of what is kept as the network takes."""
        try:
            while self._unsent:
                del self._unsent[: self.sock.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._hub.hang_up(self)
            return
        self._hub.watch(self)

    def close(self) -> None:
        """Ends the connection."""
        self._hub.hang_up(self)


class Hub:
    """All listening ports of one address, and their connections.

    Args:
        address (`str`):
            IPv4 address on which to listen.
    """

    def __init__(self, address: str):
        self.address = address
        self._selector = selectors.DefaultSelector()
        self._accept: dict[int, Callable[[Connection], Peer]] = {}
        self._listeners: dict[int, socket.socket] = {}
        self._connections: set[Connection] = set()
        self._frozen: set[int] = set()

    def listen(self, port: int, accept: Callable[[Connection], Peer]) -> None:
        """Opens a port.

        Args:
            port (`int`):
                TCP port.
            accept (`Callable[[Connection], Peer]`):
                Makes the handler of a new connection.

        Raises:
            OSError: If the address and port cannot be had.
        """
        self._accept[port] = accept
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((self.address, port))
        except OSError as error:
            listener.close()
            advice = "another twin or a robot's simulator may run there; end it, or choose another address"
            if error.errno != errno.EADDRINUSE:
                advice = "choose an address of this machine"
            raise OSError(
                error.errno,
                f"cannot listen on {self.address}:{port} ({error.strerror}): {advice} such as 127.0.0.3",
            ) from error
        listener.listen()
        listener.setblocking(False)
        self._listeners[port] = listener
        if port not in self._frozen:
            self._selector.register(listener, selectors.EVENT_READ, port)

    def shut(self, port: int) -> None:
        """Ends all connections of a port and refuses new ones, until `reopen`.

        Args:
            port (`int`):
                A port given to `listen`.
        """
        listener = self._listeners.pop(port, None)
        if listener is not None:
            self._unregister(listener)
            listener.close()
        for connection in [one for one in self._connections if one.port == port]:
            self.hang_up(connection)

    def reopen(self, port: int) -> None:
        """Listens again on a port that was shut; an open one stays as it is.

        Args:
            port (`int`):
                A port given to `listen`.
        """
        if port not in self._listeners:
            self.listen(port, self._accept[port])

    def freeze(self, port: int, frozen: bool) -> None:
        """Reads nothing from a port and accepts nobody, while all sockets stay open, or goes on doing so.

        Args:
            port (`int`):
                A port given to `listen`.
            frozen (`bool`):
                Whether to freeze it.
        """
        (self._frozen.add if frozen else self._frozen.discard)(port)
        for connection in [one for one in self._connections if one.port == port]:
            self.watch(connection)
        listener = self._listeners.get(port)
        if listener is not None:
            self._unregister(listener)
            if not frozen:
                self._selector.register(listener, selectors.EVENT_READ, port)

    def poll(self, timeout: float) -> None:
        """Handles everything that has arrived.

        Args:
            timeout (`float`):
                Longest time in s to wait for something; 0 does not wait.
        """
        for key, events in self._selector.select(timeout):
            if isinstance(key.data, int):
                self._take_in(key.data)
                continue
            if not isinstance(key.data, Connection):
                if not os.read(key.fd, 4096):
                    self._selector.unregister(key.fileobj)
                    key.data()
                continue
            connection: Connection = key.data
            if events & selectors.EVENT_READ and connection.is_open:
                self._read(connection)
            if events & selectors.EVENT_WRITE and connection.is_open:
                connection.flush()

    def watch(self, connection: Connection) -> None:
        """Waits for what a connection needs: its data unless frozen, and room for what is unsent.

        Args:
            connection (`Connection`):
                An open connection of this hub.
        """
        events = 0 if connection.port in self._frozen else selectors.EVENT_READ
        if connection.congested:
            events |= selectors.EVENT_WRITE
        known = self._selector.get_map().get(connection.sock)
        if known is None:
            if events:
                self._selector.register(connection.sock, events, connection)
        elif not events:
            self._selector.unregister(connection.sock)
        elif known.events != events:
            self._selector.modify(connection.sock, events, connection)

    def hang_up(self, connection: Connection) -> None:
        """Ends a connection and tells its handler.

        Args:
            connection (`Connection`):
                A connection of this hub; an ended one is left alone.
        """
        if connection.is_open:
            connection.is_open = False
            self._connections.discard(connection)
            self._unregister(connection.sock)
            connection.sock.close()
            if connection.peer is not None:
                connection.peer.closed()

    def watch_end(self, file: int, ended: Callable[[], None]) -> None:
        """Waits for the other end of a pipe to be closed.

        Args:
            file (`int`):
                File descriptor; whatever is written there is ignored.
            ended (`Callable[[], None]`):
                Called when it has been closed.
        """
        self._selector.register(file, selectors.EVENT_READ, ended)

    def close(self) -> None:
        """Ends everything."""
        for port in list(self._listeners):
            self.shut(port)
        self._selector.close()

    def _take_in(self, port: int) -> None:
        try:
            sock, _ = self._listeners[port].accept()
        except (KeyError, BlockingIOError, ConnectionError):
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = Connection(self, sock, port)
        self._connections.add(connection)
        connection.peer = self._accept[port](connection)
        if connection.is_open:
            self.watch(connection)

    def _read(self, connection: Connection) -> None:
        try:
            data = connection.sock.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data and connection.peer is not None:
            connection.peer.received(data)
        elif not data:
            self.hang_up(connection)

    def _unregister(self, sock: socket.socket) -> None:
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(sock)
