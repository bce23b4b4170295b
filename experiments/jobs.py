"""Commands in processes of their own, on files that nothing else works on: what sweep.py runs."""

import contextlib
import fcntl
import os
import shlex
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lerobot_ufrnn.commands import with_this_python

stopping = threading.Event()
running: set[subprocess.Popen] = set()


def replace_text(path: Path, text: str) -> None:
    """Writes a text file in one step: a reader sees the old text or the new, and a kill leaves one of them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text)
    os.replace(temporary, path)


@contextlib.contextmanager
def locked(file: Path) -> Iterator[int]:
    """Locks a file; waits while another process, perhaps one left by a killed run, has it locked."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w") as stream:
        said = False
        while not stopping.is_set():
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if not said:
                    print(f"waiting for the process that works in {file.parent} (it has {file} locked)", flush=True)
                said = True
                stopping.wait(1)
            else:
                yield stream.fileno()
                return
        raise KeyboardInterrupt


def run_command(name: str, *words: str, flags: dict[str, Any], log: Path, lock: int) -> None:
    """Prints a command and runs it on one thread, its output in `log`; a RuntimeError with the last lines if it fails.

    It keeps `lock` for as long as it runs, even when this process is killed, so that nothing works on the same files.
    """
    arguments = [*words, *(f"--{flag}={value}" for flag, value in flags.items())]
    print(f"$ {shlex.join([name, *arguments])}", flush=True)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as output:
        process = subprocess.Popen(
            [*with_this_python(name), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            pass_fds=(lock,),
        )
    running.add(process)
    if stopping.is_set():
        process.terminate()
    status = process.wait()
    running.discard(process)
    if stopping.is_set():
        raise KeyboardInterrupt
    if status != 0:
        last_lines = "\n".join(log.read_text(errors="replace").splitlines()[-15:])
        raise RuntimeError(f"{name} ended with status {status}; the end of {log}:\n{last_lines}")


def stop() -> None:
    """Ends all commands and starts no more."""
    stopping.set()
    for process in list(running):
        process.terminate()
    for process in list(running):
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
