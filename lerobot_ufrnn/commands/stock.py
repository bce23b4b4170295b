"""A command of LeRobot that runs beside ours, against the robot's digital twin."""

import contextlib
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from env_door.twin import ports

from ..experiments.processes import with_this_python

FPS = 10
"""Control frequency in Hz, of simulation, robot and policies."""

END_SECONDS = 30.0
"""How long a command may take to end after an interrupt."""

POLL_SECONDS = 0.02


def twin_flags(address: str) -> list[str]:
    """The flags with which LeRobot's commands use the twin as their robot.

    Args:
        address (`str`):
            Where the twin listens.

    Returns:
        `list[str]`: `--robot.*` flags.
    """
    # LeRobot waits 2 s for the thread that reads the camera; one that waits longer for a picture can block the end.
    camera = f"{{type: zmq, server_address: {address}, port: {ports.CAMERA}, camera_name: front, timeout_ms: 1000"
    return [
        "--robot.type=ur5e_robotiq",
        "--robot.id=twin",
        f"--robot.ip={address}",
        f"--robot.cameras={{front: {camera}, width: 640, height: 480, fps: 30}}}}",
    ]


def record_command(
    address: str, events: Path, repo_id: str, root: Path, episode_seconds: float, num_episodes: int
) -> list[str]:
    """The part of `lerobot-record` that all recordings of played events on the twin have in common.

    Args:
        address (`str`):
            Where the twin listens.
        events (`Path`):
            Events to play, see [`~lerobot_ufrnn.teleoperators.event_stream`].
        repo_id (`str`):
            Name of the data set; nothing is uploaded.
        root (`Path`):
            Its folder.
        episode_seconds (`float`):
            Length of an episode in s.
        num_episodes (`int`):
            Number of episodes.

    Returns:
        `list[str]`: the command with its first flags.
    """
    return [
        "lerobot-record",
        *twin_flags(address),
        "--teleop.type=spacemouse_twist",
        f"--teleop.robot_ip={address}",
        f"--teleop.device={events}",
        f"--dataset.repo_id={repo_id}",
        f"--dataset.root={root}",
        f"--dataset.fps={FPS}",
        f"--dataset.episode_time_s={episode_seconds:g}",
        f"--dataset.num_episodes={num_episodes}",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    ]


def late_ticks(output: str) -> int:
    """How often a control loop of LeRobot warned that it is late.

    Args:
        output (`str`):
            What the command printed.

    Returns:
        `int`: the number.
    """
    return output.count("running slower")


def last_error(output: str) -> str:
    """The last thing that a command told its user about its end, without what to do about it.

    Args:
        output (`str`):
            What the command printed.

    Returns:
        `str`: an error with its name, or what asked the command to end; empty if there is neither.
    """
    errors = re.findall(
        r"^(?:\w+\.)*(\w+(?:Error|Exception|Interrupt)\b.*)|(Ending, as asked for by \w+)", output, re.M
    )
    return "".join(errors[-1]).split(". To go on:")[0].strip() if errors else ""


def describe_failure(status: int | None, output: str) -> str:
    """How a command failed.

    Args:
        status (`int | None`):
            Its exit status.
        output (`str`):
            What it printed.

    Returns:
        `str`: its status, and the error that it ended with or else its last line.
    """
    return f"status {status}: {last_error(output) or output.strip().rpartition('\n')[2] or 'it printed nothing'}"


@contextlib.contextmanager
def _heeded(*signals: signal.Signals) -> Iterator[None]:
    """Lets programs that are started here heed signals that they would inherit as ignored.

    A background job of a shell script ignores SIGINT, and one under `nohup` SIGHUP.
    """
    ignored = [number for number in signals if signal.getsignal(number) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)


class StockCommand:
    """A command that runs for as long as a `with` block, or ends before.

    Args:
        command (`Sequence[str]`):
            Its name, such as `lerobot-rollout`, and its flags.
    """

    def __init__(self, command: Sequence[str]):
        self._command = command

    def __enter__(self) -> "StockCommand":
        self._output = tempfile.TemporaryFile()
        with _heeded(signal.SIGINT, signal.SIGHUP):
            self.process = subprocess.Popen(
                with_this_python(self._command),
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches our process alone, which then ends it in order
            )
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.stop()
        self._output.close()

    @property
    def has_ended(self) -> bool:
        """`bool`: whether it runs no more."""
        return self.process.poll() is not None

    def stop(self) -> None:
        """Interrupts it, as LeRobot wants to be ended early, and waits for its end."""
        if not self.has_ended:
            self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def wait_for(self, text: str, seconds: float) -> None:
        """Waits until it has printed something.

        Args:
            text (`str`):
                What to wait for.
            seconds (`float`):
                For how long at most.

        Raises:
            RuntimeError: If it ends without printing it, or takes longer; the message has the end of its output.
        """
        deadline = time.monotonic() + seconds
        while text not in self.output():
            if self.has_ended and text not in self.output():
                raise RuntimeError(
                    f"{self._command[0]} ended with status {self.process.returncode} before it printed {text!r}:\n"
                    f"{self.output()[-2000:]}"
                )
            if time.monotonic() > deadline:
                raise RuntimeError(
                    f"{self._command[0]} did not print {text!r} within {seconds:g} s:\n{self.output()[-2000:]}"
                )
            time.sleep(POLL_SECONDS)

    def output(self) -> str:
        """What it has printed so far.

        Returns:
            `str`: lines of text.
        """
        self._output.seek(0)
        return self._output.read().decode(errors="replace")
