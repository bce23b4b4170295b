"""The robot's controller: power, safety, registers, the program that runs, one tick of 2 ms, and the pendant.

What a client sees of it are modes and bits whose values are Universal Robots' own. A protective stop pauses the program
and waits for somebody to unlock it; an emergency stop and a loss of power end it.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Iterator
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from env_door.twin.arm import TIME_STEP, JointMotion, LiveDoor
from env_door.twin.gripper import GripperModel
from env_door.twin.ports import lines

logger = logging.getLogger(__name__)

DEVIATION_LIMIT = 0.5  # rad between target and measured joint at which the controller makes a protective stop
STOP_DECELERATION = 10.0  # rad/s^2 when a program ends while the arm moves
POWER_SECONDS = 0.3  # that switching on and releasing the brakes take each; some seconds on a real arm
START_SECONDS = 0.02  # between the upload of a program and its start
TOOL_POINT = (0.0, 0.0, 0.15, 0.0, 0.0, 0.0)  # tool centre point in the flange's frame: between the pads

STILL_LOCKED = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)

VERSION = (5, 15, 0, 126271)  # of the controller's software that clients are told
REGISTERS = [
    f"{way}_{kind}_register_{i}" for way in ("input", "output") for kind in ("int", "double") for i in range(48)
]


# What the arm is ready for, why it may not move, and RTDE's `runtime_state`.
RobotMode = IntEnum("RobotMode", {"BOOTING": 2, "POWER_OFF": 3, "IDLE": 5, "RUNNING": 7})
SafetyMode = IntEnum(
    "SafetyMode",
    {"NORMAL": 1, "PROTECTIVE_STOP": 3, "RECOVERY": 4, "SAFEGUARD_STOP": 5, "ROBOT_EMERGENCY_STOP": 7, "VIOLATION": 8},
)
ProgramState = IntEnum("ProgramState", {"STOPPED": 1, "PLAYING": 2, "PAUSED": 4})


class ScriptError(Exception):
    """The running program did something that ends it."""


class Controller:
    """State of the controller, the arm's motion, the gripper and the scene.

    `registers` are the letter box between a client and the program, by RTDE's names. As on a real controller they keep
    their values when a client leaves.
    """

    def __init__(self, door: LiveDoor, unlock_seconds: float):
        self.door = door
        self.gripper = GripperModel()
        self.motion = JointMotion(door.joint_low, door.joint_high, np.array(door.arm.joint_speed))
        self.registers: dict[str, float] = dict.fromkeys(REGISTERS, 0)
        self.tool_offset: NDArray[np.float64] = np.array(TOOL_POINT)
        self.time = 0.0
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.program_state = ProgramState.STOPPED
        self.remote_control = True
        self.speed_fraction = 1.0  # the speed slider; it is told only, and slows nothing down
        self.watchdog: tuple[str, float] | None = None  # an input, and the longest time between two writes of it
        self._written: dict[str, float] = {}  # when
        self._unlock_seconds = unlock_seconds
        self._stopped_at = 0.0
        self._program: Iterator[None] | None = None
        self._program_starts = 0.0
        self._switching_ends = math.inf
        self._ticks = 0
        self.settle()

    @property
    def may_move(self) -> bool:
        """Whether power and safety let a program move the arm."""
        return self.robot_mode == RobotMode.RUNNING and self.safety_mode == SafetyMode.NORMAL

    def settle(self) -> None:
        """Makes the measured pose the target: after a new trial, and when brakes close."""
        self.motion.hold(self.door.joints)

    def tick(self) -> None:
        """Goes on by 2 ms; raises a RuntimeError if the physics diverged."""
        self._ticks += 1
        self.time = self._ticks * TIME_STEP
        self._switch()
        self._watch()
        self._run_program()
        self.motion.step()
        self.gripper.step(self.door.closure, TIME_STEP)
        self.door.tick(self.motion.position, self.motion.velocity, self.gripper.target, self.gripper.force)
        deviation = np.abs(self.motion.position - self.door.joints)
        if deviation.max() > DEVIATION_LIMIT:
            joint = self.door.arm.joints[int(deviation.argmax())]
            self.protective_stop(f"{joint} is {deviation.max():.2f} rad off its target")

    def write_input(self, name: str, value: float) -> None:
        """Takes what a client writes; what is no register has no effect."""
        if name in self.registers:
            self.registers[name] = value
            self._written[name] = self.time

    def start_program(self, program: Iterator[None]) -> None:
        """Starts a program, which is advanced every 2 ms, in the place of another, if the arm may be controlled."""
        if not (self.remote_control and self.may_move):
            control = "remote" if self.remote_control else "local"
            logger.info("program refused: %s, %s, %s control", self.robot_mode.name, self.safety_mode.name, control)
            return
        self.stop_program()
        self._program, self._program_starts = program, self.time + START_SECONDS

    def stop_program(self) -> None:
        """Ends the running program; a moving arm brakes. Watchdogs end with it, as on a real controller."""
        self._program = self.watchdog = None
        self.program_state = ProgramState.STOPPED
        self.motion.stop(STOP_DECELERATION)

    def play(self) -> bool:
        """Resumes a paused program; whether there was one and it may run."""
        if self.program_state != ProgramState.PAUSED or not self.may_move:
            return False
        self.program_state = ProgramState.PLAYING
        if self.watchdog is not None:  # it must not take the pause for a client that has fallen silent
            self._written[self.watchdog[0]] = self.time
        return True

    def pause(self) -> bool:
        """Pauses the running program; whether one was running."""
        if self.program_state != ProgramState.PLAYING:
            return False
        self.program_state = ProgramState.PAUSED
        self.motion.stop(STOP_DECELERATION)
        return True

    def arm_watchdog(self, name: str, min_frequency: float) -> None:
        """Ends the program once an input is written less often than so many times a second; 0 watches no more."""
        self.watchdog = (name, 1.0 / min_frequency) if min_frequency > 0 else None
        self._written[name] = self.time

    def protective_stop(self, reason: str) -> None:
        """Stops at once, pauses the program and waits to be unlocked."""
        self.safety_stop(SafetyMode.PROTECTIVE_STOP, reason)

    def safety_stop(self, mode: SafetyMode, reason: str) -> None:
        """Stops at once and pauses the program, in a safety mode that keeps the power on."""
        if self.may_move:
            logger.warning("%s: %s", mode.name, reason)
            if self.program_state == ProgramState.STOPPED:
                self._program = None  # it was about to start
            self.pause()
            self.safety_mode, self._stopped_at = mode, self.time
            self.settle()

    def end_safety_stop(self, mode: SafetyMode) -> None:
        """Ends a stop of a kind that does not wait to be unlocked; the program stays paused."""
        if self.safety_mode == mode:
            self.safety_mode = SafetyMode.NORMAL

    def unlock(self) -> bool:
        """Ends a protective stop; whether it could be ended: not before the waiting time is over."""
        if self.safety_mode == SafetyMode.PROTECTIVE_STOP:
            if self.time - self._stopped_at < self._unlock_seconds:
                return False
            self.safety_mode = SafetyMode.NORMAL
        return True

    def emergency_stop(self, pressed: bool) -> None:
        """Presses the button, which takes the arm's power away, or pulls it out again; the arm stays without power."""
        self.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP if pressed else SafetyMode.NORMAL
        if pressed:
            self.power_off()

    def power_off(self) -> None:
        """Takes the arm's power away: the program ends and brakes close."""
        self.stop_program()
        self.settle()
        self._switching_ends = math.inf
        self.robot_mode = RobotMode.POWER_OFF
        self.gripper.switch_off()

    def power_on(self) -> None:
        """Switches the arm on, with brakes closed; without effect during an emergency stop."""
        if self.robot_mode == RobotMode.POWER_OFF and self.safety_mode == SafetyMode.NORMAL:
            self.robot_mode = RobotMode.BOOTING
            self._switching_ends = self.time + POWER_SECONDS

    def release_brakes(self) -> None:
        """Releases the brakes of an arm that is switched on."""
        if self.robot_mode == RobotMode.IDLE and self.safety_mode == SafetyMode.NORMAL:
            self._switching_ends = self.time + POWER_SECONDS

    def _switch(self) -> None:
        if self.time < self._switching_ends:
            return
        self._switching_ends = math.inf
        if self.robot_mode == RobotMode.BOOTING:
            self.robot_mode = RobotMode.IDLE
            self.gripper.switch_on(self.door.closure)
        else:
            self.robot_mode = RobotMode.RUNNING
            self.settle()

    def _watch(self) -> None:
        if self.watchdog is not None and self.program_state == ProgramState.PLAYING:
            name, longest = self.watchdog
            silence = self.time - self._written[name]
            if silence > longest:
                logger.warning("watchdog: %s not written for %.3f s; the program ends", name, silence)
                self.stop_program()

    def _run_program(self) -> None:
        if self._program is None or self.program_state == ProgramState.PAUSED:
            return
        if self.program_state == ProgramState.STOPPED:
            if self.time < self._program_starts:
                return
            self.program_state = ProgramState.PLAYING
        try:
            next(self._program)
        except (StopIteration, ScriptError) as end:
            if isinstance(end, ScriptError):
                logger.error("the program ends: %s", end)
            self.stop_program()


