"""Demonstrations succeed, are matched, and show no wrong try."""

import numpy as np
import pytest

from env_forks.demonstrator import demonstrate
from env_forks.env import ForksEnv
from env_forks.tasks import TASKS


@pytest.mark.parametrize("name", TASKS)
def test_every_way_is_demonstrated_and_ways_are_alike_up_to_where_they_part(name):
    env = ForksEnv(name)
    for seed in range(2):
        runs = []
        for way in env.task.ways:
            runs.append(run := demonstrate(env, way, seed))
            assert (run.kind, env._info()["attempts"]) == (f"{name}_{way}", (way,))
            assert 40 < len(run.actions) == len(run.states) == len(run.images) < 100
            assert run.success_step < len(run.actions)
        for run in runs[1:]:
            branch = run.branch_step
            assert branch == runs[0].branch_step < run.success_step
            np.testing.assert_array_equal(run.actions[:branch], runs[0].actions[:branch])
            np.testing.assert_array_equal(run.states[: branch + 1], runs[0].states[: branch + 1])
            assert (run.images[: branch + 1] == runs[0].images[: branch + 1]).all() != env.task.cue
            # Ways that share a first fork part later.
            assert env.task.name == "two_forks" or not np.array_equal(run.actions[branch], runs[0].actions[branch])


def test_noise_and_delay_are_in_the_demonstrations_too():
    noisy, exact = (demonstrate(ForksEnv(name), 0, seed=1) for name in ("noise_and_delay", "three_ways"))
    np.testing.assert_array_equal(noisy.actions, exact.actions)
    np.testing.assert_array_equal(noisy.images[20], exact.images[18])
    assert 0.003 < (noisy.states[2:] - exact.states[:-2]).std() < 0.005


def test_a_demonstration_that_fails_is_none(monkeypatch):
    monkeypatch.setattr("env_forks.demonstrator.MAX_STEPS", 20)
    assert demonstrate(ForksEnv(), 0, 0) is None
