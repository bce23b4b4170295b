"""What there is to set up about teleoperating the tool of a UR5e."""

from dataclasses import dataclass
from pathlib import Path

from lerobot.teleoperators import TeleoperatorConfig

from env_door.checks import check_choice, check_range
from lerobot_ufrnn.robots.ur5e_robotiq.configuration import UR5eRobotiqConfig, check_controller


@dataclass(kw_only=True)
class TwistTeleoperatorConfig(TeleoperatorConfig):
    """What the teleoperators have in common."""

    robot_ip: str
    """Address of the arm's controller, the same as `--robot.ip`. Where the arm is is read there."""

    # How the tool moves.
    frame: str = "base"
    """`base`: ahead, left and up are x, y and z of the arm's base. `tool`: ahead is where the gripper points, and left
    and up turn with it; with the gripper level both are the same."""
    linear_speed: float = 0.1
    """Speed of the tool in m/s at full deflection, along each axis."""
    angular_speed: float = 0.5
    """Speed of rotation in rad/s at full deflection, about each axis."""
    joint_speed: float = 0.6
    """Largest speed of a joint target in rad/s; the tool slows down, on its way, where a joint would exceed it."""
    max_lead: float = 0.07
    """Largest distance in rad between a joint target and the measured joint. A little below the `command_limit` of the
    robot, so that what is recorded as the action is what was sent."""
    min_manipulability: float = 0.01
    """Manipulability (|det J|, m^3) below which the tool is not led on towards a singular pose; 0.035 where the door is
    opened."""

    # Gripper.
    gripper_speed: float = 1.0
    """Strokes a second by which the gripper's target moves while a button is held."""
    gripper_port: int = UR5eRobotiqConfig.gripper_port
    """Port of the gripper's socket on the controller, where the first gripper target is read; 0 if there is none to
    ask, which then counts as open."""
    gripper_range: tuple[int, int] = UR5eRobotiqConfig.gripper_range
    """Its readings, of 255, when it is open and closed, as in the robot's configuration."""

    device: Path | None = None
    """File with events that are played instead of reading the device."""

    def __post_init__(self) -> None:
        check_controller(self, "robot_ip")
        check_choice(self, "frame", ("base", "tool"))
        check_range(self, "linear_speed", low=0.001, high=0.5, unit="m/s")
        check_range(self, "angular_speed", low=0.001, high=2.0, unit="rad/s")
        check_range(self, "joint_speed", low=0.01, high=3.14, unit="rad/s")
        check_range(self, "max_lead", low=0.005, high=0.5, unit="rad")
        check_range(self, "min_manipulability", low=0.0, high=0.1, unit="m^3")
        check_range(self, "gripper_speed", low=0.01, high=10.0, unit="strokes/s")


# Not plain `spacemouse`: other public plug-ins have taken it, and where two register one name the second fails to load.
@TeleoperatorConfig.register_subclass("spacemouse_twist")
@dataclass(kw_only=True)
class SpaceMouseTwistConfig(TwistTeleoperatorConfig):
    """A 3Dconnexion SpaceMouse: the tool moves as the cap is pushed and twisted."""

    deadzone: float = 0.1
    """Deflection, 0 to 0.9, up to which the cap counts as untouched."""
    stale_after: float = 0.2
    """Seconds after its last report for which a deflection counts. A deflected cap reports every few milliseconds, so
    one that is silent is not there any more."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "deadzone", low=0.0, high=0.9)
        check_range(self, "stale_after", low=0.02, high=1.0, unit="s")


@TeleoperatorConfig.register_subclass("keyboard_twist")
@dataclass(kw_only=True)
class KeyboardTwistConfig(TwistTeleoperatorConfig):
    """A keyboard: the tool moves while keys are held, together with Shift."""
