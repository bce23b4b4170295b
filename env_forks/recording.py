"""Record demonstrations of a task into a LeRobotDataset, with the recorder of the door."""

import contextlib
from dataclasses import dataclass
from typing import Any

from draccus.utils import ParsingError

from env_door.checks import check_choice
from env_door.recording import Demonstration, RecordReport, record_demonstrations
from env_door.recording_config import DatasetConfig
from env_forks.demonstrator import demonstrate
from env_forks.env import ForksEnv
from env_forks.tasks import TASKS


@dataclass
class TaskRecordConfig(DatasetConfig):
    """What to record of a task, and where to; `kinds` are its ways, all of them if none is named."""

    task: str = "three_ways"
    """Name of the task."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice(self, "task", TASKS)
        self.matched &= TASKS[self.task].matched
        self.kinds = self.kinds or TASKS[self.task].suites
        if sorted(self.kinds) != sorted(set(self.kinds) & set(TASKS[self.task].suites)):
            raise ParsingError(f"kinds must be of {TASKS[self.task].suites}, each once, got {self.kinds}.")

    @property
    def settings(self) -> dict[str, Any]:
        """The options that every episode of a dataset must share."""
        return {"env": "forks"} | super().settings


def record_task(config: TaskRecordConfig) -> RecordReport:
    """Record demonstrations of a task; see [`~env_door.recording.record_demonstrations`]."""
    with contextlib.closing(ForksEnv(config.task)) as env:

        def demonstrate_kind(kind: str, seed: int) -> Demonstration | None:
            return demonstrate(env, env.task.suites.index(kind), seed)

        return record_demonstrations(config, env, demonstrate_kind)
