import logging
import math

import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_policy
from oracle import Oracle
from small import batch_of, small_config, train
from small_network import FEATURES, JOINTS, is_close, network_config, small_model

from lerobot_ufrnn import demonstrations
from lerobot_ufrnn.demonstrations import Demonstrations, Moments
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy
from lerobot_ufrnn.networks import SHLSTM


def demonstrations_of(*paths, scenes=None, commands=None, fps: float = 10) -> Demonstrations:
    """Of paths (L, 2) and scenes (L, 1), by default always the same; commands (L, 2) are the paths unless given."""
    remembered = Demonstrations(2, 1, fps)
    for index, path in enumerate(paths):
        joints = torch.as_tensor(np.array(path)).float()
        scene = torch.zeros(len(joints), 1) if scenes is None else torch.as_tensor(scenes[index]).float()
        asked = joints if commands is None else torch.as_tensor(commands[index]).float()
        remembered.remember(index, torch.cat((joints, scene), -1), asked)
    return remembered


def moments_of(*paths, **kwargs) -> Moments | None:
    torch.manual_seed(0)
    return demonstrations_of(*paths, **kwargs).moments(SHLSTM(network_config(2, 1)))


def line(*corners, pace: float = 0.1) -> np.ndarray:
    """Points so far apart along straight lines from corner to corner."""
    corners = np.array(corners, dtype=float)
    arc = np.concatenate(([0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()))
    points = np.linspace(0, arc[-1], round(arc[-1] / pace) + 1)
    return np.stack([np.interp(points, arc, column) for column in corners.T], axis=1)


def y_of_two_ways(spread: float = 0.0) -> list[np.ndarray]:
    """Two demonstrations up and two down from a fork at (1, 0), the second of each `spread` to the side."""
    ways = [line((0, 0), (1, 0), (2, 1)), line((0, 0), (1, 0), (2, -1))]
    return [way + np.array((0, side)) for way in ways for side in (0, spread)]


# ── What is remembered ────────────────────────────────────────────────


def test_a_demonstration_is_remembered_once():
    remembered = demonstrations_of([[0, 0], [1, 0]], [[0, 0], [2, 0], [4, 0]])
    remembered.remember(1, torch.full((5, 3), 9.0), torch.full((5, 2), 9.0))
    assert remembered.lengths.tolist() == [2, 3]
    assert remembered.indices.tolist() == [0, 1]
    assert remembered.sensed[:, 0].tolist() == [0, 1, 0, 2, 4]
    assert remembered.commands[:, 0].tolist() == [0, 1, 0, 2, 4]


@pytest.mark.parametrize(("fps", "most"), [(10, 12), (30, 36)])
def test_demonstrations_too_many_are_left_out(fps, most, monkeypatch):
    monkeypatch.setattr(demonstrations, "MOST_MOMENTS", 12)
    remembered = demonstrations_of(*[np.zeros((9, 2))] * 9, fps=fps)
    assert len(remembered.sensed) <= most < len(remembered.sensed) + 9
    assert remembered.indices.tolist() == list(range(most // 9))


def test_any_number_of_demonstrations_loads_into_any_other():
    some, none = demonstrations_of(*y_of_two_ways(), fps=30), Demonstrations(2, 1)
    for saved in (some, none, demonstrations_of([[0, 1], [3, 4]])):
        for target in (demonstrations_of(*y_of_two_ways()[:2]), Demonstrations(2, 1)):
            target.load_state_dict(saved.state_dict())
            for name, values in saved.state_dict().items():
                assert torch.equal(target.state_dict()[name], values), name
            assert target.stride == saved.stride


def test_what_was_computed_is_forgotten_when_others_are_loaded_or_added():
    network = SHLSTM(network_config(2, 1))
    remembered = demonstrations_of(*y_of_two_ways())
    before = remembered.moments(network)
    assert remembered.moments(network) is before
    remembered.load_state_dict(demonstrations_of(*y_of_two_ways()[1:]).state_dict())
    assert remembered.moments(network).size == 3
    remembered.remember(9, torch.zeros(5, 3), torch.zeros(5, 2))
    assert remembered.moments(network).size == 4
    assert remembered.moments(SHLSTM(network_config(2, 1))) is not remembered.moments(network)


def test_training_remembers_each_demonstration_as_it_was_recorded_and_a_checkpoint_keeps_it(uneven_dataset, tmp_path):
    policy = make_policy(small_config(), ds_meta=uneven_dataset.meta)
    policy.eval().forward(batch_of(0))
    train(policy, [batch_of(0, 1)] * 2)  # the autoencoder: features are yet to come
    assert len(policy.demonstrations.lengths) == 0
    train(policy, [batch_of(2, 1), batch_of(1, 0)])
    policy.save_pretrained(tmp_path)
    for remembered in (policy.demonstrations, UFRNNPolicy.from_pretrained(tmp_path).demonstrations):
        assert remembered.indices.tolist() == [2, 1, 0]
        assert remembered.lengths.tolist() == [9, 12, 7]
        assert remembered.fps == 10
        for part, commands, index in zip(
            remembered.sensed.split([9, 12, 7]), remembered.commands.split([9, 12, 7]), (2, 1, 0), strict=True
        ):
            episode, scaler = policy.episodes[index], policy.joint_scaler
            torch.testing.assert_close(scaler.unscale(part[:, :3]), episode.states)
            torch.testing.assert_close(policy.image_encoder.scaler.unscale(part[:, 3:]), episode.features)
            torch.testing.assert_close(scaler.unscale(commands), episode.actions)


# ── Moments and their measures ────────────────────────────────────────


@pytest.mark.parametrize(("fps", "stride"), [(5, 1), (10, 1), (30, 3), (50, 5)])
def test_states_are_those_of_a_network_that_watches_each_demonstration(fps, stride):
    network = small_model().network
    remembered = Demonstrations(JOINTS, FEATURES, fps).double()
    rng = np.random.default_rng(0)
    watched = [0.01 * rng.standard_normal((length, JOINTS + FEATURES)) for length in (31, 43)]
    watched[0][:, 0] += np.linspace(0, 1, 31)
    watched[1][:, 0] -= np.linspace(0, 1, 43)
    for index, sensed in enumerate(watched):
        remembered.remember(index, torch.tensor(sensed), torch.zeros(len(sensed), JOINTS))
    moments, oracle, row = remembered.moments(network), Oracle(network), 0
    for index, sensed in enumerate(watched):
        state = [np.zeros(size) for size in network.state_sizes]
        for step, inputs in enumerate(sensed):
            if step % stride == 0:
                assert is_close(moments.before, state, row)
                np.testing.assert_array_equal(moments.joints[row], inputs[:JOINTS])
                np.testing.assert_array_equal(moments.features[row], inputs[JOINTS:])
                assert moments.owner[row] == index
                row += 1
            state = oracle.step(inputs, state)
    assert len(moments.joints) == row
    ends = np.cumsum([math.ceil(len(sensed) / stride) for sensed in watched])
    assert moments.begin.tolist() == [0, ends[0]]
    assert moments.end.tolist() == (ends - 1).tolist()


def test_pace_arc_and_half_step_are_those_of_the_path_without_rests():
    path = [[0, 0], [0.1, 0], [0.1, 0], [0.1, 0], [0.1, 0], [0.1, 0.1], [0.1, 0.4]]
    moments = moments_of(path, [[0, 0], [0.1, 0], [0.2, 0]])
    # Steps of 0.1, 0, 0, 0, 0.1, 0.3 and 0.1, 0.1: the median of those that move.
    assert moments.pace == pytest.approx(0.1)
    np.testing.assert_allclose(moments.arc[:7], [0, 0.1, 0.1, 0.1, 0.1, 0.2, 0.5], atol=1e-6)
    np.testing.assert_allclose(moments.half_step[:7], [0.05, 0, 0, 0, 0.05, 0.15, 0.15], atol=1e-6)


def test_near_is_how_far_demonstrations_pass_each_other_but_no_less_than_pace_and_no_more_than_a_part_of_their_extent():
    def near(spread: float) -> float:
        """Four parallel demonstrations 6 long, `spread` from one to the next, and a way to the other side."""
        paths = [line((0, spread * side), (6, spread * side)) for side in range(4)]
        return moments_of(*paths, *(path * (-1, 1) for path in paths)).near

    assert near(0.0) == pytest.approx(0.1)  # pace
    # To the third nearest: 3 for the outer ones, 2 for the inner ones; the third quartile is an outer one.
    assert near(0.05) == pytest.approx(0.15)
    # Where that is more than a twentieth of their extent, those farther off go another way: it is to the nearest.
    assert near(0.5) == pytest.approx(0.5)
    assert near(1.0) == pytest.approx(0.05 * math.hypot(12, 3))


def test_alike_is_twice_how_much_scenes_differ_from_the_most_alike_demonstration_that_passes():
    ways = [line((0, 0), (3, 0)), line((0, 0), (0, 3))]

    def alike(*values: float) -> float:
        scenes = [np.full((31, 1), value) for value in values]
        return moments_of(ways[0], ways[0], ways[1], ways[1], scenes=scenes).alike

    # Far from the beginning the only other one that passes differs by 0.2.
    assert alike(0.0, 0.2, 0.0, 0.2) == pytest.approx(0.4)
    # Where a colour tells the way, the other way's is not alike.
    assert alike(0.0, 0.1, 5.0, 5.1) == pytest.approx(0.2)
    changing = [np.arange(31)[:, None] * 0.3] * 2
    apart = moments_of(ways[0], ways[0] + 5, scenes=changing)
    assert apart.alike == pytest.approx(0.3)  # from one moment to the next
    assert 0 < moments_of(*ways).alike < 1e-3  # of a scene that never changes


def test_lead_is_how_far_commands_are_ahead_and_pulls_are_no_stronger():
    ways = [line((0, 0), (3, 0)), line((0, 0), (0, 3))]
    moments = moments_of(*ways, commands=[way + np.array((0.3, 0.4)) for way in ways])
    assert moments.lead == pytest.approx(0.5, abs=1e-6)
    joints, commands = torch.tensor([[1.0, 1.0]] * 3), torch.tensor([[1.0, 1.2], [1.0, 3.0], [-2.0, -3.0]])
    expected = [[0, 0.2], [0, 0.5], [-0.3, -0.4]]
    np.testing.assert_allclose(moments.pull(joints, commands), expected, atol=1e-6)


def test_dwell_is_for_how_long_a_demonstration_rests_and_looks_the_same():
    resting = np.concatenate((line((0, 0), (1, 0)), np.tile((1, 0), (9, 1)), line((1, 0), (2, 0))))
    scenes = np.zeros((len(resting), 1))
    scenes[15:] = 1.0  # something happens in mid-rest
    other = line((0, 0), (0, 2))
    moments = moments_of(resting, other, scenes=[scenes, np.zeros((len(other), 1))])
    assert 0.1 <= moments.near < 0.2
    dwell = moments.dwell[: len(resting)].numpy()
    assert dwell[5] == pytest.approx(0.3)  # itself and a neighbour to both sides
    assert dwell[12] == pytest.approx(0.6)  # from 9, a step before it rests, to 14, the last that looks like it
    assert dwell[17] == pytest.approx(0.7)  # from 15 to 21, a step after its rest
    assert np.isinf(dwell[-2:]).all()
    assert np.isfinite(dwell[:-2]).all()


def test_gap_is_the_distance_from_the_path_between_moments():
    moments = moments_of(line((0, 0), (3, 0)), line((0, 0), (0, 3)))
    gaps = moments.gap(torch.tensor([[1.04, 0.0], [1.0, 0.5]]))
    np.testing.assert_allclose(gaps[:, 10], [0, 0.45], atol=1e-6)
    nearest = [float(gaps[1, moments.owner == which].min()) for which in range(moments.size)]
    assert nearest == pytest.approx([0.45, 0.95], abs=1e-6)


@pytest.mark.parametrize("fps", [30, 50])
def test_a_demonstration_sampled_faster_gives_the_same_measures(fps):
    def measures(rate: float) -> Moments:
        times = np.arange(0, 4, 1 / rate)
        bends = [np.column_stack((times, bend * np.sin(times))) for bend in (1.0, 1.05, -1.0, -1.05)]
        scenes = [np.cos(2 * times)[:, None] + number / 50 for number in range(4)]
        commands = [np.column_stack((times + 0.2, bend * np.sin(times + 0.2))) for bend in (1.0, 1.05, -1.0, -1.05)]
        return moments_of(*bends, scenes=scenes, commands=commands, fps=rate)

    slow, fast = measures(10), measures(fps)
    for name in ("pace", "near", "alike", "lead"):
        assert getattr(fast, name) == pytest.approx(getattr(slow, name), rel=1e-3), name
    for name in ("owner", "begin", "end", "arc", "half_step", "dwell", "joints"):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), atol=1e-5, err_msg=name)


# ── Ways ──────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "paths",
    [
        [],
        [line((0, 0), (1, 0))],
        [line((0, 0), (1, 0)), line((0, 0.01), (1, 0.01)), line((-0.05, 0), (0.95, 0))],
        [np.zeros((5, 2))] * 3,
        [np.zeros((1, 2))] * 2,
    ],
    ids=["none", "one", "never parting", "not moving", "a moment each"],
)
def test_where_there_is_no_choice_there_are_no_moments_and_the_log_says_so_once(paths, caplog):
    remembered, network = demonstrations_of(*paths), SHLSTM(network_config(2, 1))
    with caplog.at_level(logging.INFO):
        assert remembered.moments(network) is None
        assert remembered.moments(network) is None
    assert len(caplog.records) == 1
    assert "nothing to choose between" in caplog.text


