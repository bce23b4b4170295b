import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from env_door.env import HOLD_OPENING, DoorEnv
from env_door.expert import GRASP_CLOSURE, DoorExpert
from env_door.latch import EIGHT_KINDS, KINDS, KNOB_PLAY, OPENINGS, STOP_GIVE, TURNS


def plan(env, directions, seed):
    expert = DoorExpert(env, directions)
    expert.reset(np.random.default_rng(seed))
    return expert


def play(env, kind, seed, directions=("push",), num_steps=None):
    """Positions, observations and infos of one episode of the expert's, to the first try by default."""
    observation, info = env.reset(seed=seed, options={"kind": kind})
    expert = plan(env, directions, seed)
    trace = [(env.data.qpos.copy(), observation, info)]
    for _ in range(num_steps or expert.branch_step):
        observation, _, _, _, info = env.step(expert.act())
        trace.append((env.data.qpos.copy(), observation, info))
    return trace


def assert_identical(first, second):
    for (position, seen, info), (other_position, other_seen, other_info) in zip(first, second, strict=True):
        np.testing.assert_array_equal(position, other_position)
        np.testing.assert_array_equal(seen["agent_pos"], other_seen["agent_pos"])
        np.testing.assert_array_equal(seen["pixels"]["front"], other_seen["pixels"]["front"])
        assert info["opening"] == other_info["opening"]


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space.*")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("arm", "size"), [("ur5e", 7), ("panda", 8)])
def test_gymnasium_checker_finds_nothing(arm, size):
    made = gym.make("env_door/Door-v0", arm=arm)
    assert (made.spec.max_episode_steps, made.metadata["render_fps"]) == (300, 10)
    check_env(made.unwrapped)
    assert made.observation_space["agent_pos"].shape == made.action_space.shape == (size,)
    assert made.unwrapped.joint_names[-1] == "gripper"
    assert len(made.unwrapped.joint_names) == size
    made.close()


@pytest.mark.parametrize(("direction", "seed"), [("push", 0), ("push", 1), ("push_ccw", 0)])
def test_kinds_are_bit_identical_until_tried(eight, direction, seed):
    """The same seed and actions must give the same bits for every kind, through approach, grasp and twist.

    Kinds whose knob turns the other way are stopped in the twist, all alike; up to there nothing tells them either.
    """
    turn = OPENINGS[direction].turn
    right, wrong = [], []
    for kind in EIGHT_KINDS:
        turns_so = OPENINGS[kind].turn == turn
        (right if turns_so else wrong).append(play(eight, kind, seed, (direction,)))
        assert eight.latch.unlatched == turns_so, "the trace must go through the twist, or it proves little"
        assert eight.latch.attempts == (() if turns_so else (TURNS[turn],))
    for alike in (right, wrong):
        for other in alike[1:]:
            assert_identical(alike[0], other)
    knob = eight.model.joint("knob").qposadr[0]
    angles = [position[knob] for position, _, _ in wrong[0]]
    # Clockwise the stop comes after some play; counter-clockwise it gives way to 0.2 s of pressing.
    shared = sum(angle < KNOB_PLAY for angle in angles) if turn > 0 else sum(angle > -STOP_GIVE for angle in angles) + 1
    assert 40 < shared < len(angles) - 5
    assert_identical(right[0][:shared], wrong[0][:shared])


@pytest.mark.parametrize("direction", EIGHT_KINDS)
def test_the_other_kinds_stay_identical_during_a_wrong_try(eight, direction):
    """A door that does not open in a direction tells nothing about which other direction it opens in."""
    kinds = [kind for kind in EIGHT_KINDS if OPENINGS[kind].turn == OPENINGS[direction].turn and kind != direction]
    first, *others = (play(eight, kind, 5, (direction,), num_steps=75) for kind in kinds)
    assert first[-1][2]["attempts"] == (direction,)
    for other in others:
        assert_identical(first, other)


def test_kinds_part_once_tried(env):
    push, pull = (play(env, kind, 0, num_steps=85) for kind in ("push", "pull"))
    assert push[-1][2]["opening"] > 0.5
    assert pull[-1][2]["opening"] < 0.02
    difference = push[-1][1]["pixels"]["front"].astype(int) - pull[-1][1]["pixels"]["front"]
    assert (np.abs(difference).max(axis=-1) > 30).mean() > 0.02, "an opening door must be visible in the picture"


