"""LeRobot's teleoperators that move the tool of a UR5e and command its joints."""

import contextlib
import logging
from abc import abstractmethod
from time import monotonic
from typing import Any

import numpy as np
from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from lerobot_ufrnn.robots.ur5e_robotiq.configuration import FEATURES

from .arm_state import ArmState
from .configuration import KeyboardTwistConfig, SpaceMouseTwistConfig, TwistTeleoperatorConfig
from .device import CLOSE, OPEN, DeviceState, EventStreamDevice, TwistDevice
from .keyboard import KeyboardDevice
from .spacemouse import SpaceMouseDevice
from .tool_target import ToolTarget

logger = logging.getLogger(__name__)

MAX_STEP_SECONDS = 0.25  # that one action moves the target for; a loop that hangs does not make it leap
PAUSE_SECONDS = 1.0  # without an action after which the target starts from where the arm is, as it did at first
SILENCE_SECONDS = 2.0  # that a condition must have been over before the operator is told of it again

# Ahead, left and up in the tool's own axes: z points ahead, and with the gripper level x points up.
TOOL_FROM_OPERATOR = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])


class TwistTeleoperator(Teleoperator):
    """Turns the twist of an input device into joint targets, under the names that the robot gives its actions.

    So the stock `lerobot-teleoperate` and `lerobot-record` need no processors, and what they record is what a policy of
    the simulated door is trained on. Episodes are controlled with LeRobot's own keys. Collisions are not looked for.

    **Where it starts.** The stock loops connect the teleoperator before the robot and never tell it where the arm is; a
    pose from the configuration would be a guess, and a wrong guess a jump. So it asks the arm's controller itself,
    through a connection of its own that can only read, when the *first action* is asked for: that is the measured pose,
    whatever the device says, with the gripper's target in force. Every later target lies within `max_lead` of the
    joints measured at that moment, be the arm blocked or moved by somebody else. After a pause of more than a second,
    such as LeRobot makes to save an episode, it starts anew from where the arm is.

    **When something is wrong.** A device that is silent or gives nonsense counts as at rest: the arm holds. A device
    that is gone, or an arm whose place is not known any more, ends `get_action()` with an error that says what to do;
    the stock commands then disconnect, and the robot stops the arm. Out of reach or near a singular pose, the target
    stays where it is. The operator is told once, not at every step.
    """

    config_class = TwistTeleoperatorConfig
    name = "twist"

    def __init__(self, config: TwistTeleoperatorConfig):
        super().__init__(config)
        self.config = config
        self.clock = monotonic
        self._is_connected = False
        self._arm = ArmState(config, self.clock)
        self._device = self.make_own_device() if config.device is None else EventStreamDevice(config.device, self.clock)
        self._target = ToolTarget(config)
        self._scale = np.repeat([config.linear_speed, config.angular_speed], 3)
        self._gripper = 0.0
        self._last: float | None = None
        self._noticed: dict[str, float] = {}

    @abstractmethod
    def make_own_device(self) -> TwistDevice:
        """The input device of this type, not opened yet."""

    @property
    def action_features(self) -> dict[str, type]:
        """The robot's."""
        return dict.fromkeys(FEATURES, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """None; the device cannot be moved, and the arm is asked for its state directly."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called and `disconnect` was not."""
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        """Always; there is nothing to calibrate."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Opens the connection to the arm's controller and the device; nothing moves.

        Raises an `ArmStateError`, a `DeviceUnavailableError` or an `ImportError` that says what is missing.
        """
        self._arm.open()
        try:
            self._device.open()
        except BaseException:
            self._arm.close()
            raise
        self._is_connected, self._last = True, None

    @check_if_not_connected
    def get_action(self) -> RobotAction:
        """Joint targets for now, `<joint>.pos` in rad and `gripper.pos`; the first are where the arm is.

        Raises a `DeviceLostError` or an `ArmStateError` if either is gone, and a `ValueError` if the arm starts beyond
        its joint ranges.
        """
        now = self.clock()
        measured = self._arm.joints()
        state = self._read_device()
        if self._last is None or now - self._last > PAUSE_SECONDS:
            joints = self._target.start(measured)
            self._gripper = self._arm.gripper_target()
            # Asking the gripper takes a moment, which is not to count as a step of the next action.
            now = self.clock()
        else:
            seconds = min(now - self._last, MAX_STEP_SECONDS)
            joints = self._target.step(self._in_base(state.twist * self._scale), seconds, measured)
            if (hindrance := self._target.hindrance) is not None:
                self._notice(hindrance.name, hindrance.value)
            closing = (CLOSE in state.buttons) - (OPEN in state.buttons)
            self._gripper = float(np.clip(self._gripper + closing * self.config.gripper_speed * seconds, 0.0, 1.0))
        self._last = now
        return dict(zip(FEATURES, (*joints.tolist(), self._gripper), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing to do: the stock loops call this for other robots only, so nothing may depend on it."""

    @check_if_not_connected
    def disconnect(self) -> None:
        """Lets go of the device and the connection. Does not fail once connected: the robot is next to be stopped."""
        self._is_connected = False
        for part in (self._device, self._arm):
            with contextlib.suppress(Exception):
                part.close()

    def _read_device(self) -> DeviceState:
        state = self._device.read()
        if (fault := state.fault()) is not None:
            self._notice("fault", f"The arm holds: {fault}.")
            return DeviceState()
        return DeviceState(np.clip(state.twist, -1.0, 1.0), state.buttons)

    def _notice(self, kind: str, message: str) -> None:
        """Tells the operator of a condition once, not at every step that it lasts."""
        now, before = self.clock(), self._noticed.get(kind, -np.inf)
        self._noticed[kind] = now
        if now - before > SILENCE_SECONDS:
            logger.warning(message)

    def _in_base(self, twist: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.config.frame == "base":
            return twist
        return (self._target.rotation @ TOOL_FROM_OPERATOR @ twist.reshape(2, 3).T).T.ravel()


class SpaceMouseTwist(TwistTeleoperator):
    """`--teleop.type=spacemouse_twist`."""

    config_class = SpaceMouseTwistConfig
    name = "spacemouse_twist"
    config: SpaceMouseTwistConfig

    def make_own_device(self) -> TwistDevice:
        """The SpaceMouse."""
        return SpaceMouseDevice(self.config)


class KeyboardTwist(TwistTeleoperator):
    """`--teleop.type=keyboard_twist`."""

    config_class = KeyboardTwistConfig
    name = "keyboard_twist"
    config: KeyboardTwistConfig

    def make_own_device(self) -> TwistDevice:
        """The keyboard."""
        return KeyboardDevice()
