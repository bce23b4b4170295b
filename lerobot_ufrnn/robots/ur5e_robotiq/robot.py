"""UR5e with a Robotiq 2F-85 as a LeRobot robot."""

import contextlib
import logging
import signal
import threading
import time
from collections.abc import Iterator
from functools import cached_property
from types import FrameType
from typing import Any

import cv2
import numpy as np
from lerobot.cameras import Camera, make_cameras_from_configs
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from .configuration import FEATURES, UR5eRobotiqConfig
from .controller import check_ready
from .faults import Fault, RobotFaultError
from .gripper import RobotiqGripper
from .limits import Limits
from .servo import Servo, import_client

logger = logging.getLogger(__name__)

MAX_IMAGE_AGE_MS = 500  # from which an image shows something else than the measured joints
DARK = 4.0  # mean of an image, of 255, below which it shows nothing
WRONG_SECONDS = 1.0  # for which an image must be wrong; a camera may lose a frame or adjust itself
SPEED_CHANGE = 0.05  # of the controller's speed scaling that is worth a word
MOVED = 0.05  # rad, of any joint, that cannot leave an image of the arm the same to the last bit


class UR5eRobotiq(Robot):
    """A UR5e that is commanded joint targets at a few hertz and moves smoothly between them.

    Whatever goes wrong (lost link, stale data, protective or emergency stop, stopped program, gripper fault, missing
    camera) stops the arm; `get_observation` and `send_action` then raise [`RobotFaultError`] until somebody has looked
    and connects again. While it is connected, SIGTERM and SIGHUP end the program in order: see [`ending_in_order`].
    """

    config_class = UR5eRobotiqConfig
    name = "ur5e_robotiq"

    def __init__(self, config: UR5eRobotiqConfig):
        super().__init__(config)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self._limits = Limits(config)
        self._servo: Servo | None = None
        self._gripper: RobotiqGripper | None = None
        self._pictures: dict[str, PictureCheck] = {}
        self._opened = contextlib.ExitStack()
        self._fault: RobotFaultError | None = None
        self._warned = False
        self._speed_scaling = 1.0

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """`<joint>.pos` and `gripper.pos`, and each camera's image shape."""
        size = self.config.image_size
        shapes = {name: (size or camera.height, size or camera.width, 3) for name, camera in self.cameras.items()}
        return {**self.action_features, **shapes}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """`<joint>.pos` in rad and `gripper.pos` from 0 to 1."""
        return dict.fromkeys(FEATURES, float)

    @property
    def is_connected(self) -> bool:
        """Whether it holds connections, those of a stopped arm included."""
        return self._servo is not None

    @property
    def is_calibrated(self) -> bool:
        """Always; the arm knows its joint angles."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do: rates and limits are sent with each command."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Connects cameras, gripper and arm, in this order, and holds the arm where it is.

        Raises a `RobotFaultError` if one of them is not ready; nothing stays connected.
        """
        self._fault, self._speed_scaling = None, 1.0
        self._pictures = {name: PictureCheck(name) for name in self.cameras}
        try:
            self._opened.enter_context(ending_in_order())
            import_client()
            check_ready(self.config)
            for name, camera in self.cameras.items():
                self._opened.callback(_close, camera)
                try:
                    camera.connect()
                except Exception as error:
                    raise RobotFaultError(Fault.CAMERA, f"camera '{name}' cannot be opened: {error}") from error
            if self.config.gripper_port:
                self._gripper = RobotiqGripper(self.config)
                self._opened.callback(self._gripper.disconnect)
                self._gripper.connect()
            self._servo = Servo(self.config)
            self._opened.callback(self._servo.stop)
            self._servo.start()
            self._tell_speed(self._servo.speed_scaling)
        except BaseException:
            self._release()
            raise
        logger.info("%s connected to %s.", self, self.config.ip)

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """Measured `<joint>.pos` in rad, `gripper.pos` from 0 to 1, and the latest images, (height, width, 3) uint8.

        Raises a `RobotFaultError` if the arm was stopped, now or before.
        """
        with self._stopping_on_fault() as servo:
            measured, _ = servo.read()
            self._tell_speed(servo.speed_scaling)
            closure = self._gripper.closure if self._gripper is not None else 0.0
            observation: dict[str, Any] = dict(zip(FEATURES, [*measured.tolist(), closure], strict=True))
            for name, camera in self.cameras.items():
                try:
                    image = camera.read_latest(max_age_ms=MAX_IMAGE_AGE_MS)
                except Exception as error:
                    raise RobotFaultError(Fault.CAMERA, f"camera '{name}' gives no image: {error}") from error
                self._pictures[name].check(image, measured, time.monotonic())
                observation[name] = fit_image(image, self.config.image_size)
        return observation

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Moves towards joint targets, within the limits; returns what was sent, which is what to record.

        Raises:
            ValueError: If the action has other keys or is not finite; nothing is sent and the arm holds its pose.
            RobotFaultError: If the arm was stopped, now or before.
        """
        with self._stopping_on_fault() as servo:
            asked, closure = self._limits.check(action)
            measured, commanded = servo.read()
            target = self._limits.limit(asked, commanded, measured)
            if not self._warned and (cut := np.abs(target - asked).max()) > self.config.command_limit:
                self._warned = True
                logger.warning("An action asked for joints %.2f rad beyond the limits; it and others are limited.", cut)
            servo.move_to(target)
            if self._gripper is not None:
                self._gripper.move_to(closure)
        return dict(zip(FEATURES, [*target.tolist(), closure], strict=True))

    @check_if_not_connected
    def disconnect(self) -> None:
        """Brings the arm to rest and lets go of everything; the gripper keeps what it holds."""
        self._release()
        logger.info("%s disconnected.", self)

    @contextlib.contextmanager
    def _stopping_on_fault(self) -> Iterator[Servo]:
        if self._fault is not None:
            raise self._fault
        assert self._servo is not None
        try:
            yield self._servo
        except RobotFaultError as fault:
            self._servo.stop()
            cause = self._servo.fault
            if cause is None or cause.fault is fault.fault:
                self._fault = fault
                raise
            # What stops the arm can take the gripper's power, too; the servo, which asks the controller, knows better.
            self._fault = cause
            raise cause from fault

    def _tell_speed(self, scaling: float) -> None:
        if abs(scaling - self._speed_scaling) < SPEED_CHANGE:
            return
        self._speed_scaling = scaling
        told = f"The controller scales the arm's speed to {100 * scaling:.0f} %"
        if scaling > 1 - SPEED_CHANGE:
            logger.info("%s again.", told)
        else:
            logger.warning("%s: it falls behind its targets. See the speed slider on the pendant.", told)

    def _release(self) -> None:
        self._servo = self._gripper = None
        self._opened.close()  # in reverse order: the arm is stopped first


def _close(camera: Camera) -> None:
    with contextlib.suppress(Exception):
        if camera.is_connected:
            camera.disconnect()


def fit_image(image: np.ndarray, size: int) -> np.ndarray:
    """The middle square of an image, (height, width, 3), resized to `size`; 0 leaves it as it is."""
    if not size:
        return image
    height, width = image.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = image[top : top + side, left : left + side]
    return cv2.resize(square, (size, size), interpolation=cv2.INTER_AREA)


class PictureCheck:
    """Notices images of a camera that arrive in time and still show nothing: black ones, and one that never changes."""

    def __init__(self, camera: str):
        self._camera = camera
        self._dark_since: float | None = None
        self._last: NDArray[np.uint8] | None = None
        self._last_since = 0.0
        self._last_joints: NDArray[np.float64] = np.zeros(6)

    def check(self, image: NDArray[np.uint8], joints: NDArray[np.float64], now: float) -> None:
        """Looks at an image, (height, width, 3), taken at measured joints in rad, (6,), at a time in s.

        Raises a `RobotFaultError` if images have been black, or the same although the arm moved, for a second.
        """
        if image.mean() >= DARK:
            self._dark_since = None
        elif self._dark_since is None:
            self._dark_since = now
        elif (seconds := now - self._dark_since) >= WRONG_SECONDS:
            raise RobotFaultError(Fault.CAMERA, f"camera '{self._camera}' has been black for {seconds:.1f} s")
        if self._last is None or not np.array_equal(image, self._last):
            self._last, self._last_since, self._last_joints = image.copy(), now, joints.copy()
        seconds, moved = now - self._last_since, np.abs(joints - self._last_joints).max()
        if seconds >= WRONG_SECONDS and moved >= MOVED:
            same = f"the same picture for {seconds:.1f} s, in which the arm moved by {moved:.2f} rad"
            raise RobotFaultError(Fault.CAMERA, f"camera '{self._camera}' has sent {same}")


@contextlib.contextmanager
def ending_in_order() -> Iterator[None]:
    """Lets a program that is told to end do so in order: as with Ctrl-C, what it has to close is closed.

    Python ends at once on SIGTERM and SIGHUP; here they raise `SystemExit`. The arm is stopped in any case, but
    `lerobot-record` would lose every episode of its session: LeRobot writes the ends of the files, without which they
    cannot be read, when the recording ends. A program that deals with a signal by itself, or ignores it as under
    `nohup`, goes on doing so. Only the main thread may do all this; in others nothing happens.
    """
    taken: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        for each in taken:
            # Asked for once more, the program would be torn from what it closes.
            signal.signal(each, signal.SIG_IGN)
        logger.warning("Ending, as asked for by %s: what is open is closed first.", signal.Signals(number).name)
        raise SystemExit(128 + number)

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):  # by `kill` or a closed terminal; not all systems have both
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) == signal.SIG_DFL:
                signal.signal(number, end)
                taken.append(number)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number in taken:
                # Somebody else may have taken the signal over meanwhile.
                if signal.getsignal(number) in (end, signal.SIG_IGN):
                    signal.signal(number, signal.SIG_DFL)
