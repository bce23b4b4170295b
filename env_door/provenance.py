"""How the episodes of a recording came about, kept beside the dataset's metadata so that a recording can go on."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from env_door.recording_config import RecordConfig
from env_door.staging import is_empty

PROVENANCE_PATH = Path("meta/door_recording.json")


@dataclass
class Provenance:
    """Settings and seeds of a dataset."""

    settings: dict[str, Any]  # options that all episodes share
    episodes: list[dict[str, Any]] = field(default_factory=list)  # `kind` and `seed` of each
    dropped_seeds: list[int] = field(default_factory=list)  # tried and not used: the expert failed at one kind

    @property
    def next_seed(self) -> int:
        """First seed that has not been tried."""
        used = [episode["seed"] for episode in self.episodes] + self.dropped_seeds
        return max(used, default=self.settings["seed"] - 1) + 1

    @classmethod
    def open(cls, config: RecordConfig) -> "Provenance":
        """Read the provenance of the dataset to go on with, or start one."""
        root = config.path
        settings = json.loads(json.dumps(config.settings))
        if is_empty(root):
            return cls(settings)
        if not config.resume:
            raise FileExistsError(
                f"{root} is not empty. Use --resume=true to go on with the recording in it, or choose another root."
            )
        if not (root / PROVENANCE_PATH).exists():
            raise ValueError(
                f"{root} holds no recording of the door: {PROVENANCE_PATH} is missing. Choose another root."
            )
        provenance = cls(**json.loads((root / PROVENANCE_PATH).read_text()))
        for name, value in settings.items():
            if provenance.settings.get(name) != value:
                raise ValueError(
                    f"{root} was recorded with {name}={provenance.settings.get(name)}, now {name}={value} is asked "
                    "for. Go on with the recorded value, or choose another root."
                )
        return provenance

    def write(self, root: Path) -> None:
        """Write the provenance into the dataset in a folder."""
        (root / PROVENANCE_PATH).write_text(json.dumps(asdict(self), indent=4))
