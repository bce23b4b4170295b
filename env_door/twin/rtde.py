"""Real-Time Data Exchange, version 2, on port 30004: variables in both directions, in binary packages.

A package is a length of two bytes that counts itself, a type of one byte and a body, in network byte order. The client
first agrees on recipes, lists of variables, and then receives one list of measurements at the rate it asked for.
Names and types are those of Universal Robots' RTDE guide.
"""

import asyncio
import logging
import struct
from collections import deque
from collections.abc import Callable
from enum import IntEnum

from env_door.twin.controller import Controller, ProgramState, RobotMode, SafetyMode
from env_door.twin.motion import TIME_STEP

logger = logging.getLogger(__name__)

VERSION = (5, 15, 0, 126271)
"""Version of the controller's software that clients are told."""

HEADER = struct.Struct(">HB")

TYPES = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
"""RTDE's types as formats of Python's `struct`."""


def _by_name(**names: str) -> dict[str, str]:
    return {name: kind for kind, group in names.items() for name in group.split()}


OUTPUTS = _by_name(
    DOUBLE="""timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage
        actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1 standard_analog_output0
        standard_analog_output1 payload""",
    VECTOR6D="""target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
        joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed
        joint_temperatures actual_joint_voltage ft_raw_wrench payload_inertia""",
    VECTOR3D="actual_tool_accelerometer payload_cog",
    VECTOR6INT32="joint_mode",
    INT32="robot_mode safety_mode safety_status",
    UINT32="""runtime_state robot_status_bits safety_status_bits output_bit_registers0_to_31
        output_bit_registers32_to_63""",
    UINT64="actual_digital_input_bits actual_digital_output_bits",
)
"""What a client may ask for beside registers; what has no counterpart in the scene reads 0."""

INPUTS = _by_name(
    DOUBLE="speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    VECTOR6D="external_force_torque",
    UINT32="speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63",
    UINT8="""standard_digital_output_mask standard_digital_output configurable_digital_output_mask
        configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask
        standard_analog_output_type""",
)
"""What a client may write beside registers; taken, and without effect here."""

JOINT_MODES = {RobotMode.RUNNING: 253, RobotMode.IDLE: 255, RobotMode.BOOTING: 247, RobotMode.POWER_OFF: 239}

SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}

Reading = Callable[[], tuple[float, ...]]


class Package(IntEnum):
    """Types of packages."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class RTDEServer:
    """All clients of RTDE.

    Attributes:
        sessions (`set[RTDESession]`): The clients.
        delay (`float`): Seconds by which measurements reach the clients late.
        frozen (`bool`): Whether measurements are withheld.
    """

    def __init__(self, controller: Controller):
        self.controller = controller
        self.sessions: set[RTDESession] = set()
        self.delay = 0.0
        self.frozen = False

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answers the packages of one client; hangs up at a malformed one."""
        session = RTDESession(self, writer)
        self.sessions.add(session)
        try:
            while True:
                size, kind = HEADER.unpack(await reader.readexactly(HEADER.size))
                session.handle(kind, await reader.readexactly(size - HEADER.size))
        except (struct.error, ValueError) as error:
            logger.warning("RTDE client sent a malformed package (%s): hung up", error)
        finally:
            self.sessions.discard(session)
            self.controller.registers.release(session)

    def publish(self) -> None:
        """Sends measurements to all clients whose turn it is; called every 2 ms."""
        if not self.frozen:
            for session in self.sessions:
                session.publish()

    def reading(self, name: str) -> Reading:
        """A function that reads an output variable or register, looked up once and called at every package."""
        controller, door, motion = self.controller, self.controller.door, self.controller.motion
        if (found := controller.registers.find(name)) is not None:
            registers, index = found
            return lambda: (registers[index],)
        known: dict[str, Reading] = {
            "timestamp": lambda: (controller.time,),
            "target_q": lambda: tuple(motion.position),
            "target_qd": lambda: tuple(motion.velocity),
            "target_moment": lambda: tuple(door.joint_torques),
            "actual_q": lambda: tuple(door.joints),
            "actual_qd": lambda: tuple(door.joint_speeds),
            "actual_TCP_pose": lambda: tuple(door.tool_pose(controller.tool_offset)),
            "robot_mode": lambda: (controller.robot_mode,),
            "joint_mode": lambda: (JOINT_MODES[controller.robot_mode],) * 6,
            "safety_mode": lambda: (controller.safety_mode,),
            "safety_status": lambda: (controller.safety_mode,),
            "speed_scaling": lambda: (float(controller.may_move),),
            "target_speed_fraction": lambda: (1.0,),
            "actual_main_voltage": lambda: (48.0,),
            "actual_robot_voltage": lambda: (48.0 if controller.robot_mode != RobotMode.POWER_OFF else 0.0,),
            "joint_temperatures": lambda: (30.0,) * 6,
            "runtime_state": lambda: (controller.program_state,),
            "robot_status_bits": self._status_bits,
            "safety_status_bits": lambda: (SAFETY_BITS[controller.safety_mode],),
        }
        zeros = (0,) * _count(OUTPUTS[name])
        return known.get(name, lambda: zeros)

    def type_of(self, name: str, known: dict[str, str]) -> str:
        """RTDE's type of a register or of one of the `known` variables, or what it answers for neither."""
        if self.controller.registers.find(name) is not None:
            return "INT32" if "_int_" in name else "DOUBLE"
        return known.get(name, "NOT_FOUND")

    def _status_bits(self) -> tuple[int]:
        powered = self.controller.robot_mode in (RobotMode.IDLE, RobotMode.RUNNING)
        return (int(powered) | (self.controller.program_state == ProgramState.PLAYING) << 1,)


