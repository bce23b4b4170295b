"""`ufrnn record`: demonstrations of the scripted expert."""

import logging
from dataclasses import dataclass, fields

from draccus.utils import ParsingError

from env_door.checks import check_choice
from env_door.latch import KINDS
from env_door.recording import record
from env_door.recording_config import DatasetConfig, RecordConfig
from env_forks.recording import TaskRecordConfig, record_task

SHARED = tuple(field.name for field in fields(DatasetConfig))


@dataclass
class RecordCommandConfig(RecordConfig):
    """Records demonstrations of the scripted expert."""

    env: str = "door"
    """What to record of: door, or forks, which is one of the ambiguous tasks."""
    task: str | None = None
    """Which ambiguous task, such as three_ways; needs --env=forks. All its ways are recorded, unless --kinds names some
    such as [three_ways_0,three_ways_2]. Flags of the door (arm, door_offset, num_steps) do not go with it."""
    episodes_per_way: int | None = None
    """Another name of episodes_per_kind."""

    def __post_init__(self) -> None:
        check_choice(self, "env", ("door", "forks"))
        if self.episodes_per_way is not None:
            self.episodes_per_kind = self.episodes_per_way
        self.for_recorder()  # which refuses what it does not know

    def for_recorder(self) -> RecordConfig | TaskRecordConfig:
        """What the recorder of this environment takes."""
        own = [field for field in fields(RecordConfig) if field.name not in SHARED]
        shared = {name: getattr(self, name) for name in SHARED}
        if self.env == "door":
            if self.task is not None:
                raise ParsingError(f"--task={self.task} needs --env=forks; the door has --kinds.")
            return RecordConfig(**shared, **{field.name: getattr(self, field.name) for field in own})
        if changed := [field.name for field in own if getattr(self, field.name) != field.default]:
            raise ParsingError(f"With --env=forks there is no --{changed[0]}: it is a flag of the door.")
        if self.task is None:
            raise ParsingError("--env=forks needs a task, such as --task=three_ways.")
        ways = [] if self.kinds == list(KINDS) else self.kinds
        return TaskRecordConfig(**shared | {"kinds": ways}, task=self.task)


def run(config: RecordCommandConfig) -> None:
    """Records, and says what was saved and what was dropped."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    recording = config.for_recorder()
    report = record_task(recording) if isinstance(recording, TaskRecordConfig) else record(recording)
    provenance = report.provenance
    dropped = f", {len(provenance.dropped_seeds)} failed seed(s) dropped" if provenance.dropped_seeds else ""
    print(f"{len(provenance.episodes)} episodes in {config.path} ({len(report.episodes)} new{dropped})")
