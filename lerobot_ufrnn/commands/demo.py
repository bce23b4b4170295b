"""`ufrnn demo`: record, train, evaluate and draw; each stage is also a command of its own, and is printed as such."""

import json
import logging
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from env_door.checks import check_choice, check_range

from . import with_this_python

# Nothing here imports LeRobot or PyTorch: their memory would lie idle while the stages need it.
EXPLORATIONS = ("foresight", "noise", "none")
LAST_CHECKPOINT = Path("checkpoints/last/pretrained_model")
REPO_ID = "ufrnn/door_demo"
TRIAL_SEED = 5000


@dataclass
class DemoConfig:
    """Records demonstrations, trains a policy, evaluates it and draws what it imagined."""

    output_dir: Path = Path("outputs/demo")
    """Folder of everything it makes. Running again with the same folder goes on where it stopped."""
    episodes_per_kind: int = 5
    """Demonstrations for each of the three kinds of door."""
    exploration: str = "foresight"
    """`foresight` (UF-RNN), `noise` or `none` (its baselines)."""
    autoencoder_steps: int = 400
    """Updates of the autoencoder."""
    recurrent_steps: int = 1500
    """Updates of the recurrent network after that; 3 updates are an epoch of 15 demonstrations;
    `configs/ufrnn.yaml` takes 9000."""
    batch_size: int = 5
    """Episodes per update."""
    trials_per_kind: int = 10
    """Evaluation trials for each kind of door."""
    door_offset: float = 0.0
    """Half-width in metres of the range of the door's lateral shift, in demonstrations and trials; 0 to 0.05."""
    seed: int = 0
    """Seed of demonstrations and training. Trials use seeds from 5000 on, which no demonstration has."""

    def __post_init__(self) -> None:
        check_choice(self, "exploration", EXPLORATIONS)
        check_range(self, "episodes_per_kind", "autoencoder_steps", "recurrent_steps", low=1)
        check_range(self, "batch_size", "trials_per_kind", low=1)
        self.dataset_dir, self.train_dir, self.eval_dir = (
            self.output_dir / name for name in ("dataset", "train", "eval")
        )
        self.last_checkpoint = self.train_dir / LAST_CHECKPOINT


