import itertools
import math

import numpy as np
import pytest
import torch

from lerobot_ufrnn.demonstrations import Moments
from lerobot_ufrnn.networks import HiddenState
from lerobot_ufrnn.trail import LONGEST_TRAIL, TAKEN, Trail

NEAR, ALIKE, LEAD = 0.1, 0.5, 0.2


def moments_of(*paths, scenes=None, commands=None) -> Moments:
    """Moments of paths (L, 2); commands lead along the paths unless given."""
    joints = [torch.as_tensor(np.array(path)).float() for path in paths]
    lengths = torch.tensor([len(path) for path in joints])
    steps = [(path[1:] - path[:-1]).norm(dim=-1) for path in joints]
    if commands is None:
        commands = [path[[min(step + 2, len(path) - 1) for step in range(len(path))]] for path in joints]
    total = int(lengths.sum())
    half_steps = [torch.cat((step, step[-1:])) / 2 for step in steps]
    everywhere = torch.cat(joints)
    apart = [
        (torch.cdist(everywhere, path) - half).clamp(min=0).amin(1)
        for path, half in zip(joints, half_steps, strict=True)
    ]
    return Moments(
        joints=torch.cat(joints),
        features=torch.zeros(total, 1) if scenes is None else torch.as_tensor(np.concatenate(scenes)).float(),
        commands=torch.cat([torch.as_tensor(command).float() for command in commands]),
        before=HiddenState(*[torch.zeros(total, 1)] * 6),
        owner=torch.repeat_interleave(torch.arange(len(joints)), lengths),
        begin=lengths.cumsum(0) - lengths,
        end=lengths.cumsum(0) - 1,
        arc=torch.cat([torch.cat((torch.zeros(1), step.cumsum(0))) for step in steps]),
        half_step=torch.cat(half_steps),
        apart=torch.stack(apart, dim=1),
        dwell=torch.zeros(total),
        near=NEAR,
        alike=ALIKE,
        pace=0.1,
        lead=LEAD,
        spacing=0.1,
        stride=1,
    )


def trail_of(moments: Moments, joints, commands=None, scene: float = 0.0) -> Trail:
    trail = Trail(moments)
    for step, pose in enumerate(np.array(joints, dtype=np.float32)):
        asked = pose if commands is None else np.array(commands[step], dtype=np.float32)
        trail.append(torch.tensor([*pose, scene]), torch.tensor(asked))
    return trail


def line(start, end, number: int) -> np.ndarray:
    return np.linspace(start, end, number)


# ── Alignment ─────────────────────────────────────────────────────────


def best_alignments(moments: Moments, which: int, sensed: np.ndarray) -> list[float]:
    """Of all ways to align a trail with one demonstration, the cost of the best that ends at each of its moments.

    Each moment of the trail is aligned with one no earlier, and at most three later, than that of the one before.
    """
    begin, end = int(moments.begin[which]), int(moments.end[which])
    joints, features = moments.joints.double().numpy(), moments.features.double().numpy()
    half_step, best = moments.half_step.double().numpy(), [math.inf] * (end + 1 - begin)
    for start, *jumps in itertools.product(range(begin, end + 1), *[range(4)] * (len(sensed) - 1)):
        at = [start + sum(jumps[:step]) for step in range(len(sensed))]
        if at[-1] > end:
            continue
        cost = 0.2 * (start - begin) + 0.1 * sum(jump > 1 for jump in jumps)
        for moment, values in zip(at, sensed, strict=True):
            gap = max(np.linalg.norm(values[:2] - joints[moment]) - half_step[moment], 0) / NEAR
            look = np.linalg.norm(values[2:] - features[moment]) / ALIKE
            cost += min(gap**2, 100) + 0.1 * min(look**2, 20)
        best[at[-1] - begin] = min(best[at[-1] - begin], cost)
    return best


