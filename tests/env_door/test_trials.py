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
    ("attempts", "success", "first_try", "first_try_wrong"),
    [
        (("push",), True, True, False),
        (("pull", "push"), True, False, True),
        (("push", "slide", "push"), True, False, False),
        (("pull", "slide"), False, False, True),
        (("push",), False, False, False),
        ((), False, False, False),
    ],
)
def test_first_tries(attempts, success, first_try, first_try_wrong):
    seen = trial(attempts, success)
    assert (seen.first_try, seen.first_try_wrong) == (first_try, first_try_wrong)


def play(env, seed, num_steps=5):
    env.reset(seed=seed)
    for _ in range(num_steps):
        env.step(np.zeros(1))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "logs" / "trials.jsonl"


def test_success_and_time_limit_are_logged_once_each_and_an_abandoned_trial_is_not(path):
    env = TrialLog(gym.wrappers.TimeLimit(ScriptedDoor(("pull", "push")), 7), path)
    play(env, seed=2, num_steps=1)
    play(env, seed=3, num_steps=9)  # goes on after success and past the time limit
    play(TrialLog(gym.wrappers.TimeLimit(ScriptedDoor(), 4), path), seed=None, num_steps=4)
    opened, cut = read_trials(path)
    assert opened == Trial(3, "push", True, 5, ("pull", "push"), 1.0, 0.01)
    assert cut == Trial(None, "push", False, 4, (), 0.8, 0.01)


def test_a_hold_is_logged_with_what_was_tried_meanwhile(path):
    env = TrialLog(gym.wrappers.TimeLimit(ScriptedDoor(held=(2, 3)), 5), path)
    play(env, seed=1)
    play(env, seed=2)
    for seen in read_trials(path):
        assert (seen.held_at, seen.tried_while_held, seen.opened_after_hold) == (2, ("slide",), True)


def write(path, *lines):
    path.parent.mkdir()
    path.write_text("\n".join(lines), errors="surrogateescape")


def test_a_log_from_before_there_were_holds_is_read(path):
    fields = asdict(trial(("push",)))
    del fields["held_at"], fields["tried_while_held"]
    write(path, json.dumps(fields))
    (old,) = read_trials(path)
    assert old == trial(("push",))
    assert (old.held_at, old.tried_while_held, old.opened_after_hold) == (None, (), False)


def test_parallel_writers_do_not_mix_lines(path):
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda seed: play(TrialLog(ScriptedDoor(("pull", "slide") * 500), path), seed), range(64)))
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
def test_broken_line_is_named(path, line):
    write(path, GOOD_LINE, line)
    with pytest.raises(ValueError, match="line 2"):
        read_trials(path)


def test_missing_log_is_an_error(path):
    with pytest.raises(FileNotFoundError):
        read_trials(path)


def test_a_log_of_two_evaluations_is_refused(path):
    """An interrupted evaluation that was started again must not count its trials twice."""
    write(path, GOOD_LINE, GOOD_LINE.replace('"push"', '"pull"'), GOOD_LINE)
    with pytest.raises(ValueError, match=r"line 3 repeats the trial push, seed \d+: .* more than one evaluation"):
        read_trials(path)


def test_surplus_trials_of_the_last_batch_are_not_counted():
    """lerobot-eval runs full batches and reports the first seeds; the log has all of them, in order of ending."""
    trials = [Trial(seed, kind, True, 9, (kind,), 1.0, 0.0) for kind in ("slide", "push") for seed in (7, 5, 6)]
    kept = first_of_each_kind(trials, 2)
    assert [(trial.door_kind, trial.seed) for trial in kept] == [("push", 5), ("push", 6), ("slide", 5), ("slide", 6)]
