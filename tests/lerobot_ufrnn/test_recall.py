"""A world that obeys the network's own predictions until it contradicts them by as much as a test asks for."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from oracle import Oracle

from lerobot_ufrnn import recall as recall_module
from lerobot_ufrnn.foresight import PERTURBED_STATES, Foresight, NoiseSchedule
from lerobot_ufrnn.kernels.unroll import FastUFRNN
from lerobot_ufrnn.networks import SHLSTM, HiddenState, Prediction
from lerobot_ufrnn.recall import LONGEST_RETURN, SETTLING, TRAIL_MARGIN, Recall, surprise
from lerobot_ufrnn.recurrent import UFRNN, Memory

JOINTS, FEATURES = 3, 4
# With a surprise of 6 at each step, the running surprise is 3, which is above half the threshold, and then 4.5.
THRESHOLD, CONTRADICTION, STEPS_TO_FIRE = 4.0, 6.0, 2
REWIND, HORIZON, COMMITMENT, CALM_STEPS = 3, 24, 2, 10


def make_recall(kernel=UFRNN, exploration="foresight", perturbed_states="hidden", hidden_dim=6, **overrides) -> Recall:
    """Recall of a small network, whose copies are all alike unless a test asks for noise."""
    torch.manual_seed(0)
    network = SHLSTM(JOINTS, FEATURES, hidden_dim, 5, 4, (-9.0, 3.0)).double()
    for parameter in network.parameters():  # larger weights than at the start, so that states and copies part
        parameter.data.mul_(2)
    schedule = NoiseSchedule((0.05, 0.15), "std", False)
    model = kernel(network, Foresight(exploration, schedule, 5, 3, perturbed_states=perturbed_states)).double()
    settings = {
        "threshold": THRESHOLD,
        "rewind": REWIND,
        "num_samples": 8,
        "noise_range": (0.0, 0.0),
        "horizon": HORIZON,
        "commitment": COMMITMENT,
        "memory": 200.0,
    }
    return Recall(model, **{**settings, **overrides})


def sensed(prediction: Prediction, contradiction: float = 0.0) -> torch.Tensor:
    """Sensor values as predicted, but for joints that surprise by as much as given."""
    off = (contradiction * prediction.log_variance[:, :JOINTS].exp()).sqrt()
    return torch.cat((prediction.mean[:, :JOINTS] + off, prediction.mean[:, JOINTS:]), dim=-1)


@dataclass
class World:
    """An episode that goes on, with all memories so far."""

    recall: Recall
    generator: torch.Generator | None = None
    memories: list[Memory] = field(default_factory=list)

    def __post_init__(self):
        self.now = self.recall.model.initial_memory(1)

    def step(self, contradiction: float = 0.0, off: float = 0.0) -> Memory:
        """One step; the image features are `off` from what was predicted."""
        inputs = sensed(self.now.prediction, contradiction)
        inputs[:, JOINTS:] += off
        self.now, _ = self.recall.advance(inputs, self.now, self.generator)
        self.memories.append(self.now)
        return self.now

    def steps(self, count: int, contradiction: float = 0.0) -> None:
        for _ in range(count):
            self.step(contradiction)

    def fail(self) -> None:
        """Goes on until recall goes back."""
        before = len(self.events)
        for _ in range(HORIZON):
            self.step(CONTRADICTION)
            if len(self.events) > before:
                return
        raise AssertionError("not surprised")

    def carry_out(self) -> None:
        """The arm comes back at once; the chosen future is carried out and has settled."""
        self.steps(1 + COMMITMENT + SETTLING)

    @property
    def events(self):
        return self.recall.events[0]


def surprised_world(**overrides) -> World:
    """Calm steps 0 to 9, then a contradiction, by which recall goes back at step 11."""
    world = World(make_recall(**overrides), torch.Generator().manual_seed(0))
    world.steps(CALM_STEPS)
    world.steps(STEPS_TO_FIRE, CONTRADICTION)
    return world


def assert_equal(state: HiddenState, expected: HiddenState) -> None:
    for ours, theirs in zip(state, expected, strict=True):
        assert torch.equal(ours, theirs)


def imagine(recall: Recall, state: HiddenState, steps: int) -> list[np.ndarray]:
    """The state after some steps in closed loop, by the oracle."""
    oracle = Oracle(recall.model.network)
    values = [part[0].detach().numpy() for part in state]
    for _ in range(steps):
        values = oracle.step(oracle.predict(values)[0], values)
    return values


def assert_close(state: HiddenState, expected: list[np.ndarray]) -> None:
    for ours, theirs in zip(state, expected, strict=True):
        np.testing.assert_allclose(ours[0].detach().numpy(), theirs, atol=1e-12)


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
    recall = make_recall(kernel, exploration, threshold=float("inf"), noise_range=(0.2, 1.5))
    plain = kernel(recall.model.network, Foresight("none", NoiseSchedule((0.05, 0.15), "std", False), 1, 1)).double()
    memory = expected = plain.initial_memory(2)
    for inputs in torch.rand(40, 2, JOINTS + FEATURES, dtype=torch.float64):
        memory, _ = recall.advance(inputs, memory)
        expected, _ = plain.advance(inputs, expected)
        assert_equal(memory.state, expected.state)
        for ours, theirs in zip(memory.prediction, expected.prediction, strict=True):
            assert torch.equal(ours, theirs)


def test_the_running_surprise_must_pass_the_threshold_and_not_only_one_step():
    """One contradiction of 2 * threshold - e is forgiven, of 2 * threshold + e not: half of each step counts."""
    for contradiction, fires in ((2 * THRESHOLD - 0.01, False), (2 * THRESHOLD + 0.01, True)):
        world = World(make_recall())
        world.steps(CALM_STEPS)
        world.step(contradiction)
        world.steps(CALM_STEPS)
        assert len(world.events) == fires


def test_it_does_not_go_back_before_there_is_anywhere_to_go():
    world = World(make_recall())
    world.steps(REWIND + 1, CONTRADICTION)
    assert not world.events
    world.step(CONTRADICTION)
    assert [event.step for event in world.events] == [REWIND + 1]


# ── Going back ────────────────────────────────────────────────────────


def test_it_goes_back_to_some_steps_before_the_last_calm_one():
    world = surprised_world()
    # The last calm step is 9: at step 10 the running surprise is 3, more than half of the threshold.
    anchor = world.memories[CALM_STEPS - 1 - REWIND]
    assert_equal(world.now.state, anchor.state)
    assert torch.equal(world.now.prediction.command, anchor.prediction.command)
    (event,) = world.events
    assert (event.step, event.steps_back) == (11, 11 - 6)
    assert not event.refuted.any()


@pytest.mark.parametrize("waits", [1, 3, LONGEST_RETURN, LONGEST_RETURN + 5])
def test_it_waits_in_the_remembered_state_until_the_arm_is_back_but_not_for_ever(waits):
    world = surprised_world()
    anchor = world.memories[CALM_STEPS - 1 - REWIND]
    held = min(waits, LONGEST_RETURN) - 1
    for _ in range(held):
        world.step(THRESHOLD + 0.01)
        assert_equal(world.now.state, anchor.state)
        assert torch.equal(world.now.prediction.command, anchor.prediction.command)
    world.step(THRESHOLD - 0.01 if waits <= LONGEST_RETURN else CONTRADICTION)
    assert_close(world.now.state, imagine(world.recall, anchor.state, COMMITMENT))


def test_it_waits_as_long_each_time():
    world = surprised_world()
    for _ in range(2):
        anchor = world.now.state
        world.steps(LONGEST_RETURN - 1, CONTRADICTION)
        assert_equal(world.now.state, anchor)
        world.step(CONTRADICTION)
        assert not torch.equal(world.now.state.h_joint, anchor.h_joint)
        world.steps(COMMITMENT + SETTLING)
        world.fail()


@pytest.mark.parametrize("exploration", ["foresight", "noise", "none"])
def test_a_chosen_future_is_carried_out_deaf_to_the_senses_and_then_it_listens(exploration):
    worlds = [surprised_world(exploration=exploration, noise_range=(0.2, 0.5)) for _ in range(2)]
    for world, off in zip(worlds, (0.0, 0.7), strict=True):
        world.step()
        begun = world.now.state
        for step in range(COMMITMENT):
            world.step(1000.0 * off, off)
            assert_close(world.now.state, imagine(world.recall, begun, step + 1))
    assert_equal(worlds[0].now.state, worlds[1].now.state)
    for world, off in zip(worlds, (0.0, 0.7), strict=True):
        world.step(off=off)
    assert not torch.equal(worlds[0].now.state.h_image, worlds[1].now.state.h_image)


def test_a_future_that_was_carried_out_may_settle_before_it_can_surprise():
    world = surprised_world()
    world.step()
    world.steps(COMMITMENT + SETTLING, 1000.0)
    world.steps(STEPS_TO_FIRE - 1, CONTRADICTION)
    assert len(world.events) == 1
    world.step(CONTRADICTION)
    assert len(world.events) == 2


# ── Imagining ─────────────────────────────────────────────────────────


def test_the_futures_are_those_of_the_closed_loop_up_to_the_horizon():
    world = World(make_recall())
    world.recall.keep_futures = True
    world.steps(CALM_STEPS)
    world.fail()
    futures = world.events[0].futures
    assert futures.mean.shape == (HORIZON - COMMITMENT, 8, JOINTS + FEATURES)
    anchor = [part[0].detach().numpy() for part in world.memories[CALM_STEPS - 1 - REWIND].state]
    expected = Oracle(world.recall.model.network).imagine(anchor, HORIZON)[COMMITMENT:]
    for future, (mean, log_variance, *_) in zip(zip(*futures, strict=True), expected, strict=True):
        np.testing.assert_allclose(future[0][7].numpy(), mean, atol=1e-10)
        np.testing.assert_allclose(future[1][7].numpy(), log_variance, atol=1e-10)


def test_the_first_copy_gets_the_least_noise_and_the_last_the_most():
    recall = make_recall(hidden_dim=500, num_samples=3, noise_range=(0.2, 1.4))
    anchor = recall.model.initial_memory(1).state
    copies = recall._perturb(anchor, torch.Generator().manual_seed(0))
    np.testing.assert_allclose(copies.h_joint.std(dim=-1).numpy(), [0.2, 0.8, 1.4], rtol=0.15)
    assert torch.equal(copies.c_joint, anchor.c_joint.expand(3, -1))


def test_the_noise_of_the_baseline_is_anywhere_in_the_range():
    recall = make_recall(hidden_dim=500, exploration="noise", noise_range=(0.2, 1.4))
    anchor, generator = recall.model.initial_memory(1).state, torch.Generator().manual_seed(0)
    copies = [recall._perturb(anchor, generator).h_joint for _ in range(200)]
    assert all(copy.shape == (1, 500) for copy in copies)
    found = np.sort([copy.std().item() for copy in copies])
    np.testing.assert_allclose(found, np.linspace(0.2, 1.4, 200), atol=0.15)


@pytest.mark.parametrize("perturbed_states", sorted(PERTURBED_STATES))
def test_the_states_perturbed_are_those_of_foresight(perturbed_states):
    recall = make_recall(perturbed_states=perturbed_states, noise_range=(0.5, 0.5))
    anchor = recall.model.initial_memory(1).state
    copies = recall._perturb(anchor, None)
    for name, value, copy in zip(HiddenState._fields, anchor, copies, strict=True):
        assert torch.equal(copy, value.expand_as(copy)) == (name not in PERTURBED_STATES[perturbed_states])


def test_the_baselines_have_one_future_and_only_that_with_noise_is_perturbed():
    for exploration in ("noise", "none"):
        world = surprised_world(exploration=exploration, noise_range=(0.5, 0.5))
        unperturbed = imagine(world.recall, world.now.state, COMMITMENT)
        world.step()
        assert len(world.events[0].refuted) == 1
        same = np.allclose(world.now.state.h_joint[0].detach().numpy(), unperturbed[0], atol=1e-12)
        assert same == (exploration == "none")


@pytest.mark.parametrize("exploration", ["foresight", "noise"])
def test_a_generator_makes_it_reproducible(exploration):
    def last_state(seed):
        world = World(make_recall(exploration=exploration, noise_range=(0.2, 1.0)), torch.Generator().manual_seed(seed))
        world.steps(CALM_STEPS)
        world.fail()
        world.carry_out()
        return world.now.state

    assert_equal(last_state(1), last_state(1))
    assert not torch.equal(last_state(1).h_joint, last_state(2).h_joint)


# ── Choosing ──────────────────────────────────────────────────────────


PRESENT = 0.5


def script(monkeypatch, ends: list[float], variances: list[float]) -> None:
    """Whatever is imagined, the first joint ends by one of `ends` off `PRESENT`, with these variances."""

    def roll_out(network, state, horizon):
        mean, log_variance = torch.zeros(2, horizon, len(ends), JOINTS + FEATURES, dtype=torch.float64)
        mean[-1, :, :JOINTS] = PRESENT
        mean[-1, :, 0] += torch.tensor(ends)
        log_variance[-1] = torch.tensor(variances).log()[:, None]
        nothing = mean.new_empty(horizon, len(ends), 0)
        return Prediction(mean, log_variance, nothing, nothing)

    monkeypatch.setattr(recall_module, "roll_out", roll_out)


# Two clusters of four futures, that to the right less uncertain, and the third of each the least uncertain of it.
LEFT, RIGHT = [0, 1, 2, 3], [4, 5, 6, 7]
TWO_WAYS = [-1.0, -0.999, -1.001, -1.0, 1.0, 1.001, 0.999, 1.0]
VARIANCES = [0.4, 0.4, 0.3, 0.4, 0.2, 0.2, 0.1, 0.2]


def failing_world(monkeypatch, ends, variances, failures, **overrides) -> World:
    """The joints are always predicted at `PRESENT`; every try fails."""
    script(monkeypatch, ends, variances)
    world = World(make_recall(num_samples=len(ends), **overrides))
    head = world.recall.model.network.joint_head
    head.weight.data[:JOINTS] = 0
    head.bias.data[:JOINTS] = np.arctanh(PRESENT)
    world.steps(CALM_STEPS)
    world.fail()
    for _ in range(failures):
        world.carry_out()
        world.fail()
    return world


def test_the_least_uncertain_future_is_tried_first_and_the_other_way_when_it_fails(monkeypatch):
    world = failing_world(monkeypatch, TWO_WAYS, VARIANCES, failures=1)
    first, second = world.events
    assert (first.chosen, second.chosen) == (6, 2)
    # It failed a moment ago, so that only likeness counts; the kernel is a fifth as wide as futures lead, about 1.
    distance = np.array(TWO_WAYS) - TWO_WAYS[6]
    np.testing.assert_allclose(second.refuted.numpy(), np.exp(-0.5 * (distance / 0.2) ** 2), atol=1e-5)
    # Both times it went back to the same moment.
    assert_equal(world.memories[second.step].state, world.memories[first.step].state)
    assert second.steps_back > first.steps_back == 5


def test_when_all_futures_have_failed_the_oldest_failure_is_tried_again(monkeypatch):
    world = failing_world(monkeypatch, TWO_WAYS, VARIANCES, failures=3)
    sides = ["left" if event.chosen in LEFT else "right" for event in world.events]
    assert sides == ["right", "left", "right", "left"]
    age = world.events[2].step - world.events[1].step
    third = world.events[2].refuted
    np.testing.assert_allclose(third[LEFT].numpy(), 1, atol=1e-3)
    np.testing.assert_allclose(third[RIGHT].numpy(), np.exp(-age / 200), atol=1e-3)


def test_without_memory_nothing_is_refuted(monkeypatch):
    world = failing_world(monkeypatch, TWO_WAYS, VARIANCES, failures=2, memory=0.0)
    assert [event.chosen for event in world.events] == [6, 6, 6]
    assert not any(event.refuted.any() for event in world.events)


@pytest.mark.parametrize(("memory", "third"), [(5.0, 6), (8.0, 8)])
def test_a_failure_fades_until_its_future_may_be_tried_again(monkeypatch, memory, third):
    """A try takes 8 steps; 0.3 is between exp(-8 / 5), which no longer refutes, and exp(-8 / 8), which does."""
    third_way = [3.0] * 4
    world = failing_world(monkeypatch, [*TWO_WAYS, *third_way], [*VARIANCES, *[0.9] * 4], failures=2, memory=memory)
    assert [event.chosen for event in world.events] == [6, 2, third]
    np.testing.assert_allclose(world.events[2].refuted[6].item(), np.exp(-8 / memory), rtol=1e-6)


def test_it_goes_on_from_the_chosen_copy(monkeypatch):
    script(monkeypatch, TWO_WAYS, [50 * variance for variance in VARIANCES])
    world = World(make_recall(noise_range=(0.2, 0.5)), torch.Generator().manual_seed(3))
    world.steps(CALM_STEPS)
    world.fail()
    (event,) = world.events
    assert event.chosen == 6
    copies = world.recall._perturb(world.now.state, torch.Generator().manual_seed(3))
    world.step()
    assert_close(world.now.state, imagine(world.recall, HiddenState(*(part[6:7] for part in copies)), COMMITMENT))


def test_a_future_that_no_other_shares_is_not_chosen(monkeypatch):
    world = failing_world(monkeypatch, [*TWO_WAYS, 3.0, -4.0], [*VARIANCES, 0.01, 0.02], failures=2)
    assert [event.chosen for event in world.events[:2]] == [6, 2]
    assert world.events[2].chosen in RIGHT  # although nothing like the last two was ever tried


def test_where_no_two_futures_are_alike_they_are_told_apart_by_failure_and_uncertainty(monkeypatch):
    world = failing_world(monkeypatch, [-2.0, -1.0, 1.0, 2.0, 3.0], [0.5, 0.3, 0.1, 0.4, 0.2], failures=5)
    assert [event.chosen for event in world.events] == [2, 4, 1, 3, 0, 2]


def test_a_copy_that_believes_itself_elsewhere_is_not_chosen(monkeypatch):
    """The copies' noise grows, so that the first is nearest to the present; the last is more certain by a hair."""
    script(monkeypatch, [1.0] * 8, [*[0.2] * 7, 0.1999])
    world = World(make_recall(noise_range=(0.0, 2.0)), torch.Generator().manual_seed(0))
    world.steps(CALM_STEPS)
    world.fail()
    assert world.events[0].chosen == 0


