import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import sweep
import yaml
from networks import PROVENANCE_PATH, Network
from sweep import SweepConfig, plan, read_model, record
from tables import RESULTS, read_table

from env_door import provenance
from env_door.latch import KINDS
from lerobot_ufrnn.commands import parse_flags

MODEL = """
policy: {type: ufrnn, autoencoder: {steps: 4}}
batch_size: 5
steps: 16
save_freq: 8
"""


@pytest.fixture
def config(tmp_path, fake) -> SweepConfig:
    """Two models, two seeds, two checkpoints, and somebody's demonstrations."""
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text(MODEL)
    fake.make_dataset(tmp_path / "out" / "dataset")
    return SweepConfig(
        models=[tmp_path / "one.yaml", tmp_path / "two.yaml"],
        train_seeds=[0, 1],
        epochs=[2, 4],
        trials_per_kind=3,
        output_dir=tmp_path / "out",
        results=tmp_path / "table.csv",
    )


def networks_of(config: SweepConfig) -> list[Network]:
    return plan(config, [read_model(path) for path in config.models])


def network_of(config: SweepConfig) -> Network:
    return networks_of(config)[0]


# ── A network ─────────────────────────────────────────────────────────


def test_seeds_follow_one_another_so_that_models_can_be_compared_early(config):
    assert [network.name for network in networks_of(config)] == [
        f"{m}, seed {s}" for s in (0, 1) for m in ("one", "two")
    ]


def test_a_network_is_trained_and_each_checkpoint_tried_with_the_same_trials(config, fake):
    assert network_of(config).run() == []
    (train, train_flags), *evaluations = fake.commands
    assert (train, train_flags["seed"], train_flags["save_freq"]) == ("lerobot-train", "0", "2")
    assert train_flags["dataset.root"] == str(config.output_dir / "dataset")
    assert [flags["policy.path"][-23:-17] for _, flags in evaluations] == ["000010", "000016"]
    assert {(flags["seed"], flags["eval.n_episodes"], flags["eval.batch_size"]) for _, flags in evaluations} == {
        ("10000", "3", "3")
    }
    table = read_table(config.results)
    assert set(table.trials) == {3}  # lerobot-eval ran a trial more than it was asked for
    assert table[["epoch", "kind", "opened_150", "first_try_wrong"]].to_numpy().tolist() == [
        [epoch, kind, *((3, 0) if kind == "push" else (0, 3))] for epoch in (2, 4) for kind in sorted(KINDS)
    ]


def test_what_is_done_is_not_done_again_but_its_rows_are_kept(config, fake):
    network_of(config).run()
    table = config.results.read_text()
    config.results.unlink()  # as when it was killed before it wrote them
    fake.commands.clear()
    assert network_of(config).run() == []
    assert fake.names == []
    assert config.results.read_text() == table


@pytest.mark.parametrize(("stop_at", "go_on_at"), [(2, None), (4, "000002"), (16, "000014")])
def test_a_killed_training_goes_on_from_its_last_whole_checkpoint(config, fake, stop_at, go_on_at):
    fake.stop_at = stop_at
    with pytest.raises(KeyboardInterrupt):
        network_of(config).run()
    fake.stop_at = None
    fake.commands.clear()
    assert network_of(config).run() == []
    (_, flags), *evaluations = fake.commands
    assert len(evaluations) == 2
    assert flags.get("resume", "false") == str(go_on_at is not None).lower()
    if go_on_at is not None:
        assert flags["config_path"].endswith(f"checkpoints/{go_on_at}/pretrained_model/train_config.json")
    assert list(network_of(config).checkpoints)[-1] == 16


@pytest.mark.parametrize("left", ["", '{"seed": 10000, "door_k'], ids=["no trials", "half a line"])
def test_a_killed_evaluation_is_repeated_from_scratch(config, fake, left):
    network = network_of(config)
    network.run()
    network.log_of(network.trials[0]).write_text(left)
    fake.commands.clear()
    assert network.run() == []
    assert fake.names == ["lerobot-eval"]
    assert network.missing(network.trials[0]) == set()


def test_an_evaluation_without_all_trials_has_failed_and_enters_no_table(config, fake, capsys):
    fake.surplus = -1
    assert len(network_of(config).run()) == 2
    assert "lacks 3 trials, such as ('pull', 10002)" in capsys.readouterr().out
    assert not config.results.exists()


