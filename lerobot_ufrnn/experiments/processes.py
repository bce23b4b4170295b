"""Commands in processes of their own, which end with the runner that started them."""

import contextlib
import fcntl
import os
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

LAST_LINES = 15
SECONDS_TO_END = 10.0


class Stopped(Exception):  # noqa: N818  it is no error
    """The runner was stopped before or while it ran a command."""


def with_this_python(command: Sequence[str]) -> list[str]:
    """A console command of LeRobot or of ours, run by this interpreter.

    Args:
        command (`Sequence[str]`):
            `ufrnn`, `lerobot-train` or another command of LeRobot, and its flags.

    Returns:
        `list[str]`: the same as `python -m <module>`.
    """
    name, *flags = command
    module = "lerobot_ufrnn.commands" if name == "ufrnn" else f"lerobot.scripts.{name.replace('-', '_')}"
    return [sys.executable, "-m", module, *flags]


class Runner:
    """Runs commands, from any number of threads, until it is stopped."""

    def __init__(self) -> None:
        self._stopping = threading.Event()
        self._starting = threading.Lock()
        self._processes: set[subprocess.Popen] = set()

    def run(self, command: Sequence[str], log: Path, lock: int) -> None:
        """Runs a command to its end, on one thread.

        Args:
            command (`Sequence[str]`):
                See `with_this_python`.
            log (`Path`):
                File to append its output to.
            lock (`int`):
                Descriptor of the file that `hold` locked. The command keeps it locked for as long as it runs, even when
                this process is killed, so that nothing works on the same files in the meantime.

        Raises:
            RuntimeError: If the command fails; the message has its last lines.
            Stopped: If the runner is stopped.
        """
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as output:
            output.write(f"$ {shlex.join(command)}\n")
            output.flush()
            with self._starting:
                if self._stopping.is_set():
                    raise Stopped
                process = subprocess.Popen(
                    with_this_python(command),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, "OMP_NUM_THREADS": "1"},
                    pass_fds=(lock,),
                    # Ctrl-C in a terminal reaches this process alone, which then ends the others in order.
                    start_new_session=True,
                )
                self._processes.add(process)
            status = process.wait()
            self._processes.discard(process)
        if self._stopping.is_set():
            raise Stopped
        if status != 0:
            last_lines = "\n".join(log.read_text(errors="replace").splitlines()[-LAST_LINES:])
            raise RuntimeError(f"{command[0]} ended with status {status}; the end of {log}:\n{last_lines}")

    @contextlib.contextmanager
    def hold(self, file: Path) -> Iterator[int]:
        """Locks a file; waits while another process, perhaps one left by a killed run, has it locked.

        Args:
            file (`Path`):
                File to lock; made if it is missing.

        Yields:
            `int`: its descriptor.

        Raises:
            Stopped: If the runner is stopped while it waits.
        """
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("w") as stream:
            said = False
            while True:
                try:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if not said:
                        print(f"waiting for the process that works in {file.parent} (it has {file} locked)", flush=True)
                        said = True
                    if self._stopping.wait(1):
                        raise Stopped from None
            yield stream.fileno()

    def stop(self) -> None:
        """Ends all commands, with their own processes, and starts no more."""
        with self._starting:
            self._stopping.set()
            processes = list(self._processes)
        for process in processes:
            _signal(process, signal.SIGTERM)
        for process in processes:
            try:
                process.wait(SECONDS_TO_END)
            except subprocess.TimeoutExpired:
                _signal(process, signal.SIGKILL)


def _signal(process: subprocess.Popen, number: signal.Signals) -> None:
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
