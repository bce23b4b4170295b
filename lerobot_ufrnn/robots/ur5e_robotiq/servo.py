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
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .configuration import UR5eRobotiqConfig
from .controller import end_program
from .faults import SAFETY_MODES, Fault, RobotFaultError, safety_fault

START_SECONDS = 20.0  # that connecting may take; the client uploads a program and waits for it to run
STOP_DECELERATION = 4.0  # in rad/s^2, with which the arm is stopped
SETTLE_SECONDS = 0.1  # that the values that tell of one cause may take to come in
SILENT_SECONDS = 0.5  # beyond `stale_after` that the servo process may be silent; it tells of faults within that time
STOP_SECONDS = 3.0  # that it may take to end by itself; by then the controller's watchdog has stopped the arm
HOPELESS_SECONDS = 0.5  # the same where it hardly can, or does not command the arm yet
HOPELESS = (Fault.LINK_LOST, Fault.STALE_DATA, Fault.SERVO_LATE)

ROBOT_MODE_RUNNING = 7  # as the controller numbers its modes

# What the servo tells; the moment is that of `time.monotonic()`, which all processes have in common.
MEASURED, COMMANDED, FAULT, MOMENT, SPEED = slice(0, 6), slice(6, 12), 12, 13, 14
STATE_SIZE = 15
TEXT_SIZE = 400


def import_client(what: str = "--robot.type=ur5e_robotiq") -> tuple[Any, Any]:
    """The controller's client library, needed by `what`: `rtde_control` and `rtde_receive`."""
    try:
        import rtde_control
        import rtde_receive
    except ImportError as error:
        raise ImportError(
            f"{what} needs ur_rtde, which cannot be imported ({error}): `pip install 'lerobot_policy_ufrnn[ur5e]'`. "
            "Everything else works without it."
        ) from error
    return rtde_control, rtde_receive


