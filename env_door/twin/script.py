"""Ports 30001 to 30003, where clients upload URScript, and what ur_rtde's control script does on the controller.

The client uploads some 42 kB of URScript. This module is not an interpreter of it but the same program written down
again (ur_rtde 1.6): `yield` stands for URScript's `sync()`, a wait for the next 2 ms. Other programs are not run, and
the state that a real controller streams on these ports is not sent.

A command is a number in input register 0 with its arguments in the other input registers. Output register 0 says 1
(ready) or 2 (done). Commands that stream, such as `servoj`, are read anew every 2 ms and leave it at 1; the others run
once, answer 2 and wait until the client has put back 0.
"""

import asyncio
import logging
import re
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from env_door.twin.arm import TIME_STEP
from env_door.twin.controller import Controller, ScriptError

logger = logging.getLogger(__name__)

READY, DONE = 1, 2
STOP_SCRIPT = 255
STREAMED = {6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71}  # read anew every 2 ms
STEADY = 0.01  # joint speed in rad/s below which the arm counts as steady

_NAME = re.compile(r"^def\s+(\w+)\s*\(", re.MULTILINE)
_OFFSET = re.compile(r"global reg_offset_int = # int register offset\s+(\d+)")


async def serve_uploads(controller: Controller, reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
    """Takes programs from a client; they run on when it leaves."""
    while True:  # a program is whole at its first `end` at the start of a line
        source = (await reader.readuntil(b"\nend\n")).decode("utf-8", "replace")
        name = match[1] if (match := _NAME.search(source)) else "without a name"
        if name == "rtde_control":
            controller.start_program(UploadedScript(controller, source).run())
        else:
            logger.error("program %s is not emulated (only ur_rtde's rtde_control is): ignored", name)


class UploadedScript:
    """One run of ur_rtde's control script, whose source says which half of the registers it uses."""

    def __init__(self, controller: Controller, source: str):
        self._controller, self._motion, self._registers = controller, controller.motion, controller.registers
        self._offset = int(match[1]) if (match := _OFFSET.search(source)) else 0
        self._async_writes = self._async_operations = 0

    def run(self) -> Iterator[None]:
        """The script's main loop; a ScriptError ends it."""
        executing = False
        self._signal_async(running=False)
        self._answer(0, READY)
        while (command := self._integer(0)) != STOP_SCRIPT:
            if command in STREAMED:
                yield from self._carry_out(command)
                self._answer(0, READY)
            elif command == 0:
                executing = False
                self._answer(0, READY)
            elif not executing:
                yield from self._carry_out(command)
                self._answer(0, DONE)
                executing = True
            if self._motion.kind == "hold":
                self._end_async_move()
            yield

    def _carry_out(self, command: int) -> Iterator[None]:
        controller, motion, door = self._controller, self._motion, self._controller.door
        match command:
            case 1:  # movej
                self._take_over()
                motion.move(self._joint_arguments(), speed=self._argument(6), acceleration=self._argument(7))
                yield from self._until_still_unless_async()
            case 8 | 17:  # zero_ftsensor, set_payload
                pass
            case 11:  # servoj
                self._refuse_during("move", "stopJ")
                motion.servo(self._joint_arguments(), lookahead=self._argument(9), gain=self._argument(10))
            case 16:  # servo_stop: stopl, whose unit is m/s^2; the twin brakes its joints with as many rad/s^2
                motion.stop(self._argument(0))
                yield from self._until_still()
            case 26:  # get_steptime
                self._answer_with([TIME_STEP])
            case 29:  # set_tcp
                controller.tool_offset = self._joint_arguments()
            case 31:  # protective_stop
                controller.protective_stop("asked for by the client")
                yield  # the program is paused right here, before it could answer
            case 33 | 34:  # stopl, stopj
                self._take_over()
                motion.stop(self._argument(0))
                yield from self._until_still_unless_async()
            case 35:  # set_watchdog
                controller.arm_watchdog(f"input_int_register_{self._offset}", self._argument(0))
            case 37:  # is_joints_within_safety_limits
                joints = self._joint_arguments()
                self._answer(1, int(((joints >= door.joint_low) & (joints <= door.joint_high)).all()))
            case 38:  # get_joint_torques
                self._answer_with(door.joint_torques)
            case 40:  # get_tcp_offset
                self._answer_with(controller.tool_offset)
            case 43:  # get_forward_kinematics_default
                self._answer_with(door.tool_pose(controller.tool_offset))
            case 47:  # is_steady
                self._answer(1, int(motion.kind == "hold" and np.abs(door.joint_speeds).max() < STEADY))
            case _:
                raise ScriptError(f"command {command} of ur_rtde is not emulated")

    def _integer(self, index: int) -> int:
        return int(self._registers[f"input_int_register_{self._offset + index}"])

    def _argument(self, index: int) -> float:
        return self._registers[f"input_double_register_{self._offset + index}"]

    def _joint_arguments(self) -> NDArray[np.float64]:
        values = np.array([self._argument(index) for index in range(6)])
        if not np.isfinite(values).all():
            raise ScriptError(f"arguments {values.tolist()} are not finite")
        return values

    def _answer(self, index: int, value: int) -> None:
        self._registers[f"output_int_register_{self._offset + index}"] = value

    def _answer_with(self, values: Iterable[float]) -> None:
        for index, value in enumerate(values):
            self._registers[f"output_double_register_{self._offset + index}"] = float(value)

    def _take_over(self) -> None:
        self._refuse_during("servo", "servoStop")
        self._end_async_move()

    def _refuse_during(self, kind: str, stop: str) -> None:
        if self._motion.kind == kind:
            raise ScriptError(f"another thread is already controlling the robot: {stop} first")

    def _until_still(self) -> Iterator[None]:
        while self._motion.kind != "hold":
            yield

    def _until_still_unless_async(self) -> Iterator[None]:
        if self._integer(1) == 1:
            self._signal_async(running=True)
        else:
            yield from self._until_still()

    def _end_async_move(self) -> None:
        if self._async_running:
            self._signal_async(running=False)

    def _signal_async(self, running: bool) -> None:
        # Output register 2: counters of writes and operations, and whether one runs (bit 15); how far it is stays 0.
        self._async_running = running
        self._async_writes = (self._async_writes + 1) % 128
        self._async_operations = (self._async_operations + running) % 128
        self._answer(2, self._async_writes << 16 | self._async_operations << 24 | running << 15)
