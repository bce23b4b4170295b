import json
import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR

from lerobot_ufrnn import UFRNNConfig
from lerobot_ufrnn.commands.demo import EXPLORATIONS, LAST_CHECKPOINT, DemoConfig, keep_success_videos, start, train


def test_what_the_demo_states_without_importing_it_is_true():
    assert {UFRNNConfig(exploration=exploration).exploration for exploration in EXPLORATIONS} == set(EXPLORATIONS)
    assert Path(CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR) == LAST_CHECKPOINT


def test_a_stage_that_fails_or_is_interrupted_ends_the_demo(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(RuntimeError, match="lerobot-train failed with exit status 1"):
        start("lerobot-train", "--steps=1")
    monkeypatch.setattr(subprocess, "run", lambda command, check: subprocess.CompletedProcess(command, 130))
    with pytest.raises(KeyboardInterrupt):
        start("lerobot-train", "--steps=1")


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
    keep_success_videos(config)
    kept = {path.name: path.read_text() for path in (tmp_path / "videos").iterdir()}
    assert kept == {"door_pull_seed5001.mp4": "episode_1.mp4", "door_pull_seed5002.mp4": "episode_2.mp4"}


def test_a_run_goes_on_from_its_last_checkpoint_and_stops_where_it_is_done(tmp_path, monkeypatch, capsys):
    config, commands = DemoConfig(output_dir=tmp_path, autoencoder_steps=2, recurrent_steps=3), []
    monkeypatch.setattr("lerobot_ufrnn.commands.demo.start", lambda *command: commands.append(command))
    config.train_dir.mkdir()
    (config.train_dir / "half_a_checkpoint").touch()
    train(config)
    assert "--policy.type=ufrnn" in commands[0]
    assert not config.train_dir.exists()  # stopped before its first checkpoint, there was nothing to go on from

    config.last_checkpoint.mkdir(parents=True)
    state = config.last_checkpoint.parent / "training_state"
    state.mkdir()
    (state / "training_step.json").write_text('{"step": 4}')
    train(config)
    assert commands[1] == (
        "lerobot-train",
        f"--config_path={config.last_checkpoint / 'train_config.json'}",
        "--resume=true",
        "--steps=5",
    )
    (state / "training_step.json").write_text('{"step": 5}')
    train(config)
    assert len(commands) == 2
    assert "already trained" in capsys.readouterr().out
