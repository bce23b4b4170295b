"""What can go wrong with the arm while it is in use; none of it is recovered from by itself."""

from enum import IntEnum

from lerobot.utils.errors import DeviceNotConnectedError


class Fault(IntEnum):
    """Why the arm was stopped, and what the operator is to do."""

    NONE = 0
    LINK_LOST = 1, "check the cable and the network, then connect again"
    STALE_DATA = 2, "the controller or the network hangs; check both, then connect again"
    PROTECTIVE_STOP = 3, "see why on the pendant, clear the cell, unlock the stop there, then connect again"
    EMERGENCY_STOP = 4, "make the cell safe, release the button, switch the arm on again, then connect again"
    NOT_RUNNING = 5, "switch the arm on and release its brakes on the pendant, then connect again"
    PROGRAM_STOPPED = 6, "the program was stopped on the pendant, or failed there; look at its log, then connect again"
    COMMAND_REFUSED = 7, "look at the log on the pendant, then connect again"
    OWNER_GONE = 8, "the program that commanded the arm ended; start it again"
    SERVO_LATE = 9, "this computer could not keep up with the servo rate; close other programs, then connect again"
    SERVO_DIED = 10, "the servo process ended unexpectedly; look at its output above, then connect again"
    GRIPPER_SILENT = 11, "check the gripper's cable and its URCap, then connect again"
    GRIPPER_FAULT = 12, "clear the gripper's fault on the pendant (its light tells which), then connect again"
    CAMERA = 13, "look at what the camera shows and at its cable, then connect again"

    remedy: str

    def __new__(cls, number: int, remedy: str = "") -> "Fault":
        """Numbers cross from the servo process to its owner; remedies do not."""
        member = int.__new__(cls, number)
        member._value_, member.remedy = number, remedy
        return member


class RobotFaultError(DeviceNotConnectedError):
    """The arm was stopped, for the reason `fault`, and stays so until somebody has looked and connects again."""

    def __init__(self, fault: Fault, detail: str):
        self.fault, self.detail = fault, detail
        super().__init__(f"The arm was stopped ({fault.name.lower()}): {detail}. To go on: {fault.remedy}.")
