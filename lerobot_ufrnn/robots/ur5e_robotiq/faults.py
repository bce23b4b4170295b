"""What can go wrong with the arm while it is in use; none of it is recovered from by itself."""

from enum import IntEnum

from lerobot.utils.errors import DeviceNotConnectedError


class Fault(IntEnum):
    """Why the arm was stopped."""

    NONE = 0
    LINK_LOST = 1
    STALE_DATA = 2
    PROTECTIVE_STOP = 3
    EMERGENCY_STOP = 4
    NOT_RUNNING = 5
    PROGRAM_STOPPED = 6
    COMMAND_REFUSED = 7
    OWNER_GONE = 8
    SERVO_LATE = 9
    SERVO_DIED = 10
    GRIPPER_SILENT = 11
    GRIPPER_FAULT = 12
    CAMERA = 13


REMEDIES = {
    Fault.LINK_LOST: "check the cable and the network, then connect again",
    Fault.STALE_DATA: "the controller or the network hangs; check both, then connect again",
    Fault.PROTECTIVE_STOP: "see why on the pendant, clear the cell, unlock the stop there, then connect again",
    Fault.EMERGENCY_STOP: "make the cell safe, release the button, switch the arm on again, then connect again",
    Fault.NOT_RUNNING: "switch the arm on and release its brakes on the pendant, then connect again",
    Fault.PROGRAM_STOPPED: "somebody stopped the program on the pendant, or it failed there; look at its log, then "
    "connect again",
    Fault.COMMAND_REFUSED: "look at the log on the pendant, then connect again",
    Fault.OWNER_GONE: "the program that commanded the arm ended; start it again",
    Fault.SERVO_LATE: "this computer could not keep up with the servo rate; close other programs, then connect again",
    Fault.SERVO_DIED: "the servo process ended unexpectedly; look at its output above, then connect again",
    Fault.GRIPPER_SILENT: "check the gripper's cable and its URCap, then connect again",
    Fault.GRIPPER_FAULT: "clear the gripper's fault on the pendant (its light tells which), then connect again",
    Fault.CAMERA: "look at what the camera shows and at its cable, then connect again",
}
"""What the operator is to do."""


class RobotFaultError(DeviceNotConnectedError):
    """The arm was stopped, and stays so until somebody has looked and connects again.

    Args:
        fault (`Fault`):
            Why.
        detail (`str`):
            What was seen.
    """

    def __init__(self, fault: Fault, detail: str):
        self.fault = fault
        super().__init__(f"The arm was stopped ({fault.name.lower()}): {detail}. To go on: {REMEDIES[fault]}.")
