"""Find out what of a LeRobotDataset is whole: after a kill, a loss of power, a full disk.

An episode is whole if its metadata, all of its rows and all frames of its videos can be read. What counts are the whole
episodes from the first on, as LeRobot numbers episodes without gaps.
"""

import io
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.io_utils import load_info, load_stats, load_tasks
from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH, STATS_PATH, DatasetInfo
from PIL import Image

UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, pa.ArrowException, av.FFmpegError)
# Columns that tell to which episode and place a row belongs.
PLACE = ("index", "episode_index", "frame_index", "task_index")


@dataclass
class Inspection:
    """What is whole of a dataset."""

    info: DatasetInfo
    tasks: pd.DataFrame = field(
        default_factory=lambda: pd.DataFrame({"task_index": []}, index=pd.Index([], name="task"), dtype="int64")
    )
    """Number of each task by its words, as LeRobot keeps them."""
    episodes: list[dict[str, Any]] = field(default_factory=list)
    """Metadata of the whole episodes, from the first on."""
    num_claimed: int = 0
    """Episodes that the dataset says to have."""
    faults: list[str] = field(default_factory=list)
    """What is wrong, in words; nothing if all of the dataset is whole."""
    spoilt: set[Path] = field(default_factory=set)
    """Files, relative to the dataset, that hold whole episodes and something else, too."""
    useless: set[Path] = field(default_factory=set)
    """Files and folders, relative to the dataset, that hold nothing of a whole episode."""

    @property
    def num_frames(self) -> int:
        """Frames of the whole episodes."""
        return sum(row["length"] for row in self.episodes)

    @property
    def video_keys(self) -> list[str]:
        """Features that are kept as videos."""
        return [name for name, feature in self.info.features.items() if feature["dtype"] == "video"]

    def data_file(self, row: dict[str, Any]) -> Path:
        """File, relative to the dataset, with the rows of an episode."""
        return Path(self.info.data_path.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]))

    def video_file(self, row: dict[str, Any], key: str) -> Path:
        """File, relative to the dataset, with the frames of an episode."""
        place = {name: row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
        return Path(str(self.info.video_path).format(video_key=key, **place))


def inspect(root: Path, decode: bool = True) -> Inspection:
    """Find the whole episodes of a dataset, and all that is wrong with it.

    With `decode`, every value and every frame is read. Without, it is quick, and finds what a stopped program leaves:
    files that are missing, cut short, or of no episode. A file whose content was altered unnoticed is not found.

    Raises:
        ValueError: If the folder holds no LeRobotDataset that is known, or its `info.json` is lost.
    """
    return _Inspector(root, decode).run()


def statistics(episodes: list[dict[str, Any]], info: DatasetInfo) -> dict[str, dict[str, np.ndarray]] | None:
    """Statistics over episodes from those in their metadata; `None` if these are not there."""
    per_episode = []
    for row in episodes:
        stats: dict[str, dict[str, np.ndarray]] = {}
        for name, value in row.items():
            if name.startswith("stats/") and value is not None:
                feature, _, kind = name.removeprefix("stats/").rpartition("/")
                array = np.asarray(value)
                if info.features.get(feature, {}).get("dtype") in ("image", "video") and kind != "count":
                    array = array.reshape(-1, 1, 1)
                stats.setdefault(feature, {})[kind] = array
        if not stats:
            return None
        per_episode.append(stats)
    return aggregate_stats(per_episode) if per_episode else None


class _Inspector:
    def __init__(self, root: Path, decode: bool):
        self.root, self.decode = root, decode
        self.found = Inspection(_read_info(root))
        self.lost_tasks = False
        self.rows_of: dict[Path, tuple[pd.DataFrame, str]] = {}  # of data files, as far as they can be read
        self.frames_of: dict[Path, tuple[np.ndarray, str]] = {}  # of videos, as far as they can be decoded
        self.used: dict[Path, int] = {}  # rows of whole episodes in each file; of videos, frames

    def run(self) -> Inspection:
        found = self.found
        self._read_tasks()
        metadata = list(self._read_metadata())
        found.num_claimed = max(found.info.total_episodes, len(metadata))
        for number, (file, row) in enumerate(metadata):
            if fault := self._fault_of(number, row):
                found.faults.append(f"episode {number}: {fault}")
                break
            found.episodes.append(row)
            self._use(file, row)
        else:
            if len(metadata) < found.num_claimed:
                found.faults.append(f"episode {len(metadata)}: its metadata is missing")
        self._compare_summaries()
        self._compare_files([file for file, _ in metadata])
        return found

    def _read_tasks(self) -> None:
        try:
            self.found.tasks = load_tasks(self.root)
        except UNREADABLE as error:
            self.lost_tasks = True
            self.found.faults.append(f"{DEFAULT_TASKS_PATH} cannot be read ({_brief(error)})")

    def _read_metadata(self) -> Iterator[tuple[Path, dict[str, Any]]]:
        for path in sorted((self.root / EPISODES_DIR).glob("*/*.parquet")):
            file = path.relative_to(self.root)
            try:
                rows = pq.read_table(path, partitioning=None).to_pylist()
            except UNREADABLE as error:
                self.found.faults.append(f"{file} cannot be read ({_brief(error)})")
                continue
            yield from ((file, row) for row in rows)

    def _fault_of(self, number: int, row: dict[str, Any]) -> str:
        """Why an episode is not whole; nothing if it is."""
        try:
            if row["episode_index"] != number:
                return f"its metadata is missing; that of episode {row['episode_index']} follows"
            start, length = self.found.num_frames, row["length"]
            if (row["dataset_from_index"], row["dataset_to_index"]) != (start, start + length) or length < 1:
                return "its metadata does not follow on the episode before it"
            return self._fault_of_rows(row) or self._fault_of_videos(row)
        except (LookupError, TypeError) as error:
            return f"its metadata is incomplete ({_brief(error)})"

    def _fault_of_rows(self, row: dict[str, Any]) -> str:
        file, length = self.found.data_file(row), row["length"]
        rows, trouble = self._rows(file)
        mine = rows[rows["episode_index"] == row["episode_index"]]
        wanted = {
            "index": np.arange(row["dataset_from_index"], row["dataset_to_index"]),
            "frame_index": np.arange(length),
        }
        if any(not np.array_equal(mine[name], values) for name, values in wanted.items()):
            return f"{file} has {len(mine)} of its {length} rows{trouble}"
        return self._fault_of_tasks(row, sorted(set(mine["task_index"])))

    def _fault_of_tasks(self, row: dict[str, Any], numbers: list[int]) -> str:
        tasks = self.found.tasks
        if self.lost_tasks and len(numbers) == len(row["tasks"]) == 1 and numbers[0] == len(tasks):
            tasks.loc[row["tasks"][0]] = numbers[0]
        return "" if set(numbers) <= set(tasks["task_index"]) else f"{DEFAULT_TASKS_PATH} does not have its task"

    def _fault_of_videos(self, row: dict[str, Any]) -> str:
        step = 1 / self.found.info.fps
        for key in self.found.video_keys:
            file = self.found.video_file(row, key)
            start = row[f"videos/{key}/from_timestamp"]
            times, trouble = self._frames(file)
            mine = times[(times > start - step / 2) & (times < start + (row["length"] - 0.5) * step)]
            wanted = start + np.arange(row["length"]) * step
            if len(mine) != len(wanted) or np.abs(mine - wanted).max() > step / 2:
                return f"{file} has {len(mine)} of its {row['length']} frames{trouble}"
        return ""

    def _use(self, file: Path, row: dict[str, Any]) -> None:
        self.used[file] = self.used.get(file, 0) + 1
        for part in (self.found.data_file(row), *(self.found.video_file(row, key) for key in self.found.video_keys)):
            self.used[part] = self.used.get(part, 0) + row["length"]

    def _compare_summaries(self) -> None:
        found, info = self.found, self.found.info
        if (info.total_episodes, info.total_frames) != (len(found.episodes), found.num_frames):
            found.faults.append(
                f"{INFO_PATH} counts {info.total_episodes} episodes and {info.total_frames} frames; whole are "
                f"{len(found.episodes)} and {found.num_frames}"
            )
        elif any(int(split.split(":")[-1] or 0) > len(found.episodes) for split in info.splits.values()):
            found.faults.append(f"{INFO_PATH} has splits {info.splits}, with {len(found.episodes)} episodes")
        elif info.total_tasks != len(found.tasks):
            found.faults.append(f"{INFO_PATH} counts {info.total_tasks} tasks instead of {len(found.tasks)}")
        try:
            stats = load_stats(self.root)
        except UNREADABLE as error:
            found.faults.append(f"{STATS_PATH} cannot be read ({_brief(error)})")
            return
        if stats is None and statistics(found.episodes[:1], info) is not None:
            found.faults.append(f"{STATS_PATH} is missing")
        elif stats and "index" in stats and int(stats["index"]["count"][0]) != found.num_frames:
            found.faults.append(f"{STATS_PATH} is not of these episodes")

    def _compare_files(self, metadata: list[Path]) -> None:
        found = self.found
        held = {file: len(rows) for file, (rows, _) in self.rows_of.items()}
        held |= {file: metadata.count(file) for file in metadata}
        for path in sorted(files_of_episodes(self.root)):
            file = path.relative_to(self.root)
            if file not in self.used:
                found.useless.add(file)
                found.faults.append(f"{file} holds nothing of a whole episode")
                continue
            trouble = {**self.rows_of, **self.frames_of}.get(file, (None, ""))[1]
            if trouble or held.get(file, self.used[file]) != self.used[file]:
                found.spoilt.add(file)
                found.faults.append(f"{file} holds more than the whole episodes{trouble}")
        for folder in sorted(path for path in self.root.iterdir() if path.is_dir() and not path.is_symlink()):
            files = [path.suffix for path in folder.rglob("*") if path.is_file()]
            streamed = folder.name.startswith("tmp") and set(files) <= {".mp4"}
            if streamed or (folder.name == "images" and files):
                found.useless.add(folder.relative_to(self.root))
                found.faults.append(f"{folder.name}/ was left by an episode that was not saved")

    def _rows(self, file: Path) -> tuple[pd.DataFrame, str]:
        """Places of the rows of a data file, and why there are no more if that is so."""
        if file not in self.rows_of:
            parts, trouble = [pd.DataFrame({name: [] for name in PLACE}, dtype="int64")], ""
            try:
                images = [name for name, feature in self.found.info.features.items() if feature["dtype"] == "image"]
                for table in row_groups(self.root / file, None if self.decode else list(PLACE)):
                    for name in images if self.decode else ():
                        for image in table.column(name).to_pylist():
                            Image.open(io.BytesIO(image["bytes"])).verify()
                    parts.append(table.select(PLACE).to_pandas())
            except (*UNREADABLE, SyntaxError) as error:  # PIL calls a broken PNG a SyntaxError
                trouble = f" ({_brief(error)})"
            self.rows_of[file] = pd.concat(parts, ignore_index=True), trouble
        return self.rows_of[file]

    def _frames(self, file: Path) -> tuple[np.ndarray, str]:
        """Times of the frames of a video in s, and why there are no more if that is so."""
        if file not in self.frames_of:
            read = decoded_times if self.decode else _claimed_times
            self.frames_of[file] = read(self.root / file)
        return self.frames_of[file]


def row_groups(path: Path, columns: list[str] | None = None) -> Iterator[pa.Table]:
    """Rows of a parquet file, part by part; raises where it cannot be read."""
    with pq.ParquetFile(path) as file:
        for group in range(file.num_row_groups):
            yield file.read_row_group(group, columns=columns)


def decoded_times(path: Path) -> tuple[np.ndarray, str]:
    """Times in s of the frames of a video up to the first that cannot be decoded, and why there are no more."""
    times: list[float] = []
    trouble = ""
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            unit = float(stream.time_base or 1)
            try:
                for packet in container.demux(stream):
                    if packet.is_corrupt:
                        raise EOFError("it is cut short")
                    times += [float(frame.pts or 0) * unit for frame in stream.decode(packet)]
            except (*UNREADABLE, EOFError) as error:
                trouble = f" ({_brief(error)})"
                times += [float(frame.pts or 0) * unit for frame in stream.decode(None)]
    except (*UNREADABLE, EOFError) as error:
        trouble = trouble or f" ({_brief(error)})"
    return np.sort(times), trouble


def _claimed_times(path: Path) -> tuple[np.ndarray, str]:
    """As `decoded_times`, from what the head of the file says if its end is there."""
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            container.seek(stream.duration or 0, stream=stream)
            whole = not any(packet.is_corrupt for packet in container.demux(stream))
            times = np.arange(stream.frames) / float(stream.average_rate or 1)
    except UNREADABLE:
        whole = False
    return (times, "") if whole else decoded_times(path)


def files_of_episodes(root: Path) -> Iterator[Path]:
    """All files of a dataset that hold data, frames or metadata of episodes."""
    yield from (root / EPISODES_DIR).glob("*/*.parquet")
    yield from (root / "data").glob("*/*.parquet")
    yield from (root / "videos").glob("*/*/*.mp4")


def _read_info(root: Path) -> DatasetInfo:
    if not (root / INFO_PATH).is_file():
        raise ValueError(f"{root} is no LeRobotDataset: {INFO_PATH} is missing.")
    try:
        info = load_info(root)
    except UNREADABLE as error:
        raise ValueError(
            f"{root / INFO_PATH} cannot be read ({_brief(error)}), and without it nobody knows what the columns are. "
            "Put the one of a dataset there that was recorded with the same command."
        ) from error
    if not info.codebase_version.startswith("v3."):
        raise ValueError(f"{root} is a LeRobotDataset {info.codebase_version}; only v3 is known here.")
    return info


def _brief(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0] if len(lines[0]) < 100 else f"{lines[0][:100]}..."
