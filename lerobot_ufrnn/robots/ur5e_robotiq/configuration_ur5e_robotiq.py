"""What there is to set up about the arm, its gripper and its limits."""

import math
from dataclasses import dataclass, field

from draccus.utils import ParsingError
from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
"""Joints of the arm from base to wrist."""

FEATURES = tuple(f"{joint}.pos" for joint in (*JOINTS, "gripper"))
"""Names of what is measured and commanded: joint angles in rad, and the gripper from 0, open, to 1, closed."""

JOINT_RANGE = 2 * math.pi
ELBOW_RANGE = math.pi


def check_range(config: object, name: str, low: float, high: float) -> None:
    """Refuses a field that is out of its range.

    Args:
        config (`object`):
            A configuration.
        name (`str`):
            Its field.
        low (`float`):
            Smallest value allowed.
        high (`float`):
            Largest value allowed.

    Raises:
        ParsingError: If the value is out of range.
    """
    if not low <= getattr(config, name) <= high:
        raise ParsingError(f"`{name}` must be {low} to {high}, got {getattr(config, name)}.")


def check_address(config: object, name: str) -> None:
    """Refuses an empty address of the controller; see `check_range`."""
    if not getattr(config, name):
        raise ParsingError(f"`{name}` must be the address of the controller, such as 192.168.1.10, got ''.")


def check_gripper_range(gripper_range: tuple[int, ...]) -> None:
    """Refuses readings of a gripper that are not those of an open and of a closed one; see `check_range`."""
    if len(gripper_range) != 2 or not 0 <= gripper_range[0] < gripper_range[1] <= 255:
        raise ParsingError(f"`gripper_range` must be two readings, 0 <= open < closed <= 255, got {gripper_range}.")


@RobotConfig.register_subclass("ur5e_robotiq")
@dataclass(kw_only=True)
class UR5eRobotiqConfig(RobotConfig):
    """UR5e with a Robotiq 2F-85 on its controller's socket, and cameras.

    Observations and actions are those of the simulated door (`<joint>.pos` in rad, `gripper.pos` from 0, open, to 1,
    closed, cameras as square images), so that a checkpoint trained there loads here unchanged. So are the limits.

    Args:
        ip (`str`):
            Address of the controller.
        cameras (`dict[str, CameraConfig]`, *optional*):
            Any of LeRobot's cameras, by name.
        image_size (`int`, *optional*, defaults to `128`):
            Height and width that images are cropped and resized to; 0 leaves them as the camera gives them.
        control_period (`float`, *optional*, defaults to `0.1`):
            Seconds between two actions; the arm moves to each in that time along a straight line in joint space.
        servo_frequency (`float`, *optional*, defaults to `125.0`):
            Set-points a second that are sent to the controller.
        servo_lookahead (`float`, *optional*, defaults to `0.05`):
            Seconds over which the controller smooths them, 0.03 to 0.2; by as much the arm trails a moving target,
            which a policy from simulation has not learned.
        servo_gain (`float`, *optional*, defaults to `600.0`):
            Its proportional gain, 100 to 2000.
        joint_speed (`float`, *optional*, defaults to `1.0`):
            Largest joint speed in rad/s. The arm could do 3.14.
        command_limit (`float`, *optional*, defaults to `0.08`):
            Largest distance in rad between a joint target and the measured joint: bounds the force of a blocked arm.
        joint_low (`tuple[float, ...]`, *optional*), joint_high (`tuple[float, ...]`, *optional*):
            Limits of the joints in rad; the arm's own unless given.
        workspace_low (`tuple[float, float, float]`, *optional*), workspace_high (*optional*):
            Corners in m, in the frame of the arm's base, of the box that the flange may be in. A target outside it is
            shortened so that the flange stays inside.
        stale_after (`float`, *optional*, defaults to `0.2`):
            Seconds without new data from the controller, or by which a set-point is late, from which the arm is
            stopped.
        watchdog_frequency (`float`, *optional*, defaults to `4.0`):
            Commands a second below which the controller stops the arm on its own, whatever became of this computer;
            until then the arm goes no further than to the last set-point.
        gripper_port (`int`, *optional*, defaults to `63352`):
            Port of the gripper's socket on the controller; 0 if there is no gripper, which then reads as open.
        gripper_force (`float`, *optional*, defaults to `0.56`):
            How hard it squeezes, from 0, 20 N, to 1, 235 N; by default as hard as the simulated gripper, 140 N. At 0.2
            it slips on the knob of a door that does not give way, which no demonstration in simulation shows.
        gripper_speed (`float`, *optional*, defaults to `1.0`):
            Fraction of its largest speed, 0 to 1.
        gripper_range (`tuple[int, int]`, *optional*, defaults to `(3, 230)`):
            Its readings, of 255, when it is open and closed.

    Raises:
        ParsingError: If a field is out of its range.
    """

    ip: str
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    image_size: int = 128
    control_period: float = 0.1
    servo_frequency: float = 125.0
    servo_lookahead: float = 0.05
    servo_gain: float = 600.0
    joint_speed: float = 1.0
    command_limit: float = 0.08
    joint_low: tuple[float, ...] = (-JOINT_RANGE, -JOINT_RANGE, -ELBOW_RANGE, *(-JOINT_RANGE,) * 3)
    joint_high: tuple[float, ...] = (JOINT_RANGE, JOINT_RANGE, ELBOW_RANGE, *(JOINT_RANGE,) * 3)
    workspace_low: tuple[float, float, float] = (-0.95, -0.95, 0.05)
    workspace_high: tuple[float, float, float] = (0.95, 0.95, 1.1)
    stale_after: float = 0.2
    watchdog_frequency: float = 4.0
    gripper_port: int = 63352
    gripper_force: float = 0.56
    gripper_speed: float = 1.0
    gripper_range: tuple[int, int] = (3, 230)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_address(self, "ip")
        for name, low, high in (
            ("image_size", 0, 4096),
            ("control_period", 0.02, 1.0),
            ("servo_frequency", 50.0, 500.0),
            ("servo_lookahead", 0.03, 0.2),
            ("servo_gain", 100.0, 2000.0),
            ("joint_speed", 0.01, 3.14),
            ("command_limit", 0.005, 0.5),
            ("stale_after", 0.02, 1.0),
            ("watchdog_frequency", 1.0, 125.0),
            ("gripper_port", 0, 65535),
            ("gripper_force", 0.0, 1.0),
            ("gripper_speed", 0.0, 1.0),
        ):
            check_range(self, name, low, high)
        self._check_bounds("joint_low", "joint_high", len(JOINTS))
        self._check_bounds("workspace_low", "workspace_high", 3)
        check_gripper_range(self.gripper_range)

    def _check_bounds(self, low_name: str, high_name: str, size: int) -> None:
        low, high = getattr(self, low_name), getattr(self, high_name)
        if not len(low) == len(high) == size or not all(a < b for a, b in zip(low, high, strict=True)):
            raise ParsingError(
                f"`{low_name}` and `{high_name}` must hold {size} numbers each, low below high, got {low} and {high}."
            )
