import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from env_door.demonstration import demonstrate, spread
from env_door.expert import DoorExpert
from env_door.kinematics import UnreachableError


def test_frames_hold_what_was_seen_and_what_was_done_then(env):
    run = demonstrate(env, "pull", 3, 100)
    observation, _ = env.reset(seed=3, options={"kind": "pull"})
    for step in range(run.success_step + 1):
        np.testing.assert_array_equal(run.states[step], observation["agent_pos"])
        np.testing.assert_array_equal(run.images[step], observation["pixels"]["front"])
        observation, _, terminated, _, _ = env.step(run.actions[step])
        assert terminated == (step == run.success_step)


@given(st.integers(0, 2**32), st.integers(3, 60))
def test_successive_seeds_spread_the_door_over_its_range(first, number):
    positions = np.sort([spread(seed) for seed in range(first, first + number)])
    gaps = np.diff(np.concatenate([[-1.0], positions, [1.0]]))
    assert gaps.min() >= 0
    # Evenly placed, they would be 2 / number apart. As many random ones leave a gap of about log(number) times that.
    assert gaps.max() < 2 * 2 / number


def test_the_door_stands_where_it_is_asked_to(env):
    demonstrate(env, "push", 0, 100, door_offset=-0.04)
    assert env.current_offset == -0.04


def test_too_few_steps_give_nothing_and_still_fewer_are_refused(env):
    branch = demonstrate(env, "slide", 0, 110).branch_step
    assert demonstrate(env, "slide", 0, branch + 5) is None
    with pytest.raises(ValueError, match=f"num_steps={branch} ends before the door is tried, at step {branch}"):
        demonstrate(env, "slide", 0, branch)


def test_door_out_of_reach_gives_nothing(env, monkeypatch):
    def fail(expert, rng):
        raise UnreachableError("too far")

    monkeypatch.setattr(DoorExpert, "reset", fail)
    assert demonstrate(env, "push", 0, 110) is None
