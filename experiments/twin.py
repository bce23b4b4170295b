"""What the experiments on the robot's digital twin share: LeRobot's own commands, run beside the experiment."""

import itertools
import json
import os
import re
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from env_door.limits import FPS
from env_door.twin import ports
from lerobot_ufrnn.commands import with_this_python

END_SECONDS = 30.0  # how long a command may take to end after an interrupt


def robot_flags(address: str) -> list[str]:
    """The flags with which LeRobot's commands use the twin at an address as their robot."""
    # LeRobot waits 2 s for the thread that reads the camera; one that waits longer for a picture can block the end.
    camera = f"{{type: zmq, server_address: {address}, port: {ports.CAMERA}, camera_name: front, timeout_ms: 1000"
    return [
        "--robot.type=ur5e_robotiq",
        "--robot.id=twin",
        f"--robot.ip={address}",
        f"--robot.cameras={{front: {camera}, width: 640, height: 480, fps: 30}}}}",
    ]


def record_flags(address: str, events: Path, repo_id: str, root: Path, seconds: float, episodes: int) -> list[str]:
    """The flags with which `lerobot-record` records the twin while the events of a SpaceMouse are played."""
    return [
        *robot_flags(address),
        "--teleop.type=spacemouse_twist",
        f"--teleop.robot_ip={address}",
        f"--teleop.device={events}",
        f"--dataset.repo_id={repo_id}",
        f"--dataset.root={root}",
        f"--dataset.fps={FPS}",
        f"--dataset.episode_time_s={seconds:g}",
        f"--dataset.num_episodes={episodes}",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    ]


@dataclass(frozen=True)
class Event:
    """A state of an input device and for how long it lasts."""

    seconds: float
    twist: NDArray[np.float64]  # (6,) deflections in -1 to 1
    buttons: tuple[str, ...] = ()


def write_events(events: Sequence[Event], file: Path) -> None:
    """Writes events as a file that `--teleop.device` plays."""
    times = itertools.accumulate((event.seconds for event in events), initial=0.0)
    # A device is at rest after its last event, whatever that one says.
    lines = [
        {"time": round(moment, 4), "twist": event.twist.tolist(), "buttons": event.buttons}
        for moment, event in zip(times, (*events, Event(0.0, np.zeros(6))), strict=True)
    ]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


class StockCommand(subprocess.Popen):
    """A command of LeRobot, such as `lerobot-rollout`, run by this interpreter until the end of a `with` block.

    `environment` are variables that it sees besides ours.
    """

    def __init__(self, name: str, *flags: str, **environment: str):
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        super().__init__(
            [*with_this_python(name), *flags],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **environment},
            start_new_session=True,  # Ctrl-C reaches our process alone, which then ends it in order
            preexec_fn=_heed_signals,
        )

    def __exit__(self, *exc_info) -> None:
        self.stop()
        self._log.close()

    def output(self) -> str:
        """What it has printed so far."""
        self._log.seek(0)
        return self._log.read().decode(errors="replace")

    def stop(self) -> None:
        """Interrupts it, as LeRobot wants to be ended early, and waits for its end; kills it if it takes too long."""
        self.send_signal(signal.SIGINT)  # nothing if it has ended
        try:
            self.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()


def _heed_signals() -> None:
    # A background job of a shell script ignores SIGINT, one under `nohup` SIGHUP, and what it starts inherits that.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def late_ticks(output: str) -> int:
    """How often a control loop of LeRobot warned that it is late."""
    return output.count("running slower")


def last_error(output: str) -> str:
    """The last thing that a command told its user about its end, an error or a signal, without what to do about it."""
    # Without FFmpeg LeRobot warns at the start with the whole traceback of a decoder that it then does without.
    output = re.sub(r"\[start of libtorchcodec.*?\[end of libtorchcodec", "", output, flags=re.S)
    errors = re.findall(
        r"^(?:\w+\.)*(\w+(?:Error|Exception|Interrupt)\b.*)|(Ending, as asked for by \w+)", output, re.M
    )
    return "".join(errors[-1]).split(". To go on:")[0].strip() if errors else ""


def describe_failure(status: int | None, output: str) -> str:
    """Exit status and error of a command that failed; its last line if it printed no error."""
    return f"status {status}: {last_error(output) or output.strip().rpartition('\n')[2] or 'it printed nothing'}"
