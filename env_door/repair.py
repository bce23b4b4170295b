"""Drop from a damaged LeRobotDataset what is not whole."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import av
import pyarrow.compute as pc
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import write_info, write_stats, write_tasks
from lerobot.datasets.utils import STATS_PATH

from env_door.inspection import UNREADABLE, Inspection, inspect, row_groups, statistics
from env_door.provenance import PROVENANCE_PATH
from env_door.staging import StagedDirectory


def repair(root: Path) -> Inspection:
    """Keep the whole episodes of a dataset, in one atomic step; returns what was found before.

    A dataset that is whole is left untouched, and one that an error is raised for is left as it was.

    Raises:
        ValueError: If the folder is no LeRobotDataset, or not one whole episode is in it.
        OSError: If the place is not writable, or another process records into it.
        RuntimeError: If the outcome would not be whole.
    """
    found = inspect(root)  # before anything is written beside a folder that is something else
    if not found.faults:
        return found
    with StagedDirectory(root) as directory:
        found = inspect(root)
        if not found.episodes:
            raise ValueError(f"Not one whole episode is in {root} ({found.faults[0]}); nothing was changed.")
        with directory.change() as staged:
            _keep(staged, found)
            outcome = inspect(staged)
            if outcome.faults or outcome.num_frames != found.num_frames:
                raise RuntimeError(f"Repairing {root} failed ({', '.join(outcome.faults)}); nothing was changed.")
    return found


def _keep(root: Path, found: Inspection) -> None:
    """Reduce a staged copy to what is whole. Its files are replaced, never changed in place."""
    for name in found.useless:
        if (path := root / name).is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
            _remove_empty(path.parent, root)
    for name in found.spoilt:
        part = (path := root / name).with_suffix(f".part{path.suffix}")
        if path.suffix == ".mp4":
            _keep_frames(path, part, max(_ends(name, found)))
        else:
            _keep_rows(path, part, len(found.episodes))
        os.replace(part, path)
    info = found.info
    if info.total_episodes != len(found.episodes):
        info.splits = {"train": f"0:{len(found.episodes)}"}
        _shorten_provenance(root / PROVENANCE_PATH, len(found.episodes))
    info.total_episodes, info.total_frames = len(found.episodes), found.num_frames
    info.total_tasks = len(found.tasks)
    write_info(info, root)
    write_tasks(found.tasks, root)
    if (stats := statistics(found.episodes, info)) is not None:
        write_stats(stats, root)
    else:
        (root / STATS_PATH).unlink(missing_ok=True)


def _keep_rows(path: Path, part: Path, num_episodes: int) -> None:
    """Write the rows of whole episodes, one row group for each that there was, as LeRobot reads them group by group."""
    writer = None
    try:
        for table in row_groups(path):
            kept = table.filter(pc.less(table.column("episode_index"), num_episodes))
            if kept.num_rows:
                writer = writer or pq.ParquetWriter(part, table.schema, compression="snappy", use_dictionary=True)
                writer.write_table(kept)
    except UNREADABLE:  # from here on nothing is of a whole episode
        pass
    finally:
        if writer:
            writer.close()


def _ends(video: Path, found: Inspection) -> Iterator[float]:
    """Times in s, each just before the next frame, at which whole episodes end in a video."""
    for row in found.episodes:
        for key in found.video_keys:
            if found.video_file(row, key) == video:
                yield row[f"videos/{key}/from_timestamp"] + (row["length"] - 0.5) / found.info.fps


def _keep_frames(path: Path, part: Path, end: float) -> None:
    """Copy what is before `end`; each episode was encoded by itself, so that no frame needs those that follow."""
    with av.open(str(path)) as source, av.open(str(part), "w", options={"movflags": "faststart"}) as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream, opaque=True)
        copy.time_base = stream.time_base
        try:
            for packet in source.demux(stream):
                if packet.is_corrupt:
                    break
                if packet.dts is not None and (packet.pts or 0) * float(packet.time_base or 1) < end:
                    packet.stream = copy
                    target.mux(packet)
        except UNREADABLE:
            pass


def _shorten_provenance(path: Path, num_episodes: int) -> None:
    if path.exists():
        provenance = json.loads(path.read_text())
        provenance["episodes"] = provenance["episodes"][:num_episodes]
        path.write_text(json.dumps(provenance, indent=4))


def _remove_empty(folder: Path, root: Path) -> None:
    while folder != root and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
