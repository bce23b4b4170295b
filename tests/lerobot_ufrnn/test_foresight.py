import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import Oracle
from small_network import enlarge, network_config, small_model

from lerobot_ufrnn.configuration_ufrnn import ForesightConfig
from lerobot_ufrnn.foresight import PERTURBED_STATES, Foresight, NoiseSchedule, perturb, select
from lerobot_ufrnn.networks import SHLSTM, HiddenState, Prediction

FIELDS = HiddenState._fields


def make_network(joint_dim=3, feature_dim=4, seed=0) -> SHLSTM:
    torch.manual_seed(seed)
    return enlarge(SHLSTM(network_config(joint_dim, feature_dim)))


def make_foresight(exploration="foresight", **settings_) -> Foresight:
    """Noise from 0.05 to 0.15 as variance, over a known range of predicted variances."""
    config = network_config(exploration=exploration, foresight={"noise_unit": "variance", **settings_})
    foresight = Foresight(config)
    set_range(foresight.schedule)
    return foresight


def set_range(schedule: NoiseSchedule) -> NoiseSchedule:
    schedule.double()
    low, high = torch.tensor([[0.1, 0.2], [2.0, 3.0]], dtype=torch.float64)
    if schedule.config.noise_scale == "log":
        low, high = low.log(), high.log()
    schedule.low.copy_(low)
    schedule.high.copy_(high)
    return schedule


def random_moment(network, batch_size, seed) -> tuple[HiddenState, Prediction]:
    """A state somewhere in an episode and the prediction of the step before."""
    generator = torch.Generator().manual_seed(seed)
    state = network.initial_state(batch_size)
    for _ in range(3):
        previous = network.predict(state)
        inputs = torch.rand(
            batch_size, network.joint_dim + network.feature_dim, generator=generator, dtype=torch.float64
        )
        state = network.step(inputs * 1.6 - 0.8, state)
    return state, previous


def oracle_foresight(network, schedule, state, previous, noise, settings_):
    """Perturb, roll out, select: one candidate of one sequence after the other, in float64."""
    oracle = Oracle(network)
    low, high = schedule.low.numpy(), schedule.high.numpy()
    chosen, kept, finals = [], [], []
    for row in range(state.h_joint.shape[0]):
        variance = np.exp(previous.log_variance[row].detach().numpy())
        means = np.array([variance[: network.joint_dim].mean(), variance[network.joint_dim :].mean()])
        place = np.clip((means - low) / (high - low), 0, 1)
        std = np.sqrt(0.05 + 0.1 * place)
        scale = dict(zip(("joint", "image", "shared"), (std[0], std[1], std.mean()), strict=True))
        best, best_fall = None, -np.inf
        row_finals = []
        for n in range(settings_["num_samples"]):
            candidate = []
            for name, value in zip(FIELDS, state, strict=True):
                vector = value[row].detach().numpy().copy()
                if name in noise:
                    vector = vector + scale[name[2:]] * noise[name][n, row].numpy()
                candidate.append(vector)
            _, own_log_variance, step, _ = oracle.predict(candidate)
            horizon = settings_["horizon"]
            if settings_["horizon_mode"] == "learned":
                horizon = int(np.ceil(horizon * (1 / (1 + np.exp(-step))).max()))
            final = oracle.uncertainty(oracle.imagine(candidate, horizon)[-1][1], settings_["variance_aggregation"])
            start = (
                own_log_variance
                if settings_["variance_baseline"] == "candidate"
                else previous.log_variance[row].detach().numpy()
            )
            fall = oracle.uncertainty(start, settings_["variance_aggregation"]) - final
            row_finals.append(final)
            if fall > best_fall:
                best, best_fall, best_candidate = n, fall, candidate
        chosen.append(best)
        kept.append(best_candidate)
        finals.append(row_finals)
    return np.array(chosen), kept, np.array(finals).T


