"""`ufrnn repair`: what is whole of a damaged data set."""

from dataclasses import dataclass
from pathlib import Path

import av

from env_door import repair
from env_door.inspection import inspect


@dataclass
class RepairConfig:
    """Keeps the whole episodes of a damaged LeRobotDataset, from the first on, and says what it drops."""

    root: Path
    """Folder of the data set; nothing may record into it meanwhile."""
    dry_run: bool = False
    """Only say what would be dropped."""


def run(config: RepairConfig) -> None:
    """Repairs, and says what was kept and why the rest was not; a whole data set is left untouched."""
    av.logging.set_libav_level(av.logging.PANIC)  # what it would say of damaged videos is said below
    root = config.root.expanduser().resolve()
    found = inspect(root) if config.dry_run else repair.repair(root)
    kept = f"{len(found.episodes)} episodes ({found.num_frames} frames)"
    if not found.faults:
        print(f"{root} is whole: {kept}; nothing was changed.")
        return
    print("\n".join(f"  {fault}" for fault in found.faults))
    verb = "Would keep" if config.dry_run else "Kept"
    print(f"{verb} {kept} of {found.num_claimed} in {root}.")
