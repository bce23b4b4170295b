"""The compiled kernel against the readable code, and its parts against NumPy."""

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import draccus
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies.factory import make_policy
from small import batch_of, small_config, train
from small_network import network_config

from lerobot_ufrnn.foresight import UFRNN
from lerobot_ufrnn.kernels.forward import _squash
from lerobot_ufrnn.kernels.unroll import COMPILED, FastUFRNN, unsupported
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy
from lerobot_ufrnn.networks import HiddenState, gaussian_nll

sizes = st.integers(1, 20)


def make_pair(
    dims, seed, dtype=torch.float64, gain=2.0, exploration="foresight", command_target="action", **foresight
) -> tuple[UFRNN, FastUFRNN]:
    """The same model twice: readable and compiled."""
    torch.manual_seed(seed)
    config = network_config(
        *dims[:2],
        exploration=exploration,
        command_target=command_target,
        foresight={"num_samples": 5, "horizon": 3, **foresight},
        **dict(zip(("joint_hidden_dim", "image_hidden_dim", "shared_hidden_dim"), dims[2:], strict=True)),
    )
    models = UFRNN(config), FastUFRNN(config)
    for parameter in models[0].network.parameters():  # larger weights than at the start, so that candidates part
        parameter.data.mul_(gain)
    models[0].foresight.schedule.low.copy_(torch.tensor([0.1, 0.2]))
    models[0].foresight.schedule.high.copy_(torch.tensor([2.0, 3.0]))
    models[1].load_state_dict(models[0].state_dict())
    return models[0].to(dtype), models[1].to(dtype)


def run(model, inputs, seed):
    """Predictions, trace, loss and gradients of inputs and parameters."""
    model.zero_grad()
    leaf = inputs.clone().requires_grad_()
    prediction, trace = model(leaf, torch.Generator().manual_seed(seed))
    target = inputs.roll(-1, dims=1)
    loss = gaussian_nll(target, prediction.mean, prediction.log_variance).mean() + prediction.step.square().mean()
    loss = loss + (target[..., : model.network.joint_dim] - prediction.command).square().mean()
    loss.backward()
    gradients = {name: value.grad.clone() for name, value in model.named_parameters()}
    return prediction, trace, loss.detach(), {**gradients, "inputs": leaf.grad}


def assert_close(ours, theirs, name, **tolerance):
    torch.testing.assert_close(ours, theirs, **tolerance, msg=lambda text: f"{name}: {text}")


