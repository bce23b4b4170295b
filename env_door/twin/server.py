"""The twin: an asyncio loop in which the protocols of a robot and the physics of the door scene take turns.

Everything happens in one thread, between two physics steps: that needs no locks, and a controller answers in its own
rhythm of 2 ms anyway. Only the camera is a process of its own.
"""

import asyncio
import inspect
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from env_door.checks import check_choice, check_range
from env_door.latch import EIGHT_KINDS
from env_door.limits import MAX_HOLD, MAX_OFFSET
from env_door.twin import ports
from env_door.twin.arm import TIME_STEP, LiveDoor
from env_door.twin.camera import Camera
from env_door.twin.controller import Controller, serve_dashboard
from env_door.twin.injections import find
from env_door.twin.ports import Port, Serve, lines
from env_door.twin.rtde import RTDEServer
from env_door.twin.script import serve_uploads

MAX_LAG = 0.25  # seconds by which the twin may be late and still catch up; beyond, it lets the time go


@dataclass(frozen=True)
class TwinConfig:
    """A door with a robot in front of it that listens like a real UR5e."""

    address: str = "127.0.0.2"
    """IPv4 address to listen on. The ports are fixed, as on a real robot; several twins need several addresses
    (127.0.0.2, 127.0.0.3, ...; Linux has them all). ur_rtde skips its check of remote control on 127.0.0.1."""
    kind: str = "random"
    """Kind of the door: push, pull, slide or random, or another of the eight, such as push_ccw."""
    seed: int = 0
    """Seed of the first trial: kind, start pose and the door's shift."""
    door_offset: float = 0.0
    """Half-width in m, 0 to 0.05, of the range of the door's sideways shift."""
    hold_seconds: float = 0.0
    """Seconds, 0 to 60, for which somebody holds the door once it has begun to open."""
    camera: bool = True
    """Whether there is a camera; it needs pyzmq."""
    unlock_seconds: float = 5.0
    """Seconds after a protective stop before it can be unlocked, as on a real controller."""
    until_stdin_closes: bool = False
    """Whether the twin ends with the process at the other end of its standard input, which writes nothing there."""

    def __post_init__(self) -> None:
        check_choice(self, "kind", (*EIGHT_KINDS, "random"))
        check_range(self, "seed", low=0)
        check_range(self, "door_offset", low=0.0, high=MAX_OFFSET, unit="m")
        check_range(self, "hold_seconds", low=0.0, high=MAX_HOLD, unit="s")
        check_range(self, "unlock_seconds", low=0.0, high=3600.0, unit="s")


