"""A twin of the robot: the door scene behind the protocols of a UR5e, a Robotiq gripper and a camera.

`python -m env_door.twin` runs one; `TwinProcess` runs one for a test. A client cannot tell it from a robot by its
protocols: `ur_rtde`'s interfaces, sockets of the gripper's URCap and LeRobot's `zmq` camera connect to it.

Reading order: `server` and `ports` (the clock, and who is served) -> `rtde`, `script`, `gripper`, `camera` (protocols)
-> `controller`, `arm` (what they act on) -> `injections` (what can be made to fail).
"""

from env_door.twin.client import TwinClient, TwinError, TwinProcess, free_address

__all__ = ["TwinClient", "TwinError", "TwinProcess", "free_address"]
