"""What RTDE reports of the arm: the variables that have a counterpart in the scene. All others read 0."""

from collections.abc import Callable

import numpy as np

from env_door.twin.controller import Controller
from env_door.twin.modes import SAFETY_BITS, RobotMode
from env_door.twin.rtde_variables import OUTPUTS, TYPES, register

JOINT_MODES = {RobotMode.RUNNING: 253, RobotMode.IDLE: 255, RobotMode.BOOTING: 247, RobotMode.POWER_OFF: 239}

Reading = Callable[[], tuple[float, ...]]


def readings(controller: Controller, names: list[str]) -> list[Reading]:
    """Functions that read some variables, to be looked up once and called at every package.

    Args:
        controller (`Controller`):
            The controller.
        names (`list[str]`):
            Names of RTDE output variables or registers that exist.

    Returns:
        `list[Reading]`: one function for each name; it returns as many numbers as the variable's type has.
    """
    known = _known(controller)
    return [known[name] if name in known else _register_or_zero(controller, name) for name in names]


def _known(controller: Controller) -> dict[str, Reading]:
    door, motion = controller.door, controller.motion
    return {
        "timestamp": lambda: (controller.time,),
        "target_q": lambda: tuple(motion.position),
        "target_qd": lambda: tuple(motion.velocity),
        "target_moment": lambda: tuple(door.joint_torques),
        "actual_q": lambda: tuple(door.joints),
        "actual_qd": lambda: tuple(door.joint_speeds),
        "actual_TCP_pose": lambda: tuple(door.tool_pose(controller.tool_offset)),
        "robot_mode": lambda: (int(controller.robot_mode),),
        "joint_mode": lambda: (JOINT_MODES[controller.robot_mode],) * 6,
        "safety_mode": lambda: (int(controller.safety_mode),),
        "safety_status": lambda: (int(controller.safety_mode),),
        "speed_scaling": lambda: (float(controller.may_move),),
        "target_speed_fraction": lambda: (1.0,),
        "actual_main_voltage": lambda: (48.0,),
        "actual_robot_voltage": lambda: (48.0 if controller.robot_mode != RobotMode.POWER_OFF else 0.0,),
        "joint_temperatures": lambda: (30.0,) * 6,
        "runtime_state": lambda: (int(controller.program_state),),
        "robot_status_bits": lambda: (controller.robot_status_bits,),
        "safety_status_bits": lambda: (SAFETY_BITS[controller.safety_mode],),
    }


def _register_or_zero(controller: Controller, name: str) -> Reading:
    if register(name) is not None:
        return lambda: (controller.registers.read(name),)
    zeros = (0,) * int(TYPES[OUTPUTS[name]][:-1] or 1)
    return lambda: zeros


def joint_values(controller: Controller) -> dict[str, float]:
    """Measured joints by name.

    Args:
        controller (`Controller`):
            The controller.

    Returns:
        `dict[str, float]`: angles in rad and the gripper's closure, 0 open to 1 closed.
    """
    values = np.append(controller.door.joints, controller.door.closure)
    return dict(zip(controller.door.joint_names, values.tolist(), strict=True))