def test_a_failure_after_the_horizon_is_not_held_against_the_future(monkeypatch):
    """The door did open, then something else went wrong: it goes back to before that, and nothing is refuted."""
    script(monkeypatch, TWO_WAYS, VARIANCES)
    world = World(make_recall())
    world.steps(CALM_STEPS)
    world.fail()
    world.steps(HORIZON)
    last_calm = len(world.memories) - 1
    world.fail()
    second = world.events[1]
    assert second.chosen == 6
    assert not second.refuted.any()
    assert_equal(world.now.state, world.memories[last_calm - REWIND].state)


# ── Episodes ──────────────────────────────────────────────────────────


def test_each_episode_of_a_batch_is_on_its_own():
    """The second goes back twice; the first never does and stays what it is alone, bit for bit."""
    recall, alone = make_recall(FastUFRNN), make_recall(FastUFRNN)
    inputs = 0.1 * torch.rand(60, 1, JOINTS + FEATURES, dtype=torch.float64)
    memory, expected = recall.model.initial_memory(2), alone.model.initial_memory(1)
    second = World(make_recall(FastUFRNN))
    for step, calm in enumerate(inputs):
        contradiction = CONTRADICTION if step in (20, 21, 40, 41) else 0.0
        rows = torch.cat((calm, sensed(memory.prediction, contradiction)[1:]))
        memory, _ = recall.advance(rows, memory)
        expected, _ = alone.advance(calm, expected)
        second.step(contradiction)
        for ours, theirs, other in zip(memory.state, expected.state, second.now.state, strict=True):
            assert torch.equal(ours[:1], theirs)
            torch.testing.assert_close(ours[1:], other, rtol=0, atol=1e-12)
    assert [len(events) for events in recall.events] == [0, 2]
    assert [event.step for event in recall.events[1]] == [event.step for event in second.events] == [21, 41]


