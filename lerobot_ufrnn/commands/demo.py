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

from env_door.trials import first_of_each_kind, read_trials

from ..analysis.results import summarize, to_csv, to_markdown
from ..experiments.processes import with_this_python
from .flags import parse_flags

# Nothing here imports LeRobot or PyTorch: their memory would lie idle while the stages need it.
EXPLORATIONS = ("foresight", "noise", "none")
LAST_CHECKPOINT = Path("checkpoints/last/pretrained_model")
REPO_ID = "ufrnn/door_demo"
TRIAL_SEED = 5000


@dataclass
class DemoConfig:
    """The main job.

    Args:
        output_dir (`Path`, *optional*, defaults to `outputs/demo`):
            Folder of everything it makes. Running again with the same folder goes on where it stopped.
        episodes_per_kind (`int`, *optional*, defaults to `5`):
            Demonstrations for each of the three kinds of door.
        exploration (`str`, *optional*, defaults to `"foresight"`):
            `foresight` (UF-RNN), `noise` or `none` (its baselines).
        autoencoder_steps (`int`, *optional*, defaults to `400`):
            Updates of the autoencoder.
        recurrent_steps (`int`, *optional*, defaults to `1500`):
            Updates of the recurrent network after that; 3 updates are an epoch of 15 demonstrations. Below 1000 the
            policy expects to be wrong too often to be surprised; `configs/ufrnn.yaml` takes 9000.
        batch_size (`int`, *optional*, defaults to `5`):
            Episodes per update.
        save_freq (`int`, *optional*, defaults to `100`):
            Updates between checkpoints; an interrupted training goes on from the last one.
        trials_per_kind (`int`, *optional*, defaults to `10`):
            Evaluation trials for each kind of door.
        door_offset (`float`, *optional*, defaults to `0.0`):
            Half-width in metres of the range of the door's lateral shift, in demonstrations and trials; 0 to 0.05.
        seed (`int`, *optional*, defaults to `0`):
            Seed of demonstrations and training. Trials use seeds from 5000 on, which no demonstration has.
        device (`str`, *optional*, defaults to `"cpu"`):
            Where to train; this network is too small to gain from a GPU.
    """

    output_dir: Path = Path("outputs/demo")
    episodes_per_kind: int = 5
    exploration: str = "foresight"
    autoencoder_steps: int = 400
    recurrent_steps: int = 1500
    batch_size: int = 5
    save_freq: int = 100
    trials_per_kind: int = 10
    door_offset: float = 0.0
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        if self.exploration not in EXPLORATIONS:
            raise ValueError(f"--exploration must be one of {list(EXPLORATIONS)}, got {self.exploration!r}.")
        for name in (
            "episodes_per_kind",
            "autoencoder_steps",
            "recurrent_steps",
            "batch_size",
            "save_freq",
            "trials_per_kind",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}.")

    @property
    def dataset_dir(self) -> Path:
        """Folder of the demonstrations."""
        return self.output_dir / "dataset"

    @property
    def train_dir(self) -> Path:
        """Folder of training."""
        return self.output_dir / "train"

    @property
    def eval_dir(self) -> Path:
        """Folder of evaluation."""
        return self.output_dir / "eval"

    @property
    def last_checkpoint(self) -> Path:
        """The newest trained policy."""
        return self.train_dir / LAST_CHECKPOINT

    @property
    def steps(self) -> int:
        """All training updates."""
        return self.autoencoder_steps + self.recurrent_steps


