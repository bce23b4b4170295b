"""What importing the plug-in loads and changes, and what MuJoCo it needs."""

import importlib
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from env_door import simulator

ROOT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())

IMPORT_PLUGIN = """
import logging, os, sys, warnings
# LeRobot's commands import these before they look for plug-ins.
import lerobot.configs, lerobot.envs.configs, lerobot.optim, lerobot.robots, lerobot.teleoperators
import cv2  # LeRobot's cameras import it; it changes the environment itself

def logs():
    loggers = [logging.root, *(l for l in logging.root.manager.loggerDict.values() if isinstance(l, logging.Logger))]
    return {l.name: (list(l.filters), list(l.handlers), l.level) for l in loggers if l.filters or l.handlers or l.level}

variables, before, filters = dict(os.environ), logs(), list(warnings.filters)
import lerobot_policy_ufrnn as plugin
assert dict(os.environ) == variables, set(os.environ.items()) ^ set(variables.items())
assert logs() == before, (logs(), before)
heavy = {"mujoco", "glfw", "OpenGL", "numba", "rtde_control", "lerobot_ufrnn.modeling_ufrnn", "env_door.env"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)

from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig
assert "ufrnn" in PreTrainedConfig.get_known_choices() and "door" in EnvConfig.get_known_choices()
assert "ur5e_robotiq" in RobotConfig.get_known_choices()
assert {"spacemouse_twist", "keyboard_twist"} <= set(TeleoperatorConfig.get_known_choices())
plugin.DoorEnvConfig(), plugin.UFRNNConfig()
import gymnasium, env_door, env_door.kinematics, env_door.scene, env_door.trials
assert gymnasium.spec("env_door/Door-v0").entry_point == "env_door.env:DoorEnv"
assert "mujoco" not in sys.modules

assert plugin.UFRNNPolicy.config_class is plugin.UFRNNConfig
assert callable(plugin.make_ufrnn_pre_post_processors)
assert all(hasattr(plugin, name) for name in plugin.__all__)
try:
    plugin.Nothing
except AttributeError:
    print("imported")
"""

OLD_MUJOCO = """
import mujoco
mujoco.__version__ = "3.5.0"
import lerobot_policy_ufrnn, env_door
print("configured")
import env_door.env
"""


@pytest.mark.parametrize("variables", [{}, {"MUJOCO_GL": "egl"}, {"MUJOCO_GL": "telepathy"}])
def test_importing_the_plugin_registers_configurations_and_does_nothing_else(run_fresh, variables):
    """Without a display, too, and whatever MUJOCO_GL says."""
    result = run_fresh(IMPORT_PLUGIN, **variables)
    assert result.stdout == "imported\n", result.stderr


def test_an_older_mujoco_is_told_where_a_door_is_made_and_not_before(run_fresh):
    result = run_fresh(OLD_MUJOCO)
    assert result.stdout == "configured\n", result.stderr
    assert "ImportError: the door needs MuJoCo 3.6 or later, and 3.5.0 is installed: `pip install" in result.stderr


@pytest.mark.parametrize("version", ["3.6", "3.6.0", "3.10.1", "4.0.0"])
def test_the_declared_mujoco_and_later_ones_are_accepted(monkeypatch, version):
    assert f"mujoco>={simulator.MIN_MUJOCO}" in PYPROJECT["project"]["dependencies"]
    monkeypatch.setattr("mujoco.__version__", version)
    importlib.reload(simulator)


@pytest.mark.slow
def test_the_door_runs_on_the_lowest_mujoco_that_is_declared(tmp_path):
    """In a virtual environment of its own: two versions of MuJoCo on one path would merge."""
    uv = shutil.which("uv") or ROOT / ".uv" / "bin" / "uv"
    if not Path(uv).exists():
        pytest.skip("needs uv")
    python = tmp_path / "venv" / "bin" / "python"
    needed = ["numpy", "gymnasium", "draccus", "opencv-python-headless", "scipy", "pytest", "hypothesis"]
    subprocess.run([uv, "venv", "--quiet", "--python", sys.executable, tmp_path / "venv"], check=True)
    lowest = f"mujoco=={simulator.MIN_MUJOCO}.*"
    subprocess.run([uv, "pip", "install", "--quiet", "--python", python, lowest, *needed], check=True)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    installed = [python, "-c", "import mujoco; print(mujoco.__version__)"]
    version = subprocess.run(installed, env=environment, check=True, capture_output=True, text=True).stdout
    assert version.startswith(simulator.MIN_MUJOCO)
    tests = [f"tests/env_door/test_{name}.py" for name in ("latch", "rendering", "kinematics", "env", "expert")]
    command = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=280)
    assert result.returncode == 0, result.stdout[-3000:]
    assert "passed" in result.stdout
