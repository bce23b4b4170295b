"""The door scene in MuJoCo's XML, and what the rest of the package needs to know about its arms."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

GRIPPER_STROKE = 0.085
"""Opening of the gripper between its pads, in metres (Robotiq 2F-85)."""


@dataclass(frozen=True)
class Arm:
    """What differs between the arms beyond their XML."""

    name: str  # also that of the XML file
    joints: tuple[str, ...]  # from base to wrist
    joint_speed: tuple[float, ...]  # largest that the maker states, in rad/s
    ready_pose: tuple[float, ...]
    """Joint angles in rad with the open gripper in front of the knob; inverse kinematics starts here, which keeps every
    plan on the same branch (elbow up)."""


UR5E = Arm(
    name="ur5e",
    joints=("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"),
    joint_speed=(3.1416,) * 6,
    ready_pose=(2.80, -1.60, 1.57, 0.03, 1.23, 1.57),
)
PANDA = Arm(
    name="panda",
    joints=tuple(f"joint_{i}" for i in range(1, 8)),
    joint_speed=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    ready_pose=(0.214, -0.876, -0.068, -2.192, -0.616, 2.845, 0.542),
)
ARMS = {arm.name: arm for arm in (UR5E, PANDA)}


def load_model(arm: str) -> "mujoco.MjModel":
    """Compiles the scene with one of the `ARMS`."""
    from env_door.simulator import mujoco  # here, so that configurations can look up the arms without it

    return mujoco.MjModel.from_xml_path(str(Path(__file__).with_name(f"{arm}.xml")))
