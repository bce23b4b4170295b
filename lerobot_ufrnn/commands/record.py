"""`ufrnn record`: demonstrations of the scripted expert."""

import logging

from env_door.recording import record
from env_door.recording_config import RecordConfig


def run(config: RecordConfig) -> None:
    """Records, and says what was saved and what was dropped."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    report = record(config)
    provenance = report.provenance
    dropped = f", {len(provenance.dropped_seeds)} failed seed(s) dropped" if provenance.dropped_seeds else ""
    print(f"{len(provenance.episodes)} episodes in {config.path} ({len(report.episodes)} new{dropped})")
