"""Protocols of text lines."""

from env_door.twin.network import Connection

MAX_LINE = 1_000_000
"""Bytes after which a peer that never ends its line is hung up on."""


class LinePeer:
    """A peer of a text protocol: collects bytes and hands on whole lines.

    Args:
        connection (`Connection`):
            The connection.
    """

    def __init__(self, connection: Connection):
        self.connection = connection
        self._text = b""

    def line(self, line: str) -> None:
        """Handles one line; for subclasses.

        Args:
            line (`str`):
                The line without its end and without blanks around it.
        """
        raise NotImplementedError

    def received(self, data: bytes) -> None:
        """Collects bytes and hands on the lines they end."""
        *lines, self._text = (self._text + data).split(b"\n")
        for line in lines:
            self.line(line.decode("utf-8", "replace").strip())
        if len(self._text) > MAX_LINE:
            self.connection.close()

    def closed(self) -> None:
        """Nothing to tidy up."""
