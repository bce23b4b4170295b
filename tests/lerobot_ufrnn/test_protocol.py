import csv
import json
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import yaml

from env_door.latch import KINDS
from env_door.provenance import PROVENANCE_PATH
from env_door.trials import Trial
from lerobot_ufrnn.analysis.rate_table import MINUS
from lerobot_ufrnn.commands import main
from lerobot_ufrnn.experiments import demonstrations, executors
from lerobot_ufrnn.experiments.chain import Chain, plan, run_chain
from lerobot_ufrnn.experiments.configuration import ProtocolConfig
from lerobot_ufrnn.experiments.demonstrations import record_missing
from lerobot_ufrnn.experiments.model import Model
from lerobot_ufrnn.experiments.processes import Runner, Stopped

MODEL = """
policy: {type: ufrnn, autoencoder_steps: 4}
batch_size: 5
steps: 16
save_freq: 8
"""


class FakeRunner(Runner):
    """Does in a blink what the commands would do, and notes them.

    Commands that contain `fails` fail; training is killed while it writes the checkpoint of update `stop_at`.
    """

    def __init__(self, fails: str = "", stop_at: int | None = None, surplus: int = 1):
        super().__init__()
        self.commands: list[tuple[str, dict[str, str]]] = []
        self.fails = fails
        self.stop_at = stop_at
        self.surplus = surplus

    def run(self, command, log, lock):
        name, flags = command[0], dict(flag.removeprefix("--").split("=", 1) for flag in command if "=" in flag)
        self.commands.append((name, flags))
        if self.fails and self.fails in " ".join(command):
            raise RuntimeError(f"{name} ended with status 1")
        {"ufrnn": self.record, "lerobot-train": self.train, "lerobot-eval": self.evaluate}[name](flags)

    def record(self, flags):
        make_dataset(Path(flags["root"]))
        settings = {name: yaml.safe_load(flags[name]) for name in ("kinds", "matched", "num_steps", "door_offset")}
        (Path(flags["root"]) / PROVENANCE_PATH).write_text(json.dumps({"settings": settings}))

    def train(self, flags):
        checkpoints = Path(flags["output_dir"]) / "checkpoints"
        start = 0
        if flags.get("resume") == "true":
            start = int(Path(flags["config_path"]).parents[1].name)
        else:
            assert not checkpoints.parent.exists()
            assert Path(flags["config_path"]).read_text() == MODEL
        for step in range(start + 1, 17):
            if step % int(flags["save_freq"]) == 0 or step == 16:
                (checkpoints / f"{step:06d}" / "pretrained_model").mkdir(parents=True, exist_ok=True)
                if step == self.stop_at:
                    raise Stopped
                (checkpoints / "last").unlink(missing_ok=True)
                (checkpoints / "last").symlink_to(f"{step:06d}")

    def evaluate(self, flags):
        assert Path(flags["policy.path"]).is_dir()
        log = Path(flags["env.trial_log"])
        assert not log.exists()
        log.parent.mkdir(parents=True)
        first, held = int(flags["seed"]), float(flags["env.hold_seconds"]) > 0
        trials = [
            Trial(seed, kind, kind == "push", 100, ("push",), 1.0, 0.0, held_at=70 if kind == "push" and held else None)
            for kind in flags["env.task"].split(",")
            for seed in range(first, first + int(flags["eval.n_episodes"]) + self.surplus)
        ]
        log.write_text("".join(json.dumps(asdict(trial)) + "\n" for trial in trials))


def make_dataset(root: Path, episodes: int = 15) -> None:
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta" / "info.json").write_text(json.dumps({"total_episodes": episodes, "total_frames": 150 * episodes}))


@pytest.fixture
def protocol(tmp_path) -> ProtocolConfig:
    """Two models, two seeds, two checkpoints, and their demonstrations."""
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text(MODEL)
    make_dataset(tmp_path / "out" / "dataset")
    return ProtocolConfig(
        models=[tmp_path / "one.yaml", tmp_path / "two.yaml"],
        train_seeds=[0, 1],
        epochs=[2, 4],
        trials_per_kind=3,
        output_dir=tmp_path / "out",
        results=tmp_path / "table.csv",
    )