def test_episodes_leave_nothing_behind():
    """An episode after others, with the door freed and held, equals the same episode in a fresh environment."""
    used, fresh = DoorEnv(), DoorEnv()
    play(used, "pull", 1, ("pull",), num_steps=80)
    used.hold_door(5.0)
    play(used, "slide", 2, ("slide",), num_steps=70)
    play(used, "slide_right_ccw", 3, ("slide_right_ccw",), num_steps=75)
    assert_identical(play(used, "push", 7, num_steps=75), play(fresh, "push", 7, num_steps=75))
    used.close()
    fresh.close()


def test_seed_gives_same_start_for_every_kind_and_way_of_choosing_it(env):
    starts = []
    for options in ({"kind": "push"}, {"kind": "slide"}, {}, {"kind": "random"}):
        observation, _ = env.reset(seed=11, options=options)
        starts.append([*observation["agent_pos"], env.current_offset])
    np.testing.assert_array_equal(starts, starts[:1] * 4)
    observation, _ = env.reset(seed=11, options={"door_offset": -0.03})
    np.testing.assert_array_equal(observation["agent_pos"], starts[0][:-1])
    assert env.data.site("knob").xpos[1] == pytest.approx(-0.03)


@pytest.mark.parametrize(("eight", "wanted"), [(False, KINDS), (True, EIGHT_KINDS)])
def test_draws_reach_all_kinds_and_stay_in_their_ranges(eight, wanted):
    env = DoorEnv(door_offset=0.03, start_variation=0.02, eight=eight)
    kinds, starts, offsets = set(), [], []
    for seed in range(40):
        kinds.add(env.reset(seed=seed)[1]["door_kind"])
        starts.append(env.data.site("tool").xpos - [0.66 - 0.16, 0.0, 0.95])
        offsets.append(env.current_offset)
    assert kinds == set(wanted)
    assert 0.015 < np.abs(starts).max() <= 0.02 + 1e-4
    assert 0.02 < np.abs(offsets).max() <= 0.03
    env.close()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        # What it shares with the configuration of LeRobot is tested there, field by field.
        (lambda env: DoorEnv(kind="lift"), "`kind` must be one of .*'push'.*, got 'lift'"),
        (lambda env: DoorEnv(door_offset=0.06), "`door_offset` must be at least 0 and at most 0.05 m, got 0.06"),
        (lambda env: DoorEnv(render_mode="human"), "`render_mode`.*'rgb_array'"),
        (lambda env: DoorEnv(observation_size=4), "`observation_size`.*at least 16"),
        (lambda env: env.reset(options={"kind": "lift"}), "kind"),
        (lambda env: env.reset(options={"door_offset": -0.06}), "door_offset"),
        (lambda env: env.reset(options={"colour": "red"}), "colour.*'kind' and 'door_offset' are known"),
        (lambda env: env.step(np.zeros(6)), r"action has shape \(6,\)"),
        (lambda env: env.step(np.zeros((1, 7))), "action has shape"),
        (lambda env: env.step(np.full(7, np.nan)), "action .* not finite"),
        (lambda env: env.step(np.array([0, 0, 0, np.inf, 0, 0, 0])), "action .* not finite"),
        *((lambda env, seconds=seconds: env.hold_door(seconds), "seconds") for seconds in (-1.0, np.nan, np.inf)),
    ],
)
def test_bad_arguments_are_refused(env, act, message):
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        act(env)


@pytest.mark.parametrize(
    ("command_limit", "wanted", "allowed"),
    [
        (0.08, [1.0, -1.0, 0.01, 0, 0, 0, 1.0], [0.08, -0.08, 0.01, 0, 0, 0, 0.176]),
        (1.0, [0.9, 0, 0, 0, 0, 0, 0], [0.31416, 0, 0, 0, 0, 0, 0]),  # now by the speed of the joint
    ],
)
def test_targets_are_limited_as_on_a_real_controller(command_limit, wanted, allowed):
    env = DoorEnv(command_limit=command_limit)
    env.reset(seed=0)
    measured = env.measured_joints()
    np.testing.assert_allclose(env.limit_action(measured + wanted) - measured, allowed, atol=1e-9)
    env.close()


def test_free_arm_follows_its_target(env):
    env.reset(seed=0)
    target = env.measured_joints()
    for _ in range(10):
        target[:6] += 0.02
        observation, *_ = env.step(target.astype(np.float32))
    np.testing.assert_allclose(observation["agent_pos"][:6], target[:6], atol=0.005)


