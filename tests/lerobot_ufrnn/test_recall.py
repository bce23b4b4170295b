"""A world that obeys the network's own predictions until it contradicts them by as much as a test asks for."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from oracle import Oracle
from small_network import (
    FEATURES,
    JOINTS,
    in_closed_loop,
    is_close,
    is_equal,
    network_config,
    row_of,
    small_model,
)

from lerobot_ufrnn import recall as recall_module
from lerobot_ufrnn.foresight import UFRNN, Memory
from lerobot_ufrnn.kernels.unroll import FastUFRNN
from lerobot_ufrnn.networks import HiddenState, Prediction
from lerobot_ufrnn.recall import (
    DEVIATION_STEPS,
    FIRST_STEPS,
    LONGEST_RETURN,
    LONGEST_TRAIL,
    PATIENCE,
    REFUTED,
    REST_STEPS,
    SOON,
    STALLED,
    Alternatives,
    Recall,
    surprise,
)

# With a surprise of 6 at each step, the running surprise is 3, which is above half the threshold, and then 4.5.
THRESHOLD, CONTRADICTION, STEPS_TO_FIRE = 4.0, 6.0, 2
SAMPLES, HORIZON, COMMITMENT, CALM_STEPS = 5, 24, 12, 10
ANCHOR, FIRED = CALM_STEPS - 1, CALM_STEPS + STEPS_TO_FIRE - 1
UNTIL_BLOCKED = 1 + FIRST_STEPS + PATIENCE + 1
"""Steps after which an arm that does not move is known to be blocked."""


class NeverRests:
    def detects(self, joints):
        return False


def make_recall(kernel=UFRNN, exploration="foresight", rest=None, **overrides) -> Recall:
    """Recall of a small network, whose futures are all alike unless a test asks for noise."""
    settings = {
        "surprise_threshold": THRESHOLD,
        "num_samples": SAMPLES,
        "noise_range": (0.0, 0.0),
        "horizon": HORIZON,
        "commitment": COMMITMENT,
    }
    config = network_config(exploration=exploration, recall={**settings, **overrides})
    return Recall(small_model(kernel, exploration=exploration), config, rest or NeverRests())


def sensed(
    prediction: Prediction, before: torch.Tensor | None, contradiction: float, share: float, exact: bool = True
) -> torch.Tensor:
    """Sensor values that surprise by as much as given, while the arm makes a share of the movement foreseen.

    What is missing to the surprise it does sideways; only where the movement alone surprises by more it cannot be
    `exact`. Without surprise all is as predicted.
    """
    if contradiction == 0:
        return prediction.mean.clone()
    mean, variance = prediction.mean[0, :JOINTS].numpy(), prediction.log_variance[0, :JOINTS].exp().numpy()
    movement = np.zeros(JOINTS) if before is None else mean - before.numpy()
    missing = (share - 1) * movement
    sideways = np.cross(movement, (1.0, 0.0, 0.0)) if movement.any() else np.ones(JOINTS)
    # mean((missing + amount * sideways)^2 / variance) = contradiction
    a, b, c = ((x * y / variance).mean() for x, y in ((sideways, sideways), (sideways, missing), (missing, missing)))
    inside = b * b - a * (c - contradiction)
    assert not exact or inside >= 0
    amount = (max(inside, 0.0) ** 0.5 - b) / a
    inputs = prediction.mean.clone()
    inputs[0, :JOINTS] = torch.from_numpy(mean + missing + amount * sideways)
    return inputs


@dataclass
class World:
    """An episode that goes on, with all memories so far."""

    recall: Recall
    generator: torch.Generator | None = None
    memories: list[Memory] = field(default_factory=list)
    inputs: list[torch.Tensor] = field(default_factory=list)

    def __post_init__(self):
        self.now = self.recall.model.initial_memory(1)

    @property
    def before(self) -> torch.Tensor | None:
        return self.inputs[-1][0, :JOINTS] if self.inputs else None

    def step(self, contradiction: float = 0.0, share: float = 0.1, off: float = 0.0, exact: bool = True) -> Memory:
        """One step; the image features are `off` from what was predicted."""
        inputs = sensed(self.now.prediction, self.before, contradiction, share, exact)
        inputs[:, JOINTS:] += off
        return self.sense(inputs)

    def stand(self) -> Memory:
        """One step in which the arm stays where it is."""
        inputs = self.now.prediction.mean.clone()
        inputs[:, :JOINTS] = self.inputs[-1][:, :JOINTS]
        return self.sense(inputs)

    def sense(self, inputs: torch.Tensor) -> Memory:
        self.now, _ = self.recall.advance(inputs, self.now, self.generator)
        self.inputs.append(inputs)
        self.memories.append(self.now)
        return self.now

    def steps(self, count: int, contradiction: float = 0.0, share: float = 0.1) -> None:
        for _ in range(count):
            self.step(contradiction, share)

    def surprise(self) -> None:
        self.steps(STEPS_TO_FIRE, CONTRADICTION)

    def is_blocked(self) -> None:
        """The arm stands still until recall goes back once more."""
        before = len(self.events)
        for _ in range(UNTIL_BLOCKED):
            assert len(self.events) == before
            self.stand()
        assert len(self.events) == before + 1

    def finish(self) -> None:
        """The arm is back at once and follows the future to its last state."""
        self.steps(1 + COMMITMENT)

    def state(self, step: int) -> list[np.ndarray]:
        return row_of(self.memories[step].state)

    @property
    def network(self):
        return self.recall.model.network

    @property
    def events(self):
        return self.recall.events[0]


def surprised_world(**overrides) -> World:
    """Calm steps 0 to 9, then a contradiction, by which recall goes back at step 11."""
    world = World(make_recall(**overrides), torch.Generator().manual_seed(0))
    world.recall.keep_futures = True
    world.steps(CALM_STEPS)
    world.surprise()
    return world


def undisturbed(world: World) -> list[np.ndarray]:
    """What begins at the anchor without noise, by the oracle."""
    return in_closed_loop(world.network, world.state(ANCHOR), DEVIATION_STEPS)[-1]


# ── Surprise ──────────────────────────────────────────────────────────


def test_surprise_is_the_mean_squared_error_in_units_of_the_variance():
    rng = np.random.default_rng(0)
    mean, variance = rng.normal(size=(4, 5)), rng.uniform(0.1, 2, (4, 5))
    joints = rng.normal(size=(4, 3))
    nothing = torch.empty(4, 0)
    found = surprise(
        torch.from_numpy(joints),
        Prediction(torch.from_numpy(mean), torch.from_numpy(np.log(variance)), nothing, nothing),
    )
    expected = [sum((joints[row, i] - mean[row, i]) ** 2 / variance[row, i] for i in range(3)) / 3 for row in range(4)]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)


def test_surprise_is_one_on_average_where_the_prediction_is_right_about_its_errors():
    generator = torch.Generator().manual_seed(0)
    mean, log_variance = (torch.randn(5, generator=generator).expand(20000, -1) for _ in range(2))
    samples = mean + (0.5 * log_variance).exp() * torch.randn(20000, 5, generator=generator)
    nothing = torch.empty(20000, 0)
    found = surprise(samples[:, :3], Prediction(mean, log_variance, nothing, nothing))
    assert found.mean().item() == pytest.approx(1, abs=0.02)  # 2 % are six standard errors


@pytest.mark.parametrize("kernel", [UFRNN, FastUFRNN])
@pytest.mark.parametrize("exploration", ["foresight", "noise", "none"])
def test_who_is_never_surprised_steps_as_a_model_without_exploration(kernel, exploration):
    recall = make_recall(kernel, exploration, surprise_threshold=1e30, noise_range=(0.2, 1.5))
    plain = small_model(kernel)
    memory = expected = plain.initial_memory(2)
    for inputs in torch.rand(40, 2, JOINTS + FEATURES, dtype=torch.float64):
        memory, _ = recall.advance(inputs, memory)
        expected, _ = plain.advance(inputs, expected)
        assert is_equal(memory.state, expected.state)
        for ours, theirs in zip(memory.prediction, expected.prediction, strict=True):
            assert torch.equal(ours, theirs)
    assert recall.events == [[], []]


@pytest.mark.parametrize(
    ("contradictions", "fires"),
    [
        ((2 * THRESHOLD - 0.01,), False),  # half of each step counts
        ((2 * THRESHOLD + 0.01,), True),
        ((4.0, 5.99), False),  # 4 / 4 + 5.99 / 2
        ((4.0, 6.01), True),
        ((6.0, 0.0, 6.4), False),  # 6 / 8 + 0 + 6.4 / 2
        ((6.0, 0.0, 6.6), True),
    ],
)
def test_the_running_surprise_must_pass_the_threshold_and_not_only_one_step(contradictions, fires):
    world = World(make_recall())
    world.steps(CALM_STEPS)
    for contradiction in contradictions:
        assert not world.events
        world.step(contradiction)
    world.steps(CALM_STEPS)
    assert len(world.events) == fires


@pytest.mark.parametrize(("share", "fires"), [(STALLED + 0.01, False), (STALLED - 0.01, True)])
def test_an_arm_that_lags_is_no_surprise_as_long_as_it_makes_enough_of_the_movement(share, fires):
    world = World(make_recall())
    world.steps(CALM_STEPS)
    for _ in range(20):
        world.step(100.0, share)
        if world.events:
            break
    assert bool(world.events) == fires


def test_it_does_not_go_back_before_there_is_anywhere_to_go():
    world = World(make_recall())
    world.step(2 * THRESHOLD + 0.01, exact=False)
    assert not world.events
    world.step(2 * THRESHOLD + 0.01, exact=False)
    assert [(event.step, event.steps_back) for event in world.events] == [(1, 1)]


class StandsStill:
    """Calls it a rest if no joint has moved at all."""

    def detects(self, joints):
        assert joints.shape == (REST_STEPS + 1, JOINTS)
        return bool((joints == joints[0]).all())


def resting_world(**overrides) -> World:
    """Nothing surprises, but the arm stands still after `CALM_STEPS` until recall goes back."""
    world = World(make_recall(surprise_threshold=1e30, rest=StandsStill(), **overrides), torch.Generator())
    world.steps(CALM_STEPS)
    for _ in range(REST_STEPS):
        assert not world.events
        world.stand()
    return world


@pytest.mark.parametrize("kernel", [UFRNN, FastUFRNN])
def test_it_goes_back_by_a_step_from_a_rest_although_nothing_surprises(kernel):
    world = resting_world(kernel=kernel)
    last = CALM_STEPS + REST_STEPS - 1
    assert [(event.step, event.steps_back) for event in world.events] == [(last, 1)]
    assert is_equal(world.now.state, world.memories[last - 1].state)


def test_a_rest_begins_anew_when_a_future_has_been_carried_out():
    world = resting_world()
    world.finish()
    world.step()  # from now on it listens again
    for _ in range(REST_STEPS + 1):
        assert len(world.events) == 1
        world.stand()
    assert len(world.events) == 2


def test_with_at_rest_off_or_while_it_moves_there_is_no_rest():
    for at_rest in (False, True):
        world = World(make_recall(surprise_threshold=1e30, rest=StandsStill(), at_rest=at_rest))
        world.steps(CALM_STEPS)
        for _ in range(3 * REST_STEPS):
            world.step() if at_rest else world.stand()
        assert not world.events


# ── Going back ────────────────────────────────────────────────────────


def test_it_goes_back_to_the_last_calm_moment():
    world = surprised_world()
    assert is_equal(world.now.state, world.memories[ANCHOR].state)
    assert torch.equal(world.now.prediction.command, world.memories[ANCHOR].prediction.command)
    (event,) = world.events
    assert (event.step, event.steps_back) == (FIRED, FIRED - ANCHOR) == (11, 2)
    assert event.refuted.shape == (SAMPLES,)
    assert event.futures.mean.shape == (HORIZON, SAMPLES, JOINTS + FEATURES)


@pytest.mark.parametrize(("contradiction", "is_calm"), [(THRESHOLD - 0.01, True), (THRESHOLD + 0.01, False)])
def test_a_moment_is_calm_up_to_half_of_the_threshold(contradiction, is_calm):
    """Half of the first contradiction counts at once, a quarter of it with the second."""
    world = World(make_recall())
    world.steps(CALM_STEPS)
    world.step(contradiction)
    world.step(2 * THRESHOLD)
    assert world.events[0].steps_back == 1 + (not is_calm)
    assert is_equal(world.now.state, world.memories[CALM_STEPS - (not is_calm)].state)


def test_a_long_doubt_is_remembered_only_as_far_as_the_trail_goes():
    world = World(make_recall())
    world.steps(CALM_STEPS)
    world.steps(2 * LONGEST_TRAIL, 0.75 * THRESHOLD)  # neither calm nor surprised
    assert not world.events
    world.surprise()
    assert world.events[0].steps_back == LONGEST_TRAIL


@pytest.mark.parametrize("waits", [0, 1, 3, LONGEST_RETURN - 1, LONGEST_RETURN + 5])
def test_it_waits_in_the_remembered_state_until_the_arm_is_back_but_not_for_ever(waits):
    """The arm moves as it should, but is not yet where it should be."""
    world = surprised_world()
    anchor = world.now
    for _ in range(min(waits, LONGEST_RETURN - 1)):
        world.step(THRESHOLD + 0.01, share=STALLED + 0.05 if waits < 2 else 1.0)
        assert is_equal(world.now.state, anchor.state)
        assert torch.equal(world.now.prediction.command, anchor.prediction.command)
    world.step(THRESHOLD - 0.01 if waits < LONGEST_RETURN else THRESHOLD + 0.01, share=1.0)
    assert is_close(world.now.state, undisturbed(world))


def test_it_does_not_wait_for_an_arm_that_stands_still():
    world = surprised_world()
    assert surprise(world.before, world.now.prediction).item() > THRESHOLD
    world.stand()
    assert is_close(world.now.state, undisturbed(world))


def test_it_waits_as_long_each_time():
    world = surprised_world()
    for _ in range(2):
        for _ in range(LONGEST_RETURN - 1):
            world.step(THRESHOLD + 0.01, share=1.0)
            assert is_equal(world.now.state, world.memories[ANCHOR].state)
        world.step(THRESHOLD + 0.01, share=1.0)
        assert not torch.equal(world.now.state.h_joint, world.memories[ANCHOR].state.h_joint)
        for _ in range(UNTIL_BLOCKED - 1):
            world.stand()
    assert [event.step - FIRED for event in world.events] == [
        times * (LONGEST_RETURN + UNTIL_BLOCKED - 1) for times in range(3)
    ]


# ── Imagining ─────────────────────────────────────────────────────────


def test_without_noise_all_futures_are_that_of_the_last_calm_moment():
    world = surprised_world()
    expected = Oracle(world.network).imagine(undisturbed(world), HORIZON)
    for copy in range(SAMPLES):
        np.testing.assert_allclose(world.events[0].futures.mean[:, copy], [mean for mean, *_ in expected], atol=1e-10)


@pytest.mark.parametrize("exploration", ["noise", "none"])
def test_a_baseline_has_one_future_and_only_that_with_noise_deviates(exploration):
    world = surprised_world(exploration=exploration, num_samples=50, noise_range=(0.5, 0.5))
    assert len(world.events[0].refuted) == 1
    world.step()
    assert is_close(world.now.state, undisturbed(world)) == (exploration == "none")


@pytest.mark.parametrize("exploration", ["foresight", "noise", "none"])
def test_a_generator_makes_it_reproducible(exploration):
    def last_state(seed):
        world = World(make_recall(exploration=exploration, noise_range=(0.2, 1.0)), torch.Generator().manual_seed(seed))
        world.steps(CALM_STEPS)
        world.surprise()
        world.is_blocked()
        world.steps(3)
        return world.now.state

    assert is_equal(last_state(1), last_state(1))
    assert torch.equal(last_state(1).h_joint, last_state(2).h_joint) == (exploration == "none")


# ── Trying ────────────────────────────────────────────────────────────


@pytest.mark.parametrize("exploration", ["foresight", "noise", "none"])
def test_a_chosen_future_is_carried_out_blind_and_then_it_sees_again(exploration):
    worlds = [surprised_world(exploration=exploration, noise_range=(0.2, 0.5)) for _ in range(2)]
    for world, off in zip(worlds, (0.0, 0.7), strict=True):
        world.step(off=off)
        expected = in_closed_loop(world.network, row_of(world.now.state), COMMITMENT)
        for step in range(COMMITMENT):
            world.step(off=off)
            assert is_close(world.now.state, expected[step + 1])
    assert is_equal(worlds[0].now.state, worlds[1].now.state)
    for world, off in zip(worlds, (0.0, 0.7), strict=True):
        last = row_of(world.now.state)
        world.step(off=off)
        assert is_close(world.now.state, Oracle(world.network).step(world.inputs[-1][0].numpy(), last))
        assert len(world.events) == 1
    assert not torch.equal(worlds[0].now.state.h_image, worlds[1].now.state.h_image)


def test_it_goes_on_from_the_chosen_copy():
    world = surprised_world(noise_range=(0.5, 1.5), num_samples=20)
    (event,) = world.events
    world.step()
    future = Oracle(world.network).imagine(row_of(world.now.state), HORIZON)
    for copy in range(20):
        same = np.allclose(event.futures.mean[:, copy], [mean for mean, *_ in future], atol=1e-10)
        assert same == (copy == event.chosen)


def test_while_a_future_is_carried_out_nothing_surprises():
    world = surprised_world()
    world.step()
    world.steps(4, contradiction=1000.0, share=1.0)
    assert len(world.events) == 1


def test_who_has_finished_a_try_can_be_surprised_again_and_goes_back_to_after_it():
    world = surprised_world()
    world.finish()
    world.steps(CALM_STEPS)
    last_calm = len(world.memories) - 1
    world.surprise()
    assert [event.step for event in world.events] == [FIRED, last_calm + STEPS_TO_FIRE]
    assert world.events[1].steps_back == STEPS_TO_FIRE
    assert is_equal(world.now.state, world.memories[last_calm].state)


def test_the_surprise_that_a_try_began_with_is_forgotten_with_its_end():
    world = surprised_world()
    world.finish()
    world.step()
    world.step(2 * THRESHOLD - 0.01)
    world.steps(CALM_STEPS)
    assert len(world.events) == 1


def test_an_arm_that_is_blocked_goes_back_to_the_same_moment_and_tries_once_more():
    world = surprised_world(noise_range=(1.0, 2.0))
    for times in range(1, 4):
        world.is_blocked()
        assert is_equal(world.now.state, world.memories[ANCHOR].state)
        assert world.events[-1].step == FIRED + times * UNTIL_BLOCKED
        assert world.events[-1].steps_back == world.events[-1].step - ANCHOR


# ── Refuting ──────────────────────────────────────────────────────────


NARROW = 0.01


def likeness(event, failures: list[np.ndarray], here: np.ndarray) -> list[np.ndarray]:
    """Of each failure to all futures of an event."""
    ends = event.futures.mean[-1, :, :JOINTS].numpy()
    lengths = np.sort(np.linalg.norm(ends - here, axis=-1))
    width = NARROW * lengths[(len(lengths) - 1) // 2]
    return [np.exp(-0.5 * (np.linalg.norm(ends - end, axis=-1) / width) ** 2) for end in failures]


def test_what_was_being_done_is_refuted_and_so_is_what_is_blocked_while_both_fade(monkeypatch):
    monkeypatch.setattr(recall_module, "SAME_FUTURE", NARROW)  # this network's futures are much alike
    world = surprised_world(noise_range=(1.0, 2.5), num_samples=41, memory=30.0)
    world.is_blocked()
    oracle = Oracle(world.network)
    surprised = oracle.step(world.inputs[FIRED][0].numpy(), world.state(FIRED - 1))
    done = oracle.imagine(surprised, HORIZON)[-1][0][:JOINTS]
    tried = world.events[0].futures.mean[-1, world.events[0].chosen, :JOINTS].numpy()
    here = oracle.predict(world.state(ANCHOR))[0][:JOINTS]

    (expected,) = likeness(world.events[0], [done], here)
    assert expected.min() < REFUTED
    assert expected.max() > 0.01
    np.testing.assert_allclose(world.events[0].refuted, expected, rtol=1e-6, atol=1e-9)

    first, second = likeness(world.events[1], [done, tried], here)
    expected = np.exp(-UNTIL_BLOCKED / 30) * first + second
    assert expected.min() < REFUTED
    np.testing.assert_allclose(world.events[1].refuted, expected, rtol=1e-6, atol=1e-9)


LEFT, RIGHT, UP = (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
WAYS = [LEFT] * 4 + [RIGHT] * 4 + [UP] * 4
"""Most determined are the futures to the right, of which that is the last, then those to the left."""


def script(monkeypatch, doing: tuple[float, ...]) -> None:
    """Whatever is imagined, futures end at `WAYS`, and what is being done when surprised ends at `doing`."""
    ends = torch.tensor(WAYS, dtype=torch.float64)
    left = torch.tensor([{RIGHT: 0.1, LEFT: 0.2, UP: 0.3}[way] - 0.01 * (row % 4) for row, way in enumerate(WAYS)])

    def imagine(model, state, *settings):
        states = model.imagine(state.at([0] * len(WAYS)), HORIZON)
        mean = model.network.predict_mean(states)  # what is carried out is true; it ends before `SOON`
        here = mean[0, :, :JOINTS]
        mean[SOON, :, :JOINTS] = ends + left[:, None] * (here - ends)
        mean[-1, :, :JOINTS] = ends
        nothing = mean.new_empty(1 + HORIZON, len(WAYS), 0)
        return Alternatives(states, Prediction(mean, mean, nothing, nothing), JOINTS)

    def foresee(recall, state):
        return torch.tensor(doing, dtype=torch.float64)

    monkeypatch.setattr(recall_module.Alternatives, "imagine", imagine)
    monkeypatch.setattr(recall_module.Recall, "_foresee", foresee)


def failing_world(failures: int, **overrides) -> World:
    """Every try is blocked."""
    world = World(make_recall(commitment=SOON - 1, **overrides))
    world.steps(CALM_STEPS)
    world.surprise()
    for _ in range(failures):
        world.is_blocked()
    return world


def ways_tried(world: World) -> list[tuple[float, ...]]:
    return [WAYS[event.chosen] for event in world.events]


@pytest.mark.parametrize(("doing", "first", "second"), [(RIGHT, LEFT, UP), (LEFT, RIGHT, UP), (UP, RIGHT, LEFT)])
def test_the_ways_are_tried_in_turn_but_never_the_one_that_contradicted(monkeypatch, doing, first, second):
    script(monkeypatch, doing)
    world = failing_world(failures=1)
    assert ways_tried(world) == [first, second]
    faded = np.exp(-UNTIL_BLOCKED / 200)
    for event, weights in zip(world.events, ({doing: 1.0}, {doing: faded, first: 1.0}), strict=True):
        np.testing.assert_allclose(event.refuted, [weights.get(way, 0.0) for way in WAYS], atol=1e-3)


def test_when_all_is_refuted_it_forgets_and_starts_anew(monkeypatch):
    script(monkeypatch, doing=UP)
    world = failing_world(failures=4)
    assert ways_tried(world) == [RIGHT, LEFT, RIGHT, LEFT, UP]
    assert not world.events[2].refuted.any()
    np.testing.assert_allclose(world.events[3].refuted, [way == RIGHT for way in WAYS], atol=1e-3)


def test_without_memory_nothing_is_refuted(monkeypatch):
    script(monkeypatch, doing=RIGHT)
    world = failing_world(failures=2, memory=0.0)
    assert ways_tried(world) == [RIGHT] * 3
    assert not any(event.refuted.any() for event in world.events)


@pytest.mark.parametrize(("memory", "has_faded"), [(15.0, True), (20.0, False)])
def test_a_failure_fades_until_its_future_may_be_tried_again(monkeypatch, memory, has_faded):
    """A try takes 10 steps; 0.3 is between exp(-20 / 15), which no longer refutes, and exp(-20 / 20), which does."""
    assert UNTIL_BLOCKED == 10
    script(monkeypatch, doing=RIGHT)
    world = failing_world(failures=2, memory=memory)
    assert ways_tried(world) == [LEFT, UP, RIGHT]
    weights = {RIGHT: np.exp(-20 / memory), LEFT: np.exp(-10 / memory), UP: 1.0}
    # What has not faded yet leaves nothing to try, so that it starts anew.
    expected = [weights[way] if has_faded else 0.0 for way in WAYS]
    np.testing.assert_allclose(world.events[2].refuted, expected, atol=1e-3)


def test_a_try_that_succeeded_is_not_refuted(monkeypatch):
    """The door did open, then something else went wrong."""
    script(monkeypatch, doing=UP)
    world = failing_world(failures=0)
    world.finish()
    world.steps(CALM_STEPS)
    world.surprise()
    assert len(world.events) == 2
    assert ways_tried(world) == [RIGHT, RIGHT]
    doing_twice = 1 + np.exp(-(world.events[1].step - FIRED) / 200)
    np.testing.assert_allclose(world.events[1].refuted, [doing_twice * (way == UP) for way in WAYS], atol=1e-3)


# ── Episodes ──────────────────────────────────────────────────────────


def test_each_episode_of_a_batch_is_on_its_own():
    """The second goes back twice; the first never does and stays what it is alone, to rounding."""
    recall, plain = make_recall(FastUFRNN), small_model(FastUFRNN)
    memory, expected = recall.model.initial_memory(2), plain.initial_memory(1)
    generator = torch.Generator().manual_seed(0)
    first, second = (World(make_recall(FastUFRNN), torch.Generator().manual_seed(0)) for _ in range(2))
    for step in range(60):
        first.step(off=np.sin(step))
        second.step(CONTRADICTION if step in (20, 21, 45, 46) else 0.0)
        memory, _ = recall.advance(torch.cat((first.inputs[-1], second.inputs[-1])), memory, generator)
        expected, _ = plain.advance(first.inputs[-1], expected)
        for ours, theirs, other in zip(memory.state, expected.state, second.now.state, strict=True):
            torch.testing.assert_close(ours[:1], theirs, rtol=0, atol=1e-12)
            torch.testing.assert_close(ours[1:], other, rtol=0, atol=1e-9)
    assert [len(events) for events in recall.events] == [0, 2]
    assert [event.step for event in recall.events[1]] == [event.step for event in second.events] == [21, 46]


def test_two_episodes_can_go_back_at_once_each_to_its_own_past():
    recall, worlds = make_recall(), [World(make_recall()) for _ in range(2)]
    memory, states = recall.model.initial_memory(2), []
    for step in range(CALM_STEPS + STEPS_TO_FIRE):
        for world, off in zip(worlds, (0.0, 0.3), strict=True):
            world.step(CONTRADICTION if step >= CALM_STEPS else 0.0, off=off)
        memory, _ = recall.advance(torch.cat([world.inputs[-1] for world in worlds]), memory)
        states.append(memory.state)
    assert [[event.step for event in events] for events in recall.events] == [[FIRED], [FIRED]]
    assert is_equal(memory.state, states[ANCHOR])
    assert not torch.equal(memory.state.h_image[0], memory.state.h_image[1])


def test_reset_forgets():
    recall = make_recall(noise_range=(0.2, 1.0))

    def last_state() -> HiddenState:
        world = World(recall, torch.Generator().manual_seed(0))
        world.steps(CALM_STEPS)
        world.surprise()
        world.is_blocked()
        return world.step().state

    first = last_state()
    recall.reset()
    assert recall.events == []
    assert is_equal(last_state(), first)
    recall.reset()
    recall.advance(torch.zeros(3, JOINTS + FEATURES, dtype=torch.float64), recall.model.initial_memory(3))
    assert recall.events == [[], [], []]


def test_a_thousand_steps_of_any_kind_are_survived_in_bounded_memory():
    """Failures soon after each other, and so far apart that all that may be remembered is."""
    recall = make_recall(FastUFRNN, num_samples=4, noise_range=(0.2, 1.5), horizon=6, commitment=4)
    world = World(recall, torch.Generator().manual_seed(0))
    rng = np.random.default_rng(0)
    lengths, events = [], []
    for surprises in ((0.0, 6.0, 50.0), (*[0.0] * 40, 20.0)):
        for _ in range(500):
            if world.inputs and rng.random() < 0.1:
                world.stand()
            else:
                world.step(rng.choice(surprises), rng.choice([-0.5, 0.1, 0.5, 1.0]), rng.normal(), exact=False)
            (episode,) = recall._episodes
            lengths.append(len(episode.trail))
            assert len(episode.refuted) <= len(world.events)
        events.append(len(world.events))
    assert max(lengths) == LONGEST_TRAIL
    assert events[0] > 10
    assert events[1] > events[0] + 3
    assert all(torch.isfinite(values).all() for values in world.now.state)
