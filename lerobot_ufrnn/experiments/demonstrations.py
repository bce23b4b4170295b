"""The demonstrations that all models learn from."""

import json
from pathlib import Path

from .configuration import ProtocolConfig
from .processes import Runner

REPO_ID = "ufrnn/door"
# Where the recorder keeps its settings; stated here because it imports LeRobot.
PROVENANCE_PATH = Path("meta/door_recording.json")


def record_missing(protocol: ProtocolConfig, runner: Runner) -> None:
    """Records the demonstrations, or the rest of them if that was interrupted; leaves other data sets as they are.

    Args:
        protocol (`ProtocolConfig`):
            Where they belong.
        runner (`Runner`):
            Runs `ufrnn record`.

    Raises:
        ValueError: If other demonstrations were recorded there.
        RuntimeError: If recording fails.
    """
    root = protocol.demonstrations
    with runner.hold(protocol.output_dir / "record.lock") as lock:
        if _complete(protocol):
            print(f"demonstrations: those in {root}", flush=True)
            return
        print(f"demonstrations: recording into {root}", flush=True)
        runner.run(
            [
                "ufrnn",
                "record",
                f"--repo_id={REPO_ID}",
                f"--root={root}",
                f"--episodes_per_kind={protocol.episodes_per_kind}",
                f"--kinds=[{','.join(protocol.kinds)}]",
                f"--matched={str(protocol.matched).lower()}",
                f"--num_steps={protocol.num_steps}",
                f"--door_offset={protocol.door_offset}",
                f"--resume={str(root.exists()).lower()}",
            ],
            protocol.output_dir / "record.log",
            lock,
        )


def _complete(protocol: ProtocolConfig) -> bool:
    root = protocol.demonstrations
    if not root.exists():
        return False
    if not (root / PROVENANCE_PATH).exists():
        return True
    recorded = json.loads((root / PROVENANCE_PATH).read_text())["settings"]
    wanted = {name: getattr(protocol, name) for name in ("matched", "num_steps", "door_offset")}
    wanted["kinds"] = list(protocol.kinds)
    for name, asked in wanted.items():
        if recorded.get(name) != asked:
            raise ValueError(
                f"The demonstrations in {root} were recorded with {name}={recorded.get(name)}, now --{name}={asked} is "
                "asked for. Ask for what was recorded, or give another --output_dir or --dataset_dir."
            )
    episodes, most = count_demonstrations(root)[0], protocol.episodes_per_kind * len(protocol.kinds)
    if episodes > most:
        raise ValueError(
            f"There are {episodes} demonstrations in {root}, more than the {most} of --episodes_per_kind="
            f"{protocol.episodes_per_kind}. Ask for as many, or give another --output_dir or --dataset_dir."
        )
    return episodes == most


def count_demonstrations(root: Path) -> tuple[int, int]:
    """How much there is to learn from.

    Args:
        root (`Path`):
            Folder of a LeRobotDataset.

    Returns:
        `tuple[int, int]`: episodes and frames.

    Raises:
        FileNotFoundError: If it is no such folder.
    """
    path = root / "meta" / "info.json"
    if not path.exists():
        raise FileNotFoundError(
            f"'{root}' is not a LeRobotDataset: {path} is missing. Give --dataset_dir a folder that `ufrnn record` or "
            "LeRobot made, or one that does not exist yet."
        )
    info = json.loads(path.read_text())
    return info["total_episodes"], info["total_frames"]
