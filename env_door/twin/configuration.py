"""What a twin is told when it starts."""

import math
from dataclasses import dataclass

from env_door.env import MAX_HOLD, MAX_OFFSET
from env_door.latch import KINDS


@dataclass(frozen=True)
class TwinConfig:
    """A door with a robot in front of it that listens like a real UR5e.

    Args:
        address (`str`, *optional*, defaults to `"127.0.0.2"`):
            IPv4 address to listen on. The ports are fixed, as on a real robot; several twins need several addresses
            (127.0.0.2, 127.0.0.3, ...; Linux has them all). ur_rtde skips its check of remote control on 127.0.0.1.
        kind (`str`, *optional*, defaults to `"random"`):
            Kind of the door: `"push"`, `"pull"`, `"slide"` or `"random"`.
        seed (`int`, *optional*, defaults to `0`):
            Seed of the first trial: kind, start pose and the door's shift.
        door_offset (`float`, *optional*, defaults to `0.0`):
            Half-width in m, 0 to 0.05, of the range of the door's sideways shift.
        hold_seconds (`float`, *optional*, defaults to `0.0`):
            Seconds, 0 to 60, for which somebody holds the door once it has begun to open.
        camera (`bool`, *optional*, defaults to `True`):
            Whether there is a camera; it needs pyzmq.
        camera_fps (`float`, *optional*, defaults to `30.0`):
            Pictures a second, 1 to 60; fewer where the machine cannot draw as many.
        unlock_seconds (`float`, *optional*, defaults to `5.0`):
            Seconds after a protective stop before it can be unlocked, as on a real controller.
        until_stdin_closes (`bool`, *optional*, defaults to `False`):
            Whether the twin ends with the process that holds the other end of its standard input.
    """

    address: str = "127.0.0.2"
    kind: str = "random"
    seed: int = 0
    door_offset: float = 0.0
    hold_seconds: float = 0.0
    camera: bool = True
    camera_fps: float = 30.0
    unlock_seconds: float = 5.0
    until_stdin_closes: bool = False

    def __post_init__(self) -> None:
        if self.kind not in (*KINDS, "random"):
            raise ValueError(f"--kind={self.kind!r} is unknown; choose one of {(*KINDS, 'random')}")
        if self.seed < 0:
            raise ValueError(f"--seed={self.seed} must not be negative")
        for name, value, low, high, unit in (
            ("door_offset", self.door_offset, 0.0, MAX_OFFSET, "m"),
            ("hold_seconds", self.hold_seconds, 0.0, MAX_HOLD, "s"),
            ("camera_fps", self.camera_fps, 1.0, 60.0, "pictures a second"),
            ("unlock_seconds", self.unlock_seconds, 0.0, 3600.0, "s"),
        ):
            if not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"--{name}={value} must be {low:g} to {high:g} {unit}")
