"""The robot controller: power, safety, the program that runs, and one tick of 2 ms.

What a client sees of it are modes and bits whose values are Universal Robots' own. A protective stop pauses the program
and waits for somebody to unlock it; an emergency stop and a loss of power end it.
"""

import logging
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from env_door.twin.gripper import Gripper
from env_door.twin.live_door import LiveDoor
from env_door.twin.modes import ProgramState, RobotMode, SafetyMode
from env_door.twin.motion import TIME_STEP, JointMotion
from env_door.twin.registers import Registers

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


class ScriptError(Exception):
    """The running program did something that ends it."""


class Controller:
    """State of the controller, the arm's motion, the gripper and the scene.

    Args:
        door (`LiveDoor`):
            The scene.
        unlock_seconds (`float`, *optional*, defaults to `5.0`):
            Time in s after a protective stop before it can be unlocked.
    """

    def __init__(self, door: LiveDoor, unlock_seconds: float = 5.0):
        self.door = door
        self.gripper = Gripper()
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
    def robot_status_bits(self) -> int:
        """`int`: RTDE's `robot_status_bits`: power and running program."""
        powered = self.robot_mode in (RobotMode.IDLE, RobotMode.RUNNING)
        return int(powered) | int(self.program_state == ProgramState.PLAYING) << 1

    @property
    def watchdog_armed(self) -> bool:
        """`bool`: whether the program has armed a watchdog."""
        return self._watchdog is not None

    def settle(self) -> None:
        """Makes the measured pose the target: after a new trial, and when brakes close."""
        self.motion.hold(self.door.joints)

    def tick(self) -> None:
        """Goes on by 2 ms.

        Raises:
            RuntimeError: If the physics diverged.
        """
        self._ticks += 1
        self.time = self._ticks * TIME_STEP
        self._finish_switching()
        self._watch()
        self._run_program()
        self.motion.step()
        self.gripper.step(self.door.closure, TIME_STEP)
        self.door.tick(self.motion.position, self.motion.velocity, self.gripper.target)
        if self._ticks % 10 == 0:
            self.door.limit_grip(self.gripper.force)
            self._check_deviation()
            self.door.check()

    def start_program(self, program: Iterator[None], name: str) -> bool:
        """Starts a program in the place of the one that may be running.

        Args:
            program (`Iterator[None]`):
                The program; it is advanced by one step every 2 ms.
            name (`str`):
                Its name, for the log.

        Returns:
            `bool`: whether the controller takes it: only in remote control, switched on and not stopped by safety.
        """
        if not (self.remote_control and self.may_move):
            logger.info("program %s refused: %s", name, self.describe())
            return False
        self.stop_program()
        self._starting = (self.time + START_SECONDS, program)
        logger.info("program %s taken", name)
        return True

    def stop_program(self) -> None:
        """Ends the running program; a moving arm brakes. Watchdogs end with it, as on the controller."""
        self._program = self._watchdog = self._starting = None
        self.program_state = ProgramState.STOPPED
        self.motion.stop(STOP_DECELERATION)

    def play(self) -> bool:
        """Resumes a paused program.

        Returns:
            `bool`: whether there was one and it may run.
        """
        if self.program_state != ProgramState.PAUSED or not self.may_move:
            return False
        self.program_state = ProgramState.PLAYING
        # A program that resumes must not take a pause for a client that has fallen silent.
        if self._watchdog is not None:
            self.registers.updated[self._watchdog[0]] = self.time
        return True

    def pause(self) -> bool:
        """Pauses the running program.

        Returns:
            `bool`: whether one was running.
        """
        if self.program_state != ProgramState.PLAYING:
            return False
        self.program_state = ProgramState.PAUSED
        self.motion.stop(STOP_DECELERATION)
        return True

    @property
    def may_move(self) -> bool:
        """`bool`: whether power and safety let a program move the arm."""
        return self.robot_mode == RobotMode.RUNNING and self.safety_mode == SafetyMode.NORMAL

    def arm_watchdog(self, name: str, min_frequency: float) -> None:
        """Ends the program once an input has not been written for too long.

        Args:
            name (`str`):
                The RTDE input to watch.
            min_frequency (`float`):
                How often it must be written, in Hz; 0 watches no more.
        """
        self._watchdog = (name, 1.0 / min_frequency) if min_frequency > 0 else None
        self.registers.updated[name] = self.time

    def protective_stop(self, reason: str) -> None:
        """Stops at once, pauses the program and waits to be unlocked.

        Args:
            reason (`str`):
                Why, for the log.
        """
        if self.safety_mode == SafetyMode.NORMAL and self.robot_mode == RobotMode.RUNNING:
            logger.warning("protective stop: %s", reason)
            self.pause()
            self._starting = None
            self.safety_mode, self._stopped_at = SafetyMode.PROTECTIVE_STOP, self.time
            self.settle()

    def unlock(self) -> bool:
        """Ends a protective stop.

        Returns:
            `bool`: whether it could be ended: not before the waiting time is over.
        """
        if self.safety_mode != SafetyMode.PROTECTIVE_STOP:
            return True
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
        """What the controller is in, for logs and errors.

        Returns:
            `str`: modes in words.
        """
        control = "remote" if self.remote_control else "local"
        return (
            f"robot {self.robot_mode.name}, safety {self.safety_mode.name}, program {self.program_state.name}, "
            f"{control} control"
        )

    def _become_idle(self) -> None:
        self.robot_mode = RobotMode.IDLE
        self.gripper.switch_on(self.door.closure)

    def _become_running(self) -> None:
        self.robot_mode = RobotMode.RUNNING
        self.settle()

    def _finish_switching(self) -> None:
        if self._switching is not None and self.time >= self._switching[0]:
            finish = self._switching[1]
            self._switching = None
            finish()

    def _watch(self) -> None:
        if self._watchdog is None or self.program_state != ProgramState.PLAYING:
            return
        name, longest = self._watchdog
        silence = self.time - self.registers.updated.get(name, 0.0)
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
