"""The robot's controller: power, safety, registers, the program that runs, and one tick of 2 ms.

What a client sees of it are modes and bits whose values are Universal Robots' own. A protective stop pauses the program
and waits for somebody to unlock it; an emergency stop and a loss of power end it.
"""

import logging
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from env_door.twin.gripper import GripperModel
from env_door.twin.live_door import LiveDoor
from env_door.twin.motion import TIME_STEP, JointMotion

logger = logging.getLogger(__name__)

DEVIATION_LIMIT = 0.5
"""Distance in rad between target and measured joint at which the controller makes a protective stop."""

STOP_DECELERATION = 10.0
"""Joint deceleration in rad/s^2 when a program ends while the arm moves."""

POWER_SECONDS = 0.3
"""Time that switching on and releasing the brakes take each; some seconds on a real arm."""

START_SECONDS = 0.02
"""Time between the upload of a program and its start."""

TOOL_POINT = (0.0, 0.0, 0.15, 0.0, 0.0, 0.0)
"""Tool centre point in the flange's frame: between the pads."""

NUM_REGISTERS = 48

MAX_ARRIVALS = 100_000
"""How many arrivals of inputs are kept: more than 13 minutes of set-points."""

_REGISTER = re.compile(r"(input|output)_(int|double)_register_(\d+)")


class RobotMode(IntEnum):
    """What the arm is ready for."""

    BOOTING = 2
    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """Why the arm may not move."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


class ProgramState(IntEnum):
    """RTDE's `runtime_state`."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class ScriptError(Exception):
    """The running program did something that ends it."""


class Registers:
    """The letter box between a client and the program: 48 registers of each type and direction.

    As on a real controller they keep their values when a client leaves.

    Attributes:
        updated (`dict[str, float]`): Controller time in s at which an input variable was last written.
        arrivals (`deque[float]`): Real time in s, `time.monotonic()`, at which the last data packages came.
        owners (`dict[str, object]`): Which connection writes an input variable; a second one is refused.
    """

    def __init__(self) -> None:
        self.input_int = [0] * NUM_REGISTERS
        self.input_double = [0.0] * NUM_REGISTERS
        self.output_int = [0] * NUM_REGISTERS
        self.output_double = [0.0] * NUM_REGISTERS
        self.updated: dict[str, float] = {}
        self.arrivals: deque[float] = deque(maxlen=MAX_ARRIVALS)
        self.owners: dict[str, object] = {}

    def find(self, name: str) -> tuple[list, int] | None:
        """The registers among which the RTDE variable of this name is, and its index; `None` if it is no register."""
        match = _REGISTER.fullmatch(name)
        if match is None or int(match[3]) >= NUM_REGISTERS:
            return None
        return getattr(self, f"{match[1]}_{match[2]}"), int(match[3])

    def write_inputs(self, values: Iterable[tuple[str, float]], now: float) -> None:
        """Takes a client's data package at a controller time; what is no register has no effect."""
        self.arrivals.append(time.monotonic())
        for name, value in values:
            if (found := self.find(name)) is not None:
                found[0][found[1]] = value
                self.updated[name] = now

    def release(self, owner: object) -> None:
        """Lets other connections write what one that has ended wrote."""
        self.owners = {name: holder for name, holder in self.owners.items() if holder is not owner}