@settings(max_examples=40, deadline=None)
@given(
    joint_dim=st.integers(1, 8),
    feature_dim=st.integers(1, 12),
    batch_size=st.integers(1, 4),
    num_samples=st.integers(1, 6),
    horizon=st.integers(1, 7),
    perturbed_states=st.sampled_from(sorted(PERTURBED_STATES)),
    variance_baseline=st.sampled_from(["common", "candidate"]),
    variance_aggregation=st.sampled_from(["variance", "entropy"]),
    horizon_mode=st.sampled_from(["fixed", "learned"]),
    seed=st.integers(0, 1000),
)
def test_foresight_equals_the_brute_force_oracle(joint_dim, feature_dim, batch_size, seed, **choice):
    network, foresight = make_network(joint_dim, feature_dim, seed), make_foresight(**choice)
    state, previous = random_moment(network, batch_size, seed)
    kept, trace = foresight(network, state, previous, torch.Generator().manual_seed(seed))
    fields = PERTURBED_STATES[choice["perturbed_states"]]
    joined = foresight.sample_noise(state, torch.Generator().manual_seed(seed))
    noise = dict(zip(fields, joined.split([getattr(state, name).shape[-1] for name in fields], -1), strict=True))
    chosen, expected, finals = oracle_foresight(network, foresight.schedule, state, previous, noise, choice)
    np.testing.assert_allclose(trace.final.numpy(), finals, rtol=1e-9)
    np.testing.assert_array_equal(trace.chosen.numpy(), chosen)
    for row, candidate in enumerate(expected):
        for ours, theirs in zip(kept, candidate, strict=True):
            np.testing.assert_allclose(ours[row].detach().numpy(), theirs, atol=1e-12)


def test_roll_out_feeds_the_predicted_means_back():
    network = make_network()
    state, previous = random_moment(network, 2, 0)
    foresight = make_foresight(num_samples=1, horizon=4)
    kept, trace = foresight(network, state, previous, torch.Generator().manual_seed(1))
    futures = Oracle(network).imagine([value[1].detach().numpy() for value in kept], 4)
    for step, (mean, log_variance, *_) in enumerate(futures):
        np.testing.assert_allclose(trace.imagined.mean[step, 0, 1].numpy(), mean, atol=1e-12)
        np.testing.assert_allclose(trace.imagined.log_variance[step, 0, 1].numpy(), log_variance, atol=1e-12)


def test_the_kept_state_carries_the_gradient_of_the_state_and_nothing_else():
    network = make_network()
    state, previous = random_moment(network, 2, 0)
    leaves = HiddenState(*(value.detach().requires_grad_() for value in state))
    kept, trace = make_foresight(num_samples=4, horizon=3)(network, leaves, previous)
    sum(value.sum() for value in kept).backward()
    for leaf in leaves:
        torch.testing.assert_close(leaf.grad, torch.ones_like(leaf))
    assert not trace.final.requires_grad
    assert all(parameter.grad is None for parameter in network.parameters())


def test_exploration_none_leaves_the_state_alone():
    network = make_network()
    state, previous = random_moment(network, 2, 0)
    kept, trace = make_foresight("none", num_samples=5, horizon=3)(network, state, previous)
    assert kept is state
    assert trace is None


