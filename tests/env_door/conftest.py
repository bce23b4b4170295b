import os
import subprocess
import sys

import pytest

NUM_STEPS = 110
UNSET = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM")


@pytest.fixture
def run_fresh():
    """Runs code in a new process without a display; returns its result."""

    def run(code, **variables):
        environment = {name: value for name, value in os.environ.items() if name not in UNSET} | variables
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)

    return run


@pytest.fixture(scope="module")
def env():
    # Here, so that tests that import nothing of the simulator can stand beside the others.
    from env_door.env import DoorEnv

    env = DoorEnv(door_offset=0.05)
    yield env
    env.close()


@pytest.fixture(scope="module")
def eight():
    """An environment whose door is one of eight."""
    from env_door.env import DoorEnv

    env = DoorEnv(door_offset=0.05, eight=True)
    yield env
    env.close()


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A small matched recording: its configuration and its report."""
    # Here, so that tests of the environment alone need no LeRobot.
    from env_door.recording import record
    from env_door.recording_config import RecordConfig

    root = tmp_path_factory.mktemp("recording") / "door"
    config = RecordConfig(repo_id="tester/door", root=root, episodes_per_kind=3, num_steps=NUM_STEPS)
    return config, record(config)
