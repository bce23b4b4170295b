"""The twin from the other side: what tests and experiments start, ask and make fail. Needs no simulator."""

import json
import os
import select
import socket
import subprocess
import sys
import tempfile
from typing import Any

from env_door.twin import ports

REQUEST_SECONDS = 10.0
START_SECONDS = 90.0
STOP_SECONDS = 5.0
READY = "ready"  # what a twin prints once it listens


class TwinError(RuntimeError):
    """The twin refused a request, did not start or has ended."""


class TwinClient:
    """Asks a twin that runs at an address.

    All requests raise a `TwinError` if the twin refuses, or cannot be reached.
    """

    def __init__(self, address: str = "127.0.0.2"):
        self.address = address

    def state(self) -> dict[str, Any]:
        """What is the case, whatever other clients are told.

        Returns:
            `dict[str, Any]`:
                the door: `kind`, `opening`, `is_open`, `attempts`, `held`, `tried_while_held`;
                the trial: `seed`, `time` in s, and in s the `controller_time` that RTDE's timestamps have;
                the arm: `joints` and `targets` (rad and closure), `arm_speed` (rad/s, fastest joint), `motion`;
                the controller: `robot_mode`, `safety_mode`, `program`, `watchdog`, `rtde_clients`;
                the active `injections`, `pictures` drawn and `lost_seconds` of real time.
        """
        return self._request("state")

    def reset(self, kind: str | None = None, seed: int | None = None) -> dict[str, Any]:
        """Starts a new trial: a closed door, and the arm at once in front of it with an open gripper.

        A client that goes on commanding its old target takes the arm back there: stop it first.

        Args:
            kind (`str`, *optional*):
                Kind of the door; by default as configured.
            seed (`int`, *optional*):
                Seed; by default the next one.

        Returns:
            `dict[str, Any]`: the state.
        """
        return self._request("reset", kind=kind, seed=seed)

    def arrivals(self) -> list[float]:
        """Real times in s at which clients of RTDE wrote inputs, such as set-points, since this was asked last."""
        return self._request("arrivals")["arrivals"]

    def hold(self, seconds: float) -> None:
        """Holds the door for so many seconds."""
        self._request("hold", seconds=seconds)

    def inject(self, name: str, **parameters: Any) -> None:
        """Makes something fail, by its name among `env_door.twin.injections.INJECTIONS`."""
        self._request("inject", name=name, **parameters)

    def clear(self, name: str | None = None) -> None:
        """Undoes an injection that lasts, or all of them."""
        self._request("clear", name=name)

    def _request(self, do: str, **parameters: Any) -> dict[str, Any]:
        try:
            with (
                socket.create_connection((self.address, ports.TWIN), timeout=REQUEST_SECONDS) as connection,
                connection.makefile("rb") as answers,
            ):
                connection.sendall(json.dumps({"do": do, **parameters}).encode() + b"\n")
                line = answers.readline()
            if not line.endswith(b"\n"):
                raise ConnectionError("it hung up")
        except OSError as error:
            raise TwinError(
                f"no twin answers at {self.address}:{ports.TWIN} ({error}); start one with "
                f"python -m env_door.twin --address={self.address}"
            ) from error
        answer = json.loads(line)
        if not answer.pop("ok"):
            raise TwinError(f"the twin at {self.address} refused {do!r}: {answer['error']}")
        return answer


class TwinProcess(TwinClient):
    """A twin that lives as long as a `with` block, and never longer than its parent.

    It is a process of its own because the constructors of ur_rtde hold Python's lock while they wait for the robot: a
    twin in the same process could never answer them.

    Args:
        address (`str`, *optional*):
            Address to listen on; by default a free one.
        camera (`bool`, *optional*, defaults to `False`):
            Whether there is a camera: unlike on the command line not by default, for tests seldom look.
        options (`Any`):
            Further fields of `env_door.twin.server.TwinConfig`, such as `kind` and `seed`.
    """

    def __init__(self, address: str | None = None, camera: bool = False, **options: Any):
        super().__init__(address or free_address())
        flags = {"address": self.address, "camera": camera, "until_stdin_closes": True, **options}
        self._command = [sys.executable, "-m", "env_door.twin", *(f"--{key}={value}" for key, value in flags.items())]

    def __enter__(self) -> "TwinProcess":
        self._log = tempfile.TemporaryFile()
        self.process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, text=True
        )
        assert self.process.stdout is not None
        answered, _, _ = select.select([self.process.stdout], [], [], START_SECONDS)
        if not answered or self.process.stdout.readline().strip() != READY:
            self._log.seek(0)
            log = self._log.read().decode("utf-8", "replace")
            self.__exit__()
            raise TwinError(f"the twin at {self.address} did not start:\n{log or 'it said nothing'}")
        return self

    def __exit__(self, *exc_info: object) -> None:
        try:
            self.process.communicate(timeout=STOP_SECONDS)  # closes its standard input, with which it ends
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
        self._log.close()


def free_address() -> str:
    """A loopback address on which no twin listens; on Linux all of 127.0.0.0/8 is this machine."""
    for attempt in range(100):
        number = (os.getpid() * 100 + attempt) % (250 * 250)
        address = f"127.1.{number // 250}.{number % 250 + 1}"
        try:
            socket.create_server((address, ports.TWIN)).close()
        except OSError:
            continue
        return address
    raise TwinError("none of 100 loopback addresses is free; on other systems than Linux pass address='127.0.0.1'")