@pytest.mark.parametrize("seed", range(5))
def test_a_trail_is_aligned_as_the_best_of_all_alignments(seed):
    rng = np.random.default_rng(seed)
    paths = [rng.uniform(0, 0.6, (length, 2)) for length in (6, 1, 7)]
    paths[1] = np.repeat(paths[1], 2, axis=0)
    moments = moments_of(*paths, scenes=[rng.uniform(0, 2, (len(path), 1)) for path in paths])
    sensed = rng.uniform(0, 0.6, (5, 3))
    trail = Trail(moments)
    for values in sensed:
        trail.append(torch.tensor(values).float(), torch.zeros(2))
    best = [best_alignments(moments, which, sensed) for which in range(3)]
    expected = np.concatenate(best) - np.concatenate(best).min()
    np.testing.assert_allclose(trail.last.costs, expected, rtol=1e-4, atol=1e-4)
    phases = [int(moments.begin[which]) + int(np.argmin(costs)) for which, costs in enumerate(best)]
    assert trail.aligned().phases[-1].tolist() == phases


def test_a_trail_that_follows_a_demonstration_more_slowly_or_faster_keeps_up_with_it():
    path = line((0, 0), (3, 0), 31)
    moments = moments_of(path, line((0, 0), (0, 3), 31))
    for speed in (0.5, 1, 2):
        joints = [(0.1 * speed * step, 0) for step in range(12)]
        phases = trail_of(moments, joints).aligned().phases[:, 0].tolist()
        assert phases == pytest.approx([speed * step for step in range(12)], abs=1)


def test_an_arm_that_comes_back_is_aligned_with_the_second_visit():
    out_and_back = np.concatenate((line((0, 0), (1, 0), 11), line((0.9, 0), (0, 0), 10)))
    moments = moments_of(out_and_back, line((0, 0), (0, 3), 31))
    phases = trail_of(moments, out_and_back).aligned().phases[:, 0]
    np.testing.assert_allclose(phases, range(21), atol=1)


# ── Which way was followed? ───────────────────────────────────────────

TRUNK = line((0, 0), (0.9, 0), 10)
ENDS = ((2, 1), (2, 0), (2, -1))


@pytest.fixture
def fork() -> Moments:
    """Three ways from a fork at (1, 0), two demonstrations each."""
    return moments_of(*[np.concatenate((TRUNK, line((1, 0), end, 14))) for end in ENDS for _ in range(2)])


@pytest.mark.parametrize("way", range(3))
def test_commands_tell_the_way_where_nothing_moves(fork, way):
    """Held at the fork, the arm is asked along one way."""
    along = np.array(ENDS[way]) - np.array((1, 0))
    asked = np.array((1, 0)) + 0.2 * along / np.linalg.norm(along)
    joints = [*TRUNK, *[(1, 0)] * 40]
    trail = trail_of(fork, joints, [*(TRUNK + np.array((0.2, 0))), *[asked] * 40]).aligned()
    followed = trail.followed(9)
    assert followed.sum() == pytest.approx(1)
    assert followed[[2 * way, 2 * way + 1]].tolist() == pytest.approx([0.5, 0.5], abs=0.06)


def test_where_nothing_tells_all_ways_are_as_likely(fork):
    joints = [*TRUNK[:6], *[TRUNK[5]] * 15]
    followed = trail_of(fork, joints, np.array(joints) + np.array((0.2, 0))).aligned().followed(5)
    assert followed.tolist() == pytest.approx([1 / 6] * 6, abs=1e-3)


def test_what_was_sensed_tells_the_way(fork):
    joints = np.concatenate((TRUNK, line((1, 0), ENDS[2], 14)))
    trail = trail_of(fork, joints).aligned()
    assert trail.followed(9).tolist() == pytest.approx([0, 0, 0, 0, 0.5, 0.5], abs=0.02)
    # Only what passes a moment can have been followed since.
    assert trail.near(9).all()
    assert trail.near(22).tolist() == [False] * 4 + [True] * 2
    assert trail.followed(22).tolist() == pytest.approx([0, 0, 0, 0, 0.5, 0.5], abs=1e-3)


