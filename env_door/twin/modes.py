"""What a controller can be in. The numbers are Universal Robots' own, as clients read them."""

from enum import IntEnum


class RobotMode(IntEnum):
    """What the arm is ready for."""

    BOOTING = 2
    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """Why the arm may not move."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


class ProgramState(IntEnum):
    """RTDE's `runtime_state`."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
"""RTDE's `safety_status_bits`."""