class RTDESession:
    """One client of RTDE."""

    def __init__(self, server: RTDEServer, writer: asyncio.StreamWriter):
        self._server, self._writer = server, writer
        self._registers = server.controller.registers
        self._inputs: dict[int, tuple[list[str], struct.Struct]] = {}
        self._readings: list[Reading] = []
        self._format = struct.Struct(">B")
        self._every = 1
        self._started = False
        self._ticks = 0
        self._late: deque[tuple[float, bytes]] = deque()

    def publish(self) -> None:
        """Sends the measurements if it is time for them; called every 2 ms."""
        self._ticks += 1
        time = self._server.controller.time
        while self._late and self._late[0][0] <= time:
            self._send(Package.DATA, self._late.popleft()[1])
        # A controller that cannot keep up skips packages rather than to send old ones.
        if not self._started or self._ticks % self._every or self._writer.transport.get_write_buffer_size():
            return
        body = self._format.pack(1, *(value for reading in self._readings for value in reading()))
        if self._server.delay > 0 or self._late:
            self._late.append((time + self._server.delay, body))
        else:
            self._send(Package.DATA, body)

    def handle(self, kind: int, body: bytes) -> None:
        """Takes in a package and answers it; raises a ValueError or `struct.error` if it is malformed."""
        match kind:
            case Package.DATA:
                if not body or body[0] not in self._inputs:
                    raise ValueError(f"unknown input recipe {body[:1].hex() or 'none'}")
                names, layout = self._inputs[body[0]]
                values = zip(names, layout.unpack(body[1:]), strict=True)
                self._registers.write_inputs(values, self._server.controller.time)
            case Package.PROTOCOL_VERSION:
                self._send(kind, struct.pack(">?", struct.unpack(">H", body)[0] == 2))
            case Package.CONTROLLER_VERSION:
                self._send(kind, struct.pack(">4I", *VERSION))
            case Package.OUTPUTS:
                self._send(kind, self._agree_on_outputs(body))
            case Package.INPUTS:
                self._send(kind, self._agree_on_inputs(body))
            case Package.START:
                self._started = bool(self._readings)
                self._send(kind, struct.pack(">?", self._started))
            case Package.PAUSE:
                self._started = False
                self._send(kind, struct.pack(">?", True))
            case _:
                logger.warning("RTDE package of unknown type %d ignored", kind)

    def _agree_on_outputs(self, body: bytes) -> bytes:
        (frequency,), names = struct.unpack_from(">d", body), _names(body[8:])
        types = [self._server.type_of(name, OUTPUTS) for name in names]
        if "NOT_FOUND" in types or not names or not 1 <= frequency <= 1 / TIME_STEP:
            self._readings = []
            return b"\x00" + ",".join(types).encode()
        self._every = max(1, round(1 / (TIME_STEP * frequency)))
        self._readings = [self._server.reading(name) for name in names]
        self._format = struct.Struct(">B" + "".join(TYPES[one] for one in types))
        return b"\x01" + ",".join(types).encode()

    def _agree_on_inputs(self, body: bytes) -> bytes:
        names, owners = _names(body), self._registers.owners
        types = ["IN_USE" if owners.get(name, self) is not self else self._input_type(name) for name in names]
        if any(one not in TYPES for one in types):
            return b"\x00" + ",".join(types).encode()
        owners.update(dict.fromkeys(names, self))
        identity = len(self._inputs) + 1
        # One name for each number: no vector is a register, so what its numbers are called does not matter.
        fields = [name for name, one in zip(names, types, strict=True) for _ in range(_count(one))]
        self._inputs[identity] = (fields, struct.Struct(">" + "".join(TYPES[one] for one in types)))
        return bytes([identity]) + ",".join(types).encode()

    def _input_type(self, name: str) -> str:
        return "NOT_FOUND" if name.startswith("output_") else self._server.type_of(name, INPUTS)

    def _send(self, kind: int, body: bytes) -> None:
        if not self._writer.is_closing():
            self._writer.write(HEADER.pack(HEADER.size + len(body), kind) + body)


def _names(body: bytes) -> list[str]:
    return [name for name in body.decode().split(",") if name]


def _count(kind: str) -> int:
    return int(TYPES[kind][:-1] or 1)
