"""Names and types of what RTDE carries, as far as this twin knows them (Universal Robots' RTDE guide)."""

import re

TYPES = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
"""RTDE's types as formats of Python's `struct`."""

NUM_REGISTERS = 48

_REGISTER = re.compile(r"(input|output)_(int|double)_register_(\d+)")

OUTPUTS = {
    "timestamp": "DOUBLE",
    "target_q": "VECTOR6D",
    "target_qd": "VECTOR6D",
    "target_qdd": "VECTOR6D",
    "target_current": "VECTOR6D",
    "target_moment": "VECTOR6D",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_current": "VECTOR6D",
    "joint_control_output": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "target_TCP_pose": "VECTOR6D",
    "target_TCP_speed": "VECTOR6D",
    "actual_digital_input_bits": "UINT64",
    "joint_temperatures": "VECTOR6D",
    "actual_execution_time": "DOUBLE",
    "robot_mode": "INT32",
    "joint_mode": "VECTOR6INT32",
    "safety_mode": "INT32",
    "safety_status": "INT32",
    "actual_tool_accelerometer": "VECTOR3D",
    "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE",
    "actual_momentum": "DOUBLE",
    "actual_main_voltage": "DOUBLE",
    "actual_robot_voltage": "DOUBLE",
    "actual_robot_current": "DOUBLE",
    "actual_joint_voltage": "VECTOR6D",
    "actual_digital_output_bits": "UINT64",
    "runtime_state": "UINT32",
    "standard_analog_input0": "DOUBLE",
    "standard_analog_input1": "DOUBLE",
    "standard_analog_output0": "DOUBLE",
    "standard_analog_output1": "DOUBLE",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "ft_raw_wrench": "VECTOR6D",
    "payload": "DOUBLE",
    "payload_cog": "VECTOR3D",
    "payload_inertia": "VECTOR6D",
    "output_bit_registers0_to_31": "UINT32",
    "output_bit_registers32_to_63": "UINT32",
}
"""What a client may ask for; those that `env_door.twin.measurements` does not know read 0."""

INPUTS = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_registers32_to_63": "UINT32",
}
"""What a client may write beside registers; taken, and without effect here."""


def output_type(name: str) -> str:
    """Type of a variable that a client asks for.

    Args:
        name (`str`):
            Its name.

    Returns:
        `str`: a key of `TYPES`, or `"NOT_FOUND"`.
    """
    return OUTPUTS.get(name) or _register_type(name)


def input_type(name: str) -> str:
    """Type of a variable that a client wants to write.

    Args:
        name (`str`):
            Its name.

    Returns:
        `str`: a key of `TYPES`, or `"NOT_FOUND"`.
    """
    known = INPUTS.get(name) or _register_type(name)
    return "NOT_FOUND" if name.startswith("output_") else known


def register(name: str) -> tuple[str, int] | None:
    """Which register a name means.

    Args:
        name (`str`):
            Name of an RTDE variable.

    Returns:
        `tuple[str, int] | None`: `"input_int"`, `"output_double"` or the like and the index; `None` for other names.
    """
    match = _REGISTER.fullmatch(name)
    if match is None or int(match[3]) >= NUM_REGISTERS:
        return None
    return f"{match[1]}_{match[2]}", int(match[3])


def _register_type(name: str) -> str:
    known = register(name)
    if known is None:
        return "NOT_FOUND"
    return "INT32" if known[0].endswith("int") else "DOUBLE"