async def serve_dashboard(controller: Controller, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """The dashboard server on port 29999: what a person does on the teach pendant, as lines of text.

    Replies are those of an e-Series controller, which clients compare letter by letter.
    """
    # What is done, and the answers to what was done and to what could not be. A controller in local control leaves all
    # of it to the person in front of it. Clients take any answer to `stop` but this one for a failure.
    actions: dict[str, tuple[Callable[[], bool | None], str, str]] = {
        "play": (controller.play, "Starting program", "Failed to execute: play"),
        "pause": (controller.pause, "Pausing program", "Failed to execute: pause"),
        "stop": (controller.stop_program, "Stopped", ""),
        "unlock protective stop": (controller.unlock, "Protective stop releasing", STILL_LOCKED),
        "power on": (controller.power_on, "Powering on", ""),
        "power off": (controller.power_off, "Powering off", ""),
        "brake release": (controller.release_brakes, "Brake releasing", ""),
    }
    writer.write(b"Connected: Universal Robots Dashboard Server\n")
    async for line in lines(reader):
        command = line.lower()
        if command == "quit":
            writer.write(b"Disconnected\n")
            return
        answers = {
            "running": f"Program running: {str(controller.program_state == ProgramState.PLAYING).lower()}",
            "programstate": f"{controller.program_state.name} <unnamed>",
            "robotmode": f"Robotmode: {controller.robot_mode.name}",
            "safetymode": f"Safetymode: {controller.safety_mode.name}",
            "safetystatus": f"Safetystatus: {controller.safety_mode.name}",
            "is in remote control": str(controller.remote_control).lower(),
            "close safety popup": "closing safety popup",
            "get serial number": "20235500001",  # without which ur_rtde's control does not connect
            "polyscopeversion": f"URSoftware {'.'.join(map(str, VERSION))} (Oct 15 2023)",
        }
        answer = answers.get(command, f"could not understand: '{line}'")
        if command in actions:
            action, done, failed = actions[command]
            answer = f"Failed to execute: {command}"
            if controller.remote_control:
                answer = failed if action() is False else done
        writer.write(f"{answer}\n".encode())