class Twin:
    """A twin with all its ports. `open` lets clients in, `run` lets time pass."""

    def __init__(self, config: TwinConfig):
        self._seed = config.seed
        self._lost = 0.0
        self._trial_start = 0.0
        self.door = LiveDoor(config.kind, config.door_offset, config.hold_seconds)
        self.door.reset(seed=config.seed)
        self.controller: Controller = Controller(self.door, config.unlock_seconds)
        self.rtde: RTDEServer = RTDEServer(self.controller)
        self.camera = Camera(config.address, self.door.model.nq) if config.camera else None
        self.stopped = asyncio.Event()
        self._active: list[str] = []  # injections that last
        self._requests: dict[str, Callable[..., Any]] = {
            "state": self.state,
            "reset": self.reset,
            "hold": self.door.hold_door,
            "arrivals": lambda: {"arrivals": self.rtde.take_arrivals()},
            "inject": self.inject,
            "clear": self.clear,
        }
        handlers: dict[int, Serve] = {
            ports.RTDE: self.rtde.serve,
            **dict.fromkeys(ports.SCRIPT, partial(serve_uploads, self.controller)),
            ports.DASHBOARD: partial(serve_dashboard, self.controller),
            ports.GRIPPER: self.controller.gripper.serve,
            ports.TWIN: self._serve_requests,
        }
        self.ports = {number: Port(config.address, number, serve) for number, serve in handlers.items()}

    async def open(self) -> None:
        """Listens; raises an OSError if a port cannot be had and a RuntimeError if the camera does not start."""
        for port in self.ports.values():
            await port.open()
        if self.camera is not None:
            self.camera.start()

    async def run(self) -> None:
        """Runs in real time until `stopped` is set; raises a RuntimeError if the physics diverged."""
        clock = asyncio.get_running_loop().time
        due = clock()
        while not self.stopped.is_set():
            early = due - clock()
            if early < -MAX_LAG:
                self._lost -= early
                due -= early
            # Sleeps at least once, so that clients are answered even while the twin catches up.
            await asyncio.sleep(max(early, 0.0))
            self.tick()
            due += TIME_STEP

    def tick(self) -> None:
        """Goes on by 2 ms and sends what clients are to be told."""
        self.controller.tick()
        if self.camera is not None:
            self.camera.show(self.door.data.qpos, self.door.current_offset)
        self.rtde.publish()

    def close(self) -> None:
        """Ends all connections and the camera."""
        if self.camera is not None:
            self.camera.close()
        for port in self.ports.values():
            port.shut()
        self.door.close()

    def state(self) -> dict[str, Any]:
        """What is the case, whatever clients are told; see [`~env_door.twin.TwinClient.state`]."""
        latch, controller = self.door.latch, self.controller
        targets = np.append(controller.motion.position, controller.gripper.target)
        return {
            "kind": latch.kind,
            "opening": latch.opening,
            "is_open": latch.is_open,
            "attempts": list(latch.attempts),
            "held": latch.held,
            "tried_while_held": list(latch.tried_while_held),
            "seed": self._seed,
            "time": controller.time - self._trial_start,
            "controller_time": controller.time,
            "joints": dict(zip(self.door.joint_names, self.door.measured_joints().tolist(), strict=True)),
            "targets": dict(zip(self.door.joint_names, targets.tolist(), strict=True)),
            "arm_speed": float(np.abs(self.door.joint_speeds).max()),
            "motion": controller.motion.kind,
            "robot_mode": controller.robot_mode.name,
            "safety_mode": controller.safety_mode.name,
            "program": controller.program_state.name,
            "watchdog": controller.watchdog is not None,
            "rtde_clients": len(self.rtde.sessions),
            "injections": list(self._active),
            "pictures": self.camera.drawn.value if self.camera is not None else 0,
            "lost_seconds": self._lost,
        }

    def reset(self, kind: str | None = None, seed: int | None = None) -> dict[str, Any]:
        """Starts a new trial and returns the state; see [`~env_door.twin.TwinClient.reset`]."""
        seed = self._seed + 1 if seed is None else seed
        if not isinstance(seed, int) or seed < 0:
            raise ValueError(f"seed={seed!r} must be a whole number that is not negative")
        self.door.reset(seed=seed, options={} if kind is None else {"kind": kind})
        self._seed = seed
        self._trial_start = self.controller.time
        self.controller.gripper.open_at_once()
        self.controller.settle()
        return self.state()

    def inject(self, name: str, **parameters: Any) -> None:
        """Makes something fail; raises a ValueError if it does not exist, or a parameter is unknown or out of range."""
        start, clear = find(name)
        try:
            start(self, **parameters)
        except TypeError as error:
            known = list(inspect.signature(start).parameters)[1:]
            raise ValueError(f"injection {name!r}: {error}; its parameters are {known}") from error
        if callable(clear) and name not in self._active:
            self._active.append(name)

    async def clear(self, name: str | None = None) -> None:
        """Undoes a condition, or all that last; raises a ValueError if it does not exist or is an event."""
        for one in list(self._active) if name is None else [name]:
            clear = find(one).clear
            if isinstance(clear, str):
                raise ValueError(f"injection {one!r} is an event and cannot be cleared: {clear}")
            if one in self._active:
                self._active.remove(one)
                if (waiting := clear(self)) is not None:
                    await waiting

    async def _serve_requests(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answers JSON lines such as `{"do": "inject", "name": "freeze"}` with `{"ok": true, ...}`."""
        async for line in lines(reader):
            try:
                answer = {"ok": True} | await self._carry_out(json.loads(line))
            except (ValueError, TypeError, OSError) as error:
                answer = {"ok": False, "error": str(error)}
            writer.write(json.dumps(answer).encode() + b"\n")

    async def _carry_out(self, request: Any) -> dict[str, Any]:
        if not isinstance(request, dict) or request.get("do") not in self._requests:
            known = sorted(self._requests)
            raise ValueError(f'request {request!r} is unknown; it must be {{"do": one of {known}, ...}}')
        answer = self._requests[request.pop("do")](**request)
        return (await answer if inspect.isawaitable(answer) else answer) or {}
