"""What can go wrong, by name: `Faults.start("freeze")` and, where it can be undone, `Faults.clear("freeze")`.

Conditions last until they are cleared. Events happen once, and what they leave is undone as on a real robot: through
the dashboard and by the client.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from env_door.twin import ports
from env_door.twin.camera import Camera, CameraMode
from env_door.twin.controller import Controller
from env_door.twin.network import Hub
from env_door.twin.rtde import RTDEServer

MAX_DELAY = 10_000.0
"""Longest delay in ms."""

OVERCURRENT = 14
"""Robotiq's code of a major fault: the gripper stops until it is activated again."""


@dataclass(frozen=True)
class Fault:
    """One thing that can go wrong.

    Args:
        start (`Callable[..., None]`):
            Makes it happen; its keywords are the fault's parameters.
        clear (`Callable[[], None]`, *optional*):
            Undoes it; `None` for events.
        recovery (`str`, *optional*, defaults to `""`):
            How one recovers from an event.
    """

    start: Callable[..., None]
    clear: Callable[[], None] | None = None
    recovery: str = ""


class Faults:
    """All faults of one twin.

    Args:
        hub (`Hub`):
            Its ports.
        controller (`Controller`):
            Its controller.
        rtde (`RTDEServer`):
            Its RTDE clients.
        camera (`Camera | None`):
            Its camera, if it has one.
    """

    def __init__(self, hub: Hub, controller: Controller, rtde: RTDEServer, camera: Camera | None):
        self._hub, self._controller, self._rtde, self._camera = hub, controller, rtde, camera
        gripper = controller.gripper
        self.active: list[str] = []
        self._faults = {
            "drop_link": self._port_gone(ports.RTDE),
            "dashboard_gone": self._port_gone(ports.DASHBOARD),
            "gripper_gone": self._port_gone(ports.GRIPPER),
            "freeze": Fault(lambda: self._freeze(True), lambda: self._freeze(False)),
            "delay": Fault(self._delay, lambda: setattr(rtde, "delay", 0.0)),
            "remote_control_off": self._flag(controller, "remote_control", False),
            "gripper_silent": self._flag(gripper, "silent", True),
            "gripper_garbage": self._flag(gripper, "garbage", True),
            "gripper_fault": Fault(self._fail_gripper, lambda: gripper.fail(0)),
            "camera_freeze": self._camera_mode(CameraMode.FROZEN),
            "camera_black": self._camera_mode(CameraMode.BLACK),
            "camera_gone": self._camera_mode(CameraMode.GONE),
            "emergency_stop": Fault(controller.press_emergency_stop, controller.release_emergency_stop),
            "power_off": Fault(controller.power_off, recovery="'power on' and 'brake release' on the dashboard"),
            "protective_stop": Fault(
                lambda: controller.protective_stop("fault asked for"),
                recovery="'unlock protective stop' on the dashboard; then the client uploads its script again",
            ),
            "script_stop": Fault(controller.stop_program, recovery="the client uploads its script again"),
        }

    @property
    def names(self) -> list[str]:
        """`list[str]`: names of all faults."""
        return sorted(self._faults)

    def start(self, name: str, parameters: dict[str, Any]) -> None:
        """Makes a fault happen.

        Args:
            name (`str`):
                One of `names`.
            parameters (`dict[str, Any]`):
                Its parameters.

        Raises:
            ValueError: If there is no such fault, or a parameter is unknown or out of range.
        """
        fault = self._fault(name)
        try:
            inspect.signature(fault.start).bind(**parameters)
        except TypeError as error:
            known = list(inspect.signature(fault.start).parameters)
            raise ValueError(f"fault {name!r}: {error}; its parameters are {known}") from error
        fault.start(**parameters)
        if fault.clear is not None and name not in self.active:
            self.active.append(name)

    def clear(self, name: str | None) -> None:
        """Undoes a condition, or all that last.

        Args:
            name (`str | None`):
                One of `names`; `None` for all. What does not last is left alone.

        Raises:
            ValueError: If there is no such fault, or it is an event.
        """
        for one in list(self.active) if name is None else [name]:
            clear = self._fault(one).clear
            if clear is None:
                raise ValueError(f"fault {one!r} is an event and cannot be cleared: {self._faults[one].recovery}")
            if one in self.active:
                self.active.remove(one)
                clear()

    def _fault(self, name: str) -> Fault:
        if name not in self._faults:
            raise ValueError(f"fault {name!r} is unknown; choose one of {self.names}")
        return self._faults[name]

    def _port_gone(self, port: int) -> Fault:
        return Fault(lambda: self._hub.shut(port), lambda: self._hub.reopen(port))

    @staticmethod
    def _flag(thing: object, name: str, broken: bool) -> Fault:
        return Fault(lambda: setattr(thing, name, broken), lambda: setattr(thing, name, not broken))

    def _freeze(self, frozen: bool) -> None:
        self._rtde.frozen = frozen
        self._hub.freeze(ports.RTDE, frozen)

    def _delay(self, ms: float) -> None:
        if not 0 < ms <= MAX_DELAY:
            raise ValueError(f"fault 'delay': ms={ms} must be above 0 and at most {MAX_DELAY:g} ms")
        self._rtde.delay = ms / 1000

    def _fail_gripper(self, code: int = OVERCURRENT) -> None:
        if not 1 <= code <= 15:
            raise ValueError(f"fault 'gripper_fault': code={code} must be 1 to 15, as in Robotiq's manual")
        self._controller.gripper.fail(code)

    def _camera_mode(self, mode: CameraMode) -> Fault:
        def start() -> None:
            if self._camera is None:
                raise ValueError("this twin has no camera; start it with --camera=true")
            self._camera.mode = mode

        def clear() -> None:
            if self._camera is not None and self._camera.mode == mode:
                self._camera.mode = CameraMode.NORMAL

        return Fault(start, clear)
