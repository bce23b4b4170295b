"""What can be made to fail, by name, as `TwinClient.inject("freeze")` and `TwinClient.clear("freeze")` ask for it.

Conditions last until they are cleared. Events happen once, and what they leave is undone as on a real robot: through
the dashboard and by the client.
"""

import inspect
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from env_door.twin import ports
from env_door.twin.camera import CameraMode

if TYPE_CHECKING:
    from env_door.twin.server import Twin

MAX_DELAY = 10_000.0  # ms
OVERCURRENT = 14  # Robotiq's code of a major fault: the gripper stops until it is activated again


@dataclass(frozen=True)
class Injection:
    """One thing that can be made to fail: `start` takes the twin and parameters; `clear` is `None` for events."""

    start: Callable[..., None]
    clear: "Callable[[Twin], Awaitable[None] | None] | None" = None
    recovery: str = ""


def _port_gone(port: int) -> Injection:
    return Injection(lambda twin: twin.ports[port].shut(), lambda twin: twin.ports[port].open())


def _flag(path: str, broken: bool) -> Injection:
    owner, name = path.rsplit(".", 1)
    find = attrgetter(owner)
    return Injection(lambda twin: setattr(find(twin), name, broken), lambda twin: setattr(find(twin), name, not broken))


def _camera_mode(mode: CameraMode) -> Injection:
    def start(twin: "Twin") -> None:
        if twin.camera is None:
            raise ValueError("this twin has no camera; start it with --camera=true")
        twin.camera.mode = mode

    def clear(twin: "Twin") -> None:
        if twin.camera is not None and twin.camera.mode == mode:
            twin.camera.mode = CameraMode.NORMAL

    return Injection(start, clear)


def _freeze(twin: "Twin", frozen: bool) -> None:
    twin.rtde.frozen = frozen
    twin.ports[ports.RTDE].freeze(frozen)


def _delay(twin: "Twin", ms: float) -> None:
    if not 0 < ms <= MAX_DELAY:
        raise ValueError(f"injection 'delay': ms={ms} must be above 0 and at most {MAX_DELAY:g} ms")
    twin.rtde.delay = ms / 1000


def _fail_gripper(twin: "Twin", code: int = OVERCURRENT) -> None:
    if not 1 <= code <= 15:
        raise ValueError(f"injection 'gripper_fault': code={code} must be 1 to 15, as in Robotiq's manual")
    twin.controller.gripper.fail(code)


INJECTIONS: dict[str, Injection] = {
    "drop_link": _port_gone(ports.RTDE),
    "dashboard_gone": _port_gone(ports.DASHBOARD),
    "gripper_gone": _port_gone(ports.GRIPPER),
    "freeze": Injection(lambda twin: _freeze(twin, True), lambda twin: _freeze(twin, False)),
    "delay": Injection(_delay, lambda twin: setattr(twin.rtde, "delay", 0.0)),
    "remote_control_off": _flag("controller.remote_control", False),
    "gripper_silent": _flag("controller.gripper.silent", True),
    "gripper_garbage": _flag("controller.gripper.garbage", True),
    "gripper_fault": Injection(_fail_gripper, lambda twin: twin.controller.gripper.fail(0)),
    "camera_freeze": _camera_mode(CameraMode.FROZEN),
    "camera_black": _camera_mode(CameraMode.BLACK),
    "camera_gone": _camera_mode(CameraMode.GONE),
    "emergency_stop": Injection(
        lambda twin: twin.controller.press_emergency_stop(), lambda twin: twin.controller.release_emergency_stop()
    ),
    "power_off": Injection(
        lambda twin: twin.controller.power_off(), recovery="'power on' and 'brake release' on the dashboard"
    ),
    "protective_stop": Injection(
        lambda twin: twin.controller.protective_stop("injected"),
        recovery="'unlock protective stop' on the dashboard; then the client uploads its script again",
    ),
    "script_stop": Injection(
        lambda twin: twin.controller.stop_program(), recovery="the client uploads its script again"
    ),
}


class Injections:
    """What is failing in one twin; `active` are the names of conditions."""

    def __init__(self, twin: "Twin"):
        self._twin = twin
        self.active: list[str] = []

    def start(self, name: str, **parameters: Any) -> None:
        """Makes something fail; raises a ValueError if it does not exist, or a parameter is unknown or out of range."""
        injection = _find(name)
        try:
            injection.start(self._twin, **parameters)
        except TypeError as error:
            known = list(inspect.signature(injection.start).parameters)[1:]
            raise ValueError(f"injection {name!r}: {error}; its parameters are {known}") from error
        if injection.clear is not None and name not in self.active:
            self.active.append(name)

    async def clear(self, name: str | None = None) -> None:
        """Undoes a condition, or all that last; raises a ValueError if it does not exist or is an event."""
        for one in list(self.active) if name is None else [name]:
            injection = _find(one)
            if injection.clear is None:
                raise ValueError(f"injection {one!r} is an event and cannot be cleared: {injection.recovery}")
            if one in self.active:
                self.active.remove(one)
                if (waiting := injection.clear(self._twin)) is not None:
                    await waiting


def _find(name: str) -> Injection:
    if name not in INJECTIONS:
        raise ValueError(f"injection {name!r} is unknown; choose one of {sorted(INJECTIONS)}")
    return INJECTIONS[name]
