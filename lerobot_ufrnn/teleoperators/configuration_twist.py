"""What there is to set up about teleoperating the tool of a UR5e."""

from dataclasses import dataclass
from pathlib import Path

from draccus.utils import ParsingError
from lerobot.teleoperators import TeleoperatorConfig

from lerobot_ufrnn.robots.ur5e_robotiq.configuration_ur5e_robotiq import (
    check_address,
    check_gripper_range,
    check_range,
)

FRAMES = ("base", "tool")
KEY_SOURCES = ("auto", "pynput", "terminal")


@dataclass(kw_only=True)
class TwistTeleoperatorConfig(TeleoperatorConfig):
    """What the teleoperators have in common.

    Args:
        robot_ip (`str`):
            Address of the arm's controller, the same as `--robot.ip`. Where the arm is is read there.
        frame (`str`, *optional*, defaults to `"base"`):
            `"base"`: ahead, left and up are x, y and z of the arm's base. `"tool"`: ahead is where the gripper points,
            and left and up turn with it; with the gripper level both are the same.
        linear_speed (`float`, *optional*, defaults to `0.1`):
            Speed of the tool in m/s at full deflection, along each axis.
        angular_speed (`float`, *optional*, defaults to `0.5`):
            Speed of rotation in rad/s at full deflection, about each axis.
        joint_speed (`float`, *optional*, defaults to `0.6`):
            Largest speed of a joint target in rad/s; the tool slows down, on its way, where a joint would exceed it.
        max_lead (`float`, *optional*, defaults to `0.07`):
            Largest distance in rad between a joint target and the measured joint. A little below the
            `command_limit` of the robot, so that what is recorded as the action is what was sent.
        min_manipulability (`float`, *optional*, defaults to `0.01`):
            Manipulability (|det J|, m^3) below which the tool is not led on towards a singular pose; 0.035 where the
            door is opened.
        gripper_speed (`float`, *optional*, defaults to `1.0`):
            Strokes a second by which the gripper's target moves while a button is held.
        gripper_port (`int`, *optional*, defaults to `63352`):
            Port of the gripper's socket on the controller, where the first gripper target is read; 0 if there is none
            to ask, which then counts as open.
        gripper_range (`tuple[int, int]`, *optional*, defaults to `(3, 230)`):
            Its readings, of 255, when it is open and closed, as in the robot's configuration.
        device (`Path | None`, *optional*):
            File with recorded events that are played instead of reading the device.
        record_events (`Path | None`, *optional*):
            File that what is read from the device is written to, to be played again.

    Raises:
        ParsingError: If a field is out of its range.
    """

    robot_ip: str
    frame: str = "base"
    linear_speed: float = 0.1
    angular_speed: float = 0.5
    joint_speed: float = 0.6
    max_lead: float = 0.07
    min_manipulability: float = 0.01
    gripper_speed: float = 1.0
    gripper_port: int = 63352
    gripper_range: tuple[int, int] = (3, 230)
    device: Path | None = None
    record_events: Path | None = None

    def __post_init__(self) -> None:
        check_address(self, "robot_ip")
        self._check_choice("frame", FRAMES)
        for name, low, high in (
            ("linear_speed", 0.001, 0.5),
            ("angular_speed", 0.001, 2.0),
            ("joint_speed", 0.01, 3.14),
            ("max_lead", 0.005, 0.5),
            ("min_manipulability", 0.0, 0.1),
            ("gripper_speed", 0.01, 10.0),
            ("gripper_port", 0, 65535),
        ):
            check_range(self, name, low, high)
        check_gripper_range(self.gripper_range)
        if self.device is not None and self.record_events is not None and self.device == self.record_events:
            raise ParsingError(f"`record_events` would overwrite `device`, {self.device}; name another file.")

    def _check_choice(self, name: str, choices: tuple[str, ...]) -> None:
        if getattr(self, name) not in choices:
            raise ParsingError(f"`{name}` must be one of {', '.join(choices)}, got {getattr(self, name)!r}.")


# Not plain `spacemouse`: other public plug-ins have taken it, and where two register one name the second fails to load.
@TeleoperatorConfig.register_subclass("spacemouse_twist")
@dataclass(kw_only=True)
class SpaceMouseTwistConfig(TwistTeleoperatorConfig):
    """A 3Dconnexion SpaceMouse: the tool moves as the cap is pushed and twisted.

    Args:
        deadzone (`float`, *optional*, defaults to `0.1`):
            Deflection, 0 to 0.9, up to which the cap counts as untouched.
        stale_after (`float`, *optional*, defaults to `0.2`):
            Seconds after its last report for which a deflection counts. A deflected cap reports every few
            milliseconds, so one that is silent is not there any more.
    """

    deadzone: float = 0.1
    stale_after: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "deadzone", 0.0, 0.9)
        check_range(self, "stale_after", 0.02, 1.0)


@TeleoperatorConfig.register_subclass("keyboard_twist")
@dataclass(kw_only=True)
class KeyboardTwistConfig(TwistTeleoperatorConfig):
    """A keyboard: the tool moves while keys are held.

    Args:
        keys (`str`, *optional*, defaults to `"auto"`):
            Where keys are read: `"pynput"` (a desktop: knows when keys are let go; hold Shift with them),
            `"terminal"` (works anywhere, over SSH too: lives on the keyboard's repetition), or `"auto"` for the first
            that works here.
        key_hold (`float`, *optional*, defaults to `0.15`):
            Seconds for which a key counts as held after the terminal has reported it. Above the keyboard's
            repetition period (about 0.03 s) a held key moves evenly; at most this long the tool moves on after
            the key was let go.
    """

    keys: str = "auto"
    key_hold: float = 0.15

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_choice("keys", KEY_SOURCES)
        check_range(self, "key_hold", 0.02, 0.5)
