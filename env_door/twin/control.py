"""Twin control on port 5556: JSON lines such as `{"do": "fault", "name": "freeze"}`, answered by `{"ok": true, ...}`.

Here a test or a person does what happens around a real robot: starts trials, holds the door, pulls cables, and looks
at what no camera shows.
"""

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from env_door.twin.lines import LinePeer
from env_door.twin.network import Connection

if TYPE_CHECKING:
    from env_door.twin.twin import Twin


class ControlPeer(LinePeer):
    """One client of twin control.

    Args:
        connection (`Connection`):
            Its connection.
        twin (`Twin`):
            The twin.
    """

    def __init__(self, connection: Connection, twin: "Twin"):
        super().__init__(connection)
        self._twin = twin
        self._actions: dict[str, Callable[..., dict[str, Any]]] = {
            "state": twin.state,
            "reset": twin.reset,
            "hold": self._hold,
            "arrivals": twin.arrivals,
            "fault": self._fault,
            "clear": self._clear,
        }

    def line(self, line: str) -> None:
        """Answers one request."""
        try:
            answer = {"ok": True} | self._carry_out(json.loads(line))
        except (ValueError, TypeError) as error:
            answer = {"ok": False, "error": str(error)}
        self.connection.send(json.dumps(answer).encode() + b"\n")

    def _carry_out(self, request: Any) -> dict[str, Any]:
        if not isinstance(request, dict) or request.get("do") not in self._actions:
            raise ValueError(
                f'request {request!r} is unknown; it must be {{"do": one of {sorted(self._actions)}, ...}}'
            )
        return self._actions[request.pop("do")](**request)

    def _hold(self, seconds: float) -> dict[str, Any]:
        self._twin.door.hold_door(seconds)
        return {}

    def _fault(self, name: str, **parameters: Any) -> dict[str, Any]:
        self._twin.faults.start(name, parameters)
        return {"faults": self._twin.faults.active}

    def _clear(self, name: str | None = None) -> dict[str, Any]:
        self._twin.faults.clear(name)
        return {"faults": self._twin.faults.active}
