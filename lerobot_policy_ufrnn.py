"""LeRobot's discovery hook: importing this module registers our policy, environments, robot and teleoperators.

It imports configurations only; policy and processors, and with them PyTorch networks, come when they are asked for.
"""

from typing import TYPE_CHECKING, Any

from env_door.configuration_door import DoorEnvConfig
from env_forks.configuration_forks import ForksEnvConfig
from lerobot_ufrnn.configuration_ufrnn import UFRNNConfig
from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.teleoperators import KeyboardTwistConfig, SpaceMouseTwistConfig

if TYPE_CHECKING:
    from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy
    from lerobot_ufrnn.processor_ufrnn import make_ufrnn_pre_post_processors

__all__ = [
    "DoorEnvConfig",
    "ForksEnvConfig",
    "KeyboardTwistConfig",
    "SpaceMouseTwistConfig",
    "UFRNNConfig",
    "UFRNNPolicy",
    "UR5eRobotiqConfig",
    "make_ufrnn_pre_post_processors",
]


def __getattr__(name: str) -> Any:
    if name == "UFRNNPolicy":
        from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy

        return UFRNNPolicy
    if name == "make_ufrnn_pre_post_processors":
        from lerobot_ufrnn.processor_ufrnn import make_ufrnn_pre_post_processors

        return make_ufrnn_pre_post_processors
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