@pytest.mark.parametrize(
    ("name", "value", "flag"),
    [
        ("door_offset", 0.05, ("env.door_offset", "0.05")),
        ("kinds", ("pull", "push"), ("env.task", "pull,push")),
        ("trial_seed", 7, ("seed", "7")),
    ],
)
def test_other_trials_are_evaluations_of_their_own(config, fake, name, value, flag):
    network_of(config).run()
    fake.commands.clear()
    assert network_of(replace(config, **{name: value})).run() == []
    assert fake.names == ["lerobot-eval", "lerobot-eval"]
    assert flag in fake.commands[0][1].items()


def test_trials_with_a_held_door_go_to_a_table_of_their_own(config):
    network_of(config).run()
    undisturbed = config.results.read_text()
    held = replace(config, hold_seconds=3.0, results=config.results.with_name("held.csv"))
    assert network_of(held).run() == []
    assert held.results.read_text().splitlines() == [
        "model,train_seed,epoch,kind,trials,held,opened_after_hold,tried_another_way",
        *(f"one,0,{epoch},{row}" for epoch in (2, 4) for row in ("pull,3,0,0,0", "push,3,3,3,0", "slide,3,0,0,0")),
    ]
    assert config.results.read_text() == undisturbed


def test_a_variant_tries_the_same_training_with_other_settings(config, fake, capsys):
    network_of(config).run()
    fake.commands.clear()
    varied = replace(config, variant="blind", policy_flags={"recall.enabled": False, "recall.noise_range": [0.1, 0.2]})
    assert network_of(varied).run() == []
    assert fake.names == ["lerobot-eval"] * 2
    flags = {"policy.recall.enabled": "false", "policy.recall.noise_range": "[0.1, 0.2]"}
    assert flags.items() <= fake.commands[0][1].items()
    assert read_table(config.results).model.value_counts().to_dict() == {"one": 6, "one+blind": 6}
    assert len(network_of(replace(varied, policy_flags={"recall.enabled": True})).run()) == 2
    assert "other settings: recall.enabled was False, now True; recall.noise_range was" in capsys.readouterr().out


def test_a_checkpoint_that_was_not_kept_is_reported_with_those_that_were(config, capsys):
    network_of(replace(config, epochs=[])).run()
    assert len(network_of(replace(config, epochs=[1])).run()) == 1
    assert "no checkpoint of update 7; it has those of updates [8, 16]" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("model", "episodes", "change"),
    [
        (f"{MODEL}log_freq: 9", 14, "dataset_size was [15, 2250], now [14, 2100]"),
        (
            MODEL.replace("{type: ufrnn", "{type: ufrnn, foresight: {horizon: 3}"),
            15,
            "policy.foresight.horizon was None, now 3",
        ),
    ],
)
def test_a_network_of_another_model_or_other_demonstrations_is_not_taken_for_this(
    config, fake, capsys, model, episodes, change
):
    network_of(config).run()
    config.models[0].write_text(model)
    fake.make_dataset(config.demonstrations, episodes)
    assert network_of(config).run() == ["one, seed 0: training"]
    assert f"other settings: {change}. Go back to them, give another --output_dir" in capsys.readouterr().out


# ── The demonstrations ────────────────────────────────────────────────


def test_missing_demonstrations_are_recorded_and_interrupted_ones_go_on(config, fake):
    shutil.rmtree(config.demonstrations)
    hinged = replace(
        config, kinds=("push", "pull"), episodes_per_kind=8, num_steps=100, door_offset=0.05, matched=False
    )
    for resume in ("false", "true"):
        with pytest.raises(ValueError, match=r"There are 15 demonstrations in .*, not the 16 of --episodes_per_kind=8"):
            record(hinged)
        assert fake.commands[-1][1].items() >= {"kinds": "[push,pull]", "num_steps": "100", "resume": resume}.items()
    record(replace(hinged, kinds=KINDS, episodes_per_kind=5))
    assert fake.commands[-1][1].items() >= {"episodes_per_kind": "5", "door_offset": "0.05", "matched": "false"}.items()


def test_a_data_set_of_somebody_else_is_left_alone(config, fake):
    record(replace(config, episodes_per_kind=3))
    assert fake.names == []


# ── The command ───────────────────────────────────────────────────────


def main(flags: list[str]) -> None:
    sweep.main(parse_flags(SweepConfig, flags, "sweep.py"))


def flags_for(config: SweepConfig) -> list[str]:
    return [
        f"--models=[{','.join(map(str, config.models))}]",
        "--train_seeds=[0,1]",
        "--epochs=[2,4]",
        "--trials_per_kind=3",
        f"--output_dir={config.output_dir}",
        f"--results={config.results}",
    ]


