"""Twin control from the other side: what tests and rehearsals ask of a running twin."""

import json
import socket
import time
from typing import Any

from env_door.twin import ports

REQUEST_SECONDS = 10.0


class TwinError(RuntimeError):
    """The twin refused a request, did not start or has ended."""


class TwinClient:
    """Twin control of a twin that runs somewhere.

    Args:
        address (`str`, *optional*, defaults to `"127.0.0.2"`):
            Its address.
    """

    def __init__(self, address: str = "127.0.0.2"):
        self.address = address
        self._socket: socket.socket | None = None
        self._received = b""

    def request(self, do: str, **parameters: Any) -> dict[str, Any]:
        """Asks for something.

        Args:
            do (`str`):
                `"state"`, `"reset"`, `"hold"`, `"arrivals"`, `"fault"` or `"clear"`.
            parameters (`Any`):
                Its parameters.

        Returns:
            `dict[str, Any]`: the answer.

        Raises:
            TwinError: If the twin refuses, or cannot be reached.
        """
        try:
            answer = self._exchange(json.dumps({"do": do, **parameters}).encode() + b"\n")
        except OSError as error:
            self.close()
            raise TwinError(
                f"no twin answers at {self.address}:{ports.CONTROL} ({error}); start one with "
                f"python -m env_door.twin --address={self.address}"
            ) from error
        if not answer.pop("ok"):
            raise TwinError(f"the twin at {self.address} refused {do!r}: {answer['error']}")
        return answer

    def state(self) -> dict[str, Any]:
        """What is the case.

        Returns:
            `dict[str, Any]`: as `env_door.twin.twin.Twin.state` says.
        """
        return self.request("state")

    def reset(self, kind: str | None = None, seed: int | None = None, keep_arm: bool = False) -> dict[str, Any]:
        """Starts a new trial, as `env_door.twin.twin.Twin.reset` says.

        Args:
            kind (`str`, *optional*):
                Kind of the door; by default as configured.
            seed (`int`, *optional*):
                Seed; by default the next one.
            keep_arm (`bool`, *optional*, defaults to `False`):
                Whether arm and fingers stay where they are.

        Returns:
            `dict[str, Any]`: the state.
        """
        return self.request("reset", kind=kind, seed=seed, keep_arm=keep_arm)

    def arrivals(self) -> list[float]:
        """When set-points came.

        Returns:
            `list[float]`: as `env_door.twin.twin.Twin.arrivals` says.
        """
        return self.request("arrivals")["arrivals"]

    def hold(self, seconds: float) -> None:
        """Holds the door.

        Args:
            seconds (`float`):
                For how long, in s.
        """
        self.request("hold", seconds=seconds)

    def fault(self, name: str, **parameters: Any) -> None:
        """Makes something go wrong.

        Args:
            name (`str`):
                Name of the fault; a wrong one is answered by all names.
            parameters (`Any`):
                Its parameters.
        """
        self.request("fault", name=name, **parameters)

    def clear(self, name: str | None = None) -> None:
        """Undoes a fault that lasts, or all of them.

        Args:
            name (`str`, *optional*):
                Name of the fault.
        """
        self.request("clear", name=name)

    def wait_for(self, seconds: float = 5.0, **expected: Any) -> dict[str, Any]:
        """Waits until the state is as expected.

        Args:
            seconds (`float`, *optional*, defaults to `5.0`):
                Longest time to wait in s.
            expected (`Any`):
                Entries of the state and the values they are to have.

        Returns:
            `dict[str, Any]`: the state.

        Raises:
            TwinError: If it does not become so in time.
        """
        end = time.monotonic() + seconds
        while True:
            state = self.state()
            found = {name: state[name] for name in expected}
            if found == expected:
                return state
            if time.monotonic() > end:
                raise TwinError(f"after {seconds:g} s the twin's state has {found} instead of {expected}")
            time.sleep(0.02)

    def close(self) -> None:
        """Ends the connection; the next request makes a new one."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._received = b""

    def _exchange(self, request: bytes) -> dict[str, Any]:
        if self._socket is None:
            self._socket = socket.create_connection((self.address, ports.CONTROL), timeout=REQUEST_SECONDS)
        self._socket.sendall(request)
        while b"\n" not in self._received:
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionError("it hung up")
            self._received += data
        line, self._received = self._received.split(b"\n", 1)
        return json.loads(line)
