"""What ur_rtde's control script does on the controller: it carries out the commands that arrive in registers.

The client uploads some 42 kB of URScript. This module is not an interpreter of it but the same program written down
again (ur_rtde 1.6): `yield` stands for URScript's `sync()`, a wait for the next 2 ms.

A command is a number in input register 0 with its arguments in the other input registers. Output register 0 says 1
(ready) or 2 (done). Commands that stream, such as `servoj`, are read anew every 2 ms and leave it at 1; the others run
once, answer 2 and wait until the client has put back 0.
"""

import re
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from env_door.twin.controller import Controller, ScriptError
from env_door.twin.motion import TIME_STEP

READY, DONE = 1, 2
STOP_SCRIPT = 255
STREAMED = {6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71}
"""Commands that the script reads anew every 2 ms."""

STILL = 0.01
"""Joint speed in rad/s below which the arm counts as steady."""

_OFFSET = re.compile(r"global reg_offset_int = # int register offset\s+(\d+)")


class ControlScript:
    """One run of the control script.

    Args:
        controller (`Controller`):
            The controller it runs on.
        source (`str`, *optional*, defaults to `""`):
            The uploaded URScript, which says whether the lower or the upper half of the registers is used.
    """

    def __init__(self, controller: Controller, source: str = ""):
        self._controller = controller
        self._motion = controller.motion
        self._registers = controller.registers
        match = _OFFSET.search(source)
        self._offset = int(match[1]) if match else 0
        self._async_writes = self._async_operations = 0
        self._async_moving = False
        self._commands: dict[int, Callable[[], Iterator[None] | None]] = {
            1: self._move_j,
            8: self._nothing,  # zero_ftsensor
            9: self._speed_j,
            11: self._servo_j,
            15: self._stop_speed_or_servo,
            16: self._stop_speed_or_servo,
            17: self._nothing,  # set_payload
            26: self._step_time,
            29: self._set_tool,
            31: self._protective_stop,
            33: self._stop,
            34: self._stop,
            35: self._set_watchdog,
            37: self._joints_within_limits,
            38: self._joint_torques,
            40: self._tool_offset,
            43: self._tool_pose,
            47: self._is_steady,
        }

    def run(self) -> Iterator[None]:
        """The script's main loop.

        Yields:
            `None`: wherever the script waits for the next 2 ms.

        Raises:
            ScriptError: If a command ends the script.
        """
        executing = False
        self._signal_async(-1)
        self._answer(0, READY)
        while True:
            command = self._registers.input_int[self._offset]
            if command in STREAMED:
                yield from self._carry_out(command)
                self._answer(0, READY)
            elif command == 0:
                executing = False
                self._answer(0, READY)
            elif command == STOP_SCRIPT:
                return
            elif not executing:
                yield from self._carry_out(command)
                self._answer(0, DONE)
                executing = True
            self._finish_async_move()
            yield

    def _carry_out(self, command: int) -> Iterator[None]:
        if command not in self._commands:
            raise ScriptError(f"command {command} of ur_rtde is not emulated; {sorted(self._commands)} are")
        yield from self._commands[command]() or ()

    def _argument(self, index: int) -> float:
        return self._registers.input_double[self._offset + index]

    def _arguments(self, count: int) -> NDArray[np.float64]:
        values = np.array(self._registers.input_double[self._offset : self._offset + count])
        if not np.isfinite(values).all():
            raise ScriptError(f"arguments {values.tolist()} are not finite")
        return values

    def _answer(self, index: int, value: int) -> None:
        self._registers.output_int[self._offset + index] = value

    def _answer_with(self, values: NDArray[np.float64]) -> None:
        for index, value in enumerate(values):
            self._registers.output_double[self._offset + index] = float(value)

    def _servo_j(self) -> None:
        if self._motion.kind in ("move", "speed"):
            raise ScriptError("another thread is already controlling the robot: stop it before servoj")
        target = self._arguments(6)
        self._motion.servo(target, lookahead=self._argument(9), gain=self._argument(10))

    def _speed_j(self) -> None:
        if self._motion.kind in ("move", "servo"):
            raise ScriptError("another thread is already controlling the robot: stop it before speedj")
        self._motion.speed(self._arguments(6), acceleration=self._argument(6))

    def _move_j(self) -> Iterator[None]:
        if self._motion.kind in ("servo", "speed"):
            raise ScriptError("another thread is already controlling the robot: servoStop or speedStop before movej")
        self._abandon_async_move()
        self._motion.move(self._arguments(6), speed=self._argument(6), acceleration=self._argument(7))
        if self._registers.input_int[self._offset + 1] == 1:
            self._signal_async(0)
            self._async_moving = True
            return
        yield from self._until_still()

    def _stop_speed_or_servo(self) -> Iterator[None]:
        # The script calls stopl for servos, whose unit is m/s^2; the twin brakes its joints with as many rad/s^2.
        self._motion.stop(self._argument(0))
        yield from self._until_still()

    def _stop(self) -> Iterator[None]:
        if self._motion.kind in ("servo", "speed"):
            raise ScriptError("another thread is already controlling the robot: use servoStop or speedStop")
        self._abandon_async_move()
        self._motion.stop(self._argument(0))
        if self._registers.input_int[self._offset + 1] == 1:
            self._signal_async(0)
            self._async_moving = True
            return
        yield from self._until_still()

    def _until_still(self) -> Iterator[None]:
        while self._motion.kind != "hold":
            yield

    def _nothing(self) -> None:
        """Commands that are taken and change nothing in the scene."""

    def _step_time(self) -> None:
        self._answer_with(np.array([TIME_STEP]))

    def _set_tool(self) -> None:
        self._controller.tool_offset = self._arguments(6)

    def _tool_offset(self) -> None:
        self._answer_with(self._controller.tool_offset)

    def _tool_pose(self) -> None:
        self._answer_with(self._controller.door.tool_pose(self._controller.tool_offset))

    def _protective_stop(self) -> Iterator[None]:
        self._controller.protective_stop("asked for by the client")
        yield  # the program is paused right here, before it could answer

    def _set_watchdog(self) -> None:
        self._controller.arm_watchdog(f"input_int_register_{self._offset}", self._argument(0))

    def _joints_within_limits(self) -> None:
        joints, door = self._arguments(6), self._controller.door
        self._answer(1, int(bool(((joints >= door.joint_low) & (joints <= door.joint_high)).all())))

    def _joint_torques(self) -> None:
        self._answer_with(self._controller.door.joint_torques)

    def _is_steady(self) -> None:
        steady = self._motion.kind == "hold" and bool((np.abs(self._controller.door.joint_speeds) < STILL).all())
        self._answer(1, int(steady))

    def _finish_async_move(self) -> None:
        if self._async_moving and self._motion.kind == "hold":
            self._abandon_async_move()

    def _abandon_async_move(self) -> None:
        if self._async_moving:
            self._async_moving = False
            self._signal_async(-1)

    def _signal_async(self, progress: int) -> None:
        """Output register 2: counters of writes and operations, whether one runs (bit 15) and how far it is."""
        self._async_writes = (self._async_writes + 1) % 128
        if progress == 0:
            self._async_operations = (self._async_operations + 1) % 128
        value = self._async_writes << 16 | self._async_operations << 24
        self._answer(2, value | (progress | 1 << 15 if progress >= 0 else 0))
