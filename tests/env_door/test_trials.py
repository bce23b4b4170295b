import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import gymnasium as gym
import numpy as np
import pytest

from env_door.trials import Trial, TrialLog, first_of_each_kind, read_trials


class ScriptedDoor(gym.Env):
    """Opens at the fifth step, after the given attempts, without physics; is held during some steps, counted from 0."""

    observation_space = gym.spaces.Box(0, 1, (1,))
    action_space = gym.spaces.Box(0, 1, (1,))
    current_offset = 0.01

    def __init__(self, attempts=("push",), held=()):
        self.attempts = attempts
        self.held = held

    def _info(self):
        is_open = self.step_number >= 5
        return {
            "is_success": is_open,
            "door_kind": "push",
            "opening": self.step_number / 5,
            "attempts": self.attempts if is_open else (),
            "held": self.step_number in self.held,
            "tried_while_held": ("slide",) if self.held and is_open else (),
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_number = 0
        return np.zeros(1, np.float32), self._info()

    def step(self, action):
        self.step_number += 1
        info = self._info()
        return np.zeros(1, np.float32), float(info["is_success"]), info["is_success"], False, info


def trial(attempts, success=True):
    return Trial(0, "push", success, 90, attempts, 1.0, 0.0)


@pytest.mark.parametrize(
    ("attempts", "success", "first_try", "recovered", "first_try_wrong"),
    [
        (("push",), True, True, False, False),
        (("pull", "push"), True, False, True, True),
        (("push", "slide", "push"), True, False, True, False),
        (("pull", "slide"), False, False, False, True),
        (("push",), False, False, False, False),
        ((), False, False, False, False),
    ],
)
def test_first_tries_and_recoveries(attempts, success, first_try, recovered, first_try_wrong):
    seen = trial(attempts, success)
    assert (seen.first_try, seen.recovered, seen.first_try_wrong) == (first_try, recovered, first_try_wrong)


def test_success_and_time_limit_are_logged_once_each(tmp_path):
    path = tmp_path / "logs" / "trials.jsonl"
    env = TrialLog(gym.wrappers.TimeLimit(ScriptedDoor(("pull", "push")), 7), path)
    env.reset(seed=3)
    for _ in range(9):  # goes on after success and past the time limit
        env.step(np.zeros(1))
    env = TrialLog(gym.wrappers.TimeLimit(ScriptedDoor(), 4), path)
    env.reset()
    for _ in range(4):
        env.step(np.zeros(1))
    opened, cut = read_trials(path)
    assert opened == Trial(3, "push", True, 5, ("pull", "push"), 1.0, 0.01)
    assert cut == Trial(None, "push", False, 4, (), 0.8, 0.01)


def test_a_hold_is_logged_with_what_was_tried_meanwhile(tmp_path):
    path = tmp_path / "trials.jsonl"
    env = TrialLog(gym.wrappers.TimeLimit(ScriptedDoor(held=(2, 3)), 5), path)
    for seed in (1, 2):
        env.reset(seed=seed)
        for _ in range(5):
            env.step(np.zeros(1))
    for seen in read_trials(path):
        assert (seen.held_at, seen.tried_while_held, seen.opened_after_hold) == (2, ("slide",), True)


def test_a_log_from_before_there_were_holds_is_read(tmp_path):
    path = tmp_path / "trials.jsonl"
    fields = asdict(trial(("push",)))
    del fields["held_at"], fields["tried_while_held"]
    path.write_text(json.dumps(fields))
    (old,) = read_trials(path)
    assert old == trial(("push",))
    assert (old.held_at, old.tried_while_held, old.opened_after_hold) == (None, (), False)


def test_abandoned_trial_is_not_logged(tmp_path):
    path = tmp_path / "trials.jsonl"
    env = TrialLog(ScriptedDoor(), path)
    env.reset(seed=1)
    env.step(np.zeros(1))
    env.reset(seed=2)
    for _ in range(5):
        env.step(np.zeros(1))
    assert [(seen.seed, seen.steps) for seen in read_trials(path)] == [(2, 5)]


def test_parallel_writers_do_not_mix_lines(tmp_path):
    path = tmp_path / "trials.jsonl"

    def run(seed):
        env = TrialLog(ScriptedDoor(("pull", "slide") * 500), path)
        env.reset(seed=seed)
        for _ in range(5):
            env.step(np.zeros(1))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(run, range(64)))
    assert sorted(seen.seed for seen in read_trials(path)) == list(range(64))


GOOD_LINE = json.dumps(asdict(trial(("push",))))


@pytest.mark.parametrize(
    "line",
    [
        *("{", "[1]", "7", '{"seed": 1}', '{"seed": 1, "attempts": [], "speed": 2}'),
        GOOD_LINE.replace('"steps": ', '"steps": "many", "ignored": '),
        "\udcff",
    ],
)
def test_broken_line_is_named(tmp_path, line):
    path = tmp_path / "trials.jsonl"
    path.write_text(GOOD_LINE + "\n" + line + "\n", errors="surrogateescape")
    with pytest.raises(ValueError, match="line 2"):
        read_trials(path)


def test_missing_log_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_trials(tmp_path / "none.jsonl")


def test_a_log_of_two_evaluations_is_refused(tmp_path):
    """An interrupted evaluation that was started again must not count its trials twice."""
    path = tmp_path / "trials.jsonl"
    path.write_text(GOOD_LINE + "\n" + GOOD_LINE.replace('"push"', '"pull"') + "\n" + GOOD_LINE + "\n")
    with pytest.raises(ValueError, match=r"line 3 repeats the trial push, seed \d+: .* more than one evaluation"):
        read_trials(path)


def test_surplus_trials_of_the_last_batch_are_not_counted():
    """lerobot-eval runs full batches and reports the first seeds; the log has all of them, in order of ending."""
    trials = [Trial(seed, kind, True, 9, (kind,), 1.0, 0.0) for kind in ("slide", "push") for seed in (7, 5, 6)]
    kept = first_of_each_kind(trials, 2)
    assert [(trial.door_kind, trial.seed) for trial in kept] == [("push", 5), ("push", 6), ("slide", 5), ("slide", 6)]
