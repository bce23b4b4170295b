"""Commands that are not run."""

import json
import threading
from dataclasses import asdict
from pathlib import Path

import jobs
import networks
import pytest

from env_door.trials import Trial
from env_forks.tasks import TASKS


class FakeCommands:
    """Does in a blink what the commands would do, and notes them.

    Commands that contain `fails` fail; training is killed while it writes the checkpoint of update `stop_at`.
    """

    def __init__(self):
        self.commands: list[tuple[str, dict[str, str]]] = []
        self.fails, self.stop_at, self.surplus, self.steps = "", None, 1, 16

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.commands]

    def __call__(self, name, *words, flags, log, lock):
        flags = {flag: str(value) for flag, value in flags.items()}
        self.commands.append((name, flags))
        if self.fails and self.fails in " ".join(flags.values()):
            raise RuntimeError(f"{name} ended with status 1")
        {"ufrnn": self.record, "lerobot-train": self.train, "lerobot-eval": self.evaluate}[name](flags)

    def record(self, flags):
        self.make_dataset(Path(flags["root"]))
        (Path(flags["root"]) / networks.PROVENANCE_PATH).write_text("{}")

    @staticmethod
    def make_dataset(root: Path, episodes: int = 15) -> None:
        (root / "meta").mkdir(parents=True, exist_ok=True)
        info = {"total_episodes": episodes, "total_frames": 150 * episodes}
        (root / "meta" / "info.json").write_text(json.dumps(info))

    def train(self, flags):
        checkpoints, start = Path(flags["output_dir"]) / "checkpoints", 0
        if flags.get("resume") == "true":
            start = int(Path(flags["config_path"]).parents[1].name)
        else:
            assert not checkpoints.parent.exists()
            assert f"steps: {self.steps}\n" in Path(flags["config_path"]).read_text()
        for step in range(start + 1, self.steps + 1):
            if step % int(flags["save_freq"]) == 0 or step == self.steps:
                (checkpoints / f"{step:06d}" / "pretrained_model").mkdir(parents=True, exist_ok=True)
                if step == self.stop_at:
                    raise KeyboardInterrupt
                (checkpoints / "last").unlink(missing_ok=True)
                (checkpoints / "last").symlink_to(f"{step:06d}")

    def evaluate(self, flags):
        assert Path(flags["policy.path"]).is_dir()
        log = Path(flags["env.trial_log"])
        assert not log.exists()
        log.parent.mkdir(parents=True)
        first, held = int(flags["seed"]), float(flags.get("env.hold_seconds", 0)) > 0
        kinds = flags["env.task"].split(",")
        seeds = range(first, first + int(flags["eval.n_episodes"]) + self.surplus)
        if flags["env.type"] == "door":
            held = {"push": 70} if held else {}
            trials = [Trial(s, k, k == "push", 100, ("push",), 1.0, held_at=held.get(k)) for k in kinds for s in seeds]
        else:  # recall finds every way, with a needless try; without it only the first one is found
            ways, recall = TASKS[kinds[0]].suites, flags.get("policy.recall.enabled") != "false"
            tried = {way: (ways[0], way, ways[0], way) if recall and way != ways[0] else (ways[0],) for way in ways}
            trials = [
                Trial(s, way, recall or way == ways[0], 40 * len(tried[way]), tried[way], path=((0.5, 0.1), (0.5, 0.4)))
                for way in ways
                for s in seeds
            ]
        log.write_text("".join(json.dumps(asdict(trial)) + "\n" for trial in trials))


@pytest.fixture
def fake(monkeypatch) -> FakeCommands:
    commands = FakeCommands()
    monkeypatch.setattr(networks, "run_command", commands)
    monkeypatch.setattr(jobs, "stopping", threading.Event())
    return commands
