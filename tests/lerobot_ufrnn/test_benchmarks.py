"""What the benchmark computes and concludes; not how long anything takes."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from small import small_config

from lerobot_ufrnn.benchmarks import sections
from lerobot_ufrnn.benchmarks.acting import ActingTimes
from lerobot_ufrnn.benchmarks.growth import Growth, measure_growth, resize
from lerobot_ufrnn.benchmarks.pipeline import training_speed, watch
from lerobot_ufrnn.benchmarks.report import Section, Target, describe_machine, write_report
from lerobot_ufrnn.benchmarks.timing import Spread, one_thread, take_turns
from lerobot_ufrnn.benchmarks.update import Problem, make_scan_update, make_torch_update, torch_loss
from lerobot_ufrnn.commands import benchmark, main
from lerobot_ufrnn.kernels.unroll import FastUFRNN
from lerobot_ufrnn.recurrent import UFRNN


@pytest.fixture
def problem():
    """Small, but with several of everything."""
    return Problem(batch_size=3, length=8, joint_dim=3, config=small_config())


# ── The competitor ────────────────────────────────────────────────────


def test_the_scan_computes_what_the_reference_computes(problem):
    pytest.importorskip("jax")
    from lerobot_ufrnn.benchmarks import scan

    model = problem.make_model(UFRNN).double()
    for parameter in model.parameters():  # larger weights than at the start, so that candidates part
        parameter.data.mul_(2)
    episodes = [values.double() for values in problem.make_episodes()]
    _, trace = model(episodes[0], torch.Generator().manual_seed(3))
    assert trace is not None
    generator = torch.Generator().manual_seed(3)
    noise = torch.stack(
        [model.foresight.sample_noise(model.network.initial_state(3), generator) for _ in range(problem.length)]
    )
    expected = torch_loss(model, *episodes, torch.Generator().manual_seed(3))
    expected.backward()
    loss_and_gradients = scan.jax.jit(scan.jax.value_and_grad(scan.loss, has_aux=True), static_argnames="sizes")
    with scan.jax.enable_x64(True):
        (value, chosen), gradients = loss_and_gradients(
            {name: weight.detach().numpy() for name, weight in model.network.named_parameters()},
            *(values.transpose(0, 1).numpy() for values in episodes),
            noise.numpy(),
            np.stack((model.foresight.schedule.low.numpy(), model.foresight.schedule.high.numpy())),
            sizes=problem.scan_sizes,
        )
    assert len(set(trace.chosen.flatten().tolist())) > 1
    np.testing.assert_array_equal(chosen, trace.chosen)
    assert float(value) == pytest.approx(expected.item(), rel=1e-7)
    for name, weight in model.network.named_parameters():
        assert weight.grad is not None
        np.testing.assert_allclose(gradients[name], weight.grad, rtol=1e-5, atol=1e-8, err_msg=name)


def test_all_competitors_make_the_same_updates(problem):
    pytest.importorskip("jax")
    # One candidate: nothing to choose, so that rounding cannot part them. A step takes 32 random numbers: PyTorch draws
    # multiples of 16 alike at once and step by step.
    alone = replace(problem, batch_size=2, config=small_config(num_samples=1, shared_hidden_dim=5))
    updates = [make_torch_update(alone, UFRNN), make_torch_update(alone, FastUFRNN), make_scan_update(alone)]
    reference, fast, scan = ([update() for _ in range(4)] for update in updates)
    assert reference[-1] < reference[0]
    assert fast == pytest.approx(reference, rel=1e-4)
    assert scan == pytest.approx(reference, rel=1e-4)


# ── Timing ────────────────────────────────────────────────────────────


def test_turns_give_medians_and_ratios_of_each_rounds_pair():
    now = 0.0
    durations = {"a": iter([9.0, 2.0, 4.0, 6.0]), "b": iter([9.0, 1.0, 4.0, 2.0])}

    def call(name):
        nonlocal now
        now += next(durations[name])

    rounds = take_turns({name: lambda name=name: call(name) for name in durations}, 0, 3, 1, clock=lambda: now)
    assert rounds.seconds == {"a": [2, 4, 6], "b": [1, 4, 2]}
    assert rounds.spread("a") == Spread(4, pytest.approx(2.4), pytest.approx(5.6), 3)
    assert rounds.ratio("a", "b").median == 2  # of 2, 1, 3; the ratio of the medians is 2 as well
    assert rounds.ratio("b", "a").median == 0.5


def test_turns_go_on_until_the_time_is_over():
    now = 0.0

    def call():
        nonlocal now
        now += 1

    assert len(take_turns({"a": call}, 10, 2, 1, clock=lambda: now).seconds["a"]) == 10


def test_one_thread_gives_threads_back():
    before = torch.get_num_threads()
    with one_thread(pin=True):
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before


def test_the_worst_tick_of_a_chunked_policy_is_the_one_that_computes():
    times = ActingTimes([[8.0, 0.0, 0.0, 0.0], [12.0, 0.0, 0.0, 0.0], [40.0, 0.0, 0.0, 0.0]])
    assert times.worst.median == 12
    assert times.amortised.median == 3
    assert times.worst_against(2.0).median == 6


# ── Growth ────────────────────────────────────────────────────────────


def growth(cost) -> Growth:
    sizes = (1, 2, 5, 10, 20)
    return Growth("N", sizes, tuple(Spread(cost(size), 0, 0, 1) for size in sizes))


@pytest.mark.parametrize(
    ("cost", "verdict"),
    [
        (lambda n: 3 + 2 * n, "linear"),
        (lambda n: 2.0 * n, "linear"),
        (lambda n: n**2, "more than linear"),
        (lambda n: 10 + n**2, "more than linear"),
        (lambda n: n**0.5, "less than linear"),
    ],
)
def test_growth_is_linear_only_if_the_marginal_cost_is_constant(cost, verdict):
    assert growth(cost).verdict == verdict


def test_growth_exponent_of_a_power():
    assert growth(lambda n: 7 * n**1.5).exponent == pytest.approx(1.5)


def test_every_size_can_be_varied(problem):
    assert (
        resize(problem, "batch", 9).batch_size
        == resize(problem, "L", 9).length
        == resize(problem, "T", 9).config.horizon
    )
    assert resize(problem, "N", 7).config.num_samples == 7
    assert resize(problem, "hidden size", 2).config.joint_hidden_dim == 12
    with pytest.raises(ValueError, match="colour"):
        resize(problem, "colour", 1)
    rows = measure_growth(0, problem, {"N": (1, 2, 3), "T": (1, 2, 3)})
    assert [row.name for row in rows] == ["N", "T"]


# ── The main job ──────────────────────────────────────────────────────


def test_stages_get_their_seconds_and_memory(tmp_path):
    program = (
        "import time; print('hello'); print('[1/2] small'); time.sleep(1.2); "
        "print('[2/2] large'); x = b'1' * 300_000_000; time.sleep(1.2)"
    )
    small, large = watch([sys.executable, "-u", "-c", program], tmp_path / "log")
    assert (small.name, large.name) == ("small", "large")
    assert 1.1 < large.seconds < 20
    assert large.peak_bytes - small.peak_bytes > 200_000_000
    assert "hello" in (tmp_path / "log").read_text()


def test_a_failing_job_is_an_error(tmp_path):
    with pytest.raises(RuntimeError, match="status 3"):
        watch([sys.executable, "-c", "print('[1/1] x'); raise SystemExit(3)"], tmp_path / "log")


def test_training_speed_leaves_the_autoencoder_out():
    lines = [
        "step:50 updt_s:0.900 data_s:0.500",
        "Autoencoder done: 100 frames encoded",
        "step:100 updt_s:0.800 data_s:0.400",
        "step:150 updt_s:0.100 data_s:0.002",
        "step:200 updt_s:0.300 data_s:0.004",
    ]
    speed = training_speed(lines)
    assert speed is not None
    assert (speed.update_seconds, speed.data_seconds) == (pytest.approx(0.2), pytest.approx(0.003))
    assert training_speed(lines[:3]) is None


# ── The report and the command ────────────────────────────────────────


def test_report_has_verdicts_tables_and_numbers(tmp_path):
    targets = (
        Target("fast enough", 9.0, 8, at_least=True),
        Target("short enough", 3.0, 2, at_least=False),
        Target("compared", None, 1, at_least=False),
    )
    write_report("speed", [Section("Speed", ("a", "b"), [["1", "2"]], "A note.", targets, {"a": 1.0})], tmp_path)
    text = (tmp_path / "speed.md").read_text()
    assert "| fast enough | 9 | >= 8 | met |" in text
    assert "| short enough | 3 | <= 2 | not met |" in text
    assert "| compared | - | <= 1 | not measured |" in text
    assert "## Speed\n\nA note.\n\n| a | b |\n| --- | --- |\n| 1 | 2 |" in text
    content = json.loads((tmp_path / "speed.json").read_text())
    assert content["measurements"]["Speed"] == {"a": 1.0}
    assert content["targets"][1]["verdict"] == "not met"


def test_acting_is_judged_by_the_worst_tick_of_the_others(monkeypatch):
    times = {sections.FAST: ActingTimes([[0.001] * 100]), sections.ACT: ActingTimes([[0.05, 0.0], [0.07, 0.0]])}
    monkeypatch.setattr(sections, "measure_policies", lambda seconds: times)
    ours, diffusion, act = sections.of_acting(1.0).targets
    assert (ours.value, ours.verdict) == (1.0, "met")
    assert diffusion.verdict == "not measured"
    assert act.value == pytest.approx(60)


def test_the_machine_is_described_without_its_name():
    import platform

    assert platform.node() not in json.dumps(describe_machine()) or not platform.node()


@pytest.mark.parametrize("with_jax", [True, False])
def test_quick_ends_in_one_line_of_json(with_jax, problem, monkeypatch, capsys):
    if not with_jax:
        monkeypatch.setitem(sys.modules, "lerobot_ufrnn.benchmarks.scan", None)
    elif "jax" not in sys.modules:
        pytest.importorskip("jax")
    measure_update = benchmark.measure_update
    monkeypatch.setattr(benchmark, "measure_update", lambda seconds: measure_update(0, problem))
    monkeypatch.setattr(benchmark, "QUICK_TICKS", 100)
    assert main(["benchmark", "--quick"]) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    names = ["update_speedup_vs_reference", "update_ratio_vs_scan", "select_action_p99_ms"]
    assert list(figures)[:3] == names
    for name in names:
        assert figures[name] is None if name == names[1] and not with_jax else figures[name] > 0


@pytest.mark.parametrize(
    ("flag", "message"), [("--parts=[speed]", "--parts must be of"), ("--seconds=0", "--seconds must be above 0")]
)
def test_a_bad_flag_is_refused(flag, message, capsys):
    assert main(["benchmark", flag]) == 1
    assert message in capsys.readouterr().err


def test_a_part_is_measured_and_written(tmp_path, monkeypatch, capsys):
    section = Section("Growth", ("a",), [["1"]])
    monkeypatch.setitem(benchmark.PARTS, "growth", lambda seconds, folder: [section])
    assert main(["benchmark", "--parts=[growth]", f"--output_dir={tmp_path}"]) == 0
    assert "## Growth" in capsys.readouterr().out
    assert (tmp_path / "growth.json").exists()
