"""What can be read of a recording."""

from pathlib import Path

import pyarrow.parquet
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def readable_episodes(root: Path) -> tuple[int, ...]:
    """Reads every frame of a recording, images included.

    Args:
        root (`Path`):
            Folder of a LeRobotDataset.

    Returns:
        `tuple[int, ...]`: frames of each episode; 0 for one of which a frame is missing or cannot be read. Empty if
            the recording cannot be opened.
    """
    try:
        # Where files are missing LeRobot would look for them on the Hub.
        for folder in ("meta/episodes", "data"):
            files = sorted((root / folder).rglob("*.parquet"))
            if not files:
                return ()
            for file in files:
                pyarrow.parquet.read_metadata(file)
        dataset = LeRobotDataset("me/recording", root=root, video_backend="pyav")
    except Exception:
        return ()
    return tuple(_readable_frames(dataset, number) for number in range(dataset.num_episodes))


def _readable_frames(dataset: LeRobotDataset, number: int) -> int:
    episode = dataset.meta.episodes[number]
    first, end = episode["dataset_from_index"], episode["dataset_to_index"]
    try:
        for index in range(first, end):
            frame = dataset[index]
            if (frame["episode_index"].item(), frame["frame_index"].item()) != (number, index - first):
                return 0
    except Exception:
        return 0
    return end - first