def test_the_command_goes_on_past_a_failure_and_mends_it_when_run_again(config, fake, capsys):
    fake.fails = "two/seed1/train "
    with pytest.raises(RuntimeError, match=r"1 failed, see above: two, seed 1: training\."):
        main(flags_for(config))
    out = capsys.readouterr().out
    assert "[two, seed 1: training] failed: lerobot-train ended with status 1" in out
    assert "| two | 33 | 33 | 0 |" in out
    fake.fails = ""
    fake.commands.clear()
    main(flags_for(config))
    assert fake.names == ["lerobot-train", "lerobot-eval", "lerobot-eval"]
    assert "| two | 33, 33 | 33 | 0 | 33 | 2 x 9 | 4 |" in capsys.readouterr().out
    assert len(read_table(config.results)) == 2 * 2 * 2 * 3


def test_a_table_of_another_kind_is_refused_before_the_work(config, fake):
    network_of(config).run()
    fake.commands.clear()
    with pytest.raises(ValueError, match="first line must be model,train_seed,epoch,kind,trials,held,"):
        main([*flags_for(config), "--hold_seconds=3"])
    assert fake.names == []


def test_each_kind_of_trial_has_its_table():
    assert SweepConfig([Path("one.yaml")]).table == RESULTS / "door_protocol.csv"
    assert SweepConfig([Path("one.yaml")], hold_seconds=3.0).table == RESULTS / "door_interference.csv"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--models=[]"], "--models must be one or more"),
        (["--models=[a/x.yaml,b/x.yaml]"], "with different names, got ['x', 'x']"),
        (["--models=[/nowhere/x.yaml]"], "there is no file '/nowhere/x.yaml'"),
        (["--train_seeds=[1,1]"], "got [1, 1]"),
        (["--epochs=[0]"], "`epochs` must be at least 1, got [0]"),
        (["--epochs=[9]"], "Model one: --epochs must be from 1 to 4"),
        (["--door_offset=0.5"], "`door_offset` must be at least 0 and at most 0.05 m, got 0.5"),
        (["--hold_seconds=70"], "`hold_seconds` must be at least 0 and at most 60 s, got 70.0"),
        (["--kinds=[push,lift]"], "'slide_right_ccw'], each once, got ['push',"),
        (["--kinds=[push]", "--num_steps=9", "--results=null"], "with --kinds and --num_steps give it a table of its"),
        (["--variant=blind"], "neither goes without the other; got 'blind' and {}"),
        (["--variant=a/b", "--policy_flags={{horizon: 3}}"], "in letters, digits, '_' and '-'"),
        (["--dataset_dir={tmp}"], "is not a LeRobotDataset"),
    ],
)
def test_a_bad_flag_ends_with_what_is_allowed(config, tmp_path, flags, message):
    with pytest.raises((ValueError, OSError)) as info:
        main([*flags_for(config), *(flag.format(tmp=tmp_path) for flag in flags)])
    assert message in str(info.value)


def test_while_the_commands_run_the_sweep_itself_holds_no_pytorch():
    assert provenance.PROVENANCE_PATH == PROVENANCE_PATH  # stated again, since that module imports it
    code = "import sys, sweep; print('torch' in sys.modules)"
    environment = {**os.environ, "PYTHONPATH": f"{Path(sweep.__file__).parent}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "False\n"


def script(*flags: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, sweep.__file__, *flags], capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_a_tiny_sweep_through_lerobots_own_commands_from_demonstrations_to_table(tmp_path):
    model = {"type": "ufrnn", "device": "cpu", "autoencoder": {"steps": 2}, "foresight": {"horizon": 2}}
    settings = {"dataset": {"repo_id": "ufrnn/door", "video_backend": "pyav"}, "policy": model, "num_workers": 0}
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump({**settings, "batch_size": 2, "steps": 4}))
    flags = [f"--models=[{tmp_path / 'tiny.yaml'}]", "--train_seeds=[0]", "--epochs=[2]", "--trials_per_kind=1"]
    flags += ["--kinds=[push,pull]", "--episodes_per_kind=1", "--num_steps=100", "--door_offset=0.05"]
    flags += [f"--output_dir={tmp_path / 'out'}", f"--results={tmp_path / 'table.csv'}"]
    first = script(*flags)
    assert first.returncode == 0, first.stdout + first.stderr
    table = (tmp_path / "table.csv").read_text()
    rows = [line.split(",")[:5] for line in table.splitlines()[1:]]
    assert rows == [["tiny", "0", "2", kind, "1"] for kind in ("pull", "push")]
    second = script(*flags)
    assert second.returncode == 0
    assert "$ lerobot-train" in first.stdout
    assert "$ lerobot-" not in second.stdout
    assert (tmp_path / "table.csv").read_text() == table
    other = script(*flags, "--num_steps=150")
    assert other.returncode == 1
    assert "was made with other settings: num_steps was 100, now 150." in other.stderr
