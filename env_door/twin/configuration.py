"""What a twin is told when it starts."""

from dataclasses import dataclass

from env_door.checks import check_choice, check_range
from env_door.latch import KINDS
from env_door.limits import MAX_HOLD, MAX_OFFSET


@dataclass(frozen=True)
class TwinConfig:
    """A door with a robot in front of it that listens like a real UR5e."""

    address: str = "127.0.0.2"
    """IPv4 address to listen on. The ports are fixed, as on a real robot; several twins need several addresses
    (127.0.0.2, 127.0.0.3, ...; Linux has them all). ur_rtde skips its check of remote control on 127.0.0.1."""
    kind: str = "random"
    """Kind of the door: push, pull, slide or random."""
    seed: int = 0
    """Seed of the first trial: kind, start pose and the door's shift."""
    door_offset: float = 0.0
    """Half-width in m, 0 to 0.05, of the range of the door's sideways shift."""
    hold_seconds: float = 0.0
    """Seconds, 0 to 60, for which somebody holds the door once it has begun to open."""
    camera: bool = True
    """Whether there is a camera; it needs pyzmq."""
    camera_fps: float = 30.0
    """Pictures a second, 1 to 60; fewer where the machine cannot draw as many."""
    unlock_seconds: float = 5.0
    """Seconds after a protective stop before it can be unlocked, as on a real controller."""
    until_stdin_closes: bool = False
    """Whether the twin ends with the process at the other end of its standard input, which writes nothing there."""

    def __post_init__(self) -> None:
        check_choice(self, "kind", (*KINDS, "random"))
        check_range(self, "seed", low=0)
        check_range(self, "door_offset", low=0.0, high=MAX_OFFSET, unit="m")
        check_range(self, "hold_seconds", low=0.0, high=MAX_HOLD, unit="s")
        check_range(self, "camera_fps", low=1.0, high=60.0, unit="pictures a second")
        check_range(self, "unlock_seconds", low=0.0, high=3600.0, unit="s")