def chains_of(protocol: ProtocolConfig) -> list[Chain]:
    return plan(protocol, [Model.read(path) for path in protocol.models])


def chain_of(protocol: ProtocolConfig) -> Chain:
    return chains_of(protocol)[0]


def test_seeds_follow_one_another_so_that_models_can_be_compared_early(protocol):
    assert [chain.name for chain in chains_of(protocol)] == ["one, seed 0", "two, seed 0", "one, seed 1", "two, seed 1"]


def test_a_chain_trains_then_evaluates_each_checkpoint_with_the_same_trials(protocol):
    runner, chain = FakeRunner(), chain_of(protocol)
    assert run_chain(chain, runner) == []
    (train, train_flags), *evaluations = runner.commands
    assert (train, train_flags["seed"], train_flags["save_freq"]) == ("lerobot-train", "0", "2")
    assert train_flags["dataset.root"] == str(protocol.output_dir / "dataset")
    assert [flags["policy.path"][-23:] for _, flags in evaluations] == [
        "000010/pretrained_model",
        "000016/pretrained_model",
    ]
    assert {(flags["seed"], flags["eval.n_episodes"], flags["eval.batch_size"]) for _, flags in evaluations} == {
        ("10000", "3", "3")
    }
    rows = list(csv.DictReader(protocol.results.open()))
    # lerobot-eval ran a trial more than it was asked for.
    assert {row["trials"] for row in rows} == {"3"}
    assert [(row["epoch"], row["kind"], row["opened_150"], row["first_try_wrong"]) for row in rows] == [
        (epoch, kind, "3" if kind == "push" else "0", "0" if kind == "push" else "3")
        for epoch in ("2", "4")
        for kind in sorted(KINDS)
    ]


def test_what_is_done_is_not_done_again_but_its_rows_are_kept(protocol):
    chain = chain_of(protocol)
    run_chain(chain, FakeRunner())
    table = protocol.results.read_text()
    protocol.results.unlink()  # as when it was killed before it wrote them
    runner = FakeRunner()
    assert run_chain(chain, runner) == []
    assert runner.commands == []
    assert protocol.results.read_text() == table


@pytest.mark.parametrize(("stop_at", "go_on_at"), [(2, None), (4, "000002"), (16, "000014")])
def test_a_killed_training_goes_on_from_its_last_whole_checkpoint(protocol, stop_at, go_on_at):
    chain = chain_of(protocol)
    with pytest.raises(Stopped):
        run_chain(chain, FakeRunner(stop_at=stop_at))
    runner = FakeRunner()
    assert run_chain(chain, runner) == []
    assert len(runner.commands) == 3
    flags = runner.commands[0][1]
    assert flags.get("resume", "false") == str(go_on_at is not None).lower()
    if go_on_at is not None:
        assert flags["config_path"].endswith(f"checkpoints/{go_on_at}/pretrained_model/train_config.json")
    assert [path.name for path in chain.checkpoints.values()][-1] == "000016"


def test_a_training_killed_while_it_moved_its_link_goes_on_too(protocol):
    chain = chain_of(protocol)
    with pytest.raises(Stopped):
        run_chain(chain, FakeRunner(stop_at=6))
    (chain.folder / "train" / "checkpoints" / "last").unlink()
    assert chain.last_checkpoint == 6


def test_a_training_killed_after_its_last_checkpoint_is_done(protocol):
    chain = chain_of(protocol)
    run_chain(chain, FakeRunner())
    state = chain.folder / "train.json"
    state.write_text(state.read_text().replace("true", "false"))
    runner = FakeRunner()
    run_chain(chain, runner)
    assert runner.commands == []


