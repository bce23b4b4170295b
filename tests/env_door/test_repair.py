"""Damaged datasets are repaired to the whole episodes from the first on, judged by what was recorded."""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from counting_robot import CAMERA, SIZE, picture
from kill_recording import REPO_ID, forking, read_counts
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from env_door.inspection import inspect
from env_door.repair import repair
from env_door.staged_dataset import StagedDataset

LENGTHS = (5, 7, 6, 4, 8)  # of the episodes; three in the first session, two in the second
DATA, EPISODES = "data/chunk-000/file-{}.parquet", "meta/episodes/chunk-000/file-{}.parquet"
VIDEO = f"videos/observation.images.{CAMERA}/chunk-000/file-{{}}.mp4"


def features(dtype):
    vector = {"dtype": "float32", "shape": (1,), "names": ["joint.pos"]}
    image = {"dtype": dtype, "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    return {"observation.state": vector, "action": dict(vector), f"observation.images.{CAMERA}": image}


def record(root, lengths, dtype="video", dataset_class=LeRobotDataset, first=0):
    """Records a session; returns the counts of its episodes."""
    options = {"root": root, "video_backend": "pyav", "rgb_encoder": RGBEncoderConfig(vcodec="h264")}
    if root.exists():
        dataset = dataset_class.resume(REPO_ID, **options)
    else:
        dataset = dataset_class.create(REPO_ID, 10, features(dtype), **options)
    counts = np.split(np.arange(first, first + sum(lengths)), np.cumsum(lengths)[:-1])
    for episode, numbers in enumerate(counts):
        for number in numbers:
            state = np.array([number], np.float32)
            frame = {"observation.state": state, "action": state + np.float32(0.5), "task": f"count {episode // 2}"}
            dataset.add_frame({**frame, f"observation.images.{CAMERA}": picture(number)})
        dataset.save_episode()
    dataset.finalize()
    return [numbers.tolist() for numbers in counts]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two sessions of stock LeRobot, as videos and as images, and the counts of all their episodes."""
    folder, counts = tmp_path_factory.mktemp("recorded"), None
    for dtype in ("video", "image"):
        counts = record(folder / dtype, LENGTHS[:3], dtype)
        counts += record(folder / dtype, LENGTHS[3:], dtype, first=100)
    return folder, counts


@pytest.fixture(params=["video", "image"])
def both(request, recorded, tmp_path):
    return Path(shutil.copytree(recorded[0] / request.param, tmp_path / "dataset"))


@pytest.fixture
def videos(recorded, tmp_path):
    return Path(shutil.copytree(recorded[0] / "video", tmp_path / "dataset"))


def everything(root):
    """Contents and times of all files."""
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in root.rglob("*") if path.is_file()}


def check_repaired(root, counts, num_kept):
    """The first episodes are there, frame by frame, nothing else is, statistics fit them, and a recording goes on."""
    assert os.listdir(root.parent) == [root.name]
    assert read_counts(root) == counts[:num_kept]
    assert not inspect(root).faults
    assert {path.relative_to(root).parts[0] for path in everything(root)} <= {"data", "meta", "videos"}
    numbers = np.concatenate(counts[:num_kept])
    stats = json.loads((root / "meta/stats.json").read_text())["observation.state"]
    expected = {"min": numbers.min(), "max": numbers.max(), "mean": numbers.mean(), "std": numbers.std()}
    for name, value in (expected | {"count": len(numbers)}).items():
        assert stats[name] == pytest.approx([value], rel=1e-4)
    more = record(root, (3, 2), first=200)
    assert read_counts(root) == [*counts[:num_kept], *more]


def cut(path, share=0.6):
    os.truncate(path, int(path.stat().st_size * share))


def overwrite(path, start, size):
    with path.open("r+b") as file:
        file.seek(start)
        file.write(bytes(size))


def edit_info(root, **values):
    path = root / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def interrupt_an_episode(root):
    frames = root / f"images/observation.images.{CAMERA}/episode-000005"
    frames.mkdir(parents=True)
    (frames / "frame-000000.png").write_bytes(b"half")
    (root / "tmpab12cd34").mkdir()
    (root / "tmpab12cd34" / "front_streaming.mp4").write_bytes(b"half")
    (root / DATA.format("002")).write_bytes(b"PAR1half")


def spoil_rows(root):
    """Zeros in the rows of the last episode, which is the second in its file."""
    path = root / DATA.format("001")
    column = pq.read_metadata(path).row_group(1).column(0)
    overwrite(path, column.dictionary_page_offset or column.data_page_offset, column.total_compressed_size)


DAMAGES = {
    "rows cut short": (lambda root: cut(root / DATA.format("001")), 3),
    "rows missing": (lambda root: (root / DATA.format("001")).unlink(), 3),
    "rows lost on disk": (spoil_rows, 4),
    "metadata cut short": (lambda root: cut(root / EPISODES.format("001")), 3),
    "metadata missing": (lambda root: (root / EPISODES.format("001")).unlink(), 3),
    "metadata empty": (lambda root: (root / EPISODES.format("001")).write_bytes(b""), 3),
    "counting too many": (lambda root: edit_info(root, total_episodes=7, total_frames=99, splits={"train": "0:7"}), 5),
    "counting too few": (lambda root: edit_info(root, total_episodes=4, total_frames=22, splits={"train": "0:4"}), 5),
    "statistics cut short": (lambda root: cut(root / "meta/stats.json"), 5),
    "statistics missing": (lambda root: (root / "meta/stats.json").unlink(), 5),
    "tasks cut short": (lambda root: cut(root / "meta/tasks.parquet"), 5),
    "tasks missing": (lambda root: (root / "meta/tasks.parquet").unlink(), 5),
    "an episode interrupted": (interrupt_an_episode, 5),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_the_longest_whole_prefix_is_kept(damage, both, recorded):
    spoil, num_kept = DAMAGES[damage]
    spoil(both)
    found = repair(both)
    assert found.faults
    assert found.num_claimed >= num_kept == len(found.episodes)
    assert list(pd.read_parquet(both / "meta/tasks.parquet").index) == ["count 0", "count 1"]
    check_repaired(both, recorded[1], num_kept)


def packets_of(path):
    """Place and size in the file of each frame, in the order of the frames."""
    with av.open(str(path)) as video:
        packets = [packet for packet in video.demux(video=0) if packet.size]
        return [(packet.pos, packet.size) for packet in sorted(packets, key=lambda packet: packet.pts)]


@pytest.mark.parametrize(
    ("file", "frame", "zeros", "num_kept"),
    [
        # Frames 0 to 4, 5 to 11 and 12 to 17 of the first file are its episodes, 0 to 3 and 4 to 11 of the second.
        ("000", 17, False, 2),
        ("000", 12, False, 2),
        ("000", 11, False, 1),
        ("001", 4, False, 4),
        ("001", 0, False, 3),
        ("000", 12, True, 2),
        ("001", 4, True, 4),
    ],
)
def test_a_damaged_video_costs_the_episodes_from_the_damaged_frame_on(file, frame, zeros, num_kept, videos, recorded):
    path = videos / VIDEO.format(file)
    start, size = packets_of(path)[frame]
    if zeros:
        overwrite(path, start, size)
    else:
        os.truncate(path, start + size // 2)
    assert len(repair(videos).episodes) == num_kept
    check_repaired(videos, recorded[1], num_kept)


def test_a_damaged_image_costs_the_episodes_from_it_on(recorded, tmp_path):
    root = Path(shutil.copytree(recorded[0] / "image", tmp_path / "dataset"))
    path = root / DATA.format("000")
    table = pq.read_table(path)
    rows = table.to_pylist()
    image = rows[8][f"observation.images.{CAMERA}"]  # of the second episode
    place = image["bytes"].index(b"IDAT") + 8
    image["bytes"] = image["bytes"][:place] + bytes(4) + image["bytes"][place + 4 :]
    groups = (rows[:5], rows[5:12], rows[12:])
    with pq.ParquetWriter(path, table.schema) as writer:
        for group in groups:
            writer.write_table(pa.Table.from_pylist(group, schema=table.schema))
    assert len(repair(root).episodes) == 1
    check_repaired(root, recorded[1], 1)


def test_a_whole_dataset_is_left_untouched(both):
    before = everything(both)
    assert not repair(both).faults
    assert everything(both) == before
    assert os.listdir(both.parent) == [both.name]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda root: shutil.rmtree(root), "is no LeRobotDataset: meta/info.json is missing"),
        (lambda root: (root / "meta/info.json").unlink(), "is no LeRobotDataset"),
        (lambda root: cut(root / "meta/info.json"), "info.json cannot be read"),
        (lambda root: (root / "meta/info.json").write_text("[]"), "info.json cannot be read"),
        (lambda root: edit_info(root, codebase_version="v2.1"), "only v3 is known"),
        (lambda root: cut(root / DATA.format("000")), r"Not one whole episode .*; nothing was changed"),
    ],
)
def test_what_cannot_be_repaired_is_refused_and_left_as_it_was(spoil, message, videos):
    spoil(videos)
    before = everything(videos)
    with pytest.raises(ValueError, match=message):
        repair(videos)
    assert everything(videos) == before
    assert set(os.listdir(videos.parent)) <= {videos.name}


def test_our_own_record_of_the_episodes_is_shortened_with_them(videos):
    path = videos / "meta/door_recording.json"
    path.write_text(
        json.dumps({"settings": {}, "episodes": [{"seed": seed} for seed in range(5)], "dropped_seeds": []})
    )
    cut(videos / DATA.format("001"))
    repair(videos)
    assert [episode["seed"] for episode in json.loads(path.read_text())["episodes"]] == [0, 1, 2]


def test_a_repair_that_is_killed_loses_nothing(videos, recorded):
    cut(videos / DATA.format("001"))
    before = everything(videos)
    delay, undone = 0.01, 0
    while everything(videos) == before:
        process = forking().Process(target=repair, args=(videos,))
        process.start()
        time.sleep(delay)
        if process.is_alive():
            os.kill(process.pid, signal.SIGKILL)
            undone += 1
        process.join()
        delay *= 1.3
    assert undone > 2
    with pytest.raises(ValueError, match="is no LeRobotDataset"):
        repair(videos.parent)
    shutil.rmtree(videos.parent / ".dataset.staging", ignore_errors=True)
    check_repaired(videos, recorded[1], 3)


def test_a_damaged_dataset_is_not_recorded_into(both, recorded):
    cut(both / DATA.format("001"))
    before = everything(both)
    with pytest.raises(ValueError, match=r"is damaged .*`ufrnn repair --root="):
        record(both, (3,), dataset_class=StagedDataset)
    assert everything(both) == before
    repair(both)
    more = record(both, (3, 2), dataset_class=StagedDataset, first=200)
    assert read_counts(both) == recorded[1][:3] + more