class Mailbox:
    """The latest of a series of vectors of `size` numbers, from one process to another, without a lock to die in.

    The writer fills one of two slots while the other holds the last whole vector, then counts up, which is what makes
    the new one the latest. So a writer that is stopped or killed half-way leaves neither a lock nor a broken vector
    behind, and the reader never waits for it.
    """

    def __init__(self, context: BaseContext, size: int):
        self._shared: Any = context.RawArray("d", 1 + 2 * size)

    def write(self, values: NDArray[np.float64]) -> None:
        """Replaces the vector."""
        count, slots = self._parts()
        number = int(count[0]) + 1
        slots[number % 2] = values
        count[0] = number

    def read(self) -> tuple[int, NDArray[np.float64]]:
        """How many vectors were written so far, and the latest; zeros before the first."""
        count, slots = self._parts()
        while True:
            number = int(count[0])
            values = slots[number % 2].copy()
            # Unless one more was written meanwhile, the writer was busy with the other slot at most.
            if count[0] == number:
                return number, values

    def _parts(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        numbers = np.frombuffer(self._shared)
        return numbers[:1], numbers[1:].reshape(2, -1)


class _Shared:
    """What the servo process and its owner have in common."""

    def __init__(self, context: BaseContext):
        self.targets, self.state = Mailbox(context, 6), Mailbox(context, STATE_SIZE)
        self.text: Any = context.RawArray("c", TEXT_SIZE)
        # Flags without the lock that an event has: a process that ends with it in hand would block the other for ever.
        self.stop, self.ready = context.RawValue("b", False), context.RawValue("b", False)


class Servo:
    """The servo process as its owner sees it."""

    def __init__(self, config: UR5eRobotiqConfig):
        self._config = config
        self._ended = False
        context = multiprocessing.get_context("spawn")
        self._shared = _Shared(context)
        arguments = config, os.getpid(), self._shared
        self._process = context.Process(target=_run, args=arguments, name="ur5e-servo", daemon=True)

    def start(self) -> None:
        """Connects and holds the arm where it is, or raises a `RobotFaultError`."""
        self._process.start()
        deadline = time.monotonic() + START_SECONDS
        while not self._shared.ready.value:
            time.sleep(0.02)
            if not self._process.is_alive() or time.monotonic() > deadline:
                fault = self.fault
                self.stop()
                late = f"connecting to {self._config.ip} took longer than {START_SECONDS:.0f} s"
                raise fault or RobotFaultError(Fault.LINK_LOST, late)

    def stop(self) -> None:
        """Decelerates the arm, ends the program on the controller and the process. Safe to call at any time."""
        if self._ended or self._process.pid is None:
            return
        cause = self.fault
        self._shared.stop.value = True
        hopeless = not self._shared.ready.value or (cause is not None and cause.fault in HOPELESS)
        self._process.join(HOPELESS_SECONDS if hopeless else STOP_SECONDS)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(timeout=1.0)
        # Whatever became of the process, nobody commands its program any more. What runs later is not ours to end.
        if cause is None or cause.fault is not Fault.REGISTERS_IN_USE:
            end_program(self._config.ip)
        self._ended = True

    @property
    def fault(self) -> RobotFaultError | None:
        """Why the arm was stopped, if it was."""
        _, values = self._shared.state.read()
        fault = Fault(int(values[FAULT]))
        if fault is not Fault.NONE:
            return RobotFaultError(fault, self._shared.text.value.decode(errors="replace") or "no details")
        if self._process.pid is None or self._shared.stop.value:
            return None
        if not self._process.is_alive():
            return RobotFaultError(Fault.SERVO_DIED, f"exit code {self._process.exitcode}")
        silent = time.monotonic() - values[MOMENT]
        if self._shared.ready.value and silent > self._config.stale_after + SILENT_SECONDS:
            return RobotFaultError(Fault.SERVO_LATE, f"the servo process hangs: nothing heard of it for {silent:.1f} s")
        return None

    @property
    def speed_scaling(self) -> float:
        """Fraction of the commanded speed, 0 to 1, to which the controller slows the arm."""
        return float(self._shared.state.read()[1][SPEED])

    def read(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Measured and commanded joints in rad, (6,) each; raises a `RobotFaultError` if the arm was stopped."""
        if (fault := self.fault) is not None:
            raise fault
        _, values = self._shared.state.read()
        return values[MEASURED], values[COMMANDED]

    def move_to(self, target: NDArray[np.float64]) -> None:
        """Sets the target, in rad and within all limits, (6,), that the arm is to be at one control period from now."""
        self.read()  # which raises if the arm was stopped
        self._shared.targets.write(target)


def _run(config: UR5eRobotiqConfig, owner: int, shared: _Shared) -> None:
    """The servo process."""
    # Ctrl-C reaches every process of a terminal; what becomes of the arm is its owner's decision.
    for name in ("SIGINT", "SIGHUP"):  # so does a terminal that is closed, where there is such a signal
        if (number := getattr(signal, name, None)) is not None:
            signal.signal(number, signal.SIG_IGN)
    driver, link_works = _Driver(config, owner, shared), True
    signal.signal(signal.SIGTERM, driver.end)
    try:
        driver.connect()
        driver.drive()
    except RobotFaultError as stopped:
        driver.tell(stopped.fault, stopped.detail)
        link_works = stopped.fault not in (Fault.LINK_LOST, Fault.STALE_DATA)
    except Exception as error:
        traceback.print_exc()
        driver.tell(Fault.SERVO_DIED, f"{type(error).__name__}: {error}")
    if link_works:
        driver.halt()
    # Over a broken link the client waits for minutes or aborts when it is destroyed. The watchdog has stopped the arm,
    # so the process ends here and now.
    sys.stderr.flush()
    os._exit(0)


class _Driver:
    """What the servo process does."""

    def __init__(self, config: UR5eRobotiqConfig, owner: int, shared: _Shared):
        self._config, self._owner, self._shared = config, owner, shared
        self._values = np.zeros(STATE_SIZE)
        self._told_to_end = False
        self._control: Any = None
        self._receive: Any = None

    def connect(self) -> None:
        """Connects to the controller and arms its watchdog."""
        config = self._config
        rtde_control, rtde_receive = import_client()
        try:
            self._receive = rtde_receive.RTDEReceiveInterface(config.ip, config.servo_frequency)
            self._control = rtde_control.RTDEControlInterface(config.ip, config.servo_frequency)
        except RuntimeError as error:
            fault = Fault.REGISTERS_IN_USE if "in use" in str(error) else Fault.LINK_LOST
            raise RobotFaultError(fault, f"cannot connect to {config.ip}: {error}") from error
        if not self._control.setWatchdog(config.watchdog_frequency):
            raise RobotFaultError(Fault.COMMAND_REFUSED, "the controller's watchdog could not be armed")
        _forbid_connections()

    def end(self, *_: object) -> None:
        """Notes, as the handler of a signal, that somebody else than the owner wants the process to end."""
        self._told_to_end = True

    def drive(self) -> None:
        """Sends set-points, on a straight line from target to target, until the owner ends it or something is wrong."""
        config, shared, values = self._config, self._shared, self._values
        control, receive = self._control, self._receive
        period = 1.0 / config.servo_frequency
        target = commanded = np.array(receive.getActualQ())
        step, left = np.zeros(6), 0.0  # rad a set-point, and set-points until the target is reached
        seen = shared.targets.read()[0]
        stamp, stamped = receive.getTimestamp(), time.monotonic()
        due = time.monotonic()
        while not shared.stop.value:
            now = time.monotonic()
            if (newest := receive.getTimestamp()) != stamp:
                stamp, stamped = newest, now
            self._check(now, stamped)
            count, newest_target = shared.targets.read()
            if count != seen:
                seen, target, left = count, newest_target, config.control_period / period
                step = (target - commanded) / left
            # Counted in set-points, not in time: what is late is made up for by no jump, and each new target is begun
            # at once, however soon the next one comes.
            left = max(left - 1.0, 0.0)
            wanted = target - step * left
            measured = np.array(receive.getActualQ())
            # A blocked arm must not be leant against harder than agreed, however far it is pushed back between targets.
            commanded = np.clip(wanted, measured - config.command_limit, measured + config.command_limit)
            try:
                # The controller ignores speed and acceleration here.
                taken = control.servoJ(commanded.tolist(), 0.0, 0.0, period, config.servo_lookahead, config.servo_gain)
            except RuntimeError as error:  # the client found the link broken and tried in vain to mend it
                raise RobotFaultError(Fault.LINK_LOST, str(error)) from error
            if not taken:
                time.sleep(SETTLE_SECONDS)
                self._check(now, stamped)
                raise RobotFaultError(Fault.COMMAND_REFUSED, "the controller refused a set-point")
            # Each set-point kicks the watchdog. The client's `kickWatchdog` would overwrite it before it is read.
            values[MEASURED], values[COMMANDED], values[MOMENT] = measured, commanded, time.monotonic()
            values[SPEED] = min(receive.getTargetSpeedFraction(), receive.getSpeedScaling())
            shared.state.write(values)
            shared.ready.value = True
            due += period
            if (behind := time.monotonic() - due) > 0:
                if behind > config.stale_after:
                    raise RobotFaultError(Fault.SERVO_LATE, f"a set-point came {1000 * behind:.0f} ms late")
                due = time.monotonic()
            else:
                time.sleep(-behind)
        # The owner may have asked for the end because of what the same cause did to the gripper or a camera.
        self._check_interruption()

    def tell(self, fault: Fault, detail: str) -> None:
        """Lets the owner know why the arm was stopped."""
        self._shared.text.value = detail.encode()[: TEXT_SIZE - 1]
        self._values[FAULT] = fault
        self._shared.state.write(self._values)

    def halt(self) -> None:
        """Stops the arm and ends the program on the controller, as far as the link still carries that."""
        control = self._control
        if control is None:
            return
        for command in (lambda: control.servoStop(STOP_DECELERATION), control.stopScript, control.disconnect):
            with contextlib.suppress(Exception):
                if control.isConnected():
                    command()

    def _check(self, now: float, stamped: float) -> None:
        """Looks for a reason to stop."""
        if not (self._receive.isConnected() and self._control.isConnected()):
            raise RobotFaultError(Fault.LINK_LOST, f"the connection to {self._config.ip} broke")
        if now - stamped > self._config.stale_after:
            silent = 1000 * (now - stamped)
            raise RobotFaultError(Fault.STALE_DATA, f"no new data from {self._config.ip} for {silent:.0f} ms")
        self._check_interruption()
        if self._told_to_end:
            raise RobotFaultError(Fault.SERVO_DIED, "somebody told the servo process to end (SIGTERM)")
        if os.getppid() != self._owner:
            raise RobotFaultError(Fault.OWNER_GONE, "the program that commanded it ended")

    def _check_interruption(self) -> None:
        if self._interruption() is not None:
            # One cause shows in several values, which come one after the other and over two connections: nothing more
            # is commanded while the rest comes in, then the most telling one counts.
            time.sleep(SETTLE_SECONDS)
            paused = RobotFaultError(Fault.PROGRAM_STOPPED, "the controller paused the program")
            raise self._interruption() or paused

    def _interruption(self) -> RobotFaultError | None:
        """Why the controller does not carry out commands, if it says so; the most telling reason first."""
        safety = self._receive.getSafetyMode()
        if (stopped := safety_fault(SAFETY_MODES.get(safety, f"{safety}"))) is not None:
            return stopped
        if (mode := self._receive.getRobotMode()) != ROBOT_MODE_RUNNING:
            return RobotFaultError(Fault.NOT_RUNNING, f"robot mode {mode} instead of {ROBOT_MODE_RUNNING} (running)")
        if not self._control.isProgramRunning():
            return RobotFaultError(Fault.PROGRAM_STOPPED, "the program on the controller is not running")
        return None


def _forbid_connections() -> None:
    """Lets this process open nothing more.

    The client would otherwise connect again by itself, on a thread of its own as well as within a command, upload its
    program anew and repeat the last set-point, without the watchdog and without a word.
    """
    with contextlib.suppress(ImportError):  # on Windows
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, most))  # beside the three files that every process has
