"""LeRobot's discovery hook: importing this module registers our policy, environment, robot and teleoperators."""

import logging

from env_door.configuration_door import DoorEnvConfig
from lerobot_ufrnn.configuration_ufrnn import UFRNNConfig
from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.teleoperators import KeyboardTwistConfig, SpaceMouseTwistConfig

__all__ = ["DoorEnvConfig", "KeyboardTwistConfig", "SpaceMouseTwistConfig", "UFRNNConfig", "UR5eRobotiqConfig"]


def _keep_last_line(record: logging.LogRecord) -> bool:
    if "torchcodec" in str(record.msg):
        record.msg = str(record.msg).strip().splitlines()[-1].replace(" (see the error above)", "")
    return True


# Where FFmpeg's libraries are missing, LeRobot falls back to PyAV, which this project uses anyway, but first prints
# sixty lines of torchcodec's attempts; the last one says it all.
logging.getLogger("lerobot.utils.import_utils").addFilter(_keep_last_line)
