"""The tasks: what is hidden, what blocks, what opens."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import env_forks  # noqa: F401  registers the environment
from env_forks.demonstrator import Demonstrator
from env_forks.env import ForksEnv
from env_forks.tasks import FPS, TASKS

AMBIGUOUS = [name for name, task in TASKS.items() if len(task.ways) > 1 and not task.cue]
GATED = [name for name in AMBIGUOUS if not TASKS[name].lamp]


def plan(env, way, seed=0):
    """What a demonstrator commands who takes `way` for the right one."""
    env.reset(seed=seed, options={"way": way})
    demonstrator, targets = Demonstrator(env, np.random.default_rng(seed)), []
    while not demonstrator.has_arrived:
        targets.append(demonstrator.act())
    return targets + [targets[-1]] * 10


def play(env, way, targets, seed=0):
    """Observations, infos and whether the trial terminated."""
    steps = [(env.reset(seed=seed, options={"way": way}))]
    terminated = False
    for target in targets:
        observation, reward, terminated, truncated, info = env.step(target)
        assert (reward, truncated) == (float(info["is_success"]), False)
        steps.append((observation, info))
    observations, infos = zip(*steps, strict=True)
    return observations, infos, terminated


def there_and_back(targets):
    return [*targets, *targets[::-1]]


@pytest.mark.parametrize("name", TASKS)
def test_gymnasium_finds_nothing_to_complain_of(name, recwarn):
    made = gym.make("env_forks/Forks-v0", task=name)
    check_env(made.unwrapped)
    assert not [str(warning.message) for warning in recwarn]
    assert (made.spec.max_episode_steps, made.metadata["render_fps"]) == (300, FPS)
    made.reset(seed=0)
    assert made.render().shape == (256, 256, 3)


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_nothing_tells_the_way_before_a_gate_is_reached(name):
    env = ForksEnv(name)
    targets = plan(env, 0)
    seen = [play(env, way, targets)[:2] for way in env.task.ways]
    tried = min([step for step, info in enumerate(seen[1][1]) if info["attempts"]], default=len(targets))
    assert tried > 10
    for observations, infos in seen[1:]:
        assert infos[0]["way"] != 0
        # While its gate is being reached, the open way lets the disc on a little earlier than a shut one.
        for ours, theirs in zip(observations[: tried - 3], seen[0][0], strict=False):
            np.testing.assert_array_equal(ours["agent_pos"], theirs["agent_pos"])
            np.testing.assert_array_equal(ours["pixels"]["front"], theirs["pixels"]["front"])


@pytest.mark.parametrize("name", GATED)
def test_wrong_gates_block_and_the_right_one_gives_way(name):
    env = ForksEnv(name)
    for tried in env.task.ways:
        targets = plan(env, tried)
        targets = [targets[0]] * env.task.shut_steps + targets
        for way in (tried, tried - 1):
            _, infos, terminated = play(env, way % len(env.task.ways), targets)
            assert infos[-1]["attempts"] == (tried,)
            assert infos[-1]["is_success"] == terminated == (way == tried)
        if not env.task.back:
            gate, end = env.world.gates[tried], env.nodes[env.task.tree.ends[tried]]
            assert np.linalg.norm(env.world.position - end) > np.linalg.norm(gate - end) - env.task.play - 0.02


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_another_way_can_be_tried_after_a_wrong_one(name):
    env = ForksEnv(name)
    wrong, right = plan(env, 1), plan(env, 0)
    _, infos, terminated = play(env, 0, there_and_back(wrong) + [right[0]] * env.task.shut_steps + right)
    assert [attempt for attempt, _ in itertools.groupby(infos[-1]["attempts"])][-2:] == [1, 0]
    assert infos[-1]["is_success"]
    assert terminated


def test_where_a_colour_tells_the_way_a_wrong_try_ends_the_trial():
    env = ForksEnv("shown")
    first = [env.reset(seed=0, options={"way": way})[0]["pixels"]["front"] for way in env.task.ways]
    assert [tuple(picture[52, 16]) for picture in first] == [(240, 40, 40), (40, 240, 40), (40, 40, 240)]
    wrong, right = plan(env, 1), plan(env, 0)
    _, infos, terminated = play(env, 0, there_and_back(wrong) + right)
    assert terminated
    assert not any(info["is_success"] for info in infos)


def test_the_lamp_goes_on_at_the_end_of_the_right_way_only():
    env = ForksEnv("lamp")
    targets = plan(env, 1)
    lamps = [play(env, way, targets)[0][-1]["pixels"]["front"][52, 16].tolist() for way in (0, 1)]
    assert lamps == [[30, 30, 30], [250, 240, 60]]


@pytest.mark.parametrize(("short_by", "success"), [(0.07, True), (0.1, False)])
def test_out_and_back_may_turn_a_little_before_the_end(short_by, success):
    env = ForksEnv("out_and_back")
    env.reset(seed=0, options={"way": 1})
    start, fork, end = env.nodes[env.task.path(1)]
    turn = end + (fork - end) * short_by / np.linalg.norm(fork - end)
    _, infos, terminated = play(env, 1, [fork] * 25 + [turn] * 25 + [fork] * 25 + [start] * 25)
    assert infos[-1]["is_success"] == terminated == success


# A finger of radius 0.035 between walls cuts the corners at the fork, of 60 degrees, by 0.035 * (1 - sin(30 degrees)).
@pytest.mark.parametrize(("name", "tolerance"), [("slack", 0.0), ("blocks", 0.0175 + 0.003)])
def test_walls_keep_it_in_the_corridors_however_it_is_pulled(name, tolerance):
    env = ForksEnv(name)
    env.reset(seed=0, options={"way": 1})
    lines = np.concatenate([np.linspace(*env.nodes[[env.task.tree.parents[k], k]], 500) for k in range(1, 5)])
    rng, target = np.random.default_rng(0), env.nodes[1]
    for step in range(300):
        if step % 6 == 0:
            target = rng.uniform(0, 1, 2)
        env.step(target)
        assert np.linalg.norm(lines - env.world.position, axis=1).min() < env.task.play + 0.001 + tolerance


def test_the_gate_that_gives_way_later_blocks_at_first():
    env = ForksEnv("gives_way_later")
    targets = plan(env, 1)
    _, infos, _ = play(env, 1, targets + [targets[-1]] * 120)
    first = [info["is_success"] for info in infos].index(True)
    assert 120 < first < 130
    assert infos[-1]["attempts"] == (1,)


def test_observations_are_late_and_noisy_where_the_task_says_so():
    noisy, exact = ForksEnv("noise_and_delay"), ForksEnv("three_ways")
    targets = plan(exact, 0)
    late, true = (play(env, 0, targets)[0] for env in (noisy, exact))
    np.testing.assert_array_equal(late[20]["pixels"]["front"], true[18]["pixels"]["front"])
    errors = np.array([ours["agent_pos"] - theirs["agent_pos"] for ours, theirs in zip(late[2:], true, strict=False)])
    assert 0.003 < errors.std() < 0.005


def test_everything_is_shifted_as_a_whole_where_the_task_says_so():
    env = ForksEnv("moved")
    shifts = np.array([env.reset(seed=seed) and env.nodes - TASKS["moved"].tree.nodes for seed in range(60)])
    np.testing.assert_allclose(shifts, np.broadcast_to(shifts[:, :1], shifts.shape), atol=1e-12)
    assert 0.025 < np.abs(shifts).max() <= 0.03


@pytest.mark.parametrize("name", ["three_ways", "noise_and_delay", "blocks"])
def test_a_trial_depends_on_its_seed_and_on_nothing_else(name):
    env, other = ForksEnv(name), ForksEnv(name, way=2)
    targets = plan(env, 2)
    play(env, 1, targets, seed=4)
    ours, theirs = (play(each, 2, targets, seed=3)[0] for each in (env, other))
    for one, two in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one["agent_pos"], two["agent_pos"])
        np.testing.assert_array_equal(one["pixels"]["front"], two["pixels"]["front"])
    assert len({tuple(env.reset(seed=seed)[0]["agent_pos"]) for seed in range(5)}) == 5
    assert {env.reset(seed=seed)[1]["way"] for seed in range(20)} == {0, 1, 2}
    assert {other.reset(seed=seed)[1]["way"] for seed in range(5)} == {2}


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda: ForksEnv("four_ways"), "task must be one of three_ways, two_ways, .* got 'four_ways'"),
        (lambda: ForksEnv(way=3), "way must be from 0 to 2 in three_ways, got 3"),
        (lambda: ForksEnv(way="left"), "way must be from 0 to 2 in three_ways, got 'left'"),
        (lambda: ForksEnv(render_mode="human"), r"render_mode must be one of \['rgb_array'\], got 'human'"),
        (lambda: ForksEnv(render_size=8), "render_size must be at least 16 and at most 768 pixels, got 8"),
        (lambda: ForksEnv().reset(options={"way": -1}), "way must be from 0 to 2 in three_ways, got -1"),
        (lambda: ForksEnv().reset(options={"kind": 1}), r"options may hold way and demonstration, got \['kind'\] too"),
        (lambda: ForksEnv().step([0.5]), "An action must hold two finite numbers, got"),
        (lambda: ForksEnv().step([0.5, np.nan]), "An action must hold two finite numbers, got"),
        (lambda: ForksEnv().step([[0.5, 0.5]]), "An action must hold two finite numbers, got"),
    ],
)
def test_bad_input_is_refused(use, message):
    with pytest.raises(ValueError, match=message):
        use()
