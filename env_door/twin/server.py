"""The twin: an asyncio loop in which the protocols of a robot and the physics of the door scene take turns.

Everything happens in one thread, between two physics steps: that needs no locks, and a controller answers in its own
rhythm of 2 ms anyway. Only the camera is a process of its own.
"""

import asyncio
import inspect
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from env_door.twin import ports
from env_door.twin.camera import Camera
from env_door.twin.configuration import TwinConfig
from env_door.twin.controller import Controller, Dashboard
from env_door.twin.injections import Injections
from env_door.twin.live_door import LiveDoor
from env_door.twin.motion import TIME_STEP
from env_door.twin.ports import Port, Serve, lines
from env_door.twin.rtde import RTDEServer
from env_door.twin.script import serve_uploads

MAX_LAG = 0.25  # seconds by which the twin may be late and still catch up; beyond, it lets the time go


class Twin:
    """A twin with all its ports. `open` lets clients in, `run` lets time pass."""

    def __init__(self, config: TwinConfig):
        self._seed = config.seed
        self._lost = 0.0
        self._trial_start = 0.0
        self.door = LiveDoor(config.kind, config.door_offset, config.hold_seconds)
        self.door.place(config.seed, None, keep_arm=False)
        self.controller: Controller = Controller(self.door, config.unlock_seconds)
        self.rtde: RTDEServer = RTDEServer(self.controller)
        self.camera = Camera(config.address, config.camera_fps, self.door.model.nq) if config.camera else None
        self.injections = Injections(self)
        self.stopped = asyncio.Event()
        self._actions: dict[str, Callable[..., Any]] = {
            "state": self.state,
            "reset": self.reset,
            "hold": self.door.hold_door,
            "arrivals": lambda: {"arrivals": self.rtde.take_arrivals()},
            "inject": self.injections.start,
            "clear": self.injections.clear,
        }
        handlers: dict[int, Serve] = {
            ports.RTDE: self.rtde.serve,
            **dict.fromkeys(ports.SCRIPT, serve_uploads(self.controller)),
            ports.DASHBOARD: Dashboard(self.controller).serve,
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
        joints = np.append(self.door.joints, self.door.closure)
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
            "joints": dict(zip(self.door.joint_names, joints.tolist(), strict=True)),
            "targets": dict(zip(self.door.joint_names, targets.tolist(), strict=True)),
            "arm_speed": float(np.abs(self.door.joint_speeds).max()),
            "motion": controller.motion.kind,
            "robot_mode": controller.robot_mode.name,
            "safety_mode": controller.safety_mode.name,
            "program": controller.program_state.name,
            "watchdog": controller.watchdog is not None,
            "rtde_clients": len(self.rtde.sessions),
            "injections": self.injections.active,
            "pictures": self.camera.drawn if self.camera is not None else 0,
            "lost_seconds": self._lost,
        }

    def reset(self, kind: str | None = None, seed: int | None = None, keep_arm: bool = False) -> dict[str, Any]:
        """Starts a new trial and returns the state; see [`~env_door.twin.TwinClient.reset`]."""
        seed = self._seed + 1 if seed is None else seed
        if not isinstance(seed, int) or seed < 0:
            raise ValueError(f"seed={seed!r} must be a whole number that is not negative")
        self.door.place(seed, kind, keep_arm)
        self._seed = seed
        self._trial_start = self.controller.time
        if not keep_arm:
            self.controller.gripper.open_at_once()
            self.controller.settle()
        return self.state()

    async def _serve_requests(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answers JSON lines such as `{"do": "inject", "name": "freeze"}` with `{"ok": true, ...}`."""
        async for line in lines(reader):
            try:
                answer = {"ok": True} | await self._carry_out(json.loads(line))
            except (ValueError, TypeError, OSError) as error:
                answer = {"ok": False, "error": str(error)}
            writer.write(json.dumps(answer).encode() + b"\n")

    async def _carry_out(self, request: Any) -> dict[str, Any]:
        if not isinstance(request, dict) or request.get("do") not in self._actions:
            known = sorted(self._actions)
            raise ValueError(f'request {request!r} is unknown; it must be {{"do": one of {known}, ...}}')
        answer = self._actions[request.pop("do")](**request)
        return (await answer if inspect.isawaitable(answer) else answer) or {}
