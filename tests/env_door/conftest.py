import pytest

NUM_STEPS = 110


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A small matched recording: its configuration and its report."""
    # Here, so that tests of the environment alone need no LeRobot.
    from env_door.recording import record
    from env_door.recording_config import RecordConfig

    root = tmp_path_factory.mktemp("recording") / "door"
    config = RecordConfig(repo_id="tester/door", root=root, episodes_per_kind=3, num_steps=NUM_STEPS)
    return config, record(config)