def test_success_ends_the_episode_but_not_the_simulation(env):
    env.reset(seed=0, options={"kind": "slide"})
    expert, successes = plan(env, ("slide",), 0), []
    for _ in range(125):
        _, reward, terminated, truncated, info = env.step(expert.act())
        assert not truncated
        assert terminated == info["is_success"] == (reward == 1.0)
        successes.append(terminated)
    assert 85 <= successes.index(True) <= 110
    assert all(successes[-5:])
    assert info["opening"] == pytest.approx(0.19 / OPENINGS["slide"].threshold, abs=0.05)


@pytest.mark.parametrize("kind", [*KINDS, "slide_right_ccw"])
def test_a_door_is_held_once_it_has_begun_to_open_in_every_trial(env, kind):
    """Whoever goes on as before opens it once it is let go; until it is held, nothing differs from any other trial."""
    holding = DoorEnv(door_offset=0.05, hold_seconds=3.0)
    play(holding, kind, 1, (kind,), num_steps=90)
    trace = play(holding, kind, 0, (kind,), num_steps=130)
    holding.close()
    infos = [info for _, _, info in trace]
    held = [step for step, info in enumerate(infos) if info["held"]]
    assert held == list(range(held[0], held[0] + 30))
    assert infos[held[0] - 1]["opening"] < HOLD_OPENING <= infos[held[0]]["opening"] < HOLD_OPENING + 0.1
    openings = [info["opening"] for info in infos[held[0] : held[-1] + 2]]
    assert np.ptp(openings) < 0.005
    assert not any(info["is_success"] for info in infos[: held[-1] + 2])
    assert infos[held[-1] + 5]["opening"] > openings[-1] + 0.1
    assert infos[-1]["is_success"]
    assert (infos[-1]["attempts"], infos[-1]["tried_while_held"]) == ((kind,), ())

    undisturbed = play(env, kind, 0, (kind,), num_steps=held[0])
    assert_identical(undisturbed, trace[: held[0] + 1])
    assert not any(info["held"] for _, _, info in undisturbed)


def test_a_push_at_a_held_pull_door_is_noted_and_the_door_opens_after_it():
    env = DoorEnv(hold_seconds=3.0)
    _, info = env.reset(seed=0, options={"kind": "pull"})
    expert = plan(env, ("pull",), 0)
    while not info["held"]:
        *_, info = env.step(expert.act())
    joints = env.measured_joints()
    position, rotation = env.kinematics.forward(joints[:-1])
    pushed = env.kinematics.solve(position + np.array([0.04, 0.0, 0.0]), rotation, joints[:-1])
    for _ in range(10):
        *_, info = env.step(np.append(pushed, GRASP_CLOSURE))
    assert info["held"]
    assert (info["attempts"], info["tried_while_held"]) == (("pull",), ("push",))
    for _ in range(60):
        *_, info = env.step(expert.act())
    env.close()
    assert info["is_success"]
    assert info["tried_while_held"] == ("push",)


def test_picture_is_drawn_only_when_something_moved(env, monkeypatch):
    env.reset(seed=0)
    env.render()
    drawn, renderer = [], env._renderer("view")
    draw = renderer.draw
    monkeypatch.setattr(renderer, "draw", lambda data: drawn.append(data.time) or draw(data))
    first = env.render()
    env.render()[:] = 0
    np.testing.assert_array_equal(first, env.render(), err_msg="the caller owns what it got")
    assert drawn == []

    target = env.measured_joints()
    target[0] += 0.05
    for count in (1, 2):
        env.step(target.astype(np.float32))
        moved = env.render()
        assert len(drawn) == count
    assert (moved != first).any()
    np.testing.assert_array_equal(moved, draw(env.data))
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), first)
    env.reset(seed=0, options={"door_offset": 0.04})
    assert (env.render() != first).any(), "the doorway is part of the picture"


def test_diverged_physics_is_told():
    env = DoorEnv()
    env.reset(seed=0)
    env.data.qvel[:] = 1e12
    with pytest.raises(RuntimeError, match="diverged"):
        env.step(env.measured_joints().astype(np.float32))
    env.reset(seed=0)
    env.step(env.measured_joints().astype(np.float32))
    env.close()
