"""Real-Time Data Exchange, version 2, on port 30004: variables in both directions, in binary packages.

A package is a length of two bytes that counts itself, a type of one byte and a body, in network byte order. The client
first agrees on recipes, lists of variables, and then receives one list of measurements at the rate it asked for.
Names and types are those of Universal Robots' RTDE guide.
"""

import asyncio
import logging
import struct
import time
from collections import deque
from collections.abc import Callable

from env_door.twin.arm import TIME_STEP
from env_door.twin.controller import REGISTERS, VERSION, Controller, ProgramState, RobotMode, SafetyMode

logger = logging.getLogger(__name__)

HEADER = struct.Struct(">HB")
MAX_ARRIVALS = 100_000  # times of set-points that are kept: more than 13 minutes

FORMATS = {"UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d"}
FORMATS |= {"VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i"}


def _by_name(**names: str) -> dict[str, str]:
    registers = {name: "INT32" if "_int_" in name else "DOUBLE" for name in REGISTERS}
    return registers | {name: kind for kind, group in names.items() for name in group.split()}


# What a client may ask for; what has no counterpart in the scene reads 0.
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
# What a client may write; only registers have an effect.
INPUTS = _by_name(
    DOUBLE="speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    VECTOR6D="external_force_torque",
    UINT32="speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63",
    UINT8="""standard_digital_output_mask standard_digital_output configurable_digital_output_mask
        configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask
        standard_analog_output_type""",
)
INPUTS = {name: kind for name, kind in INPUTS.items() if not name.startswith("output_")}

POWERED = (RobotMode.IDLE, RobotMode.RUNNING)
JOINT_MODES = {RobotMode.RUNNING: 253, RobotMode.IDLE: 255, RobotMode.BOOTING: 247, RobotMode.POWER_OFF: 239}
SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.RECOVERY: 1 << 3,
    SafetyMode.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
    SafetyMode.VIOLATION: 1 << 8 | 1 << 10,
}

Reading = Callable[[], tuple[float, ...]]


