"""What is asked of the controller before the arm is commanded, and how its program is ended when nobody commands it."""

import contextlib
import io
import logging
import socket
import struct
import time
from collections.abc import Iterator

from .configuration import UR5eRobotiqConfig
from .faults import Fault, RobotFaultError, safety_fault

logger = logging.getLogger(__name__)

DASHBOARD_PORT, RTDE_PORT = 29999, 30004
RTDE_HEADER = struct.Struct(">HB")  # size of a package, of which it is a part, and kind
TIMEOUT = 2.0  # s that the controller may take to answer
END_SECONDS = 1.0  # that a program may take to end
OLDEST = (5, 11)  # version of the controller's software, of which 5 is PolyScope 5 and 10 PolyScope X


class Dashboard:
    """The controller's dashboard server, which takes a command a line and answers in one line."""

    def __init__(self, connection: socket.socket):
        self._connection, self._answers = connection, connection.makefile("rb")
        self._answers.readline()  # it greets

    def ask(self, command: str) -> str:
        """Answer to a command; raises an `OSError` if there is none."""
        self._connection.sendall(f"{command}\n".encode())
        if not (answer := self._answers.readline()):
            raise ConnectionError("it closed the connection")
        return answer.decode(errors="replace").strip()

    def is_running(self) -> bool:
        """Whether a program runs."""
        return "true" in self.ask("running").lower()


@contextlib.contextmanager
def open_dashboard(ip: str) -> Iterator[Dashboard]:
    """A connection to the dashboard server; raises an `OSError` without one."""
    with socket.create_connection((ip, DASHBOARD_PORT), TIMEOUT) as connection:
        yield Dashboard(connection)


def check_ready(config: UR5eRobotiqConfig) -> None:
    """Raises a `RobotFaultError` unless the controller can be commanded and no other program is under way on it.

    Its answers say more than a client that cannot start its program, whose constructors would also wait for ever.
    """
    check_version(config.ip)
    try:
        with open_dashboard(config.ip) as dashboard:
            safety, mode = dashboard.ask("safetystatus"), dashboard.ask("robotmode")
            is_remote = "true" in dashboard.ask("is in remote control").lower()
            is_running, program = dashboard.is_running(), dashboard.ask("programState")
    except OSError as error:
        silence = f"no controller answers at {config.ip}, port {DASHBOARD_PORT}: {error}"
        raise RobotFaultError(Fault.LINK_LOST, silence) from error
    if (stopped := safety_fault(safety.rpartition(":")[2].strip().upper())) is not None:
        raise stopped
    if "RUNNING" not in mode:
        raise RobotFaultError(Fault.NOT_RUNNING, f"the robot mode is '{mode}'")
    if not is_remote:
        raise RobotFaultError(Fault.LOCAL_CONTROL, "the controller is in local control")
    if is_running or "PAUSED" in program:
        if not config.stop_running_program:
            raise RobotFaultError(Fault.PROGRAM_RUNNING, f"a program is under way on the controller ('{program}')")
        logger.warning("The program that is under way on the controller ('%s') is ended, as asked for.", program)
        end_program(config.ip)


def check_version(ip: str) -> None:
    """Raises a `RobotFaultError` if the controller's RTDE does not answer, or its software is none that we know."""
    try:
        with socket.create_connection((ip, RTDE_PORT), TIMEOUT) as rtde, rtde.makefile("rwb") as stream:
            _exchange(stream, "V", struct.pack(">H", 2))
            version = struct.unpack(">4I", _exchange(stream, "v"))
    except (OSError, struct.error) as error:
        silence = f"no controller answers at {ip}, port {RTDE_PORT}: {error}"
        raise RobotFaultError(Fault.LINK_LOST, silence) from error
    if version[:2] < OLDEST or version[0] > OLDEST[0]:
        found, oldest = (".".join(map(str, numbers)) for numbers in (version[:3], OLDEST))
        name = " (PolyScope X)" if version[0] >= 10 else ""
        wanted = f"its software is {found}{name}, and what is known is PolyScope 5 from {oldest} on"
        raise RobotFaultError(Fault.CONTROLLER_VERSION, wanted)


def _exchange(stream: io.BufferedRWPair, kind: str, body: bytes = b"") -> bytes:
    """Answer to a package of RTDE, of the same kind; raises an `OSError` if there is none."""
    stream.write(RTDE_HEADER.pack(RTDE_HEADER.size + len(body), ord(kind)) + body)
    stream.flush()
    while header := stream.read(RTDE_HEADER.size):
        size, answered = RTDE_HEADER.unpack(header)
        answer = stream.read(size - RTDE_HEADER.size)
        if answered == ord(kind):  # it may send messages in between
            return answer
    raise ConnectionError("it closed the connection")


def end_program(ip: str) -> None:
    """Ends whatever program the controller runs; a moving arm brakes. A warning tells if it cannot be made sure of."""
    try:
        with open_dashboard(ip) as dashboard:
            answer = dashboard.ask("stop")
            deadline = time.monotonic() + END_SECONDS
            while dashboard.is_running():
                if time.monotonic() > deadline:
                    raise ConnectionError(f"it runs on after 'stop', which was answered '{answer}'")
                time.sleep(0.02)
    except OSError as error:
        logger.warning("See on the pendant that no program runs: it could not be ended at %s (%s).", ip, error)
