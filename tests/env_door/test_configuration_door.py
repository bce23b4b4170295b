import contextlib

import gymnasium as gym
import numpy as np
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs import FeatureType
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.scripts.lerobot_eval import rollout

from env_door.configuration_door import DoorEnvConfig
from env_door.expert import DoorExpert
from env_door.latch import EIGHT_KINDS, KINDS
from env_door.trials import read_trials


class ExpertPolicy(torch.nn.Module):
    """Moves the first environments by the expert and lets the others stand."""

    def __init__(self, envs, directions):
        super().__init__()
        self.experts = [DoorExpert(env.unwrapped, tried) for env, tried in zip(envs, directions, strict=False)]

    def reset(self):
        self.is_planned = False

    def select_action(self, observation):
        actions = observation["observation.state"].clone()
        for index, expert in enumerate(self.experts):
            if not self.is_planned:
                expert.reset(np.random.default_rng(0))
            actions[index] = torch.from_numpy(expert.act())
        self.is_planned = True
        return actions


def unchanged(batch):
    return batch


def run(vector_env, directions, seeds):
    policy = ExpertPolicy(vector_env.envs, directions)
    return rollout(vector_env, policy, unchanged, unchanged, unchanged, unchanged, seeds=seeds)


@pytest.fixture
def make():
    """Makes the vector environments of a configuration by suite, and closes them after the test."""
    with contextlib.ExitStack() as made:

        def make(n_envs=1, use_async_envs=False, **fields):
            config = make_env_config("door", **fields)
            suites = {name: tasks[0] for name, tasks in make_env(config, n_envs, use_async_envs).items()}
            for env in suites.values():
                made.callback(env.close)
            return suites

        yield make


@pytest.mark.parametrize(("arm", "dimension"), [("ur5e", 7), ("panda", 8)])
def test_type_is_registered_with_its_features(arm, dimension):
    config = make_env_config("door", arm=arm)
    assert isinstance(config, DoorEnvConfig)
    assert (config.type, config.task, config.fps) == ("door", "all", 10)
    features = env_to_policy_features(config)
    assert {key: (feature.type, feature.shape) for key, feature in features.items()} == {
        "action": (FeatureType.ACTION, (dimension,)),
        "observation.state": (FeatureType.STATE, (dimension,)),
        "observation.images.front": (FeatureType.VISUAL, (3, 128, 128)),
    }


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("task", "open", "push, pull, slide, slide_right, push_ccw, .*, slide_right_ccw, random, all, eight"),
        ("task", None, "push, pull, slide, .*, random, all, eight"),
        ("task", "", "or several kinds such as push,pull"),
        ("task", "push,lift", "or several kinds such as push,pull"),
        ("task", "push,push", "or several kinds such as push,pull"),
        ("task", "push,random", "or several kinds such as push,pull"),
        ("fps", 30, "at least 10 and at most 10 Hz, got 30"),
        ("episode_length", 0, "at least 1 step, got 0"),
        ("arm", "ur10", "'ur5e', 'panda'"),
        ("door_offset", 0.06, "at least 0 and at most 0.05 m, got 0.06"),
        ("door_offset", -0.01, "at least 0 and"),
        ("door_offset", float("nan"), "at least 0 and"),
        ("start_variation", 0.06, "at most 0.05 m"),
        ("command_limit", 0.0, "at least 0.01"),
        ("command_limit", 1.1, "at most 1 rad"),
        ("hold_seconds", -0.1, "at least 0"),
        ("hold_seconds", 60.1, "at most 60 s"),
        ("max_parallel_tasks", 2, "must be 1"),
    ],
)
def test_bad_fields_are_refused(field, value, allowed):
    with pytest.raises(ParsingError, match=f"{field}.*{allowed}"):
        DoorEnvConfig(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("door_offset", 0.05),
        ("start_variation", 0.05),
        ("command_limit", 1.0),
        ("command_limit", 0.01),
        ("hold_seconds", 20),
    ],
)
def test_the_environment_takes_the_extremes_that_the_configuration_allows(make, field, value):
    assert make(task="push", **{field: value})["door_push"].get_attr(field) == (value,)


@pytest.mark.parametrize(
    ("task", "wanted"),
    [
        ("all", ["push", "pull", "slide"]),
        ("pull, push", ["pull", "push"]),
        ("slide", ["slide"]),
        ("push,slide_right_ccw", ["push", "slide_right_ccw"]),
        ("eight", [*EIGHT_KINDS]),
    ],
)
def test_each_kind_has_a_suite_of_its_own(make, task, wanted):
    suites = make(task=task)
    kinds = {name: env.reset(seed=0)[1]["door_kind"][0] for name, env in suites.items()}
    assert {env.get_attr("eight")[0] for env in suites.values()} == {not set(wanted) <= set(KINDS)}
    assert list(kinds.items()) == [(f"door_{kind}", kind) for kind in wanted]