def test_a_demonstration_of_a_single_moment_among_others_does_no_harm():
    moments = moments_of(*y_of_two_ways(), [[0, 0]])
    assert moments.size == 5
    assert len(moments.half_step) == len(moments.joints)


@pytest.mark.parametrize("spread", [0.0, 0.04])
def test_demonstrations_of_a_y_go_the_same_way_up_to_the_fork_and_beside_their_like(spread):
    moments = moments_of(*y_of_two_ways(spread))
    assert moments.same_way(0, int(moments.begin[0]), 0.9).tolist() == pytest.approx([1] * 4, abs=0.01)
    same = moments.same_way(0, int(moments.begin[0]), math.inf)
    assert same[:2].tolist() == pytest.approx([1, 1], abs=0.01)
    assert same[2:].tolist() == pytest.approx([0, 0], abs=0.01)
    half = moments.begin + 5
    assert moments.same_way(2, int(half[2]), math.inf).tolist() == pytest.approx([0, 0, 1, 1], abs=0.01)


def test_a_demonstration_that_ends_early_goes_the_way_only_so_far():
    short, long, other = line((0, 0), (2, 0)), line((0, 0), (4, 0)), line((0, 0), (0, 4))
    moments = moments_of(short, long, other)
    assert moments.same_way(0, int(moments.begin[0]), 1.5)[1] == pytest.approx(1)
    assert moments.same_way(1, int(moments.begin[1]), math.inf)[0] == pytest.approx(0, abs=0.01)