def test_exploration_noise_is_the_first_candidate_of_foresight():
    """The baseline SH-RNN+noise takes one draw of the same noise and does not select."""
    network = make_network()
    state, previous = random_moment(network, 2, 0)
    kept, trace = make_foresight("noise", num_samples=5, horizon=3)(
        network, state, previous, torch.Generator().manual_seed(3)
    )
    only, _ = make_foresight(num_samples=1, horizon=3)(network, state, previous, torch.Generator().manual_seed(3))
    assert trace is None
    for ours, theirs in zip(kept, only, strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize(
    ("perturbed_states", "moved"), [("hidden", "h"), ("shared", "h_shared"), ("hidden_and_cell", "")]
)
def test_only_the_named_states_are_perturbed(perturbed_states, moved):
    network = make_network()
    state, _ = random_moment(network, 2, 0)
    foresight = make_foresight(num_samples=3, perturbed_states=perturbed_states)
    std = torch.full((2, 2), 0.3, dtype=torch.float64)
    candidates = perturb(state, foresight.sample_noise(state), std, PERTURBED_STATES[perturbed_states])
    for name in FIELDS:
        same = torch.equal(getattr(candidates, name), getattr(state, name).repeat(3, 1))
        assert same != name.startswith(moved)


def test_perturbed_states_have_the_asked_spread():
    network = make_network()
    state = network.initial_state(1)
    noise = make_foresight(num_samples=20000).sample_noise(state, torch.Generator().manual_seed(0))
    std = torch.tensor([[0.2, 0.4]], dtype=torch.float64)
    candidates = perturb(state, noise, std, PERTURBED_STATES["hidden"])
    for name, std in (("h_joint", 0.2), ("h_image", 0.4), ("h_shared", 0.3)):
        assert getattr(candidates, name).std().item() == pytest.approx(std, rel=0.02)


def test_the_unperturbed_state_can_be_a_candidate():
    state, _ = random_moment(make_network(), 2, 0)
    noise = make_foresight(num_samples=3, keep_unperturbed=True).sample_noise(state)
    assert (noise[0] == 0).all()
    assert (noise[1:] != 0).all()


def test_select_takes_the_largest_fall():
    baseline = torch.tensor([[1.0, 1.0], [1.0, 9.0]])
    final = torch.tensor([[0.5, 0.5], [0.4, 1.0]])
    assert select(baseline, final).tolist() == [1, 1]
    assert select(baseline[:1], final).tolist() == [1, 0]


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ({}, np.sqrt([0.05, 0.10, 0.15, 0.05, 0.15])),
        ({"noise_unit": "std"}, np.array([0.05, 0.10, 0.15, 0.05, 0.15])),
    ],
)
def test_noise_follows_the_place_of_the_variance_in_its_range(overrides, expected):
    schedule = set_range(NoiseSchedule(ForesightConfig(**{"noise_unit": "variance", **overrides})))
    joints = torch.tensor([0.1, 1.05, 2.0, 0.0, 50.0], dtype=torch.float64)
    std = schedule(torch.stack([joints, joints], dim=-1))
    np.testing.assert_allclose(std[:, 0].numpy(), expected, rtol=1e-12)


def test_noise_on_a_log_scale():
    schedule = set_range(NoiseSchedule(ForesightConfig(noise_scale="log")))
    middle = torch.tensor([[0.1, 0.2], [2.0, 3.0]], dtype=torch.float64).log().mean(0).exp()
    np.testing.assert_allclose(schedule(middle).numpy(), [0.1, 0.1], rtol=1e-12)


def test_the_range_starts_with_the_first_update_and_follows_training():
    schedule = NoiseSchedule(ForesightConfig()).double()
    early = torch.linspace(0, 10, 101, dtype=torch.float64)[:, None].expand(-1, 2)
    schedule.observe(early)
    np.testing.assert_allclose([schedule.low[0], schedule.high[0]], [0.5, 9.5])
    for _ in range(300):
        schedule.observe(early / 1000)
    np.testing.assert_allclose([schedule.low[0], schedule.high[0]], [0.5e-3, 9.5e-3], rtol=1e-3)


def test_one_outlier_does_not_set_the_range():
    schedule = NoiseSchedule(ForesightConfig()).double()
    values = torch.ones(100, 2, dtype=torch.float64)
    values[0] = 1000
    schedule.observe(values)
    np.testing.assert_allclose(schedule.high.numpy(), [1, 1])


def test_an_episode_is_the_same_in_one_go_and_step_by_step():
    model = small_model(exploration="foresight")
    inputs = torch.rand(2, 6, 7, dtype=torch.float64)
    whole, traces = model(inputs, torch.Generator().manual_seed(5))
    generator = torch.Generator().manual_seed(5)
    memory = model.initial_memory(2)
    for step in range(6):
        memory, trace = model.advance(inputs[:, step], memory, generator)
        torch.testing.assert_close(memory.prediction.mean, whole.mean[:, step])
        assert torch.equal(trace.chosen, traces.chosen[step])
