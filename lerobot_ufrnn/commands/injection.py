"""What can be made to fail while a recording moves the twin: everything the twin offers, and our own side."""

import signal
from collections.abc import Callable
from dataclasses import dataclass

import psutil

from env_door.twin import TwinProcess

from .stock import StockCommand

RELEASE_SECONDS = 2.0
"""Time after which a fault that passes has passed, well before the end of the episode."""


@dataclass
class Victim:
    """What faults strike.

    Args:
        twin (`TwinProcess`):
            The robot.
        command (`StockCommand`):
            The recording.
    """

    twin: TwinProcess
    command: StockCommand

    @property
    def servo(self) -> psutil.Process:
        """`psutil.Process`: the servo process, the only one that the command spawns through `multiprocessing`.

        Raises:
            RuntimeError: If there is none, or several.
        """
        children = psutil.Process(self.command.process.pid).children(recursive=True)
        found = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        if len(found) != 1:
            raise RuntimeError(f"the recording has {len(found)} processes that could be the servo, not one")
        return found[0]


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Args:
        strike (`Callable[[Victim], object]`):
            Makes it happen.
        must_stop (`bool`, *optional*, defaults to `True`):
            Whether the arm must be stopped.
        release (`Callable[[Victim], object]`, *optional*):
            Undoes it after `RELEASE_SECONDS`, while the command still runs; the arm may move again then.
        may_die_of (`int`, *optional*, defaults to 0):
            Number of the signal that may end the command.
        may_lose (`bool`, *optional*, defaults to `False`):
            Whether the recording may be lost.
    """

    strike: Callable[[Victim], object]
    must_stop: bool = True
    release: Callable[[Victim], object] | None = None
    may_die_of: int = 0
    may_lose: bool = False


def _on_twin(name: str, **parameters: float) -> Callable[[Victim], object]:
    return lambda victim: victim.twin.fault(name, **parameters)


def _signal(number: int) -> Callable[[Victim], object]:
    return lambda victim: victim.command.process.send_signal(number)


FAULTS: dict[str, Fault] = {
    "drop_link": Fault(_on_twin("drop_link")),
    "freeze": Fault(_on_twin("freeze")),
    "delay": Fault(_on_twin("delay", ms=500.0)),
    "protective_stop": Fault(_on_twin("protective_stop")),
    "emergency_stop": Fault(_on_twin("emergency_stop")),
    "power_off": Fault(_on_twin("power_off")),
    "script_stop": Fault(_on_twin("script_stop")),
    "gripper_silent": Fault(_on_twin("gripper_silent")),
    "gripper_garbage": Fault(_on_twin("gripper_garbage")),
    "gripper_gone": Fault(_on_twin("gripper_gone")),
    "gripper_fault": Fault(_on_twin("gripper_fault")),
    "camera_gone": Fault(_on_twin("camera_gone")),
    "camera_freeze": Fault(_on_twin("camera_freeze")),
    "camera_black": Fault(_on_twin("camera_black")),
    "dashboard_gone": Fault(_on_twin("dashboard_gone"), must_stop=False),
    "remote_control_off": Fault(_on_twin("remote_control_off"), must_stop=False),
    "servo_killed": Fault(lambda victim: victim.servo.kill()),
    "servo_paused": Fault(lambda victim: victim.servo.suspend()),
    "command_paused": Fault(_signal(signal.SIGSTOP), release=_signal(signal.SIGCONT)),
    "command_interrupted": Fault(_signal(signal.SIGINT), may_die_of=signal.SIGINT),
    "command_terminated": Fault(_signal(signal.SIGTERM)),
    "terminal_closed": Fault(_signal(signal.SIGHUP)),
    # LeRobot 0.6.1 writes the ends of a recording's files, without which they cannot be read, when the recording ends.
    "command_killed": Fault(_signal(signal.SIGKILL), may_die_of=signal.SIGKILL, may_lose=True),
}
