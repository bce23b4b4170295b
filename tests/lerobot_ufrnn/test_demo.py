import json
import subprocess
import sys
from pathlib import Path

from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR

from lerobot_ufrnn.commands.demo import (
    EXPLORATIONS,
    LAST_CHECKPOINT,
    DemoConfig,
    _keep_success_videos,
    _trained_steps,
)
from lerobot_ufrnn.configuration_ufrnn import CHOICES


def test_what_the_demo_states_without_importing_it_is_true():
    assert CHOICES["exploration"] == EXPLORATIONS
    assert Path(CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR) == LAST_CHECKPOINT


def test_while_the_stages_run_the_demo_itself_holds_no_pytorch():
    code = "import sys, lerobot_ufrnn.commands.demo; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_only_videos_of_opened_doors_are_kept(tmp_path):
    config = DemoConfig(output_dir=tmp_path)
    paths = [tmp_path / f"episode_{number}.mp4" for number in range(3)]
    for path in paths:
        path.write_text(path.name)
    metrics = {"video_paths": [str(path) for path in paths], "successes": [False, True, True]}
    config.eval_dir.mkdir()
    (config.eval_dir / "eval_info.json").write_text(
        json.dumps({"per_task": [{"task_group": "door_pull", "metrics": metrics}]})
    )
    _keep_success_videos(config)
    kept = {path.name: path.read_text() for path in (tmp_path / "videos").iterdir()}
    assert kept == {"door_pull_seed5001.mp4": "episode_1.mp4", "door_pull_seed5002.mp4": "episode_2.mp4"}


def test_a_run_without_a_checkpoint_has_no_steps_to_go_on_from(tmp_path):
    assert _trained_steps(DemoConfig(output_dir=tmp_path)) == 0