@contextmanager
def threads(number):
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@settings(max_examples=30, deadline=None)
@given(
    dims=st.tuples(sizes, sizes, sizes, sizes, sizes),
    rows=st.integers(1, 9),
    num_steps=st.integers(0, 12),
    num_threads=st.integers(1, 3),
    seed=st.integers(0, 1000),
)
def test_what_is_imagined_equals_the_reference(dims, rows, num_steps, num_threads, seed):
    reference, fast = make_pair(dims, seed)
    state = HiddenState(*(torch.randn(rows, size).double() for size in reference.network.state_sizes))
    with threads(num_threads):
        found = fast.imagine(state, num_steps)
    for ours, theirs in zip(found, reference.imagine(state, num_steps), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(
    dims=st.tuples(sizes, sizes, sizes, sizes, sizes),
    batch_size=st.integers(1, 4),
    length=st.integers(1, 12),
    num_samples=st.integers(1, 12),
    horizon=st.integers(1, 6),
    exploration=st.sampled_from(["foresight", "foresight", "noise", "none"]),
    keep_unperturbed=st.booleans(),
    noise_unit=st.sampled_from(["variance", "std"]),
    command_target=st.sampled_from(["action", "next_state"]),
    seed=st.integers(0, 1000),
)
def test_forward_loss_gradients_and_choices_equal_the_reference(dims, batch_size, length, seed, **settings_):
    reference, fast = make_pair(dims, seed, **settings_)
    inputs = torch.rand(batch_size, length, dims[0] + dims[1], dtype=torch.float64) * 1.6 - 0.8
    theirs, ours = run(reference, inputs, seed), run(fast, inputs, seed)
    for name, expected, value in zip(theirs[0]._fields, theirs[0], ours[0], strict=True):
        assert_close(value, expected, name, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(ours[2], theirs[2], rtol=1e-9, atol=0)
    for name, expected in theirs[3].items():
        assert_close(ours[3][name], expected, name, rtol=1e-7, atol=1e-12)
    if theirs[1] is None:
        assert ours[1] is None
        return
    for name in ("chosen", "horizon", "calmest"):
        expected = getattr(theirs[1], name)
        assert expected is getattr(ours[1], name) is None or torch.equal(getattr(ours[1], name), expected), name
    for name in ("noise_std", "baseline", "final"):
        assert_close(getattr(ours[1], name), getattr(theirs[1], name), name, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("exploration", ["noise", "none"])
def test_float32_agrees_to_its_precision_over_a_whole_episode(exploration):
    """Without selection, which may turn on the last bit, 150 steps stay together."""
    reference, fast = make_pair((7, 10, 50, 50, 20), 0, torch.float32, gain=1, exploration=exploration)
    inputs = torch.rand(2, 150, 17) * 1.6 - 0.8
    theirs, ours = run(reference, inputs, 0), run(fast, inputs, 0)
    torch.testing.assert_close(ours[0].mean, theirs[0].mean, rtol=0, atol=1e-5)
    torch.testing.assert_close(ours[0].log_variance, theirs[0].log_variance, rtol=0, atol=1e-5)
    for name, expected in theirs[3].items():
        assert (ours[3][name] - expected).norm() <= 1e-4 * expected.norm() + 1e-7, name


def test_float32_makes_the_choices_of_float64_wherever_they_are_not_a_tie():
    """One step from the same state at a time, so that one tie does not change all that follows."""
    single, double = (make_pair((7, 10, 50, 50, 20), 0, dtype)[1] for dtype in (torch.float32, torch.float64))
    memory, agreed, clear = double.initial_memory(20), 0, 0
    for _ in range(30):
        inputs = torch.rand(20, 17, dtype=torch.float64) * 1.6 - 0.8
        noise = torch.randn(5, 20, 120, dtype=torch.float64)
        traces = []
        for model in (single, double):
            number = next(model.parameters()).dtype
            model.foresight.sample_noise = lambda *_, number=number, noise=noise: noise.to(number)
            start = type(memory)(*(type(part)(*(value.to(number) for value in part)) for part in memory))
            after, trace = model.advance(inputs.to(number), start)
            traces.append(trace)
        memory = after
        best = (traces[1].baseline - traces[1].final).topk(2, dim=0).values
        is_clear = best[0] - best[1] > 1e-4
        agreed += int((traces[0].chosen == traces[1].chosen)[is_clear].sum())
        clear += int(is_clear.sum())
    assert clear > 300
    assert agreed == clear


def test_an_episode_is_the_same_step_by_step():
    _, fast = make_pair((3, 4, 6, 5, 4), 0)
    inputs = torch.rand(2, 6, 7, dtype=torch.float64)
    whole, traces = fast(inputs, torch.Generator().manual_seed(5))
    generator, memory = torch.Generator().manual_seed(5), fast.initial_memory(2)
    for step in range(6):
        memory, trace = fast.advance(inputs[:, step], memory, generator)
        torch.testing.assert_close(memory.prediction.mean, whole.mean[:, step])
        assert torch.equal(trace.chosen, traces.chosen[step])


def test_a_sequence_does_not_depend_on_threads_or_on_its_batch():
    """Beyond rounding: how many rows BLAS multiplies at once decides in which order it adds."""
    _, fast = make_pair((7, 10, 50, 50, 20), 0)
    inputs, noise = torch.rand(20, 3, 17).double(), torch.randn(20, 5, 3, 120).double()

    def last_state(rows, num_threads):
        draws = iter(noise[:, :, rows])
        fast.foresight.sample_noise = lambda *_: next(draws)
        memory = fast.initial_memory(len(rows))
        with threads(num_threads):
            for step_inputs in inputs[:, rows]:
                memory, _ = fast.advance(step_inputs, memory)
        return torch.cat(memory.state, dim=-1)

    together = last_state([0, 1, 2], 1)
    torch.testing.assert_close(last_state([0, 1, 2], 3), together, rtol=0, atol=1e-12)
    torch.testing.assert_close(last_state([1], 1), together[1:2], rtol=0, atol=1e-12)


def test_changed_weights_are_used_at_the_next_step():
    reference, fast = make_pair((3, 4, 6, 5, 4), 0, exploration="none")
    inputs = torch.rand(1, 7, dtype=torch.float64)
    for _ in range(3):
        fast.advance(inputs, fast.initial_memory(1))
        with torch.no_grad():
            for parameter in fast.network.parameters():
                parameter.mul_(1.1)
        ours, _ = fast.advance(inputs, fast.initial_memory(1))
        reference.load_state_dict(fast.state_dict())
        theirs, _ = reference.advance(inputs, reference.initial_memory(1))
        torch.testing.assert_close(ours.prediction.mean, theirs.prediction.mean)


def test_broken_weights_are_not_hidden():
    _, fast = make_pair((3, 4, 6, 5, 4), 0, torch.float32)
    with torch.no_grad():
        fast.network.shared_cell.weight_ih[0, 0] = float("nan")
    memory, _ = fast.advance(torch.rand(1, 7), fast.advance(torch.rand(1, 7), fast.initial_memory(1))[0])
    assert not torch.isfinite(memory.prediction.mean).all()


def test_autocast_does_not_reach_the_kernel():
    _, fast = make_pair((3, 4, 6, 5, 4), 0, torch.float32, exploration="none")
    inputs = torch.rand(2, 5, 7)
    expected = fast(inputs)[0].mean
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(fast(inputs)[0].mean, expected)


@pytest.mark.parametrize(("number", "tolerance"), [(np.float32, 4e-7), (np.float64, 1e-15)])
def test_tanh_is_accurate_everywhere_keeps_nan_and_bounds_infinity(number, tolerance):
    edges = [np.nan, np.inf, -np.inf, 0.0] * 9
    x = np.concatenate([edges, np.linspace(-12, 12, 200001), np.logspace(-30, 2, 1000)]).astype(number)
    squashed = x[None].copy()
    _squash(squashed, np.zeros(len(x), number))
    np.testing.assert_allclose(squashed[0], np.tanh(x.astype(np.longdouble)), rtol=tolerance, atol=0)


@pytest.mark.parametrize(("kernel", "expected"), [("auto", FastUFRNN), ("fast", FastUFRNN), ("reference", UFRNN)])
def test_the_configuration_chooses_the_kernel(dataset, kernel, expected):
    assert type(make_policy(small_config(kernel=kernel), ds_meta=dataset.meta).model) is expected


OTHER = {
    "perturbed_states": "shared",
    "variance_baseline": "candidate",
    "variance_aggregation": "entropy",
    "horizon_mode": "learned",
    "noise_scale": "log",
}


@pytest.mark.parametrize("name", COMPILED)
def test_a_reading_that_is_not_compiled_falls_back_and_fast_is_refused(dataset, name):
    assert type(make_policy(small_config({name: OTHER[name]}), ds_meta=dataset.meta).model) is UFRNN
    with pytest.raises(ValueError, match=f"does not compile foresight.{name}='{OTHER[name]}' .*{COMPILED[name]}"):
        make_policy(small_config({name: OTHER[name]}, kernel="fast"), ds_meta=dataset.meta)
    assert unsupported(small_config({name: OTHER[name]}, exploration="none")) is None


@pytest.mark.parametrize(
    "file", sorted((Path(__file__).parents[3] / "configs").glob("*rnn*.yaml")), ids=lambda f: f.stem
)
def test_every_configuration_that_is_shipped_is_compiled(file):
    assert unsupported(draccus.parse(TrainPipelineConfig, file, args=[]).policy) is None


def test_exploration_can_be_left_out_of_a_step():
    _, fast = make_pair((3, 4, 6, 5, 4), 0)
    plain, _ = make_pair((3, 4, 6, 5, 4), 0, exploration="none")
    inputs = torch.rand(2, 7, dtype=torch.float64)
    ours, trace = fast.advance(inputs, fast.initial_memory(2), explore=False)
    theirs, _ = plain.advance(inputs, plain.initial_memory(2))
    assert trace is None
    torch.testing.assert_close(ours.state.h_joint, theirs.state.h_joint, rtol=0, atol=1e-12)


def test_without_numba_the_reference_steps_in_and_fast_says_what_is_missing():
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "from small_network import network_config\n"
        "from lerobot_ufrnn.kernels import make_model\n"
        "print(type(make_model(network_config(kernel='auto'))).__name__)\n"
        "try: make_model(network_config(kernel='fast'))\n"
        "except ImportError as error: print(error)\n"
    )
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env)
    assert done.stdout.startswith("UFRNN\n")
    assert "pip install numba" in done.stdout
    assert "reference kernel" in done.stderr


def test_training_gives_the_same_weights_with_both_kernels(dataset):
    """Through the policy: both phases, all losses, three updates."""
    weights = []
    for kernel in ("fast", "reference"):
        torch.manual_seed(0)
        policy = make_policy(small_config(kernel=kernel, exploration="noise"), ds_meta=dataset.meta)
        assert isinstance(policy, UFRNNPolicy)
        train(policy, [batch_of(0, 1, 2)] * 5)
        weights.append({name: value.clone() for name, value in policy.state_dict().items()})
    for name, expected in weights[1].items():
        torch.testing.assert_close(weights[0][name], expected, rtol=1e-3, atol=1e-4)
