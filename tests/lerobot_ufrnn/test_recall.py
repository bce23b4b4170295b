"""The search alone: what the network would do is a stand-in's choice, and ways are lines in the plane."""

import itertools

import numpy as np
import pytest
import torch
from forking import Leaf, Robot, Search, demonstrate, leaves_below, path_to, walk
from small_network import network_config

from lerobot_ufrnn.foresight import UFRNN, uncertainty
from lerobot_ufrnn.recall import REFUTED, Recall
from lerobot_ufrnn.trail import LONGEST_TRAIL

THREE = [(0,), (1,), (2,)]


def search(leaves, wanted: Leaf, *robots: Robot, fps: float = 10, repeats: int = 2, **config) -> Search:
    return Search(demonstrate(leaves, fps, repeats), path_to(wanted, leaves), *robots, **config)


def random_tree(seed: int, depth: int, most: int) -> tuple[list[Leaf], Leaf]:
    """Its leaves, at most so many, and the one that the stand-in wants."""
    rng = np.random.default_rng(seed)
    trees = (leaves_below(rng, depth) for _ in itertools.count())
    leaves = next(leaves for leaves in trees if len(leaves) <= most)
    return leaves, leaves[rng.integers(len(leaves))]


def is_depth_first(order: list[Leaf]) -> bool:
    """Whether what is below each fork is tried in one go."""
    for depth in range(1, len(order[0])):
        forks = [leaf[:depth] for leaf in order]
        if sum(fork != other for fork, other in itertools.pairwise(forks)) != len(set(forks)) - 1:
            return False
    return True


# ── Every way is found ────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("seed", "depth", "most", "repeats"),
    [*((seed, 1, 5, 2 + seed % 2) for seed in range(6)), *((seed, 2, 8, 2 + seed) for seed in range(3)), (0, 3, 11, 3)],
)
def test_every_leaf_of_a_tree_is_tried_once_before_any_is_tried_again_depth_first(seed, depth, most, repeats):
    leaves, wanted = random_tree(seed, depth, most)
    robot = Robot(leaves, barred=leaves)
    search(leaves, wanted, robot, repeats=repeats).run(20 * len(leaves), tries=len(leaves))
    assert sorted(robot.tries) == sorted(leaves)
    assert robot.tries[0] == wanted
    assert is_depth_first(robot.tries)


@pytest.mark.parametrize(("seed", "depth", "most", "repeats"), [(0, 1, 5, 3), (1, 1, 5, 2), (2, 2, 6, 3)])
def test_every_leaf_is_reached_after_no_more_tries_than_it_takes_to_come_to_it(seed, depth, most, repeats):
    leaves, wanted = random_tree(seed, depth, most)
    tried = Robot(leaves, barred=leaves)
    search(leaves, wanted, tried, repeats=repeats).run(20 * len(leaves), tries=len(leaves))
    for number, leaf in enumerate(tried.tries):
        robot = Robot(leaves, barred=set(leaves) - {leaf})
        search(leaves, wanted, robot, repeats=repeats).run(20 * len(leaves))
        assert robot.arrived == leaf
        assert robot.tries == tried.tries[:number]


def test_a_way_that_is_barred_for_a_while_is_found_later():
    robot = Robot(THREE, barred=THREE)
    searching = search(THREE, (1,), robot).run(60, tries=4)  # all, and one of them again
    robot.barred.remove((0,))
    searching.run(60)
    assert robot.arrived == (0,)


@pytest.mark.parametrize("fps", [30, 50])
def test_a_search_takes_as_many_tries_and_seconds_at_any_rate(fps):
    def at(rate: float) -> tuple[Robot, float]:
        robot = Robot(THREE, barred=[(1,), (2,)], fps=rate)
        searching = search(THREE, (1,), robot, fps=rate).run(60)
        return robot, searching.recall.events[0][-1].step / rate

    (slow, seconds), (fast, same_seconds) = at(10), at(fps)
    assert slow.arrived == fast.arrived == (0,)
    assert len(fast.tries) == len(slow.tries)
    assert same_seconds == pytest.approx(seconds, rel=0.2)


# ── It does no harm ───────────────────────────────────────────────────


@pytest.mark.parametrize("wanted", THREE)
def test_where_nothing_contradicts_it_never_goes_back(wanted):
    robot = Robot(THREE)
    searching = search(THREE, wanted, robot).run(20)
    assert robot.arrived == wanted
    assert searching.run(5).recall.events == [[]]


@pytest.mark.parametrize(("beyond", "goes_back"), [(0.1, False), (2.0, True)])
def test_at_the_end_of_a_demonstration_it_may_rest_but_not_far_beyond(beyond, goes_back):
    robot = Robot(THREE)
    searching = search(THREE, (1,), robot).run(2)
    robot.position, robot.held = robot.paths[(1,)][-1] + np.array((beyond, 0)), True
    robot.paths = {}  # not arrived: nothing tells it that it is done
    searching.run(5)
    assert any(searching.recall.events) == goes_back


