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
    SAFEGUARD_STOP = 14, "clear the cell and close its safeguard (a gate, a light curtain), then connect again"
    RECOVERY_MODE = 15, "jog the arm back within its safety limits on the pendant, then connect again"
    SAFETY_VIOLATION = 16, "see the log on the pendant, restart the safety system there, then connect again"
    LOCAL_CONTROL = 17, "switch the pendant to remote control, then connect again"
    PROGRAM_RUNNING = 18, "end it on the pendant, or let it be ended by --robot.stop_running_program=true"
    REGISTERS_IN_USE = (
        19,
        "end what else commands the arm, disable EtherNet/IP, PROFINET and MODBUS, then connect again",
    )
    GRIPPER_NOT_ACTIVE = 20, "clear the gripper, then connect again: it is activated, and opens and closes once"
    CONTROLLER_VERSION = 21, "update the controller, or use another one"

    remedy: str

    def __new__(cls, number: int, remedy: str = "") -> "Fault":
        """Numbers cross from the servo process to its owner; remedies do not."""
        member = int.__new__(cls, number)
        member._value_, member.remedy = number, remedy
        return member


# The controller's safety modes, as RTDE numbers them and as the dashboard names them.
SAFETY_MODES = {
    1: "NORMAL",
    2: "REDUCED",
    3: "PROTECTIVE_STOP",
    4: "RECOVERY",
    5: "SAFEGUARD_STOP",
    6: "SYSTEM_EMERGENCY_STOP",
    7: "ROBOT_EMERGENCY_STOP",
    8: "VIOLATION",
    9: "FAULT",
}
MAY_MOVE = ("NORMAL", "REDUCED")
_STOPS = {
    "PROTECTIVE_STOP": Fault.PROTECTIVE_STOP,
    "RECOVERY": Fault.RECOVERY_MODE,
    "SAFEGUARD_STOP": Fault.SAFEGUARD_STOP,
    "AUTOMATIC_MODE_SAFEGUARD_STOP": Fault.SAFEGUARD_STOP,
    "SYSTEM_THREE_POSITION_ENABLING_STOP": Fault.SAFEGUARD_STOP,
    "SYSTEM_EMERGENCY_STOP": Fault.EMERGENCY_STOP,
    "ROBOT_EMERGENCY_STOP": Fault.EMERGENCY_STOP,
}
REFUSALS = (Fault.LOCAL_CONTROL, Fault.PROGRAM_RUNNING, Fault.REGISTERS_IN_USE, Fault.CONTROLLER_VERSION)
"""What is found before the arm is commanded at all."""


class RobotFaultError(DeviceNotConnectedError):
    """The arm was stopped, for the reason `fault`, and stays so until somebody has looked and connects again."""

    def __init__(self, fault: Fault, detail: str):
        self.fault, self.detail = fault, detail
        outcome = "is not commanded" if fault in REFUSALS else "was stopped"
        super().__init__(f"The arm {outcome} ({fault.name.lower()}): {detail}. To go on: {fault.remedy}.")


def safety_fault(mode: str) -> RobotFaultError | None:
    """What keeps an arm from moving in a safety mode of the controller, by its name; nothing in some."""
    if mode in MAY_MOVE:
        return None
    return RobotFaultError(_STOPS.get(mode, Fault.SAFETY_VIOLATION), f"the safety status is '{mode}'")
