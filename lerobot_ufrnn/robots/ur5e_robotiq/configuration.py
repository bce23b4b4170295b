"""What there is to set up about the arm, its gripper and its limits."""

import math
from dataclasses import dataclass, field

from draccus.utils import ParsingError
from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig

from env_door.checks import check_pair, check_range

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
"""Joints of the arm from base to wrist."""

FEATURES = tuple(f"{joint}.pos" for joint in (*JOINTS, "gripper"))
"""Names of what is measured and commanded: joint angles in rad, and the gripper from 0, open, to 1, closed."""


def check_controller(config: object, address: str) -> None:
    """Refuses an address that is empty and a gripper that cannot be, which robot and teleoperator are told alike."""
    if not getattr(config, address):
        raise ParsingError(f"`{address}` must be the address of the controller, such as 192.168.1.10, got ''.")
    check_range(config, "gripper_port", low=0, high=65535)
    check_range(config, "gripper_range", low=0, high=255)
    check_pair(config, "gripper_range", strictly=True)


@RobotConfig.register_subclass("ur5e_robotiq")
@dataclass(kw_only=True)
class UR5eRobotiqConfig(RobotConfig):
    """UR5e with a Robotiq 2F-85 on its controller's socket, and cameras.

    Observations and actions are those of the simulated door (`<joint>.pos` in rad, `gripper.pos` from 0, open, to 1,
    closed, cameras as square images), so that a checkpoint trained there loads here unchanged. So are the limits.
    """

    ip: str
    """Address of the controller."""
    stop_running_program: bool = False
    """Whether to end a program that the controller runs already; otherwise connecting is refused then."""

    # Cameras.
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    """Any of LeRobot's cameras, by name."""
    image_size: int = 128
    """Height and width that images are cropped and resized to; 0 leaves them as the camera gives them."""

    # How the arm is driven.
    control_period: float = 0.1
    """Seconds between two actions; the arm moves to each in that time along a straight line in joint space."""
    servo_frequency: float = 125.0
    """Set-points a second that are sent to the controller."""
    servo_lookahead: float = 0.05
    """Seconds over which the controller smooths them, 0.03 to 0.2; by as much the arm trails a moving target, which a
    policy from simulation has not learned."""
    servo_gain: float = 600.0
    """The controller's proportional gain, 100 to 2000."""
    stale_after: float = 0.2
    """Seconds without new data from the controller, or by which a set-point is late, from which the arm is stopped."""
    watchdog_frequency: float = 4.0
    """Commands a second below which the controller stops the arm on its own, whatever became of this computer; until
    then the arm goes no further than to the last set-point."""

    # Limits.
    joint_speed: float = 1.0
    """Largest joint speed in rad/s. The arm could do 3.14."""
    command_limit: float = 0.08
    """Largest distance in rad between a joint target and the measured joint: bounds the force of a blocked arm."""
    joint_low: tuple[float, ...] = (-2 * math.pi, -2 * math.pi, -math.pi, *(-2 * math.pi,) * 3)
    """Lower limits of the joints in rad; the arm's own unless given."""
    joint_high: tuple[float, ...] = (2 * math.pi, 2 * math.pi, math.pi, *(2 * math.pi,) * 3)
    """Upper limits of the joints in rad."""
    workspace_low: tuple[float, float, float] = (-0.95, -0.95, 0.05)
    """Lower corner in m, in the frame of the arm's base, of the box that the flange may be in; a target outside is
    shortened so that the flange stays inside."""
    workspace_high: tuple[float, float, float] = (0.95, 0.95, 1.1)
    """Upper corner of that box."""

    # Gripper.
    gripper_port: int = 63352
    """Port of the gripper's socket on the controller; 0 if there is no gripper, which then reads as open."""
    gripper_force: float = 0.56
    """How hard it squeezes, from 0, 20 N, to 1, 235 N; by default as hard as the simulated gripper, 140 N. At 0.2 it
    slips on the knob of a door that does not give way, which no demonstration in simulation shows."""
    gripper_speed: float = 1.0
    """Fraction of its largest speed, 0 to 1."""
    gripper_range: tuple[int, int] = (3, 230)
    """Its readings, of 255, when it is open and closed."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_controller(self, "ip")
        check_range(self, "image_size", low=0, high=4096)
        check_range(self, "control_period", low=0.02, high=1.0, unit="s")
        check_range(self, "servo_frequency", low=50, high=500, unit="Hz")
        check_range(self, "servo_lookahead", low=0.03, high=0.2, unit="s")
        check_range(self, "servo_gain", low=100, high=2000)
        check_range(self, "joint_speed", low=0.01, high=3.14, unit="rad/s")
        check_range(self, "command_limit", low=0.005, high=0.5, unit="rad")
        check_range(self, "stale_after", low=0.02, high=1.0, unit="s")
        check_range(self, "watchdog_frequency", low=1, high=125, unit="Hz")
        check_range(self, "gripper_force", "gripper_speed", low=0, high=1)
        for box, size in (("joint", len(JOINTS)), ("workspace", 3)):
            low, high = getattr(self, f"{box}_low"), getattr(self, f"{box}_high")
            if not len(low) == len(high) == size or not all(a < b for a, b in zip(low, high, strict=True)):
                raise ParsingError(
                    f"`{box}_low` and `{box}_high` must hold {size} numbers each, low below high, got {low} and {high}."
                )
