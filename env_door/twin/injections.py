"""What can be made to fail, by name, as `TwinClient.inject("freeze")` and `TwinClient.clear("freeze")` ask for it.

Conditions last until they are cleared. Events happen once, and what they leave is undone as on a real robot: through
the dashboard and by the client.
"""

from collections.abc import Callable
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from env_door.twin import camera, ports
from env_door.twin.controller import SafetyMode

if TYPE_CHECKING:
    from env_door.twin.server import Twin

MAX_DELAY = 10_000.0  # ms
OVERCURRENT = 14  # Robotiq's code of a major fault: the gripper stops until it is activated again


class Injection(NamedTuple):
    """One thing that can be made to fail: `start` takes the twin and parameters, `clear` the twin.

    An event has instead of `clear` the words that say how a user undoes it.
    """

    start: Callable[..., None]
    clear: "Callable[[Twin], Any] | str"


def find(name: str) -> Injection:
    """An injection by its name; raises a ValueError if there is none."""
    if name not in INJECTIONS:
        raise ValueError(f"injection {name!r} is unknown; choose one of {sorted(INJECTIONS)}")
    return INJECTIONS[name]


def _port_gone(port: int) -> Injection:
    return Injection(lambda twin: twin.ports[port].shut(), lambda twin: twin.ports[port].open())


def _flag(path: str, broken: bool) -> Injection:
    owner, name = path.rsplit(".", 1)
    of = attrgetter(owner)
    return Injection(lambda twin: setattr(of(twin), name, broken), lambda twin: setattr(of(twin), name, not broken))


def _camera_mode(mode: int) -> Injection:
    def start(twin: "Twin") -> None:
        if twin.camera is None:
            raise ValueError("this twin has no camera; start it with --camera=true")
        twin.camera.mode.value = mode

    def clear(twin: "Twin") -> None:
        if twin.camera is not None and twin.camera.mode.value == mode:
            twin.camera.mode.value = camera.NORMAL

    return Injection(start, clear)


def _hang_up(only_commanding: bool) -> Injection:
    return Injection(lambda twin: twin.rtde.hang_up(only_commanding), "the client connects again")


def _safety_stop(mode: SafetyMode) -> Injection:
    return Injection(
        lambda twin: twin.controller.safety_stop(mode, "injected"), lambda twin: twin.controller.end_safety_stop(mode)
    )


def _delay(twin: "Twin", ms: float) -> None:
    if not 0 < ms <= MAX_DELAY:
        raise ValueError(f"injection 'delay': ms={ms} must be above 0 and at most {MAX_DELAY:g} ms")
    twin.rtde.delay = ms / 1000


def _fail_gripper(twin: "Twin", code: int = OVERCURRENT) -> None:
    if not 1 <= code <= 15:
        raise ValueError(f"injection 'gripper_fault': code={code} must be 1 to 15, as in Robotiq's manual")
    twin.controller.gripper.fail(code)


def _reset_gripper(twin: "Twin") -> None:
    twin.controller.gripper.set({"ACT": 0})


def _speed_slider(twin: "Twin", fraction: float = 0.2) -> None:
    if not 0 <= fraction <= 1:
        raise ValueError(f"injection 'speed_slider': fraction={fraction} must be 0 to 1")
    twin.controller.speed_fraction = fraction


INJECTIONS = {
    "drop_link": _port_gone(ports.RTDE),
    "close_link": _hang_up(only_commanding=False),
    "close_control": _hang_up(only_commanding=True),
    "dashboard_gone": _port_gone(ports.DASHBOARD),
    "gripper_gone": _port_gone(ports.GRIPPER),
    "freeze": _flag("rtde.frozen", True),
    "delay": Injection(_delay, lambda twin: setattr(twin.rtde, "delay", 0.0)),
    "remote_control_off": _flag("controller.remote_control", False),
    "speed_slider": Injection(_speed_slider, lambda twin: setattr(twin.controller, "speed_fraction", 1.0)),
    "gripper_silent": _flag("controller.gripper.silent", True),
    "gripper_garbage": _flag("controller.gripper.garbage", True),
    "gripper_reset": Injection(_reset_gripper, "the client activates it again"),
    "gripper_fault": Injection(_fail_gripper, lambda twin: twin.controller.gripper.fail(0)),
    "camera_freeze": _camera_mode(camera.FROZEN),
    "camera_black": _camera_mode(camera.BLACK),
    "camera_gone": _camera_mode(camera.GONE),
    "emergency_stop": Injection(
        lambda twin: twin.controller.emergency_stop(True), lambda twin: twin.controller.emergency_stop(False)
    ),
    "power_off": Injection(lambda twin: twin.controller.power_off(), "'power on' and 'brake release' on the dashboard"),
    "protective_stop": Injection(
        lambda twin: twin.controller.protective_stop("injected"),
        "'unlock protective stop' on the dashboard; then the client uploads its script again",
    ),
    "safeguard_stop": _safety_stop(SafetyMode.SAFEGUARD_STOP),
    "recovery_mode": _safety_stop(SafetyMode.RECOVERY),
    "safety_violation": _safety_stop(SafetyMode.VIOLATION),
    "script_stop": Injection(lambda twin: twin.controller.stop_program(), "the client uploads its script again"),
}
