"""The servo loop: a process of its own that moves the arm between targets, and stops it when anything is wrong.

It alone talks to the controller while the arm is in use. Python code beside it, a policy that thinks for long or a
camera that hangs, delays a target but never a set-point: without a new target the arm comes to rest at the last one.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import time
import traceback
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .client import import_client
from .configuration_ur5e_robotiq import UR5eRobotiqConfig
from .errors import Fault, RobotFaultError
from .mailbox import Mailbox

START_SECONDS = 60.0
"""How long connecting may take; the client uploads a program and waits for it to run."""

STOP_DECELERATION = 4.0
"""Deceleration in rad/s^2 with which the arm is stopped."""

SETTLE_SECONDS = 0.1
"""How long the values that tell of one cause may take to come in."""

ROBOT_MODE_RUNNING = 7
SAFETY_NORMAL, SAFETY_REDUCED = 1, 2
STOPPED_BY_SAFETY = {3: Fault.PROTECTIVE_STOP, 6: Fault.EMERGENCY_STOP, 7: Fault.EMERGENCY_STOP}

SILENT_SECONDS = 0.5
"""How much longer than `stale_after` nothing may be heard of the servo process; it tells of faults within that time."""

# What the servo tells; the moment is that of `time.monotonic()`, which all processes have in common.
MEASURED, COMMANDED, FAULT, MOMENT = slice(0, 6), slice(6, 12), 12, 13
STATE_SIZE = 14
TEXT_SIZE = 400


class Servo:
    """The servo process as its owner sees it.

    Args:
        config (`UR5eRobotiqConfig`):
            Address, rates and limits.
    """

    def __init__(self, config: UR5eRobotiqConfig):
        self._config = config
        context = multiprocessing.get_context("spawn")
        self._targets, self._state = Mailbox(context, 6), Mailbox(context, STATE_SIZE)
        self._text: Any = context.RawArray("c", TEXT_SIZE)
        self._stop = context.Event()
        self._ready = context.Event()
        self._process = context.Process(
            target=_run,
            args=(config, os.getpid(), self._targets, self._state, self._text, self._stop, self._ready),
            name="ur5e-servo",
            daemon=True,
        )

    def start(self) -> None:
        """Connects and holds the arm where it is.

        Raises:
            RobotFaultError: If that fails.
        """
        self._process.start()
        deadline = time.monotonic() + START_SECONDS
        while not self._ready.wait(0.05):
            if not self._process.is_alive() or time.monotonic() > deadline:
                fault = self.fault
                self.stop()
                raise fault or RobotFaultError(
                    Fault.LINK_LOST, f"connecting to {self._config.ip} took longer than {START_SECONDS:.0f} s"
                )

    def stop(self) -> None:
        """Decelerates the arm, ends the program on the controller and the process. Safe to call at any time."""
        self._stop.set()
        if self._process.pid is not None:
            self._process.join(timeout=5.0)
            if self._process.is_alive():
                # The controller's watchdog has stopped the arm by now.
                self._process.kill()
                self._process.join(timeout=1.0)

    @property
    def fault(self) -> RobotFaultError | None:
        """`RobotFaultError | None`: why the arm was stopped, if it was."""
        _, values = self._state.read()
        fault = Fault(int(values[FAULT]))
        if fault is not Fault.NONE:
            return RobotFaultError(fault, self._text.value.decode(errors="replace") or "no details")
        if self._process.pid is None or self._stop.is_set():
            return None
        if not self._process.is_alive():
            return RobotFaultError(Fault.SERVO_DIED, f"exit code {self._process.exitcode}")
        silent = time.monotonic() - values[MOMENT]
        if self._ready.is_set() and silent > self._config.stale_after + SILENT_SECONDS:
            return RobotFaultError(Fault.SERVO_LATE, f"the servo process hangs: nothing heard of it for {silent:.1f} s")
        return None

    def check(self) -> None:
        """Says so if the arm was stopped.

        Raises:
            RobotFaultError: If it was.
        """
        if (fault := self.fault) is not None:
            raise fault

    def read(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the arm is.

        Returns:
            `tuple[NDArray[np.float64], NDArray[np.float64]]`: measured and commanded joints in rad, (6,) each.

        Raises:
            RobotFaultError: If the arm was stopped.
        """
        self.check()
        _, values = self._state.read()
        return values[MEASURED], values[COMMANDED]

    def move_to(self, target: NDArray[np.float64]) -> None:
        """Sets the target that the arm is to be at one control period from now.

        Args:
            target (`NDArray[np.float64]`):
                Joint angles in rad within all limits, (6,).

        Raises:
            RobotFaultError: If the arm was stopped.
        """
        self.check()
        self._targets.write(target)


class _StopError(Exception):
    def __init__(self, fault: Fault, detail: str):
        self.fault, self.detail = fault, detail


def _run(
    config: UR5eRobotiqConfig,
    owner: int,
    targets: Mailbox,
    state: Mailbox,
    text: Any,
    stop: Any,
    ready: Any,
) -> None:
    """The servo process."""
    # Ctrl-C reaches every process of a terminal; what becomes of the arm is its owner's decision.
    for name in ("SIGINT", "SIGHUP"):  # so does a terminal that is closed, where there is such a signal
        if (number := getattr(signal, name, None)) is not None:
            signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    values, control, link_works = np.zeros(STATE_SIZE), None, True
    try:
        control, receive = _connect(config)
        _servo(config, owner, control, receive, targets, state, stop, ready, values)
    except _StopError as stopped:
        _tell(state, text, values, stopped.fault, stopped.detail)
        link_works = stopped.fault not in (Fault.LINK_LOST, Fault.STALE_DATA)
    except Exception as error:
        traceback.print_exc()
        _tell(state, text, values, Fault.SERVO_DIED, f"{type(error).__name__}: {error}")
    if link_works:
        _halt(control)
    # Over a broken link the client waits for minutes, reconnects by itself or aborts when it is destroyed. The watchdog
    # has stopped the arm, so the process ends here and now.
    sys.stderr.flush()
    os._exit(0)


