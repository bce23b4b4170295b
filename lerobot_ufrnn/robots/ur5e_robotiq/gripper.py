"""Robotiq 2F-85 through the socket that its URCap opens on the controller."""

import contextlib
import itertools
import logging
import re
import socket
import threading
import time
from collections.abc import Iterator

from .configuration import UR5eRobotiqConfig
from .faults import Fault, RobotFaultError

logger = logging.getLogger(__name__)

TIMEOUT = 1.0  # s that the gripper may take to answer
MORE_SECONDS = 0.01  # after which no more digits of a number come
MAX_AGE = 1.0  # s from which a position is no measured one any more
MAX_WAIT = 0.3  # s for which a new one is waited for then
ACTIVATION_SECONDS = 15.0  # that activating may take: it opens and closes once
POLL_SECONDS = 0.05  # between two questions; the socket takes tens of milliseconds for each anyway
ACTIVE = 3  # its status once it is activated
FULL = 255  # full speed and full force
FIRST_FAULT = 8  # fault codes below this one, but for 0, only say that a move waits for activation


def closure_at(reading: int, gripper_range: tuple[int, int]) -> float:
    """Closure from 0, open, to 1, closed, at a reading of a gripper with this range."""
    opened, closed = gripper_range
    return min(max((reading - opened) / (closed - opened), 0.0), 1.0)


def ask(connection: socket.socket, command: str, expected: str) -> str:
    """What the group of a pattern finds in the answer to a command; raises an `OSError` without such an answer."""
    connection.sendall(f"{command}\n".encode())
    answer, patience = "", connection.gettimeout()
    # It may come in pieces, and a real URCap ends it with no line end: then its number ends when no more digits come.
    while not answer.endswith("\n"):
        matches = re.fullmatch(expected, answer)
        connection.settimeout(MORE_SECONDS if matches else patience)
        try:
            piece = connection.recv(1024)
        except TimeoutError:
            if not answer:
                raise
            break
        finally:
            connection.settimeout(patience)
        if not piece:
            break
        answer = (answer + piece.decode(errors="replace")).lstrip()
    if (match := re.fullmatch(expected, answer.strip())) is None:
        raise ConnectionError(f"it answered {answer!r} to {command}" if answer else "it closed the connection")
    return match[1]


class RobotiqGripper:
    """Follows a target and knows where it is; a thread of its own does the asking.

    The socket takes tens of milliseconds to answer, too long for a control loop to wait for.
    """

    def __init__(self, config: UR5eRobotiqConfig):
        self._config = config
        self._socket = socket.socket()
        self._socket.settimeout(TIMEOUT)
        self._thread = threading.Thread(target=self._follow, name="gripper", daemon=True)
        self._stop = threading.Event()
        self._target: int | None = None
        self._position, self._asked = config.gripper_range[0], 0.0  # and when it was asked for
        self._fault: RobotFaultError | None = None

    def connect(self) -> None:
        """Connects, once, and, if it is not active yet, activates the gripper, which then opens and closes once.

        Raises a `RobotFaultError` if it does not answer, or has a fault; it is to be disconnected then, too.
        """
        config = self._config
        with self._telling_silence():
            self._socket.connect((config.ip, config.gripper_port))
            if any(self._waits_for_activation(by) for by in ("FLT", "STA")):
                self._activate()
            self._set(GTO=1, SPE=round(FULL * config.gripper_speed), FOR=round(FULL * config.gripper_force))
            self._measure()
        self._thread.start()

    def disconnect(self) -> None:
        """Lets go of the socket; the gripper stays as it is, so that it drops nothing. Safe to call at any time."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2 * TIMEOUT)
        with contextlib.suppress(OSError):
            self._socket.close()

    @property
    def closure(self) -> float:
        """`float`: measured, from 0, open, to 1, closed; raises a `RobotFaultError` on a silent or faulty gripper."""
        # A program that was held up, its threads and all, asks for a new position at once when it goes on.
        deadline = time.monotonic() + MAX_WAIT
        while self._fault is None and (age := time.monotonic() - self._asked) > MAX_AGE:
            if time.monotonic() > deadline:
                raise RobotFaultError(Fault.GRIPPER_SILENT, f"the gripper's position is {age:.1f} s old")
            time.sleep(0.005)
        if self._fault is not None:
            raise self._fault
        return closure_at(self._position, self._config.gripper_range)

    def move_to(self, closure: float) -> None:
        """Sets the target from 0, open, to 1, closed; raises as `closure` does."""
        if self._fault is not None:
            raise self._fault
        opened, closed = self._config.gripper_range
        self._target = round(opened + closure * (closed - opened))

    def _follow(self) -> None:
        sent = None
        signs = itertools.cycle(("FLT", "STA"))  # one at a time, so that positions come more often
        try:
            with self._telling_silence():
                while not self._stop.wait(POLL_SECONDS):
                    if (target := self._target) != sent and target is not None:
                        self._set(POS=target)
                        sent = target
                    self._measure()
                    if self._waits_for_activation(by=next(signs)):
                        lost = "the gripper has lost its activation, as after an emergency stop"
                        raise RobotFaultError(Fault.GRIPPER_NOT_ACTIVE, lost)
        except RobotFaultError as fault:
            self._fault = fault

    @contextlib.contextmanager
    def _telling_silence(self) -> Iterator[None]:
        try:
            yield
        except RobotFaultError:  # which is an OSError, too
            raise
        except OSError as error:
            address = f"{self._config.ip}:{self._config.gripper_port}"
            silence = f"the gripper at {address} does not answer ({error})"
            raise RobotFaultError(Fault.GRIPPER_SILENT, silence) from error

    def _activate(self) -> None:
        logger.warning("The gripper is being activated: it opens and closes once.")
        self._set(ACT=0)
        self._set(ACT=1, GTO=1)
        deadline = time.monotonic() + ACTIVATION_SECONDS
        while self._get("STA") != ACTIVE:
            if time.monotonic() > deadline:
                raise RobotFaultError(Fault.GRIPPER_FAULT, f"not active {ACTIVATION_SECONDS:.0f} s after activation")
            time.sleep(POLL_SECONDS)

    def _measure(self) -> None:
        asked = time.monotonic()
        self._position, self._asked = self._get("POS"), asked

    def _waits_for_activation(self, by: str) -> bool:
        """Whether its fault (FLT) or its status (STA) says so; raises a `RobotFaultError` on any other fault."""
        value = self._get(by)
        if by == "STA":
            return value != ACTIVE
        if value >= FIRST_FAULT:
            raise RobotFaultError(Fault.GRIPPER_FAULT, f"the gripper reports fault {value}")
        return value > 0

    def _get(self, name: str) -> int:
        return int(ask(self._socket, f"GET {name}", rf"{name}\s+(\d+)"))

    def _set(self, **values: int) -> None:
        ask(self._socket, "SET " + " ".join(f"{name} {value}" for name, value in values.items()), "(ack)")