def test_a_killed_evaluation_is_repeated_from_scratch(protocol):
    chain = chain_of(protocol)
    run_chain(chain, FakeRunner())
    chain.trial_log(2).parent.with_suffix(".json").unlink()
    (chain.trial_log(2).parent / "half").write_text("")
    runner = FakeRunner()
    assert run_chain(chain, runner) == []
    assert [name for name, _ in runner.commands] == ["lerobot-eval"]
    assert [path.name for path in chain.trial_log(2).parent.iterdir()] == ["trials.jsonl"]


@pytest.mark.parametrize(
    ("name", "value", "flag"),
    [
        ("door_offset", 0.05, ("env.door_offset", "0.05")),
        ("kinds", ("pull", "push"), ("env.task", "pull,push")),
        ("trial_seed", 7, ("seed", "7")),
    ],
)
def test_other_trials_are_evaluations_of_their_own(protocol, name, value, flag):
    run_chain(chain_of(protocol), FakeRunner())
    setattr(protocol, name, value)
    runner = FakeRunner()
    assert run_chain(chain_of(protocol), runner) == []
    assert [command for command, _ in runner.commands] == ["lerobot-eval", "lerobot-eval"]
    assert flag in runner.commands[0][1].items()


def test_trials_with_a_held_door_go_to_a_table_of_their_own(protocol):
    run_chain(chain_of(protocol), FakeRunner())
    undisturbed = protocol.results.read_text()
    held = replace(protocol, hold_seconds=3.0, results=protocol.results.with_name("held.csv"))
    for commands in (["lerobot-eval"] * 2, []):
        runner = FakeRunner()
        assert run_chain(chain_of(held), runner) == []
        assert [name for name, _ in runner.commands] == commands
    assert held.results.read_text().splitlines() == [
        "model,train_seed,epoch,kind,trials,held,opened_after_hold,tried_another_way",
        *(f"one,0,{epoch},{row}" for epoch in (2, 4) for row in ("pull,3,0,0,0", "push,3,3,3,0", "slide,3,0,0,0")),
    ]
    assert protocol.results.read_text() == undisturbed


def test_a_variant_tries_the_same_training_with_other_settings(protocol):
    run_chain(chain_of(protocol), FakeRunner())
    varied = replace(protocol, variant="blind", policy_flags={"recall": False, "recall_noise": [0.1, 0.2]})
    runner = FakeRunner()
    assert run_chain(chain_of(varied), runner) == []
    assert [name for name, _ in runner.commands] == ["lerobot-eval"] * 2
    assert {"policy.recall": "false", "policy.recall_noise": "[0.1, 0.2]"}.items() <= runner.commands[0][1].items()
    labels = [line.split(",")[0] for line in protocol.results.read_text().splitlines()]
    assert (labels.count("one"), labels.count("one+blind")) == (6, 6)
    assert run_chain(chain_of(replace(varied, policy_flags={"recall": True})), FakeRunner()) != []


def test_each_kind_of_trial_has_its_table():
    assert ProtocolConfig([Path("one.yaml")]).table == Path("results/door_protocol.csv")
    assert ProtocolConfig([Path("one.yaml")], hold_seconds=3.0).table == Path("results/door_interference.csv")


def test_an_evaluation_without_all_trials_has_failed(protocol, capsys):
    assert len(run_chain(chain_of(protocol), FakeRunner(surplus=-1))) == 2
    assert "lacks 3 of 9 trials, such as ('pull', 10002)" in capsys.readouterr().out
    assert not protocol.results.exists()


def test_a_checkpoint_that_was_not_kept_is_reported_with_those_that_were(protocol, capsys):
    protocol.epochs = []
    run_chain(chain_of(protocol), FakeRunner())
    protocol.epochs = [1]
    assert run_chain(chain_of(protocol), FakeRunner()) == ["one, seed 0: evaluation of epoch 1"]
    assert "no checkpoint of epoch 1 (update 7); it has those of updates [8, 16]" in capsys.readouterr().out