def run(arguments: list[str]) -> None:
    """Runs all stages that are not done yet and shows the result."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    config = parse_flags(DemoConfig, arguments)
    seconds = {}
    for number, (name, stage) in enumerate(
        (("record", _record), ("train", _train), ("evaluate", _evaluate), ("draw", _draw)), start=1
    ):
        print(f"\n[{number}/4] {name}", flush=True)
        start = time.perf_counter()
        try:
            stage(config)
        except KeyboardInterrupt:
            print(f"\nStopped in stage '{name}'. Run the same command again to go on from there.", file=sys.stderr)
            raise
        seconds[name] = time.perf_counter() - start
    print(f"\n{(config.output_dir / 'results.md').read_text()}")
    print(", ".join(f"{name} {value:.0f} s" for name, value in seconds.items()))
    made = sorted(path.name + "/" * path.is_dir() for path in config.output_dir.iterdir())
    print(f"Everything is in {config.output_dir}: {', '.join(made)}")


def _record(config: DemoConfig) -> None:
    _run([
        "ufrnn",
        "record",
        f"--repo_id={REPO_ID}",
        f"--root={config.dataset_dir}",
        f"--episodes_per_kind={config.episodes_per_kind}",
        f"--door_offset={config.door_offset}",
        f"--seed={config.seed}",
        f"--resume={str(config.dataset_dir.exists()).lower()}",
    ])  # fmt: skip


def _train(config: DemoConfig) -> None:
    if _trained_steps(config) >= config.steps:
        print("already trained")
        return
    if config.last_checkpoint.exists():
        command = ["lerobot-train", f"--config_path={config.last_checkpoint / 'train_config.json'}", "--resume=true"]
    else:
        # A run that was stopped before its first checkpoint left nothing to go on from.
        shutil.rmtree(config.train_dir, ignore_errors=True)
        command = [
            "lerobot-train",
            "--policy.type=ufrnn",
            f"--policy.exploration={config.exploration}",
            f"--policy.autoencoder_steps={config.autoencoder_steps}",
            f"--policy.device={config.device}",
            f"--dataset.repo_id={REPO_ID}",
            f"--dataset.root={config.dataset_dir}",
            "--dataset.video_backend=pyav",
            f"--output_dir={config.train_dir}",
            f"--batch_size={config.batch_size}",
            f"--save_freq={config.save_freq}",
            "--log_freq=50",
            "--num_workers=0",
            f"--seed={config.seed}",
        ]
    _run([*command, f"--steps={config.steps}"])


def _evaluate(config: DemoConfig) -> None:
    done = config.eval_dir / "eval_info.json"
    if not done.exists() or done.stat().st_mtime < config.last_checkpoint.stat().st_mtime:
        # Trials are independent and quick: an evaluation that was cut short starts afresh.
        shutil.rmtree(config.eval_dir, ignore_errors=True)
        _run([
            "lerobot-eval",
            f"--policy.path={config.last_checkpoint}",
            f"--policy.device={config.device}",
            "--env.type=door",
            "--env.task=all",
            f"--env.door_offset={config.door_offset}",
            f"--env.trial_log={config.eval_dir / 'trials.jsonl'}",
            f"--eval.n_episodes={config.trials_per_kind}",
            f"--eval.batch_size={min(config.trials_per_kind, 5)}",
            "--eval.use_async_envs=false",
            f"--output_dir={config.eval_dir}",
            f"--seed={TRIAL_SEED}",
        ])  # fmt: skip
    trials = read_trials(config.eval_dir / "trials.jsonl")
    rows = summarize(first_of_each_kind(trials, config.trials_per_kind))
    (config.output_dir / "results.md").write_text(to_markdown(rows))
    (config.output_dir / "results.csv").write_text(to_csv(rows))


def _draw(config: DemoConfig) -> None:
    if config.exploration == "foresight":
        _draw_foresight(config)
    _keep_success_videos(config)
    checkpoint = config.output_dir / "checkpoint"
    shutil.rmtree(checkpoint, ignore_errors=True)
    shutil.copytree(config.last_checkpoint, checkpoint)


def _draw_foresight(config: DemoConfig) -> None:
    try:
        _run([
            "ufrnn",
            "foresight",
            f"--policy_path={config.last_checkpoint}",
            f"--output={config.output_dir / 'foresight.png'}",
            f"--door_offset={config.door_offset}",
        ])  # fmt: skip
    except RuntimeError as error:  # a policy that is never surprised imagines nothing
        print(f"No picture of foresight: {error}", file=sys.stderr)


def _keep_success_videos(config: DemoConfig) -> None:
    videos = config.output_dir / "videos"
    shutil.rmtree(videos, ignore_errors=True)
    videos.mkdir()
    info = json.loads((config.eval_dir / "eval_info.json").read_text())
    for task in info["per_task"]:
        metrics = task["metrics"]
        for number, (path, success) in enumerate(zip(metrics["video_paths"], metrics["successes"], strict=False)):
            if success:
                shutil.copy(path, videos / f"{task['task_group']}_seed{TRIAL_SEED + number}.mp4")
    print(f"{len(list(videos.iterdir()))} videos of opened doors")


def _trained_steps(config: DemoConfig) -> int:
    step_file = config.last_checkpoint.parent / "training_state" / "training_step.json"
    return json.loads(step_file.read_text())["step"] if step_file.exists() else 0


def _run(command: list[str]) -> None:
    """Runs a console command of LeRobot or of ours with this interpreter.

    Raises:
        RuntimeError: If it fails.
    """
    print("$ " + shlex.join(command), flush=True)
    result = subprocess.run(with_this_python(command), check=False)
    if result.returncode == -2 or result.returncode == 130:
        raise KeyboardInterrupt
    if result.returncode != 0:
        raise RuntimeError(f"{command[0]} failed with exit status {result.returncode}; its message is above.")
