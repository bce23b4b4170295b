"""What lerobot-eval and lerobot-train see."""

import numpy as np
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.scripts.lerobot_eval import rollout

from env_door.trials import Trial, first_of_each_kind, read_trials
from env_forks.configuration_forks import ForksEnvConfig
from env_forks.env import ForksEnv
from env_forks.tasks import TASKS


def suites(**fields):
    return {name: envs[0] for name, envs in make_env(make_env_config("forks", **fields), n_envs=2).items()}


def test_type_is_registered_with_its_features():
    config = make_env_config("forks")
    assert (config.type, config.task, config.fps) == ("forks", "three_ways", 10)
    shapes = {key: feature.shape for key, feature in env_to_policy_features(config).items()}
    assert shapes == {"action": (2,), "observation.state": (2,), "observation.images.front": (3, 64, 64)}


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("task", "four_ways", "--env.task must be one of three_ways, .*, all, or several .* got 'four_ways'"),
        ("task", None, "got None"),
        ("task", "lamp,lamp", "got 'lamp,lamp'"),
        ("fps", 30, "at least 10 and at most 10 Hz, got 30"),
        ("episode_length", 0, "at least 1 step, got 0"),
        ("render_size", 8, "at least 16 and at most 768 pixels, got 8"),
        ("max_parallel_tasks", 2, "must be 1, got 2"),
    ],
)
def test_bad_fields_are_refused(field, value, message):
    with pytest.raises(ParsingError, match=message):
        ForksEnvConfig(**{field: value})


@pytest.mark.parametrize("task", ["two_ways", "lamp, two_ways", "all"])
def test_each_way_has_a_suite_of_its_own(task):
    ways = {name: env.reset(seed=[0, 1])[1]["way"].tolist() for name, env in suites(task=task).items()}
    names = TASKS if task == "all" else task.split(", ")
    assert list(ways.items()) == [(f"{name}_{way}", [way] * 2) for name in names for way in TASKS[name].ways]


class GoesTo(torch.nn.Module):
    """A policy of scripted targets, one list for each environment."""

    def __init__(self, *targets):
        super().__init__()
        self.targets = torch.tensor(targets)

    def reset(self):
        self.step = 0

    def select_action(self, observation):
        assert observation["observation.images.front"].shape == (2, 3, 64, 64)
        self.step += 1
        return self.targets[:, min(self.step // 30, self.targets.shape[1] - 1)]


def test_rollout_of_lerobot_eval_sees_success_and_failure_and_logs_the_tries(tmp_path):
    log = tmp_path / "trials.jsonl"
    env = suites(task="three_ways", episode_length=150, trial_log=str(log))["three_ways_1"]
    fork, ends = (0.5, 0.4), [ForksEnv().task.tree.nodes[end] for end in ForksEnv().task.tree.ends]
    policy = GoesTo([fork, ends[1], ends[1], ends[1]], [fork, ends[0], fork, ends[2]])
    same = [lambda batch: batch] * 4
    result = rollout(env, policy, *same, seeds=[7, 8])
    assert result["success"].any(dim=1).tolist() == [True, False]
    opened, failed = read_trials(log)
    assert (opened.seed, opened.attempts, opened.success) == (7, ("three_ways_1",), True)
    tried = ("three_ways_0", "three_ways_2")
    assert failed == Trial(8, "three_ways_1", False, 150, tried, path=failed.path)
    assert len(failed.path) == 76
    assert np.linalg.norm(np.subtract(failed.path[-1], ends[2])) < np.linalg.norm(np.subtract(failed.path[0], ends[2]))
    assert (opened.first_try, failed.first_try_wrong) == (True, True)
    assert first_of_each_kind([failed, opened], 1) == [opened]
    assert preprocess_observation(env.reset(seed=[1, 2])[0])["observation.state"].shape == (2, 2)
    assert env.call("task_description") == ("find the way through",) * 2
