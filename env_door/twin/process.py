"""A twin in a process of its own, for tests and rehearsals.

The constructors of ur_rtde hold Python's lock while they wait for the robot, so that a twin in the same process could
never answer them.
"""

import os
import selectors
import socket
import subprocess
import sys
import tempfile
from typing import Any

from env_door.twin import ports
from env_door.twin.client import TwinClient, TwinError

READY = "ready"
"""What a twin prints once it listens."""


def free_address() -> str:
    """A loopback address on which no twin listens, so that tests can run side by side.

    Returns:
        `str`: an IPv4 address in 127.0.0.0/8, all of which is this machine on Linux.

    Raises:
        TwinError: If none is free.
    """
    for attempt in range(100):
        number = (os.getpid() * 100 + attempt) % (250 * 250)
        address = f"127.1.{number // 250}.{number % 250 + 1}"
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, ports.CONTROL))
            except OSError:
                continue
            return address
    raise TwinError("none of 100 loopback addresses is free; on other systems than Linux pass address='127.0.0.1'")


class TwinProcess(TwinClient):
    """A twin that lives as long as a `with` block, and never longer than its parent.

    Args:
        address (`str`, *optional*):
            Address to listen on; by default a free one.
        kind (`str`, *optional*, defaults to `"random"`):
            Kind of the door.
        seed (`int`, *optional*, defaults to `0`):
            Seed of the first trial.
        camera (`bool`, *optional*, defaults to `False`):
            Whether there is a camera: unlike on the command line not by default, for tests seldom look.
        start_seconds (`float`, *optional*, defaults to `90.0`):
            Longest time to wait until it listens, in s.
        options (`Any`):
            Further fields of `env_door.twin.configuration.TwinConfig`.
    """

    def __init__(
        self,
        address: str | None = None,
        kind: str = "random",
        seed: int = 0,
        camera: bool = False,
        start_seconds: float = 90.0,
        **options: Any,
    ):
        super().__init__(address or free_address())
        fields = {
            "address": self.address,
            "kind": kind,
            "seed": seed,
            "camera": camera,
            "until_stdin_closes": True,
            **options,
        }
        self._command = [
            sys.executable,
            "-m",
            "env_door.twin",
            *(f"--{name}={value}" for name, value in fields.items()),
        ]
        self._start_seconds = start_seconds
        self._process: subprocess.Popen[bytes] | None = None
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (closed in `stop`)

    @property
    def pid(self) -> int:
        """`int`: id of the process.

        Raises:
            TwinError: If it does not run.
        """
        if self._process is None:
            raise TwinError("the twin does not run; use it in a with block")
        return self._process.pid

    def log(self) -> str:
        """What the twin has logged so far.

        Returns:
            `str`: lines of text.
        """
        self._log.seek(0)
        return self._log.read().decode("utf-8", "replace")

    def start(self) -> None:
        """Starts the process and waits until it listens.

        Raises:
            TwinError: If it does not.
        """
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, env=dict(os.environ)
        )
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            answered = selector.select(self._start_seconds)
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
