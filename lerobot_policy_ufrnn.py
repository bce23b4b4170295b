"""LeRobot's discovery hook: importing this module registers the policy type `ufrnn` and the environment type `door`."""

from env_door.configuration_door import DoorEnvConfig
from lerobot_ufrnn.configuration_ufrnn import UFRNNConfig

__all__ = ["DoorEnvConfig", "UFRNNConfig"]
