"""The scripted operator: played by its teleoperator, its events lead the tool along the path and open doors."""

from dataclasses import replace

import numpy as np
import pytest
import teleoperators_fakes as fakes
from scipy.spatial.transform import Rotation
from scripted_operator import TELEOPERATOR, ToolPath, events_along, plan
from twin import write_events

from env_door.env import DoorEnv
from lerobot_ufrnn.teleoperators import SpaceMouseTwist, twist_teleoperator

KINDS = ("push", "pull", "slide")


def path_of(joints, closures=None) -> ToolPath:
    """The path of the tool through joint angles, by the published Denavit-Hartenberg table."""
    joints = np.array(joints)
    positions, rotations = zip(*map(fakes.tool_pose, joints), strict=True)
    closures = np.zeros(len(joints)) if closures is None else np.array(closures, dtype=np.float64)
    return ToolPath(np.array(positions), Rotation.concatenate(rotations), closures, joints)


def wander(steps=40, size=0.4) -> np.ndarray:
    """Joint angles on a smooth way from one rest to another, all joints at once."""
    ease = (1 - np.cos(np.linspace(0, np.pi, steps + 1)))[:, None] / 2
    return fakes.READY + ease * size * np.array([0.5, -0.4, 0.6, 0.3, -0.5, 1.0])


def seconds(events) -> float:
    return sum(event.seconds for event in events)


@pytest.fixture
def play(monkeypatch, tmp_path):
    """Plays events with the teleoperator that they are for, on an arm and at times that the test chooses."""

    def play(events, arm, ticks, follow):
        clock = fakes.Clock()
        monkeypatch.setattr(twist_teleoperator, "ArmState", lambda *_: arm)
        monkeypatch.setattr(twist_teleoperator, "monotonic", clock)
        write_events(events, tmp_path / "events.jsonl")
        teleop = SpaceMouseTwist(replace(TELEOPERATOR, device=tmp_path / "events.jsonl", calibration_dir=tmp_path))
        teleop.connect()
        actions = []
        for tick in ticks:
            actions.append(np.array(list(teleop.get_action().values())))
            follow(actions[-1])
            clock.now += tick
        teleop.disconnect()
        return np.array(actions)

    return play


@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.1])
def test_played_by_the_teleoperator_the_tool_comes_to_the_end_of_its_path(play, jitter):
    joints = np.concatenate([wander(), np.repeat(wander()[-1:], 8, axis=0)])
    path = path_of(joints, [0.0] * 41 + list(np.linspace(0.1, 0.8, 8)))
    events = events_along(path)
    ticks = 0.1 + np.random.default_rng(0).uniform(0, jitter, round(seconds(events) / 0.1) + 5)
    arm = fakes.FakeArmState()
    before = [arm.measured]

    def trail(action):  # by one action
        arm.measured = before[-1]
        before.append(action[:6])

    actions = play(events, arm, ticks, trail)
    np.testing.assert_array_equal(actions[0], [*fakes.READY, 0.0])
    position, rotation = fakes.tool_pose(actions[-1, :6])
    np.testing.assert_allclose(position, path.positions[-1], atol=1e-4 if jitter == 0 else 2e-3)
    assert (rotation * path.rotations[-1].inv()).magnitude() < (1e-3 if jitter == 0 else 0.01)
    assert actions[-1, 6] == pytest.approx(0.8, abs=1e-6 if jitter == 0 else 0.1 + jitter)


def test_a_path_that_moves_tool_and_gripper_at_once_is_refused():
    with pytest.raises(ValueError, match="Step 0 of the path moves tool and gripper at once"):
        events_along(path_of(wander()[[0, 9]], [0.0, 0.5]))


@pytest.fixture(scope="module")
def door() -> DoorEnv:
    return DoorEnv(arm="ur5e")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_the_events_open_the_simulated_door(play, door, kind, jitter):
    events = events_along(plan(door, kind, seed=1))
    door.reset(seed=1, options={"kind": kind})
    arm = fakes.FakeArmState(door.measured_joints()[:-1])

    def follow(action):
        door.advance(action)
        arm.measured = door.measured_joints()[:-1]

    # The physics takes steps of 0.1 s; an action that is late finds the arm where it was by then.
    ticks = 0.1 + np.random.default_rng(2).uniform(0, jitter, round(15 / (0.1 + jitter / 2)))
    assert seconds(events) < 15
    play(events, arm, ticks, follow)
    assert door.latch.is_open
    assert door.latch.attempts == (kind,)