def test_a_phase_difference_within_one_way_is_no_difference():
    early, late = line((0, 0), (3, 0)), np.concatenate((np.zeros((3, 2)), line((0, 0), (3, 0))))
    moments = moments_of(early, late, line((0, 0), (0, 3)))
    assert moments.same_way(0, int(moments.begin[0]) + 2, math.inf)[:2].tolist() == pytest.approx([1, 1])


def test_ways_of_a_y_have_parted_where_they_are_twice_as_far_as_near():
    moments = moments_of(*y_of_two_ways())
    begin = moments.begin
    # At 45 degrees to both sides: the distance from the other way is that from its path, less half a step.
    beyond = next(k for k in range(20) if 0.1 * k - 0.05 >= 2 * moments.near)
    assert abs(moments.parting(0, begin, [2, 3]) - (10 + beyond)) <= 1
    assert moments.parting(0, begin, [1]) == begin[0]  # they never part
    assert moments.parting(0, begin, []) == begin[0]
    assert moments.parting(2, begin, [1, 0]) - begin[2] == moments.parting(0, begin, [2])
    assert moments.parting(0, begin + 8, [2]) == moments.parting(0, begin, [2])


def test_demonstrations_that_contradict_themselves_crash_nothing():
    path, (up, _, down, _) = line((0, 0), (3, 0)), y_of_two_ways()
    assert moments_of(path, path, commands=[path + 0.2, path - 0.2]) is None  # they go the same way
    moments = moments_of(up, up, down, commands=[up + 0.2, up - 0.2, down])
    assert moments.same_way(0, int(moments.begin[0]), math.inf).tolist() == pytest.approx([1, 1, 0], abs=0.01)


@pytest.mark.xfail(reason="Ways are compared as sets of points, whatever the order in which they are passed.")
def test_a_circle_to_the_left_is_another_way_than_one_to_the_right():
    angles = np.linspace(0, 2 * np.pi, 60)
    left = np.column_stack((np.sin(angles), np.cos(angles) - 1))
    assert moments_of(left, left * (-1, 1)) is not None
