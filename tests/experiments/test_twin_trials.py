"""Trials on the twin, with a twin and a roll-out that play a script."""

import numpy as np
import pytest
import twin_trials
from twin_trials import TrialsConfig

from env_door.trials import append_trial, read_trials


class Script:
    """States of the twin one after the other, the last one for ever; it is its own roll-out."""

    address = "127.0.0.99"
    returncode = 1

    def __init__(self, *states, ends_at: int = 10**6):
        self.states, self.asked, self.ends_at, self.resets = states, 0, ends_at, []
        self.flags = set()

    def __call__(self, *flags, **_):
        self.flags |= set(flags)
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def reset(self, kind, seed):
        self.resets.append((kind, seed))
        self.asked = 0

    def state(self):
        self.asked += 1
        return self.states[min(self.asked, len(self.states)) - 1]

    def arrivals(self):
        return [0.0, 0.008]

    def poll(self):
        return self.returncode if self.asked >= self.ends_at else None

    def stop(self):
        pass

    def output(self):
        return "Record loop is running slower\nRuntimeError: The arm was stopped\n"


def state(time, moved=0.5, opening=0.0, attempts=(), held=False, tried_while_held=()):
    return {
        "time": time,
        "targets": {"elbow": moved},
        "joints": {"elbow": 0.0},
        "opening": opening,
        "is_open": opening >= 1,
        "attempts": list(attempts),
        "held": held,
        "tried_while_held": list(tried_while_held),
    }


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    monkeypatch.setattr(twin_trials, "POLL_SECONDS", 0.0)


def watch(script, duration=30.0):
    return twin_trials.watch(script, script, "pull", 7, duration)


def test_a_trial_begins_when_the_arm_is_commanded_to_move_and_ends_when_the_door_is_open(tmp_path):
    states = [
        state(3.0, moved=0.005),
        state(5.0),
        state(9.0, attempts=["push"]),
        state(12.4, opening=0.4, attempts=["push", "pull"], held=True),
        state(15.0, opening=0.4, attempts=["push", "pull"], held=True, tried_while_held=["slide"]),
        state(18.06, opening=1.1, attempts=["push", "pull"], tried_while_held=["slide"]),
    ]
    trial = watch(Script(*states))
    assert (trial.success, trial.steps) == (True, 131)
    assert (trial.door_kind, trial.seed, trial.attempts) == ("pull", 7, ("push", "pull"))
    assert (trial.held_at, trial.tried_while_held) == (74, ("slide",))
    append_trial(tmp_path / "log.jsonl", trial)
    assert read_trials(tmp_path / "log.jsonl") == [trial]


def test_a_trial_ends_with_its_time():
    trial = watch(Script(state(5.0), state(14.9), state(15.0), state(99.0, opening=2.0)), duration=10.0)
    assert (trial.success, trial.steps) == (False, 100)


def test_a_roll_out_that_ends_before_it_moves_is_no_trial(monkeypatch):
    script = Script(state(1.0, moved=0.0), ends_at=3)
    monkeypatch.setattr(twin_trials, "StockCommand", script)
    with pytest.raises(RuntimeError, match=r"status 1 before it moved the arm:\n(.|\n)*The arm was stopped"):
        twin_trials.try_door(script, "me/door", "pull", 7, 30.0)


def test_trials_go_on_where_they_stopped_and_a_roll_out_that_fails_on_the_way_is_one(monkeypatch, tmp_path, capsys):
    script = Script(state(1.0), state(4.0, attempts=["slide"]), ends_at=2)
    for name in ("TwinProcess", "StockCommand"):
        monkeypatch.setattr(twin_trials, name, script)
    settings = {"policy_path": "me/door", "trial_log": tmp_path / "new" / "log.jsonl", "kinds": ("pull", "push")}
    twin_trials.main(TrialsConfig(**settings, trials_per_kind=1, seed=8))
    said = capsys.readouterr().out
    assert (
        "pull door, seed 8: not opened after 3.0 s; tried slide; 1 late ticks; lerobot-rollout ended with status 1: Ru"
        in said
    )
    assert "2 set-points in 0 s" in said
    assert "| all | 0/2 = 0%" in said
    twin_trials.main(TrialsConfig(**settings, trials_per_kind=2, seed=8))
    assert script.resets == [("pull", 8), ("push", 8), ("pull", 9), ("push", 9)]
    assert "| all | 0/4 = 0%" in capsys.readouterr().out
    assert len(read_trials(settings["trial_log"])) == 4
    assert {"--policy.path=me/door", "--robot.ip=127.0.0.99", "--return_to_initial_position=false"} <= script.flags
    (cameras,) = {flag for flag in script.flags if flag.startswith("--robot.cameras=")}
    assert cameras.count("{") == cameras.count("}")


def test_intervals_between_set_points_are_told_and_missed_ones_counted():
    intervals = np.array([0.008] * 197 + [0.009, 0.013, 0.050])
    told = twin_trials.describe_intervals(intervals)
    for part in ("200 set-points in 2 s", "one every 8.00 ms", "longest 50.0 ms", "2 more than 12 ms after"):
        assert part in told
    assert f"99th percentile {1000 * np.percentile(intervals, 99):.2f} ms" in told
    assert twin_trials.describe_intervals(np.array([])) == "No set-points came."


@pytest.mark.slow
def test_a_trained_policy_opens_a_door_on_the_twin(tmp_path, capsys):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    checkpoint = "experiments/results/demo_checkpoint"
    config = TrialsConfig(checkpoint, tmp_path / "trials.jsonl", kinds=("slide",), trials_per_kind=1)
    twin_trials.main(config)
    assert "slide door, seed 20000: opened" in capsys.readouterr().out
