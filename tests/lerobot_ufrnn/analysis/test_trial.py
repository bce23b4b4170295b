import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_policy
from small import JOINTS, batch_of, remember_ways, small_config, train

from lerobot_ufrnn.analysis.hidden_states import read_demonstrations, states_along
from lerobot_ufrnn.analysis.trial import Attempt, TrialHistory, run_trial


class Playback(gym.Env):
    """Shows a recorded episode whatever is commanded; the door is tried at some steps and open at the end.

    Tries at steps in `held` are tries at a held door.
    """

    joint_names = JOINTS

    def __init__(self, dataset, tries: dict[int, str], held: range = range(0)):
        self.frames = [dataset[index] for index in range(dataset.meta.episodes["length"][0])]
        self.tries = tries
        self.held = held

    def reset(self, *, seed=None, options=None):
        self.step_count, self.attempts, self.tried_while_held = 0, (), ()
        return self.observation(), self.info()

    def step(self, action):
        assert action.shape == (len(JOINTS),)
        tried = (self.tries[self.step_count],) if self.step_count in self.tries else ()
        if self.step_count in self.held:
            self.tried_while_held += tried
        else:
            self.attempts += tried
        self.step_count += 1
        done = self.step_count == len(self.frames)
        return None if done else self.observation(), 0.0, done, False, self.info()

    def observation(self):
        frame = self.frames[self.step_count]
        image = (frame["observation.images.front"].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
        return {"pixels": {"front": image}, "agent_pos": frame["observation.state"].numpy()}

    def render(self):
        return np.full((8, 8, 3), self.step_count, dtype=np.uint8)

    def info(self):
        return {
            "door_kind": "pull",
            "attempts": self.attempts,
            "held": self.step_count in self.held,
            "tried_while_held": self.tried_while_held,
            "is_success": self.step_count == len(self.frames),
        }


def trained(dataset, exploration: str, **overrides):
    torch.manual_seed(0)
    policy = make_policy(small_config(exploration=exploration, **overrides), ds_meta=dataset.meta)
    train(policy, [batch_of(0, 1, 2)] * 4)
    return policy.eval()


@pytest.mark.parametrize("exploration", ["none", "foresight"])
def test_a_trial_is_kept_step_by_step(dataset, exploration):
    policy = trained(dataset, exploration, recall={"enabled": False}, kernel="reference")
    history = run_trial(policy, Playback(dataset, {4: "push", 7: "pull"}), seed=0)
    assert history.attempts == [Attempt(4, "push"), Attempt(7, "pull")]
    assert (history.door_kind, history.first_try, history.success) == ("pull", 4, True)
    assert history.joint_names == JOINTS
    assert len(history.images) == len(history.joints) == len(history.variances) == len(history.states) == 12
    assert [imagined.step for imagined in history.imaginations] == (
        list(range(12)) if exploration == "foresight" else []
    )


def test_with_recall_what_is_imagined_is_kept_of_the_steps_at_which_it_went_back(dataset):
    policy = trained(dataset, "foresight", recall={"horizon": 0.9})
    door = Playback(dataset, {})
    door.frames = door.frames[:1] * 40  # it is held where it begins
    remember_ways(policy, door.frames[0]["observation.state"])
    history = run_trial(policy, door, seed=0)
    events = policy.recall.events[0]
    assert len(events) > 1
    assert [imagined.step for imagined in history.imaginations] == [event.step for event in events] == history.returns
    for imagined, event in zip(history.imaginations, events, strict=True):
        assert imagined.futures.mean.shape[:2] == (9, len(event.demonstrations))
        assert imagined.chosen == event.chosen
        assert imagined.ahead == 2 + event.moments_back
        np.testing.assert_array_equal(imagined.refuted, event.refuted)


@pytest.mark.parametrize("film", [False, True])
def test_a_hold_and_the_tries_meanwhile_are_kept_and_the_scene_before_the_first_step_and_after_each(dataset, film):
    door = Playback(dataset, {2: "pull", 5: "push", 9: "pull"}, held=range(4, 8))
    history = run_trial(trained(dataset, "none"), door, seed=0, film=film)
    assert history.held == [4, 5, 6, 7]
    assert history.attempts == [Attempt(2, "pull"), Attempt(5, "push"), Attempt(9, "pull")]
    assert [picture[0, 0, 0] for picture in history.film] == (list(range(13)) if film else [])


@pytest.mark.parametrize(
    ("attempts", "success", "first_try", "recovered", "outcome"),
    [
        ([], False, None, False, ("nothing", "not opened")),
        (["pull"], True, 0, False, ("pull", "opened")),
        (["push", "pull"], True, 0, True, ("push, pull", "opened")),
        (["push", "pull"], False, 0, False, ("push, pull", "not opened")),
    ],
)
def test_a_recovery_opens_a_door_after_a_wrong_try(attempts, success, first_try, recovered, outcome):
    tries = [Attempt(step, way) for step, way in enumerate(attempts)]
    history = TrialHistory("pull", (), attempts=tries, success=success)
    assert (history.first_try, history.recovered, history.outcome) == (first_try, recovered, outcome)


def test_reading_a_demonstration_and_living_it_lead_to_the_same_states(dataset):
    policy = trained(dataset, "none")
    history = run_trial(policy, Playback(dataset, {}), seed=0)
    read = states_along(policy, read_demonstrations(policy, dataset.root))
    assert len(read) == 3
    for name in history.states[0]._fields:
        lived = torch.cat([getattr(state, name) for state in history.states])
        np.testing.assert_allclose(getattr(read[0], name), lived, atol=1e-5)
