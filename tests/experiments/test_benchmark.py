"""What the benchmark computes; not how long anything takes."""

import json
import platform
import sys
import time
from dataclasses import replace
from functools import partial

import benchmark
import numpy as np
import pandas as pd
import pytest
import torch
from benchmark import (
    BenchmarkConfig,
    main,
    make_episodes,
    make_model,
    make_scan_update,
    make_update,
    take_turns,
    time_ticks,
)
from draccus.utils import ParsingError
from small_network import enlarge, network_config

from lerobot_ufrnn.foresight import UFRNN
from lerobot_ufrnn.kernels.unroll import FastUFRNN

SMALL = {"config": network_config(), "batch_size": 3, "length": 8}


# ── The competitor ────────────────────────────────────────────────────


def test_the_scan_computes_what_the_reference_computes():
    pytest.importorskip("jax")
    import scan

    config = SMALL["config"]
    model = make_model(UFRNN, config).double()
    enlarge(model.network)  # so that candidates part
    episodes = [values.double() for values in make_episodes(*SMALL.values())]
    _, trace = model(episodes[0], torch.Generator().manual_seed(3))
    generator = torch.Generator().manual_seed(3)
    noise = torch.stack([model.foresight.sample_noise(model.network.initial_state(3), generator) for _ in range(8)])
    expected = benchmark.loss_of(model, *episodes, torch.Generator().manual_seed(3))
    expected.backward()
    loss_and_gradients = scan.jax.jit(scan.jax.value_and_grad(partial(scan.loss, config), has_aux=True))
    with scan.jax.enable_x64(True):
        (value, chosen), gradients = loss_and_gradients(
            {name: weight.detach().numpy() for name, weight in model.network.named_parameters()},
            *(values.transpose(0, 1).numpy() for values in episodes),
            noise.numpy(),
            np.stack((model.foresight.schedule.low.numpy(), model.foresight.schedule.high.numpy())),
        )
    assert len(set(trace.chosen.flatten().tolist())) > 1
    np.testing.assert_array_equal(chosen, trace.chosen)
    assert float(value) == pytest.approx(expected.item(), rel=1e-7)
    for name, weight in model.network.named_parameters():
        np.testing.assert_allclose(gradients[name], weight.grad, rtol=1e-5, atol=1e-8, err_msg=name)


def test_all_competitors_make_the_same_updates():
    pytest.importorskip("jax")
    # One candidate: nothing to choose, so that rounding cannot part them. A step takes 32 random numbers: PyTorch draws
    # multiples of 16 alike at once and step by step.
    config = network_config(shared_hidden_dim=5, foresight={"num_samples": 1})
    problem = {"config": config, "batch_size": 2, "length": 8}
    updates = [make_update(UFRNN, **problem), make_update(FastUFRNN, **problem), make_scan_update(**problem)]
    reference, fast, scan = ([update() for _ in range(4)] for update in updates)
    assert reference[-1] < reference[0]
    assert fast == pytest.approx(reference, rel=1e-4)
    assert scan == pytest.approx(reference, rel=1e-4)


# ── Timing ────────────────────────────────────────────────────────────


@pytest.fixture
def clock(monkeypatch):
    """A clock that calls turn; returns what does."""
    now = 0.0

    def turn(seconds):
        nonlocal now
        now += seconds

    monkeypatch.setattr(time, "perf_counter", lambda: now)
    return turn


def test_calls_take_turns_and_warm_up_uncounted(clock):
    durations = {"a": iter([9.0, 2.0, 4.0, 6.0]), "b": iter([9.0, 1.0, 4.0, 2.0])}
    times = take_turns({name: lambda name=name: clock(next(durations[name])) for name in durations}, 0, 3)
    assert times.to_dict("list") == {"a": [2000, 4000, 6000], "b": [1000, 4000, 2000]}


def test_turns_go_on_until_the_time_is_over(clock):
    assert len(take_turns({"a": lambda: clock(1)}, 10, 2)) == 10


def test_a_round_of_a_chunked_policy_begins_with_the_tick_that_computes(clock):
    class Chunked:
        config = type("Config", (), {"n_action_steps": 4})
        queue = 0

        def reset(self):
            self.queue = 0

        def select_action(self, batch):
            clock(0 if self.queue % 4 else 8.0)
            self.queue += 1

    (ticks,) = time_ticks({"chunked": Chunked()}, 0, 3).values()
    np.testing.assert_array_equal(ticks, [[8000, 0, 0, 0]] * 3)


# ── What is measured ──────────────────────────────────────────────────


@pytest.mark.parametrize("with_jax", [True, False])
def test_quick_ends_in_one_line_of_json(with_jax, monkeypatch, capsys):
    if with_jax:
        pytest.importorskip("jax")
    else:
        monkeypatch.setitem(sys.modules, "scan", None)
    quick_figures = benchmark.quick_figures
    monkeypatch.setattr(benchmark, "quick_figures", lambda: quick_figures(0, 1, **SMALL))
    main(BenchmarkConfig(quick=True))
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    names = "update_speedup_vs_reference update_ratio_vs_scan select_action_p99_ms update_ms update_reference_ms "
    assert list(figures) == f"{names}update_scan_ms select_action_p50_ms".split()
    for name, value in figures.items():
        assert value is None if "scan" in name and not with_jax else value > 0


def test_every_size_is_varied_around_the_papers(monkeypatch):
    problems = []
    monkeypatch.setattr(benchmark, "make_update", lambda kernel, **problem: lambda: problems.append(problem))
    assert list(benchmark.of_growth(0).what) == ["N", "T", "batch", "L", "hidden size"]
    paper = benchmark.PAPER
    configs = [problem["config"] for problem in problems if "config" in problem]
    assert replace(paper, foresight=replace(paper.foresight, num_samples=20)) in configs
    assert replace(paper, joint_hidden_dim=200, image_hidden_dim=200, shared_hidden_dim=80) in configs
    assert {"batch_size": 20} in problems


def test_a_part_is_measured_and_written_with_the_machine(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(benchmark.PARTS, "growth", lambda seconds: pd.DataFrame({"what": ["N"], "exponent": ["0.85"]}))
    main(BenchmarkConfig(parts=("growth",), output_dir=tmp_path))
    assert "| N | 0.85 |" in capsys.readouterr().out
    content = json.loads((tmp_path / "growth.json").read_text())
    assert content["table"] == [{"what": "N", "exponent": "0.85"}]
    assert content["machine"]["AVX-512"] in ("yes", "no", "unknown")
    assert platform.node() not in json.dumps(content) or not platform.node()
    assert (tmp_path / "growth.md").read_text().startswith("# Benchmark: growth\n\nprocessor ")


@pytest.mark.parametrize(
    ("setting", "message"),
    [({"parts": ("speed",)}, "--parts must be of"), ({"seconds": 0}, "`seconds` must be above 0")],
)
def test_a_bad_flag_is_refused(setting, message):
    with pytest.raises(ParsingError, match=message):
        BenchmarkConfig(**setting)
