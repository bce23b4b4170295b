import pytest

from env_door.recording import record
from env_door.recording_config import RecordConfig

NUM_STEPS = 110


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A small matched recording: its configuration and its report."""
    root = tmp_path_factory.mktemp("recording") / "door"
    config = RecordConfig(repo_id="tester/door", root=root, episodes_per_kind=3, num_steps=NUM_STEPS)
    return config, record(config)
