import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file

from env_door.recording import record
from env_door.recording_config import RecordConfig
from lerobot_ufrnn.commands import COMMANDS, main
from lerobot_ufrnn.commands.lyapunov import phase_starts
from lerobot_ufrnn.commands.policies import read_provenance
from lerobot_ufrnn.commands.results import ResultsConfig


def test_help_names_every_command_and_like_the_demo_while_its_stages_run_holds_nothing_heavy():
    code = "import sys; from lerobot_ufrnn.commands import main; main(['--help']); print('loaded', *sys.modules)\n"
    code += "import lerobot_ufrnn.commands.demo; print('loaded', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    text, *modules = done.stdout.split("loaded")
    assert all(f"\n  {name} " in text for name in COMMANDS)
    heavy = {"torch", "lerobot", "mujoco", "pandas", "matplotlib"}
    assert not (heavy | {"gymnasium"}) & set(modules[0].split())
    assert not heavy & set(modules[1].split())


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "lerobot-record"])  # LeRobot's own help
def test_help_of_a_command_names_it_and_explains_every_flag(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: ufrnn {command} [-h]")
    flags = [block.split("\n\n")[0] for block in text.split("\n  --")[1:]]
    assert len(flags) > 1
    for flag in flags:
        name, _, *explanation = flag.split("(default:")[0].split()
        assert len(explanation) > 1 or name.startswith("rgb_encoder."), f"--{flag}"  # those are LeRobot's


def test_an_unknown_command_is_refused(capsys):
    assert main(["fly"]) == 2
    assert "unknown command 'fly'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["results", "--trial_log=/nowhere/trials.jsonl"], "/nowhere/trials.jsonl"),
        (["record", "--repo_id=me/door", "--kinds=[push,lift]"], "lift"),
        (["record", "--repo_id=me/door", "--episodes_per_kind=0"], "episodes_per_kind"),
        (["record", "--repo_id=me/door", "--door_offset=0.5"], "0.05"),
        (["record", "--repo_id=me/door", "--episodes_per_kind=abc"], "`episodes_per_kind`"),
        (["demo", "--trials_per_kind=0"], "`trials_per_kind` must be at least 1"),
        (["demo", "--exploration=magic"], "`exploration` must be one of ['foresight', 'noise', 'none'], got 'magic'"),
        (["results", "--trial_log=a", "--trials_per_kind=0"], "`trials_per_kind` must be at least 1"),
        (["foresight", "--policy_path=/nowhere"], "/nowhere"),
        (["hidden", "--policy_paths=[/nowhere]", "--dataset_dir=/nowhere"], "/nowhere"),
        (["hidden", "--policy_paths=[a,b]", "--dataset_dir=/nowhere", "--labels=[a]"], "--labels must be one for each"),
        (["lyapunov", "--policy_paths=[]", "--dataset_dir=/nowhere"], "--policy_paths must name one or more"),
        (["lyapunov", "--policy_paths=[a]", "--dataset_dir=/nowhere", "--horizon=0"], "`horizon` must be at least 1"),
        (["video", "--policy_path=/nowhere"], "/nowhere"),
        (["repair", "--root=/nowhere"], "/nowhere is no LeRobotDataset: meta/info.json is missing"),
        (["video", "--policy_path=a", "--size=1000"], "`size` must be at least 16 and at most 768, got 1000"),
        (["video", "--policy_path=a", "--num_steps=0"], "`num_steps` must be at least 1"),
    ],
)
def test_a_bad_flag_ends_with_a_message_and_no_traceback(arguments, message, capsys):
    assert main(arguments) == 1
    assert message in capsys.readouterr().err


def test_results_writes_both_tables_of_the_trials_that_were_asked_for(tmp_path, capsys):
    log, fields = tmp_path / "trials.jsonl", {"success": True, "steps": 90, "opening": 1.1, "door_offset": 0.0}
    trials = [{**fields, "seed": seed, "door_kind": "push", "attempts": ["push"]} for seed in (3, 1, 2)]
    log.write_text("".join(json.dumps(trial) + "\n" for trial in trials))
    for flags, count in (([], 3), (["--trials_per_kind=2"], 2)):
        assert main(["results", f"--trial_log={log}", f"--output_dir={tmp_path / 'out'}", *flags]) == 0
        text = (tmp_path / "out" / "results.md").read_text()
        assert text in capsys.readouterr().out
        assert f"| push | {count}/{count} = 100%" in text
        table = (tmp_path / "out" / "results.csv").read_text().splitlines()
        assert table[0].startswith("kind,trials,opened_150,opened_300")
        assert table[1].startswith(f"push,{count},{count}")


# ── LeRobot's own commands ────────────────────────────────────────────


def lerobot(name: str, *flags: str) -> str:
    """Runs a stock command as a user would and returns what it printed."""
    command = [sys.executable, "-m", f"lerobot.scripts.lerobot_{name}", *flags]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout + result.stderr


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory) -> Path:
    """One demonstration a door."""
    root = tmp_path_factory.mktemp("commands") / "dataset"
    record(RecordConfig(repo_id="test/door", root=root, episodes_per_kind=1, num_steps=100))
    return root


