"""The twin from the other side: what tests and experiments start, ask and make fail. Needs no simulator."""

import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from typing import Any

from env_door.twin import ports

REQUEST_SECONDS = 10.0
READY = "ready"  # what a twin prints once it listens


class TwinError(RuntimeError):
    """The twin refused a request, did not start or has ended."""


class TwinClient:
    """Asks a twin that runs at an address.

    All requests raise a `TwinError` if the twin refuses, or cannot be reached.
    """

    def __init__(self, address: str = "127.0.0.2"):
        self.address = address
        self._socket: socket.socket | None = None

    def request(self, do: str, **parameters: Any) -> dict[str, Any]:
        """Asks for `"state"`, `"reset"`, `"hold"`, `"arrivals"`, `"inject"` or `"clear"`; returns the answer."""
        try:
            answer = self._exchange(json.dumps({"do": do, **parameters}).encode() + b"\n")
        except OSError as error:
            self.close()
            raise TwinError(
                f"no twin answers at {self.address}:{ports.TWIN} ({error}); start one with "
                f"python -m env_door.twin --address={self.address}"
            ) from error
        if not answer.pop("ok"):
            raise TwinError(f"the twin at {self.address} refused {do!r}: {answer['error']}")
        return answer

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
        return self.request("state")

    def reset(self, kind: str | None = None, seed: int | None = None, keep_arm: bool = False) -> dict[str, Any]:
        """Starts a new trial: a closed door, and the arm at once in front of it with an open gripper.

        A client that goes on commanding its old target takes the arm back there: stop it first, or keep the arm.

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
        """Real times in s at which clients of RTDE wrote inputs, such as set-points, since this was asked last."""
        return self.request("arrivals")["arrivals"]

    def hold(self, seconds: float) -> None:
        """Holds the door for so many seconds."""
        self.request("hold", seconds=seconds)

    def inject(self, name: str, **parameters: Any) -> None:
        """Makes something fail, by its name among `env_door.twin.injections.INJECTIONS`."""
        self.request("inject", name=name, **parameters)

    def clear(self, name: str | None = None) -> None:
        """Undoes an injection that lasts, or all of them."""
        self.request("clear", name=name)

    def wait_for(self, seconds: float = 5.0, **expected: Any) -> dict[str, Any]:
        """Waits until entries of the state have the expected values; a `TwinError` if they do not in time."""
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

    def _exchange(self, request: bytes) -> dict[str, Any]:
        if self._socket is None:
            self._socket = socket.create_connection((self.address, ports.TWIN), timeout=REQUEST_SECONDS)
        self._socket.sendall(request)
        answer = b""  # a single line, for requests go one at a time
        while not answer.endswith(b"\n"):
            if not (data := self._socket.recv(65536)):
                raise ConnectionError("it hung up")
            answer += data
        return json.loads(answer)


class TwinProcess(TwinClient):
    """A twin that lives as long as a `with` block, and never longer than its parent.

    It is a process of its own because the constructors of ur_rtde hold Python's lock while they wait for the robot: a
    twin in the same process could never answer them.

    Args:
        address (`str`, *optional*):
            Address to listen on; by default a free one.
        camera (`bool`, *optional*, defaults to `False`):
            Whether there is a camera: unlike on the command line not by default, for tests seldom look.
        start_seconds (`float`, *optional*, defaults to `90.0`):
            Longest time to wait until it listens, in s.
        options (`Any`):
            Further fields of `env_door.twin.configuration.TwinConfig`, such as `kind` and `seed`.
    """

    def __init__(self, address: str | None = None, camera: bool = False, start_seconds: float = 90.0, **options: Any):
        super().__init__(address or free_address())
        flags = {"address": self.address, "camera": camera, "until_stdin_closes": True, **options}
        self._command = [sys.executable, "-m", "env_door.twin", *(f"--{key}={value}" for key, value in flags.items())]
        self._start_seconds = start_seconds
        self._process: subprocess.Popen[bytes] | None = None
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (closed in `stop`)

    @property
    def pid(self) -> int:
        """Id of the process."""
        if self._process is None:
            raise TwinError("the twin does not run; use it in a with block")
        return self._process.pid

    def log(self) -> str:
        """What the twin has logged so far."""
        self._log.seek(0)
        return self._log.read().decode("utf-8", "replace")

    def start(self) -> None:
        """Starts the process and waits until it listens; raises a TwinError if it does not."""
        self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log)
        assert self._process.stdout is not None
        answered, _, _ = select.select([self._process.stdout], [], [], self._start_seconds)
        if not answered or self._process.stdout.readline().decode().strip() != READY:
            log = self.log()
            self.stop()
            raise TwinError(f"the twin at {self.address} did not start:\n{log or 'it said nothing'}")

    def stop(self) -> None:
        """Ends the process; one that has ended is left alone."""
        self.close()
        if self._process is not None:
            process, self._process = self._process, None
            process.terminate()
            try:
                process.communicate(timeout=5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
        self._log.close()

    def __enter__(self) -> "TwinProcess":
        self.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.stop()


def free_address() -> str:
    """A loopback address on which no twin listens; on Linux all of 127.0.0.0/8 is this machine."""
    for attempt in range(100):
        number = (os.getpid() * 100 + attempt) % (250 * 250)
        address = f"127.1.{number // 250}.{number % 250 + 1}"
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, ports.TWIN))
            except OSError:
                continue
            return address
    raise TwinError("none of 100 loopback addresses is free; on other systems than Linux pass address='127.0.0.1'")