def test_a_model_that_changed_is_not_mixed_with_its_old_self(protocol, capsys):
    run_chain(chain_of(protocol), FakeRunner())
    protocol.models[0].write_text(MODEL.replace("{type: ufrnn", "{type: ufrnn, horizon: 3") + "log_freq: 9")
    assert run_chain(chain_of(protocol), FakeRunner()) == ["one, seed 0: training"]
    out = capsys.readouterr().out
    assert "other settings: policy.horizon was None, now 3. Go back to them, give another --output_dir" in out


# ── The demonstrations ────────────────────────────────────────────────


def test_what_the_protocol_states_without_importing_it_is_true():
    assert demonstrations.PROVENANCE_PATH == PROVENANCE_PATH


@pytest.fixture
def hinged(protocol) -> ProtocolConfig:
    """Demonstrations as with the paper's real robot, recorded."""
    shutil.rmtree(protocol.demonstrations)
    return replace(protocol, kinds=("push", "pull"), episodes_per_kind=15, num_steps=100, door_offset=0.05)


def test_missing_demonstrations_are_recorded_once(hinged):
    runner = FakeRunner()
    record_missing(hinged, runner)
    make_dataset(hinged.demonstrations, episodes=30)
    record_missing(hinged, runner)
    ((name, flags),) = runner.commands
    assert name == "ufrnn"
    assert (flags["episodes_per_kind"], flags["kinds"], flags["num_steps"]) == ("15", "[push,pull]", "100")
    assert (flags["door_offset"], flags["matched"], flags["resume"]) == ("0.05", "true", "false")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("kinds", KINDS, r"recorded with kinds=\['push', 'pull'\], now --kinds=\['push', 'pull', 'slide'\] is"),
        ("num_steps", 150, "recorded with num_steps=100, now --num_steps=150 is asked for. Ask for what was"),
        ("door_offset", 0.0, "recorded with door_offset=0.05"),
        ("matched", False, "recorded with matched=True, now --matched=False"),
        ("episodes_per_kind", 7, "There are 15 demonstrations in .*, more than the 14 of --episodes_per_kind=7"),
    ],
)
def test_other_demonstrations_than_asked_for_are_refused(hinged, name, value, message):
    record_missing(hinged, FakeRunner())
    runner = FakeRunner()
    with pytest.raises(ValueError, match=message):
        record_missing(replace(hinged, **{name: value}), runner)
    assert runner.commands == []


def test_an_interrupted_recording_goes_on_and_another_data_set_is_left_alone(hinged):
    make_dataset(hinged.demonstrations, episodes=6)
    runner = FakeRunner()
    record_missing(hinged, runner)
    assert runner.commands == []
    shutil.rmtree(hinged.demonstrations)
    record_missing(hinged, runner)
    record_missing(hinged, runner)
    assert [flags["resume"] for _, flags in runner.commands] == ["false", "true"]


def test_a_model_of_other_demonstrations_is_not_taken_for_one_of_these(protocol, capsys):
    run_chain(chain_of(protocol), FakeRunner())
    make_dataset(protocol.demonstrations, episodes=14)
    assert run_chain(chain_of(protocol), FakeRunner()) == ["one, seed 0: training"]
    assert "dataset_size was [15, 2250], now [14, 2100]" in capsys.readouterr().out


# ── The command ───────────────────────────────────────────────────────


def flags_for(protocol: ProtocolConfig) -> list[str]:
    return [
        f"--models=[{','.join(map(str, protocol.models))}]",
        "--train_seeds=[0,1]",
        "--epochs=[2,4]",
        "--trials_per_kind=3",
        f"--output_dir={protocol.output_dir}",
        f"--results={protocol.results}",
    ]


