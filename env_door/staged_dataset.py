"""A LeRobotDataset whose folder holds whole episodes at any moment, whatever stops the recording.

LeRobot writes an episode file by file, closes its parquet files when the recording ends, and rewrites earlier files on
the way. Here all of that happens in a copy beside the folder, and each saved episode enters the folder in one atomic
step (see [`~env_door.staging`]).
"""

import contextlib
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HOME

from env_door.inspection import inspect
from env_door.staging import StagedDirectory, is_empty

logger = logging.getLogger(__name__)


class _OneFilePerEpisode(LeRobotDatasetMetadata):
    """Begins new files with each episode: parquet files cannot be continued once closed, and earlier files stay."""

    data_files_size_in_mb = 0
    video_files_size_in_mb = 0


class StagedDataset(LeRobotDataset):
    """LeRobot's dataset for recording; an episode is safe as soon as `save_episode` has returned."""

    _directory: StagedDirectory
    _opened: contextlib.ExitStack
    _saved: int  # episodes in the folder

    @classmethod
    def create(cls, repo_id: str, *args: Any, root: str | Path | None = None, **options: Any) -> "StagedDataset":
        """As LeRobot's; `root` appears with the first saved episode.

        Raises:
            FileExistsError: If the folder holds something.
            OSError: If the place is not writable, or another process records into it.
        """
        return cls._open(super().create, _refuse_to_overwrite, root, repo_id, *args, **options)

    @classmethod
    def resume(cls, repo_id: str, *args: Any, root: str | Path | None = None, **options: Any) -> "StagedDataset":
        """As LeRobot's, for a dataset that is there and whole.

        Raises:
            FileNotFoundError: If there is nothing to go on with.
            ValueError: If the folder is no LeRobotDataset, or a damaged one.
            OSError: If the place is not writable, or another process records into it.
        """
        return cls._open(super().resume, _refuse_unless_whole, root, repo_id, *args, **options)

    @classmethod
    def _open(
        cls,
        make: Callable[..., Any],
        check: Callable[[Path], None],
        root: str | Path | None,
        repo_id: str,
        *args: Any,
        batch_encoding_size: int = 1,
        **options: Any,
    ) -> "StagedDataset":
        if batch_encoding_size > 1:
            logger.warning("Videos are encoded episode by episode: an episode is safe when its videos are.")
        path = Path(root or HF_LEROBOT_HOME / repo_id).expanduser().resolve()
        with contextlib.ExitStack() as stack:
            directory = stack.enter_context(StagedDirectory(path))
            check(path)
            dataset = make(repo_id, *args, root=directory.stage(), **options)
            dataset.meta.__class__ = _OneFilePerEpisode
            dataset._directory, dataset._saved = directory, dataset.num_episodes
            dataset._opened = stack.pop_all()
        return dataset

    def save_episode(self, episode_data: dict | None = None, parallel_encoding: bool = True) -> None:
        """As LeRobot's; when it returns, the episode is in the dataset's folder and on the disk.

        Raises:
            RuntimeError: If an encoder lost frames; the episode is not kept.
        """
        super().save_episode(episode_data, parallel_encoding)
        self.writer.close_writer()
        self.meta._close_writer()
        self._refuse_lost_frames()
        shutil.rmtree(self.root / "images", ignore_errors=True)  # what is left of frames that are in the files now
        self._directory.commit()
        self._saved = self.num_episodes
        self._directory.stage()

    def finalize(self) -> None:
        """Close the dataset; what was not saved is thrown away."""
        if self._is_finalized:
            return
        try:
            super().finalize()
        finally:
            # LeRobot closes its files once more when it is garbage-collected, and makes their folder anew for that.
            self.writer._finalized = self.meta._finalized = True
            self.root = self.meta.root = self.writer._root = self._directory.root
            self.meta.info.total_episodes = self._saved
            self._opened.close()

    def _refuse_lost_frames(self) -> None:
        episode = self.meta.latest_episode
        for key in self.meta.video_keys:
            file = {name: episode[f"videos/{key}/{name}"][0] for name in ("chunk_index", "file_index")}
            with av.open(str(self.root / self.meta.video_path.format(video_key=key, **file))) as video:
                found = video.streams.video[0].frames
            if found != (wanted := episode["length"][0]):
                raise RuntimeError(
                    f"The encoder of {key} wrote {found} of {wanted} frames; the episode was thrown away. A larger "
                    "--dataset.encoder_queue_maxsize, or --dataset.streaming_encoding=false, loses none."
                )


def _refuse_to_overwrite(path: Path) -> None:
    if not is_empty(path):
        raise FileExistsError(f"{path} is not empty. Use --resume=true to record more into it, or another root.")


def _refuse_unless_whole(path: Path) -> None:
    if is_empty(path):
        raise FileNotFoundError(f"{path} holds nothing to go on with. Leave out --resume, or name another root.")
    if faults := inspect(path, decode=False).faults:
        raise ValueError(
            f"{path} is damaged ({faults[0]}). `ufrnn repair --root={path} --dry_run=true` says what can be kept, and "
            "without --dry_run keeps it."
        )
