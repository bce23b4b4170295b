"""`ufrnn record`: demonstrations of the scripted expert."""

import logging

from env_door.recording import record
from env_door.recording_config import RecordConfig


def run(config: RecordConfig) -> None:
    """Records, and says what was saved and what was dropped."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    report = record(config)
    dropped = f", {len(report.dropped_seeds)} failed seed(s) dropped" if report.dropped_seeds else ""
    new = f"{len(report.episodes)} new, {report.seconds:.0f} s"
    print(f"{report.total_episodes} episodes in {report.root} ({new}{dropped})")
