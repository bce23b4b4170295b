"""`ufrnn lerobot-record`: LeRobot's own command, but each saved episode is safe whatever stops it."""

import sys

from lerobot.scripts import lerobot_record

from env_door.staged_dataset import StagedDataset


def run(arguments: list[str]) -> None:
    """Records with the flags of `lerobot-record`."""
    own_dataset, own_words = lerobot_record.LeRobotDataset, sys.argv
    try:
        lerobot_record.LeRobotDataset = StagedDataset
        sys.argv = ["ufrnn lerobot-record", *arguments]  # where LeRobot reads its flags
        lerobot_record.main()
    finally:
        lerobot_record.LeRobotDataset, sys.argv = own_dataset, own_words