def test_random_draws_kinds_by_the_seed(make):
    env = make(task="random")["door_random"]
    kinds = {env.reset(seed=seed, options={"lerobot_new_rollout": True})[1]["door_kind"][0] for seed in range(12)}
    assert kinds == {"push", "pull", "slide"}


def test_observations_and_time_limit(make):
    env = make(2, task="push", episode_length=3)["door_push"]
    observation, _ = env.reset(seed=[1, 2])
    batch = preprocess_observation(observation)
    assert batch["observation.images.front"].shape == (2, 3, 128, 128)
    assert batch["observation.state"].shape == (2, 7)
    assert env.call("task_description") == ("open the door",) * 2
    assert env.call("_max_episode_steps") == (3, 3)
    truncations = [env.step(observation["agent_pos"])[3].tolist() for _ in range(3)]
    assert truncations == [[False] * 2, [False] * 2, [True] * 2]


def test_rollout_of_lerobot_eval_sees_success_and_failure(tmp_path, make):
    log = tmp_path / "trials.jsonl"
    env = make(3, task="pull", episode_length=130, trial_log=str(log))["door_pull"]
    assert isinstance(env, gym.vector.SyncVectorEnv)
    # Straight away, after a wrong try, and not at all: only the last one runs into the time limit.
    evaluations = []
    for _ in range(2):  # a second roll-out must thaw the environments frozen by the first
        result = run(env, [("pull",), ("push", "pull")], seeds=[7, 8, 9])
        assert result["success"].any(dim=1).tolist() == [True, True, False]
        assert result["done"].all(dim=1).tolist() == [False] * 3
        assert result["reward"].sum(dim=1).tolist() == [1.0, 1.0, 0.0]
        assert result["action"].shape == (3, 130, 7)
        evaluations.append(sorted(read_trials(log), key=lambda trial: trial.seed))
        log.unlink()
    trials = evaluations[0]
    assert trials == evaluations[1]
    assert [(trial.seed, trial.door_kind, trial.attempts, trial.success) for trial in trials] == [
        (7, "pull", ("pull",), True),
        (8, "pull", ("push", "pull"), True),
        (9, "pull", (), False),
    ]
    assert trials[0].steps < trials[1].steps < trials[2].steps == 130
    # The steps of the log are those at which the roll-out was done.
    assert [int(done.int().argmax()) + 1 for done in result["done"]] == [trial.steps for trial in trials]


def test_rollout_of_lerobot_eval_logs_the_turns_that_the_knob_stopped(tmp_path, make):
    log = tmp_path / "trials.jsonl"
    env = make(2, task="pull_ccw", episode_length=130, trial_log=str(log))["door_pull_ccw"]
    result = run(env, [("pull", "pull_ccw")], seeds=[7, 8])
    assert result["success"].any(dim=1).tolist() == [True, False]
    opened, _ = sorted(read_trials(log), key=lambda trial: trial.seed)
    assert (opened.door_kind, opened.attempts) == ("pull_ccw", ("turn_cw", "pull_ccw"))
    assert (opened.first_try_wrong, opened.first_try) == (True, False)


def test_rollout_of_lerobot_eval_logs_the_hold(tmp_path, make):
    """One trial is held and opened, the other never begins to open: their infos must go into one batch."""
    log = tmp_path / "trials.jsonl"
    env = make(2, task="push", episode_length=120, hold_seconds=3.0, trial_log=str(log))["door_push"]
    run(env, [("push",)], seeds=[7, 8])
    opened, untouched = sorted(read_trials(log), key=lambda trial: trial.seed)
    assert opened.opened_after_hold
    assert 65 <= opened.held_at <= 75
    assert opened.held_at + 30 < opened.steps
    assert (untouched.held_at, untouched.tried_while_held, untouched.opened_after_hold) == (None, (), False)


@pytest.mark.slow
def test_asynchronous_environments_run_in_processes(tmp_path, make):
    log = tmp_path / "trials.jsonl"
    env = make(2, use_async_envs=True, task="slide", episode_length=2, trial_log=str(log))["door_slide"]
    observation, _ = env.reset(seed=[1, 2], options={"lerobot_new_rollout": True})
    for _ in range(4):
        observation = env.step(observation["agent_pos"])[0]
    assert sorted(trial.seed for trial in read_trials(log)) == [1, 2]
