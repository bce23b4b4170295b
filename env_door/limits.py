"""What the task fixes and what of it may be chosen, for environment, configurations and twin; imports no MuJoCo."""

from env_door.checks import check_choice, check_range
from env_door.scene import ARMS

FPS = 10  # control steps a second
EPISODE_STEPS = 300  # control steps after which a trial is cut
IMAGE_SIZE = 128  # height and width in pixels of the images that a policy sees
MAX_OFFSET = 0.05  # largest sideways shift of the door in m
MAX_HOLD = 60.0  # longest time in s for which somebody holds the door


def check_door(config: object) -> None:
    """Refuses (ParsingError) fields that say how a door is set up: arm, shift, start, limit of commands, hold."""
    check_choice(config, "arm", ARMS)
    check_range(config, "door_offset", low=0.0, high=MAX_OFFSET, unit="m")
    check_range(config, "start_variation", low=0.0, high=0.05, unit="m")
    check_range(config, "command_limit", low=0.01, high=1.0, unit="rad")
    check_range(config, "hold_seconds", low=0.0, high=MAX_HOLD, unit="s")