class Controller:
    """State of the controller, the arm's motion, the gripper and the scene."""

    def __init__(self, door: LiveDoor, unlock_seconds: float):
        self.door = door
        self.gripper = GripperModel()
        self.registers = Registers()
        self.motion = JointMotion(door.joint_low, door.joint_high, np.array(door.arm.joint_speed))
        self.tool_offset: NDArray[np.float64] = np.array(TOOL_POINT)
        self.time = 0.0
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.program_state = ProgramState.STOPPED
        self.remote_control = True
        self._unlock_seconds = unlock_seconds
        self._stopped_at = 0.0
        self._program: Iterator[None] | None = None
        self._starting: tuple[float, Iterator[None]] | None = None
        self._watchdog: tuple[str, float] | None = None
        self._switching: tuple[float, Callable[[], None]] | None = None
        self._ticks = 0
        self.gripper.switch_on(0.0)
        self.settle()

    @property
    def may_move(self) -> bool:
        """Whether power and safety let a program move the arm."""
        return self.robot_mode == RobotMode.RUNNING and self.safety_mode == SafetyMode.NORMAL

    @property
    def watchdog_armed(self) -> bool:
        """Whether the program has armed a watchdog."""
        return self._watchdog is not None

    def settle(self) -> None:
        """Makes the measured pose the target: after a new trial, and when brakes close."""
        self.motion.hold(self.door.joints)

    def tick(self) -> None:
        """Goes on by 2 ms; raises a RuntimeError if the physics diverged."""
        self._ticks += 1
        self.time = self._ticks * TIME_STEP
        if self._switching is not None and self.time >= self._switching[0]:
            finish, self._switching = self._switching[1], None
            finish()
        self._watch()
        self._run_program()
        self.motion.step()
        self.gripper.step(self.door.closure, TIME_STEP)
        self.door.tick(self.motion.position, self.motion.velocity, self.gripper.target)
        if self._ticks % 10 == 0:
            self.door.limit_grip(self.gripper.force)
            self._check_deviation()
            self.door.check()

    def start_program(self, program: Iterator[None], name: str) -> None:
        """Starts a program, which is advanced every 2 ms, in the place of another, if the arm may be controlled."""
        if not (self.remote_control and self.may_move):
            logger.info("program %s refused: %s", name, self.describe())
            return
        self.stop_program()
        self._starting = (self.time + START_SECONDS, program)
        logger.info("program %s taken", name)

    def stop_program(self) -> None:
        """Ends the running program; a moving arm brakes. Watchdogs end with it, as on a real controller."""
        self._program = self._watchdog = self._starting = None
        self.program_state = ProgramState.STOPPED
        self.motion.stop(STOP_DECELERATION)

    def play(self) -> bool:
        """Resumes a paused program; whether there was one and it may run."""
        if self.program_state != ProgramState.PAUSED or not self.may_move:
            return False
        self.program_state = ProgramState.PLAYING
        # A program that resumes must not take a pause for a client that has fallen silent.
        if self._watchdog is not None:
            self.registers.updated[self._watchdog[0]] = self.time
        return True

    def pause(self) -> bool:
        """Pauses the running program; whether one was running."""
        if self.program_state != ProgramState.PLAYING:
            return False
        self.program_state = ProgramState.PAUSED
        self.motion.stop(STOP_DECELERATION)
        return True

    def arm_watchdog(self, name: str, min_frequency: float) -> None:
        """Ends the program once an RTDE input is written less often than so many times a second; 0 watches no more."""
        self._watchdog = (name, 1.0 / min_frequency) if min_frequency > 0 else None
        self.registers.updated[name] = self.time

    def protective_stop(self, reason: str) -> None:
        """Stops at once, pauses the program and waits to be unlocked."""
        if self.may_move:
            logger.warning("protective stop: %s", reason)
            self.pause()
            self._starting = None
            self.safety_mode, self._stopped_at = SafetyMode.PROTECTIVE_STOP, self.time
            self.settle()

    def unlock(self) -> bool:
        """Ends a protective stop; whether it could be ended: not before the waiting time is over."""
        if self.safety_mode == SafetyMode.PROTECTIVE_STOP:
            if self.time - self._stopped_at < self._unlock_seconds:
                return False
            self.safety_mode = SafetyMode.NORMAL
        return True

    def press_emergency_stop(self) -> None:
        """Emergency stop: the program ends, brakes close and the arm loses its power."""
        self.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP
        self.power_off()

    def release_emergency_stop(self) -> None:
        """Pulls the button out again; the arm stays without power until somebody switches it on."""
        if self.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP:
            self.safety_mode = SafetyMode.NORMAL

    def power_off(self) -> None:
        """Takes the arm's power away: the program ends and brakes close."""
        self.stop_program()
        self.settle()
        self._switching = None
        self.robot_mode = RobotMode.POWER_OFF
        self.gripper.switch_off()

    def power_on(self) -> None:
        """Switches the arm on, with brakes closed; without effect during an emergency stop."""
        if self.robot_mode == RobotMode.POWER_OFF and self.safety_mode == SafetyMode.NORMAL:
            self.robot_mode = RobotMode.BOOTING
            self._switching = (self.time + POWER_SECONDS, self._become_idle)

    def release_brakes(self) -> None:
        """Releases the brakes of an arm that is switched on."""
        if self.robot_mode == RobotMode.IDLE and self.safety_mode == SafetyMode.NORMAL:
            self._switching = (self.time + POWER_SECONDS, self._become_running)

    def describe(self) -> str:
        """What the controller is in, for logs."""
        modes = f"robot {self.robot_mode.name}, safety {self.safety_mode.name}, program {self.program_state.name}"
        return f"{modes}, {'remote' if self.remote_control else 'local'} control"

    def _become_idle(self) -> None:
        self.robot_mode = RobotMode.IDLE
        self.gripper.switch_on(self.door.closure)

    def _become_running(self) -> None:
        self.robot_mode = RobotMode.RUNNING
        self.settle()

    def _watch(self) -> None:
        if self._watchdog is None or self.program_state != ProgramState.PLAYING:
            return
        name, longest = self._watchdog
        silence = self.time - self.registers.updated[name]
        if silence > longest:
            logger.warning("watchdog: %s not written for %.3f s; the program ends", name, silence)
            self.stop_program()

    def _run_program(self) -> None:
        if self._starting is not None and self.time >= self._starting[0]:
            self._program, self._starting = self._starting[1], None
            self.program_state = ProgramState.PLAYING
        if self._program is None or self.program_state != ProgramState.PLAYING:
            return
        try:
            next(self._program)
        except StopIteration:
            self.stop_program()
        except ScriptError as error:
            logger.error("the program ends: %s", error)
            self.stop_program()

    def _check_deviation(self) -> None:
        deviation = np.abs(self.motion.position - self.door.joints)
        if deviation.max() > DEVIATION_LIMIT:
            joint = self.door.arm.joints[int(deviation.argmax())]
            self.protective_stop(f"{joint} is {deviation.max():.2f} rad off its target")
