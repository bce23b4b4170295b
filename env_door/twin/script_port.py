"""Ports 30001 to 30003, where clients upload URScript. The state that a real controller streams there is not sent."""

import logging
import re

from env_door.twin.control_script import ControlScript
from env_door.twin.controller import Controller
from env_door.twin.lines import MAX_LINE
from env_door.twin.network import Connection

logger = logging.getLogger(__name__)

_NAME = re.compile(r"^def\s+(\w+)\s*\(", re.MULTILINE)


class ScriptPeer:
    """One client that uploads programs.

    Args:
        connection (`Connection`):
            Its connection.
        controller (`Controller`):
            The controller.
    """

    def __init__(self, connection: Connection, controller: Controller):
        self._connection = connection
        self._controller = controller
        self._text = b""

    def received(self, data: bytes) -> None:
        """Collects a program until it is whole: its last `end` is the first one at the start of a line."""
        self._text += data
        while (end := self._text.find(b"\nend\n")) >= 0:
            source, self._text = self._text[: end + 5], self._text[end + 5 :]
            self._start(source.decode("utf-8", "replace"))
        if len(self._text) > MAX_LINE:
            self._connection.close()

    def closed(self) -> None:
        """Nothing to tidy up: a program runs on when the client that uploaded it leaves."""

    def _start(self, source: str) -> None:
        match = _NAME.search(source)
        name = match[1] if match else "without a name"
        if name != "rtde_control":
            logger.error("program %s is not emulated (only ur_rtde's rtde_control is): ignored", name)
            return
        self._controller.start_program(ControlScript(self._controller, source).run(), name)
