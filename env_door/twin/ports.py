"""The ports of a robot with a Robotiq gripper, and those that only the twin has."""

RTDE = 30004
SCRIPT = (30001, 30002, 30003)
DASHBOARD = 29999
GRIPPER = 63352
CAMERA = 5555
CONTROL = 5556
"""Twin control: what no real robot offers (faults, new trials, the door's state)."""