def _tell(state: Mailbox, text: Any, values: NDArray[np.float64], fault: Fault, detail: str) -> None:
    text.value = detail.encode()[: TEXT_SIZE - 1]
    values[FAULT] = fault
    state.write(values)


def _connect(config: UR5eRobotiqConfig) -> tuple[Any, Any]:
    rtde_control, rtde_receive, _ = import_client()
    try:
        receive = rtde_receive.RTDEReceiveInterface(config.ip, config.servo_frequency)
        control = rtde_control.RTDEControlInterface(config.ip, config.servo_frequency)
    except RuntimeError as error:
        raise _StopError(Fault.LINK_LOST, f"cannot connect to {config.ip}: {error}") from error
    if not control.setWatchdog(config.watchdog_frequency):
        _halt(control)
        raise _StopError(Fault.COMMAND_REFUSED, "the controller's watchdog could not be armed")
    return control, receive


def _halt(control: Any) -> None:
    """Stops the arm and ends the program on the controller, as far as the link still carries that."""
    if control is None:
        return
    for command in (lambda: control.servoStop(STOP_DECELERATION), control.stopScript, control.disconnect):
        with contextlib.suppress(Exception):
            if control.isConnected():
                command()


def _servo(
    config: UR5eRobotiqConfig,
    owner: int,
    control: Any,
    receive: Any,
    targets: Mailbox,
    state: Mailbox,
    stop: Any,
    ready: Any,
    values: NDArray[np.float64],
) -> None:
    period = 1.0 / config.servo_frequency
    commanded = np.array(receive.getActualQ())
    begin = end = commanded
    began, seen = time.monotonic(), targets.read()[0]
    stamp, stamped = receive.getTimestamp(), time.monotonic()
    due = time.monotonic()
    while not stop.is_set():
        now = time.monotonic()
        if (newest := receive.getTimestamp()) != stamp:
            stamp, stamped = newest, now
        _check(config, owner, control, receive, now, stamped)
        count, target = targets.read()
        if count != seen:
            seen, begin, end, began = count, commanded, target, now
        progress = min((now - began) / config.control_period, 1.0)
        measured = np.array(receive.getActualQ())
        wanted = begin + (end - begin) * progress
        # A blocked arm must not be leant against harder than agreed, however far it is pushed back between targets.
        commanded = np.clip(wanted, measured - config.command_limit, measured + config.command_limit)
        try:
            taken = control.servoJ(commanded.tolist(), 0.0, 0.0, period, config.servo_lookahead, config.servo_gain)
        except RuntimeError as error:  # the client found the link broken and tried in vain to mend it
            raise _StopError(Fault.LINK_LOST, str(error)) from error
        if not taken:
            time.sleep(SETTLE_SECONDS)
            _check(config, owner, control, receive, now, stamped)
            raise _StopError(Fault.COMMAND_REFUSED, "the controller refused a set-point")
        # Each set-point kicks the watchdog. The client's `kickWatchdog` would overwrite it before it is read.
        values[MEASURED], values[COMMANDED], values[MOMENT] = measured, commanded, time.monotonic()
        state.write(values)
        ready.set()
        due += period
        if (behind := time.monotonic() - due) > 0:
            if behind > config.stale_after:
                raise _StopError(Fault.SERVO_LATE, f"a set-point came {1000 * behind:.0f} ms late")
            due = time.monotonic()
        else:
            time.sleep(-behind)
    # The owner may have asked for the end because of what the same cause did to the gripper or a camera.
    _check_interruption(control, receive)


def _check(config: UR5eRobotiqConfig, owner: int, control: Any, receive: Any, now: float, stamped: float) -> None:
    """Looks for a reason to stop."""
    if not (receive.isConnected() and control.isConnected()):
        raise _StopError(Fault.LINK_LOST, f"the connection to {config.ip} broke")
    if now - stamped > config.stale_after:
        raise _StopError(Fault.STALE_DATA, f"no new data from {config.ip} for {1000 * (now - stamped):.0f} ms")
    _check_interruption(control, receive)
    if os.getppid() != owner:
        raise _StopError(Fault.OWNER_GONE, "the program that commanded it ended")


def _check_interruption(control: Any, receive: Any) -> None:
    """Looks whether the controller carries out commands."""
    if _interruption(control, receive) is not None:
        # One cause shows in several values, which come one after the other and over two connections: nothing more is
        # commanded while the rest comes in, then the most telling one counts.
        time.sleep(SETTLE_SECONDS)
        raise _interruption(control, receive) or _StopError(Fault.PROGRAM_STOPPED, "the controller paused the program")


def _interruption(control: Any, receive: Any) -> _StopError | None:
    """Why the controller does not carry out commands, if it says so; the most telling reason first."""
    if (safety := receive.getSafetyMode()) not in (SAFETY_NORMAL, SAFETY_REDUCED):
        return _StopError(STOPPED_BY_SAFETY.get(safety, Fault.PROTECTIVE_STOP), f"safety mode {safety}")
    if (mode := receive.getRobotMode()) != ROBOT_MODE_RUNNING:
        return _StopError(Fault.NOT_RUNNING, f"robot mode {mode} instead of {ROBOT_MODE_RUNNING} (running)")
    if not control.isProgramRunning():
        return _StopError(Fault.PROGRAM_STOPPED, "the program on the controller is not running")
    return None