def test_the_demonstration_that_was_taken_over_is_more_likely(fork):
    joints = [*TRUNK[:6], *[TRUNK[5]] * 5]
    trail = trail_of(fork, joints, np.array(joints) + np.array((0.2, 0)))
    trail.take_back(7, 4)
    followed = trail.aligned().followed(7)
    assert (followed[4] / followed[0]).log() == pytest.approx(TAKEN, abs=1e-3)
    assert trail.aligned().followed(6)[4] == pytest.approx(1 / 6, abs=1e-3)  # it was taken over only later


# ── Back ──────────────────────────────────────────────────────────────


def test_what_was_taken_back_never_happened(fork):
    joints = np.concatenate((TRUNK, line((1, 0), ENDS[2], 14)))
    other = np.concatenate((TRUNK[:8], line((0.8, 0.1), ENDS[0], 6)))
    trail = trail_of(fork, joints)
    trail.take_back(7, 1)
    assert len(trail) == 8
    assert trail.taken == (1, 7)
    for pose in other[8:]:
        trail.append(torch.tensor([*pose, 0]).float(), torch.tensor(pose).float())
    ours, expected = trail.aligned(), trail_of(fork, other).aligned()
    for name in ("sensed", "commands", "gaps", "costs"):
        torch.testing.assert_close(getattr(ours, name), getattr(expected, name))


def test_the_way_back_leads_through_all_poses_and_does_not_let_go_of_what_is_held():
    """The second joint is a gripper: it closes to 0.5 on a thing, and squeezes by a command of 0.2 from then on."""
    moments = moments_of(line((0, 0.5), (1, 0.5), 11), line((0, 0.5), (-1, 0.5), 11))
    joints = [(0.0, 0.9), (0.0, 0.5), *line((0.1, 0.5), (0.5, 0.5), 5)]
    commands = [(0.0, 0.2), (0.1, 0.2), *line((0.2, 0.2), (0.6, 0.2), 5)]
    trail = trail_of(moments, joints, commands).aligned()
    back = trail.way_back(2)
    np.testing.assert_allclose([pose for pose, _ in back], [joints[step] for step in (5, 4, 3, 2)])
    np.testing.assert_allclose(
        [command for _, command in back], [(joints[step][0], 0.2) for step in (5, 4, 3, 2)], atol=1e-6
    )
    # Back beyond the grasp it opens again.
    np.testing.assert_allclose(trail.way_back(0)[-1][1], (0.0, 0.9))
    assert trail.way_back(6) == []


def test_a_way_is_entered_where_it_is_nearest_and_a_run_up_before(fork):
    trail = trail_of(fork, [*TRUNK[:9], (0.85, 0.1), (0.9, 0.15)]).aligned()  # drifts off from the ninth on
    assert trail.entry(10, 4, 0.0) == 8
    assert trail.entry(10, 4, 0.25) == 5
    assert trail.entry(10, 4, 9.0) == 0
    on = trail_of(fork, TRUNK).aligned()
    assert on.entry(9, 4, 0.0) == 9  # nothing is nearer than where it is on its way


def test_a_trail_forgets_what_is_longer_ago_than_its_length(fork):
    trail = trail_of(fork, TRUNK)
    trail.take_back(9, 3)
    for _ in range(LONGEST_TRAIL - 10 + 4):
        trail.append(torch.tensor([0.9, 0, 0]), torch.tensor([0.9, 0]))
    assert len(trail) == len(trail.aligned().sensed) == LONGEST_TRAIL
    assert trail.taken == (3, 5)
    assert trail.aligned().sensed[5, 0] == pytest.approx(0.9)
    assert trail.aligned().sensed[4, 0] == pytest.approx(0.8)
    for _ in range(9):
        trail.append(torch.tensor([0.9, 0, 0]), torch.tensor([0.9, 0]))
    assert trail.taken == (3, 0)