class RTDEServer:
    """All clients of RTDE, what they may read, and who writes which input: a second one is refused."""

    def __init__(self, controller: Controller):
        self.controller = controller
        self.sessions: set[RTDESession] = set()
        self.owners: dict[str, RTDESession] = {}
        self.delay = 0.0  # seconds by which measurements reach the clients late
        self.frozen = False  # whether measurements are withheld and nothing is taken in
        self.arrivals: deque[float] = deque(maxlen=MAX_ARRIVALS)  # real times in s at which inputs came

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answers the packages of one client; hangs up at a malformed one."""
        session = RTDESession(self, writer)
        self.sessions.add(session)
        try:
            while True:
                size, kind = HEADER.unpack(await reader.readexactly(HEADER.size))
                body = await reader.readexactly(size - HEADER.size)
                while self.frozen:
                    await asyncio.sleep(TIME_STEP)
                if not writer.is_closing():
                    session.handle(chr(kind), body)
        except (struct.error, ValueError) as error:
            logger.warning("RTDE client sent a malformed package (%s): hung up", error)
        finally:
            self.sessions.discard(session)
            self.owners = {name: owner for name, owner in self.owners.items() if owner is not session}

    def hang_up(self, only_commanding: bool) -> None:
        """Ends the connections of all clients in order, or of those that write inputs; they may connect again."""
        for session in set(self.owners.values()) if only_commanding else set(self.sessions):
            session.close()

    def take_arrivals(self) -> list[float]:
        """The times at which inputs came, since this was asked last."""
        times = list(self.arrivals)
        self.arrivals.clear()
        return times

    def publish(self) -> None:
        """Sends measurements to all clients whose turn it is; called every 2 ms."""
        if not self.frozen:
            for session in self.sessions:
                session.publish()

    def reading(self, name: str) -> Reading:
        """A function that reads an output, looked up once and called at every package."""
        controller, door, motion = self.controller, self.controller.door, self.controller.motion
        if name in controller.registers:
            return lambda: (controller.registers[name],)
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
            "speed_scaling": lambda: (controller.speed_fraction * controller.may_move,),
            "target_speed_fraction": lambda: (controller.speed_fraction,),
            "runtime_state": lambda: (controller.program_state,),
            "robot_status_bits": lambda: (
                (controller.robot_mode in POWERED) | (controller.program_state == ProgramState.PLAYING) << 1,
            ),
            "safety_status_bits": lambda: (SAFETY_BITS[controller.safety_mode],),
        }
        zeros = (0,) * _count(OUTPUTS[name])
        return known.get(name, lambda: zeros)


class RTDESession:
    """One client of RTDE."""

    def __init__(self, server: RTDEServer, writer: asyncio.StreamWriter):
        self._server, self._writer = server, writer
        self._inputs: list[tuple[list[str], struct.Struct]] = []
        self._readings: list[Reading] = []
        self._started = False
        self._ticks = 0
        self._due: deque[tuple[float, bytes]] = deque()

    def close(self) -> None:
        """Hangs up in order."""
        self._writer.close()

    def publish(self) -> None:
        """Sends the measurements if it is time for them; called every 2 ms."""
        self._ticks += 1
        now = self._server.controller.time
        # A controller that cannot keep up skips packages rather than to send old ones.
        if self._started and not self._ticks % self._every and not self._writer.transport.get_write_buffer_size():
            body = self._format.pack(1, *(value for reading in self._readings for value in reading()))
            self._due.append((now + self._server.delay, body))
        while self._due and self._due[0][0] <= now:
            self._send("U", self._due.popleft()[1])

    def handle(self, kind: str, body: bytes) -> None:
        """Takes in a package and answers it; raises a ValueError or `struct.error` if it is malformed."""
        match kind:
            case "U":  # inputs
                if not body or not 1 <= body[0] <= len(self._inputs):
                    raise ValueError(f"unknown input recipe {body[:1].hex() or 'none'}")
                names, layout = self._inputs[body[0] - 1]
                for name, value in zip(names, layout.unpack(body[1:]), strict=True):
                    self._server.controller.write_input(name, value)
                self._server.arrivals.append(time.monotonic())
            case "V":  # version of the protocol
                self._send(kind, struct.pack(">?", struct.unpack(">H", body)[0] == 2))
            case "v":  # version of the controller
                self._send(kind, struct.pack(">4I", *VERSION))
            case "O":
                self._send(kind, self._agree_on_outputs(body))
            case "I":
                self._send(kind, self._agree_on_inputs(body))
            case "S" | "P":  # start, pause
                self._started = kind == "S" and bool(self._readings)
                self._send(kind, struct.pack(">?", self._started or kind == "P"))
            case _:
                logger.warning("RTDE package of unknown type %r ignored", kind)

    def _agree_on_outputs(self, body: bytes) -> bytes:
        (frequency,), names = struct.unpack_from(">d", body), _names(body[8:])
        types = [OUTPUTS.get(name, "NOT_FOUND") for name in names]
        known = "NOT_FOUND" not in types and bool(names) and 1 <= frequency <= 1 / TIME_STEP
        self._readings = [self._server.reading(name) for name in names] if known else []
        self._started &= known
        if known:
            self._every = max(1, round(1 / (TIME_STEP * frequency)))
            self._format = struct.Struct(">B" + "".join(FORMATS[one] for one in types))
        return bytes([known]) + ",".join(types).encode()

    def _agree_on_inputs(self, body: bytes) -> bytes:
        names, owners = _names(body), self._server.owners
        types = ["IN_USE" if owners.get(name, self) is not self else INPUTS.get(name, "NOT_FOUND") for name in names]
        known = set(types) <= set(FORMATS)
        if known:
            owners.update(dict.fromkeys(names, self))
            # One name for each number: no vector is a register, so what its numbers are called does not matter.
            fields = [name for name, one in zip(names, types, strict=True) for _ in range(_count(one))]
            self._inputs.append((fields, struct.Struct(">" + "".join(FORMATS[one] for one in types))))
        return bytes([len(self._inputs) if known else 0]) + ",".join(types).encode()

    def _send(self, kind: str, body: bytes) -> None:
        if not self._writer.is_closing():
            self._writer.write(HEADER.pack(HEADER.size + len(body), ord(kind)) + body)


def _names(body: bytes) -> list[str]:
    return [name for name in body.decode().split(",") if name]


def _count(kind: str) -> int:
    return int(FORMATS[kind][:-1] or 1)