def run(config: DemoConfig) -> None:
    """Runs all stages that are not done yet and shows the result."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    seconds = {}
    for number, stage in enumerate((record, train, evaluate, draw), start=1):
        print(f"\n[{number}/4] {stage.__name__}", flush=True)
        began = time.perf_counter()
        try:
            stage(config)
        except KeyboardInterrupt:
            print(f"\nStopped in stage '{stage.__name__}'. Run the same command again to go on.", file=sys.stderr)
            raise
        seconds[stage.__name__] = time.perf_counter() - began
    print(f"\n{(config.output_dir / 'results.md').read_text()}")
    print(", ".join(f"{name} {value:.0f} s" for name, value in seconds.items()))
    made = sorted(path.name + "/" * path.is_dir() for path in config.output_dir.iterdir())
    print(f"Everything is in {config.output_dir}: {', '.join(made)}")


def record(config: DemoConfig) -> None:
    """Records the demonstrations that are still missing."""
    start(
        "ufrnn record",
        f"--repo_id={REPO_ID}",
        f"--root={config.dataset_dir}",
        f"--episodes_per_kind={config.episodes_per_kind}",
        f"--door_offset={config.door_offset}",
        f"--seed={config.seed}",
        f"--resume={str(config.dataset_dir.exists()).lower()}",
    )


def train(config: DemoConfig) -> None:
    """Trains, or goes on from the last checkpoint."""
    num_steps = config.autoencoder_steps + config.recurrent_steps
    step_file = config.last_checkpoint.parent / "training_state" / "training_step.json"
    if step_file.exists() and json.loads(step_file.read_text())["step"] >= num_steps:
        print("already trained")
        return
    flags = [f"--config_path={config.last_checkpoint / 'train_config.json'}", "--resume=true"]
    if not config.last_checkpoint.exists():
        # A run that was stopped before its first checkpoint left nothing to go on from.
        shutil.rmtree(config.train_dir, ignore_errors=True)
        flags = [
            "--policy.type=ufrnn",
            f"--policy.exploration={config.exploration}",
            f"--policy.autoencoder.steps={config.autoencoder_steps}",
            "--policy.device=cpu",  # the network is too small to gain from a GPU
            f"--dataset.repo_id={REPO_ID}",
            f"--dataset.root={config.dataset_dir}",
            "--dataset.video_backend=pyav",
            f"--output_dir={config.train_dir}",
            f"--batch_size={config.batch_size}",
            "--save_freq=100",
            "--log_freq=50",
            "--num_workers=0",
            f"--seed={config.seed}",
        ]
    start("lerobot-train", *flags, f"--steps={num_steps}")


def evaluate(config: DemoConfig) -> None:
    """Evaluates the last checkpoint, and makes the table of it."""
    done, trial_log = config.eval_dir / "eval_info.json", config.eval_dir / "trials.jsonl"
    if not done.exists() or done.stat().st_mtime < config.last_checkpoint.stat().st_mtime:
        # Trials are independent and quick: an evaluation that was cut short starts afresh.
        shutil.rmtree(config.eval_dir, ignore_errors=True)
        start(
            "lerobot-eval",
            f"--policy.path={config.last_checkpoint}",
            "--policy.device=cpu",
            "--env.type=door",
            "--env.task=all",
            f"--env.door_offset={config.door_offset}",
            f"--env.trial_log={trial_log}",
            f"--eval.n_episodes={config.trials_per_kind}",
            f"--eval.batch_size={min(config.trials_per_kind, 5)}",
            "--eval.use_async_envs=false",
            f"--output_dir={config.eval_dir}",
            f"--seed={TRIAL_SEED}",
        )
    start(
        "ufrnn results",
        f"--trial_log={trial_log}",
        f"--trials_per_kind={config.trials_per_kind}",
        f"--output_dir={config.output_dir}",
    )


def draw(config: DemoConfig) -> None:
    """Draws what foresight imagined, and keeps the videos of opened doors and the last checkpoint."""
    if config.exploration == "foresight":
        try:
            start(
                "ufrnn foresight",
                f"--policy_path={config.last_checkpoint}",
                f"--output={config.output_dir / 'foresight.png'}",
                f"--door_offset={config.door_offset}",
            )
        except RuntimeError as error:  # a policy that is never contradicted imagines nothing
            print(f"No picture of foresight: {error}", file=sys.stderr)
    keep_success_videos(config)
    shutil.rmtree(config.output_dir / "checkpoint", ignore_errors=True)
    shutil.copytree(config.last_checkpoint, config.output_dir / "checkpoint")


def keep_success_videos(config: DemoConfig) -> None:
    """Copies the videos of the evaluation in which a door was opened."""
    videos = config.output_dir / "videos"
    shutil.rmtree(videos, ignore_errors=True)
    videos.mkdir()
    for task in json.loads((config.eval_dir / "eval_info.json").read_text())["per_task"]:
        outcomes = zip(task["metrics"]["video_paths"], task["metrics"]["successes"], strict=False)
        for seed, (path, success) in enumerate(outcomes, start=TRIAL_SEED):
            if success:
                shutil.copy(path, videos / f"{task['task_group']}_seed{seed}.mp4")
    print(f"{len(list(videos.iterdir()))} videos of opened doors")


def start(command: str, *flags: str) -> None:
    """Runs a console command of LeRobot or of ours with this interpreter, to its end; an interruption is passed on."""
    name, *words = [*command.split(), *flags]
    print("$ " + shlex.join([name, *words]), flush=True)
    status = subprocess.run([*with_this_python(name), *words], check=False).returncode
    if status in (-2, 130):
        raise KeyboardInterrupt
    if status != 0:
        raise RuntimeError(f"{name} failed with exit status {status}; its message is above.")
