"""Trials, requests, and what of it can be had without a simulator."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from env_door.env import DoorEnv
from env_door.twin import ports


@pytest.fixture
def requests(connect):
    return connect(ports.TWIN)


@pytest.mark.parametrize("kind", ["push", "pull", "slide"])
def test_trials_are_those_of_the_environment(twin, kind):
    env = DoorEnv(kind=kind)
    env.reset(seed=11)
    state = twin.reset(kind=kind, seed=11)
    np.testing.assert_array_equal(list(state["joints"].values()), env.measured_joints())
    assert state["kind"] == kind
    assert not state["attempts"]


def test_somebody_holds_the_door_for_a_while(twin, requests):
    assert requests.ask('{"do": "hold", "seconds": 0.1}') == '{"ok": true}\n'
    assert twin.state()["held"]
    requests.turn(50)
    assert not twin.state()["held"]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("nonsense", "Expecting value"),
        ('{"do": "dance"}', "must be"),
        ('{"do": "reset", "kind": "lift"}', "'slide_right_ccw', 'random'"),
        ('{"do": "reset", "seed": -1}', "not negative"),
        ('{"do": "hold", "seconds": -1}', "negative"),
        ('{"do": "inject", "name": "rain"}', "drop_link"),
        ('{"do": "inject", "name": "delay"}', "parameters are ['ms']"),
        ('{"do": "inject", "name": "delay", "ms": -5}', "above 0"),
        ('{"do": "inject", "name": "gripper_fault", "code": 16}', "1 to 15"),
        ('{"do": "inject", "name": "camera_black"}', "no camera"),
        ('{"do": "clear", "name": "script_stop"}', "uploads its script"),
    ],
)
def test_a_request_is_told_what_is_wrong_with_it(requests, line, says):
    answer = requests.ask(line)
    assert '"ok": false' in answer
    assert says in answer
    assert '"injections": []' in requests.ask('{"do": "state"}')


def test_the_client_needs_no_simulator():
    # In the place of the package `env_door` stands an empty one: what that imports is not the twin's.
    folder = Path(ports.__file__).parents[1]
    code = (
        f"import sys, types; sys.modules['env_door'] = types.ModuleType('env_door'); "
        f"sys.modules['env_door'].__path__ = [{str(folder)!r}]; import env_door.twin; "
        "print({'mujoco', 'numpy', 'cv2', 'gymnasium'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.stdout == "set()\n", run.stderr
