"""LeRobot's discovery hook: importing this module registers the policy type `ufrnn` and the environment type `door`."""

import lerobot_ufrnn.configuration_ufrnn  # noqa: F401