def test_the_command_goes_on_past_a_failure_and_reports_it(protocol, monkeypatch, capsys):
    failing = FakeRunner(fails="two/seed1/train ")
    monkeypatch.setattr("lerobot_ufrnn.commands.protocol.Runner", lambda: failing)
    assert main(["protocol", *flags_for(protocol)]) == 1
    out, err = capsys.readouterr()
    assert "[two, seed 1: training] failed: lerobot-train ended with status 1" in out
    assert "1 failed, see above: two, seed 1: training." in err
    assert "| one | 6/18" in out
    assert "| two | 3/9 = 33%" in out

    mended = FakeRunner()
    monkeypatch.setattr("lerobot_ufrnn.commands.protocol.Runner", lambda: mended)
    assert main(["protocol", *flags_for(protocol)]) == 0
    assert [name for name, _ in mended.commands] == ["lerobot-train", "lerobot-eval", "lerobot-eval"]
    assert f"| two {MINUS} one | +0 [" in capsys.readouterr().out
    assert len(protocol.results.read_text().splitlines()) == 1 + 2 * 2 * 2 * 3


def test_an_interruption_stops_the_commands(protocol, monkeypatch):
    class Interrupted(FakeRunner):
        def run(self, command, log, lock):
            raise KeyboardInterrupt

    runner = Interrupted()
    monkeypatch.setattr("lerobot_ufrnn.commands.protocol.Runner", lambda: runner)
    assert main(["protocol", *flags_for(protocol)]) == 130
    assert runner._stopping.is_set()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--models=[]"], "one or more files with different names, got []"),
        (["--models=[a/x.yaml,b/x.yaml]"], "different names"),
        (["--models=[/nowhere/x.yaml]"], "there is no file '/nowhere/x.yaml'"),
        (["--train_seeds=[]"], "--train_seeds must be one or more numbers"),
        (["--train_seeds=[1,1]"], "--train_seeds must be different numbers, 0 or more, got [1, 1]"),
        (["--epochs=[0]"], "--epochs must be different numbers, 1 or more, got [0]"),
        (["--epochs=[9]"], "Model one: --epochs must be from 1 to 4"),
        (["--trials_per_kind=0"], "--trials_per_kind must be at least 1, got 0"),
        (["--workers=0"], "--workers must be at least 1"),
        (["--door_offset=0.5"], "--door_offset must be 0 to 0.05 m, got 0.5"),
        (["--hold_seconds=70"], "--hold_seconds must be 0 to 60.0 s, got 70.0"),
        (["--kinds=[push,lift]"], "--kinds must be one or more of ['push', 'pull', 'slide'], each once, got ['push',"),
        (["--kinds=[push,push]"], "each once"),
        (["--kinds=[]"], "--kinds must be one or more of"),
        (["--num_steps=0"], "--num_steps must be at least 1, got 0"),
        (["--kinds=[push]", "--num_steps=9", "--results=null"], "with --kinds and --num_steps give it a table of its"),
        (["--variant=blind"], "neither goes without the other; got 'blind' and {}"),
        (["--variant=a/b", "--policy_flags={{recall: false}}"], "in letters, digits, '_' and '-'"),
        (["--executor=pbs"], "--executor must be one of ['local', 'slurm'], got 'pbs'"),
        (["--dataset_dir={tmp}"], "is not a LeRobotDataset"),
    ],
)
def test_a_bad_flag_ends_with_what_is_allowed(protocol, tmp_path, flags, message, capsys):
    flags = [flag.format(tmp=tmp_path) for flag in flags]
    assert main(["protocol", *flags_for(protocol), *flags]) == 1
    assert message in capsys.readouterr().err


def test_a_table_of_another_kind_is_refused_before_the_work(protocol, monkeypatch, capsys):
    run_chain(chain_of(protocol), FakeRunner())
    runner = FakeRunner()
    monkeypatch.setattr("lerobot_ufrnn.commands.protocol.Runner", lambda: runner)
    assert main(["protocol", *flags_for(protocol), "--hold_seconds=3"]) == 1
    assert "first line must be model,train_seed,epoch,kind,trials,held," in capsys.readouterr().err
    assert runner.commands == []