def test_where_there_is_a_single_way_it_never_goes_back():
    robot = Robot([(0,)], barred=[(0,)])
    searching = search([(0,)], (0,), robot, repeats=4).run(20)
    assert robot.tries == [(0,)]
    assert searching.recall.events == []


@pytest.mark.parametrize("repeats", [2, 3])
@pytest.mark.parametrize("seconds", [2, 6])
def test_a_surprise_before_the_fork_refutes_no_way(seconds, repeats):
    undisturbed, held = (Robot(THREE, barred=THREE) for _ in range(2))
    search(THREE, (1,), undisturbed, repeats=repeats).run(60, tries=3)
    searching = search(THREE, (1,), held, repeats=repeats).run(0.5)
    held.held = True
    searching.run(seconds)
    held.held = False
    assert all((event.refuted < REFUTED).all() for event in searching.recall.events[0])
    searching.run(60, tries=3)
    assert sorted(held.tries) == THREE
    assert held.tries[0] == undisturbed.tries[0]


# ── Episodes ──────────────────────────────────────────────────────────


def test_episodes_of_a_batch_do_not_influence_each_other():
    barred = [(0,), (1,)], [(1,), (2,)]
    together, alone = ([Robot(THREE, some) for some in barred] for _ in range(2))
    both = search(THREE, (1,), *together).run(40)
    for row, robot in enumerate(alone):
        single = search(THREE, (1,), robot).run(40)
        assert robot.arrived == together[row].arrived
        assert robot.tries == together[row].tries
        steps = [event.step for event in single.recall.events[0]]
        assert [event.step for event in both.recall.events[row]][: len(steps)] == steps


def test_reset_forgets_the_episode():
    def tries_of(searching: Search) -> list[Leaf]:
        searching.robots = (Robot(THREE, barred=THREE),)
        searching.begin()
        return searching.run(60, tries=3).robots[0].tries

    searching = search(THREE, (1,), Robot(THREE))
    first = tries_of(searching)
    searching.recall.reset()
    assert searching.recall.events == []
    assert tries_of(searching) == first


def test_an_episode_remembers_no_more_however_long_it_is(monkeypatch):
    monkeypatch.setattr("lerobot_ufrnn.trail.LONGEST_TRAIL", 40)
    robot = Robot(THREE, barred=THREE)
    searching = search(THREE, (1,), robot)
    lengths = []
    for _ in range(60):
        searching.run(1.5)
        (episode,) = searching.recall._episodes
        lengths.append(len(episode.trail))
        assert len(episode.strangeness) <= LONGEST_TRAIL
        assert len(episode.failed_entries) <= 6
    assert max(lengths) <= 40
    assert len(robot.tries) > 6  # and it goes on trying


# ── Which candidate is kept ───────────────────────────────────────────


def start_of(demonstrations, wanted: int) -> torch.Tensor:
    return demonstrations.sensed.split(demonstrations.lengths.tolist())[wanted][0, :2]


@pytest.mark.parametrize("surest", [0, 1, 4, 5])
def test_of_candidates_refuted_least_the_one_whose_variance_falls_most_is_kept(surest):
    """With ways 0 and 2 open, it is the future of one demonstration of them that is the surest."""
    demonstrations = demonstrate(THREE, noise=1e-3)
    start = start_of(demonstrations, surest)

    def unsure_of_start(first: torch.Tensor) -> torch.Tensor:
        return ((first - start).norm(dim=-1, keepdim=True) > 1e-6).float()

    for exploration in ("foresight", "noise", "none"):
        robot = Robot(THREE, barred=[(1,)])
        run = Search(
            demonstrations, path_to((1,), THREE), robot, unsure_of_start=unsure_of_start, exploration=exploration
        ).run(40)
        event = run.recall.events[0][0]
        kept = event.demonstrations[event.chosen]
        # The baselines take the first of those refuted least, whatever their variance.
        assert kept == (surest if exploration == "foresight" else 0)
        assert robot.arrived == (kept // 2,)


def test_futures_are_kept_on_demand_and_are_those_that_the_network_imagines():
    torch.manual_seed(0)
    demonstrations = demonstrate(THREE)
    model = UFRNN(network_config(2, 1)).requires_grad_(False)
    config = network_config(2, 1, recall={"horizon": 0.7})
    for keep in (False, True):
        recall = Recall(model, config, demonstrations)
        recall.keep_futures = keep
        memory = model.initial_memory(1)
        to_the_gate = walk(path_to((1,), THREE)[:-1], 10)
        for position in itertools.chain(to_the_gate, itertools.repeat(to_the_gate[-1], 50)):
            memory, trace = recall.advance(torch.tensor([[*position, 0.0]]).float(), memory)
            assert trace is None
        event = recall.events[0][0]
        if keep:
            unsure = uncertainty(event.futures.log_variance[-1], 2, config.foresight.variance_aggregation)
            assert event.futures.mean.shape == (7, len(event.demonstrations), 3)
            least = (4 * event.refuted).round() == (4 * event.refuted).round().min()
            assert event.chosen == int(unsure.where(least, torch.inf).argmin())
        else:
            assert event.futures is None
