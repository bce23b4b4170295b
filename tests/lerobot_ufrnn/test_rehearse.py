"""Trials on the twin, with a twin and a roll-out that play a script."""

import sys

import numpy as np
import pytest

from env_door.trials import append_trial, read_trials
from lerobot_ufrnn.commands import main, rehearse
from lerobot_ufrnn.commands.rehearse import RehearseConfig


class Script:
    """States of the twin one after the other, the last one for ever; it is its own roll-out."""

    address = "127.0.0.99"

    def __init__(self, *states, ends_at: int = 10**6):
        self.states, self.asked, self.ends_at = states, 0, ends_at

    def state(self):
        self.asked += 1
        return self.states[min(self.asked, len(self.states)) - 1]

    def arrivals(self):
        return []

    def reset(self, kind, seed):
        pass

    @property
    def has_ended(self):
        return self.asked >= self.ends_at


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
    monkeypatch.setattr(rehearse, "POLL_SECONDS", 0.0)


def watch(script: Script, tmp_path, **settings):
    config = RehearseConfig("checkpoint", tmp_path / "trials.jsonl", **settings)
    return rehearse._watch(config, script, script, "pull", 7)


def test_a_trial_begins_when_the_arm_is_commanded_to_move_and_ends_when_the_door_is_open(tmp_path):
    states = [
        state(3.0, moved=0.005),
        state(5.0),
        state(9.0, attempts=["push"]),
        state(12.4, opening=0.4, attempts=["push", "pull"], held=True),
        state(15.0, opening=0.4, attempts=["push", "pull"], held=True, tried_while_held=["slide"]),
        state(18.06, opening=1.1, attempts=["push", "pull"], tried_while_held=["slide"]),
    ]
    trial = watch(Script(*states), tmp_path)
    assert trial.success
    assert trial.steps == 131
    assert (trial.door_kind, trial.seed, trial.attempts) == ("pull", 7, ("push", "pull"))
    assert (trial.held_at, trial.tried_while_held) == (74, ("slide",))
    append_trial(tmp_path / "log.jsonl", trial)
    assert read_trials(tmp_path / "log.jsonl") == [trial]


def test_intervals_between_set_points_are_told_and_missed_ones_counted():
    intervals = np.array([0.008] * 197 + [0.009, 0.013, 0.050])
    told = rehearse.describe_intervals(intervals)
    assert told.startswith("200 set-points in 2 s")
    assert "one every 8.00 ms" in told
    assert f"99th percentile {1000 * np.percentile(intervals, 99):.2f} ms" in told
    assert "longest 50.0 ms" in told
    assert "2 more than 12 ms after" in told
    assert rehearse.describe_intervals(np.array([])) == "No set-points came."


def test_a_trial_ends_with_its_time(tmp_path):
    trial = watch(Script(state(5.0), state(14.9), state(15.0), state(99.0, opening=2.0)), tmp_path, duration=10.0)
    assert not trial.success
    assert trial.steps == 100


def test_a_roll_out_that_ends_before_it_moves_is_no_trial_and_one_that_ends_later_is(tmp_path):
    assert watch(Script(state(1.0, moved=0.0), ends_at=3), tmp_path) is None
    trial = watch(Script(state(1.0), state(2.0), ends_at=2), tmp_path)
    assert (trial.success, trial.steps) == (False, 10)


def test_a_roll_out_that_fails_on_the_way_is_a_trial_and_its_error_is_told(tmp_path, monkeypatch):
    code = "print('running slower'); raise RuntimeError('The arm was stopped')"
    monkeypatch.setattr("lerobot_ufrnn.commands.stock.with_this_python", lambda command: command)
    monkeypatch.setattr(rehearse, "_rollout", lambda *_: [sys.executable, "-c", code])
    monkeypatch.setattr(rehearse, "POLL_SECONDS", 0.01)
    config = RehearseConfig("checkpoint", tmp_path / "trials.jsonl", duration=3000.0)
    trial, told = rehearse._try(config, Script(state(1.0), state(4.0)), "pull", 7)
    assert (trial.success, trial.steps) == (False, 30)
    assert told == "1 late ticks; lerobot-rollout ended with status 1: RuntimeError: The arm was stopped"


def test_the_roll_out_is_the_stock_command_without_a_return_to_the_first_pose(tmp_path):
    command = rehearse._rollout(RehearseConfig("me/door", tmp_path / "log"), "127.0.0.5")
    assert command[0] == "lerobot-rollout"
    assert {"--policy.path=me/door", "--robot.ip=127.0.0.5", "--return_to_initial_position=false"} <= set(command)
    (cameras,) = [flag for flag in command if flag.startswith("--robot.cameras=")]
    assert cameras.count("{") == cameras.count("}")


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--kinds=[up]", "--kinds must be one or more of"),
        ("--kinds=[push,push]", "each once"),
        ("--trials_per_kind=0", "at least 1"),
        ("--duration=0", "--duration must be above 0"),
        ("--hold_seconds=99", "--hold_seconds must be 0 to 60"),
    ],
)
def test_flags_out_of_range_are_refused(tmp_path, capsys, flag, message):
    assert main(["rehearse", "--policy_path=x", f"--trial_log={tmp_path / 'log'}", flag]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_trained_policy_opens_a_door_on_the_twin(tmp_path, capsys):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    log = tmp_path / "trials.jsonl"
    flags = ["--policy_path=results/demo_checkpoint", f"--trial_log={log}", "--trials_per_kind=1", "--kinds=[slide]"]
    assert main(["rehearse", *flags]) == 0
    assert "slide door, seed 20000: opened" in capsys.readouterr().out
    assert main(["rehearse", *flags]) == 0  # which repeats nothing
    assert len(read_trials(log)) == 1
