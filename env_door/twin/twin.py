"""The twin: the door scene in real time behind the protocols of a UR5e, a Robotiq gripper and a camera."""

import logging
import time
from typing import Any

import numpy as np

from env_door.twin import ports
from env_door.twin.camera import Camera, CameraOptions
from env_door.twin.configuration import TwinConfig
from env_door.twin.control import ControlPeer
from env_door.twin.controller import Controller
from env_door.twin.dashboard import Dashboard
from env_door.twin.faults import Faults
from env_door.twin.gripper import GripperSocket
from env_door.twin.live_door import LiveDoor
from env_door.twin.measurements import joint_values
from env_door.twin.motion import TIME_STEP
from env_door.twin.network import Hub
from env_door.twin.rtde import RTDEServer
from env_door.twin.script_port import ScriptPeer

logger = logging.getLogger(__name__)

MAX_LAG = 0.25
"""Seconds by which the twin may be late and still catch up; beyond, it lets the time go."""


class Twin:
    """A twin with all its servers; listens once it is made.

    Args:
        config (`TwinConfig`):
            What it is like.

    Raises:
        OSError: If a port cannot be had.
        ModuleNotFoundError: If there is to be a camera and pyzmq is missing.
        RuntimeError: If the camera does not start.
    """

    def __init__(self, config: TwinConfig):
        self._config = config
        self.door = LiveDoor(config.kind, config.door_offset, config.hold_seconds)
        self.door.place(config.seed, None, keep_arm=False)
        self._seed = config.seed
        self.controller = Controller(self.door, config.unlock_seconds)
        self._trial_start = self.controller.time
        self._lost = 0.0
        self.hub = Hub(config.address)
        self._camera: Camera | None = None
        try:
            self._rtde = RTDEServer(self.controller)
            self._listen()
            if config.camera:
                options = CameraOptions(config.address, ports.CAMERA, config.camera_fps)
                self._camera = Camera(options, self.door.model.nq)
                self._camera.start()
        except BaseException:
            self.close()
            raise
        self.faults = Faults(self.hub, self.controller, self._rtde, self._camera)
        self.stopping = False

    def _listen(self) -> None:
        controller = self.controller
        self.hub.listen(ports.RTDE, self._rtde.accept)
        for port in ports.SCRIPT:
            self.hub.listen(port, lambda connection: ScriptPeer(connection, controller))
        self.hub.listen(ports.DASHBOARD, lambda connection: Dashboard(connection, controller))
        self.hub.listen(ports.GRIPPER, lambda connection: GripperSocket(connection, controller.gripper))
        self.hub.listen(ports.CONTROL, lambda connection: ControlPeer(connection, self))

    def run(self) -> None:
        """Runs in real time until `stopping` is set.

        Raises:
            RuntimeError: If the physics diverged.
        """
        due = time.monotonic()
        while not self.stopping:
            early = due - time.monotonic()
            if early < -MAX_LAG:
                self._lost -= early
                due -= early
            self.hub.poll(max(early, 0.0))
            if time.monotonic() >= due:
                self.tick()
                due += TIME_STEP

    def tick(self) -> None:
        """Goes on by 2 ms and sends what clients are to be told."""
        self.controller.tick()
        if self._camera is not None:
            self._camera.show(self.door.data.qpos, self.door.doorway)
        self._rtde.publish()

    def reset(self, kind: str | None = None, seed: int | None = None, keep_arm: bool = False) -> dict[str, Any]:
        """Starts a new trial: a closed door, and the arm at once in front of it with an open gripper.

        A client that goes on commanding its old target takes the arm back there: stop it first, or keep the arm.

        Args:
            kind (`str`, *optional*):
                Kind of the door; by default as configured.
            seed (`int`, *optional*):
                Seed; by default the next one.
            keep_arm (`bool`, *optional*, defaults to `False`):
                Whether arm and fingers stay where they are.

        Returns:
            `dict[str, Any]`: the state.

        Raises:
            ValueError: If the kind or the seed is not allowed.
        """
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

    def state(self) -> dict[str, Any]:
        """What is the case, whatever clients are told.

        Returns:
            `dict[str, Any]`:
                the door: `kind`, `opening`, `is_open`, `attempts`, `held`, `tried_while_held`;
                the trial: `seed`, `time` in s, and in s the `controller_time` that RTDE's timestamps have;
                the arm: `joints` and `targets` (rad and closure), `arm_speed` (rad/s, fastest joint), `motion`;
                the controller: `robot_mode`, `safety_mode`, `program`, `watchdog`, `rtde_clients`;
                the active `faults`, `pictures` drawn and `lost_seconds` of real time.
        """
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
            "joints": joint_values(controller),
            "targets": dict(zip(self.door.joint_names, targets.tolist(), strict=True)),
            "arm_speed": float(np.abs(self.door.joint_speeds).max()),
            "motion": controller.motion.kind,
            "robot_mode": controller.robot_mode.name,
            "safety_mode": controller.safety_mode.name,
            "program": controller.program_state.name,
            "watchdog": controller.watchdog_armed,
            "rtde_clients": len(self._rtde.sessions),
            "faults": self.faults.active,
            "pictures": self._camera.drawn if self._camera is not None else 0,
            "lost_seconds": self._lost,
        }

    def arrivals(self) -> dict[str, Any]:
        """When clients of RTDE wrote inputs since this was asked last: each set-point of a servo is one such package.

        Returns:
            `dict[str, Any]`: `arrivals`, real times in s in order.
        """
        arrivals = self.controller.registers.arrivals
        times = list(arrivals)
        arrivals.clear()
        return {"arrivals": times}

    def close(self) -> None:
        """Ends all connections and the camera."""
        if self._camera is not None:
            self._camera.close()
        self.hub.close()
        self.door.close()