def test_the_summary_is_that_of_the_table(protocol, monkeypatch, capsys):
    monkeypatch.setattr("lerobot_ufrnn.commands.protocol.Runner", FakeRunner)
    assert main(["protocol", *flags_for(protocol), "--hold_seconds=3"]) == 0
    assert (
        "| one | 6/18 = 33% [16%, 56%] | 6/6 = 100% [61%, 100%] | 0/6 = 0% [0%, 39%] | 4 | 2 |"
        in capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("policy: [", "is not YAML"),
        ("steps: 3", "must state `policy.type`"),
        ("policy: {type: act}\nsteps: 3", "must state `batch_size`, a whole number of at least 1, got None"),
        ("policy: {type: act}\nsteps: 0\nbatch_size: 2", "must state `steps`"),
        (MODEL + "dataset: {episodes: [0]}", "states `dataset.episodes`, but all models learn from the same"),
    ],
)
def test_a_model_without_what_the_protocol_needs_is_refused(tmp_path, text, message):
    (tmp_path / "model.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        Model.read(tmp_path / "model.yaml")


def test_while_the_commands_run_the_protocol_itself_holds_no_pytorch():
    code = "import sys, lerobot_ufrnn.commands.protocol; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


# ── Clusters ──────────────────────────────────────────────────────────


def test_a_cluster_without_submitit_says_what_to_install(protocol, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "submitit", None)
    assert main(["protocol", *flags_for(protocol), "--executor=slurm"]) == 1
    assert "pip install 'lerobot_policy_ufrnn[cluster]'" in capsys.readouterr().err


def test_a_cluster_runs_the_same_chains(protocol, monkeypatch, capsys):
    pytest.importorskip("submitit")
    # `debug` runs jobs in this process, so that the fake reaches them.
    monkeypatch.setattr(executors, "Runner", lambda: FakeRunner(fails="one/seed1/train "))
    failures = executors.run_on_cluster(
        chains_of(protocol), 2, protocol.output_dir / "submitit", {"slurm_partition": "cpu"}, cluster="debug"
    )
    assert failures == ["one, seed 1: training"]
    assert len(protocol.results.read_text().splitlines()) == 1 + 3 * 2 * 3


def test_a_job_that_breaks_is_a_failure(protocol, capsys):
    pytest.importorskip("submitit")
    (protocol.output_dir / "one").write_text("no folder")
    protocol.models, protocol.train_seeds = protocol.models[:1], [0]
    folder = protocol.output_dir / "submitit"
    assert executors.run_on_cluster(chains_of(protocol), 1, folder, {}, cluster="local") == ["one, seed 0"]
    assert "NotADirectoryError" in capsys.readouterr().out


# ── LeRobot's own commands ────────────────────────────────────────────


@pytest.mark.slow
def test_a_tiny_protocol_from_demonstrations_to_table(tmp_path, capsys):
    model = tmp_path / "tiny.yaml"
    model.write_text(
        "dataset: {repo_id: ufrnn/door, video_backend: pyav}\n"
        "policy: {type: ufrnn, device: cpu, autoencoder_steps: 2, horizon: 2, num_samples: 2}\n"
        "batch_size: 2\nsteps: 4\nnum_workers: 0\n"
    )
    flags = [
        f"--models=[{model}]",
        "--train_seeds=[0]",
        "--epochs=[2]",
        "--trials_per_kind=1",
        "--kinds=[push,pull]",
        "--episodes_per_kind=1",
        "--num_steps=100",
        "--door_offset=0.05",
        f"--output_dir={tmp_path / 'out'}",
        f"--results={tmp_path / 'table.csv'}",
    ]
    assert main(["protocol", *flags]) == 0, capsys.readouterr().out
    table = (tmp_path / "table.csv").read_text()
    assert [line.split(",")[:5] for line in table.splitlines()[1:]] == [
        ["tiny", "0", "2", kind, "1"] for kind in ("pull", "push")
    ]
    assert "training] is done" not in capsys.readouterr().out
    assert main(["protocol", *flags]) == 0
    assert "training] is done" in capsys.readouterr().out
    assert (tmp_path / "table.csv").read_text() == table