def test_two_episodes_can_go_back_at_once_each_to_its_own_past():
    recall = make_recall()
    memory, states = recall.model.initial_memory(2), []
    for step in range(CALM_STEPS + STEPS_TO_FIRE):
        inputs = sensed(memory.prediction, CONTRADICTION if step >= CALM_STEPS else 0.0)
        inputs[1, JOINTS:] += 0.3
        memory, _ = recall.advance(inputs, memory)
        states.append(memory.state)
    assert_equal(memory.state, states[CALM_STEPS - 1 - REWIND])
    assert not torch.equal(memory.state.h_image[0], memory.state.h_image[1])


def test_reset_forgets():
    recall = make_recall(noise_range=(0.2, 1.0))

    def last_state() -> HiddenState:
        world = World(recall, torch.Generator().manual_seed(0))
        world.steps(CALM_STEPS)
        world.fail()
        world.carry_out()
        world.fail()
        return world.step().state

    first = last_state()
    recall.reset()
    assert recall.events == []
    assert_equal(last_state(), first)
    recall.reset()
    recall.advance(torch.zeros(3, JOINTS + FEATURES, dtype=torch.float64), recall.model.initial_memory(3))
    assert recall.events == [[], [], []]


@pytest.mark.parametrize("surprises", [(0.0, 6.0, 50.0), (*[0.0] * 40, 20.0)])
def test_a_thousand_steps_of_any_kind_are_survived_in_bounded_memory(surprises):
    """Failures soon after each other, and so far apart that all that may be remembered is."""
    recall = make_recall(FastUFRNN, num_samples=4, noise_range=(0.2, 1.5), horizon=6)
    world = World(recall, torch.Generator().manual_seed(0))
    rng = np.random.default_rng(0)
    longest = 0
    for _ in range(1000):
        world.step(rng.choice(surprises))
        longest = max(longest, len(recall._episodes[0].trail))
    assert longest <= 6 + REWIND + TRAIL_MARGIN
    assert len(world.events) > 10
    assert all(torch.isfinite(values).all() for values in world.now.state)