def train_flags(root: Path, output: Path) -> list[str]:
    return [
        "--policy.type=ufrnn",
        "--policy.device=cpu",
        "--policy.autoencoder.steps=2",
        "--policy.foresight.horizon=2",
        "--dataset.repo_id=test/door",
        f"--dataset.root={root}",
        "--dataset.video_backend=pyav",
        "--batch_size=2",
        "--num_workers=0",
        f"--output_dir={output}",
    ]


def test_stock_training_resumes_and_stock_evaluation_reports_each_door(demonstrations, tmp_path, capsys):
    # That a resumed run computes what an uninterrupted one would is shown in test_modeling_ufrnn.py.
    run, last = tmp_path / "run", Path("checkpoints/last/pretrained_model")
    lerobot("train", *train_flags(demonstrations, run), "--steps=3")
    features = load_file(run / last / "model.safetensors")["image_encoder.scaler.high"]
    lerobot("train", f"--config_path={run / last / 'train_config.json'}", "--resume=true", "--steps=5")
    weights = load_file(run / last / "model.safetensors")
    assert int(weights["updates"]) == 5
    assert weights["image_encoder.scaler.high"].equal(features)

    lerobot(
        "eval",
        f"--policy.path={run / last}",
        "--env.type=door",
        "--env.task=all",
        "--env.episode_length=4",
        f"--env.trial_log={tmp_path / 'trials.jsonl'}",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )
    info = json.loads((tmp_path / "eval" / "eval_info.json").read_text())
    assert {task["task_group"] for task in info["per_task"]} == {"door_push", "door_pull", "door_slide"}
    trials = [json.loads(line) for line in (tmp_path / "trials.jsonl").read_text().splitlines()]
    assert sorted(trial["door_kind"] for trial in trials) == ["pull"] * 2 + ["push"] * 2 + ["slide"] * 2
    assert all(trial["steps"] == 4 and not trial["success"] for trial in trials)

    picture = ["foresight", f"--policy_path={run / last}", f"--output={tmp_path / 'f.png'}", "--num_steps=6"]
    assert main(picture) == 1  # this one has nothing to remember yet when the trial ends
    assert "never contradicted" in capsys.readouterr().err
    config = json.loads((run / last / "config.json").read_text())
    (run / last / "config.json").write_text(json.dumps(config | {"recall": {"enabled": False}}))
    assert main(picture) == 0
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")

    video = ["video", f"--policy_path={run / last}", f"--output={tmp_path / 'v.gif'}", "--num_steps=6", "--size=32"]
    assert main(video) == 1  # it opens nothing
    assert "In no trial was the first try wrong" in capsys.readouterr().err
    assert main([*video, "--kind=pull"]) == 0
    assert (tmp_path / "v.gif").read_bytes().startswith(b"GIF8")

    flags = [f"--policy_paths=[{run / last}]", f"--dataset_dir={demonstrations}"]
    assert main(["lyapunov", *flags, f"--output={tmp_path / 'l.png'}", "--horizon=1"]) == 0
    rows = (tmp_path / "l.csv").read_text().splitlines()
    assert len(rows) == 1 + 3 * 100
    assert rows[1].startswith("UF-RNN,0,0,")
    hidden = [*flags, f"--output={tmp_path / 'h.png'}", "--num_steps=6", "--kind=pull", "--hold_seconds=3"]
    assert main(["hidden", *hidden]) == 0
    rows = (tmp_path / "h.csv").read_text().splitlines()
    assert len(rows) == 1 + 3 * 100 + 6
    assert [row.split(",")[2] for row in rows[1::100]] == ["push", "pull", "slide", "pull"]
    assert main(["hidden", f"--policy_paths=[{run / last},{run / last}]", f"--dataset_dir={demonstrations}"]) == 1


def test_phases_begin_where_the_expert_planned_them(demonstrations):
    starts = phase_starts(read_provenance(demonstrations))
    dataset = LeRobotDataset("test/door", root=demonstrations, video_backend="pyav")
    actions = np.stack(dataset.hf_dataset["action"]).reshape(3, 100, -1)
    closing = (actions[0, :, -1] > 0).argmax()
    parting = (abs(actions[0] - actions[1]).max(-1) > 1e-6).argmax()
    assert starts["grasp"] == [closing]
    assert starts["open"] == [parting]
    assert starts["grasp"] < starts["twist"] < starts["open"]


def test_an_interruption_leaves_with_the_usual_status(monkeypatch, capsys):
    def interrupted(config: ResultsConfig):
        raise KeyboardInterrupt

    monkeypatch.setattr("lerobot_ufrnn.commands.results.run", interrupted)
    assert main(["results", "--trial_log=a"]) == 130
    assert "interrupted" in capsys.readouterr().err
