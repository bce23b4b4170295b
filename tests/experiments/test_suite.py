"""The suite of ambiguous tasks, with commands that are not run."""

import math

import numpy as np
import pandas as pd
import pytest
import suite
from matplotlib.image import imread
from suite import COUNTS, KEY, SuiteConfig, bootstrap, describe, fewest_steps, needless_tries, plan, read_counts

from env_door.trials import Trial
from env_forks.tasks import TASKS
from lerobot_ufrnn.commands import parse_flags


@pytest.fixture
def start(fake, tmp_path):
    """Starts the suite, two tasks unless told otherwise."""
    fake.steps = 12

    def main(*flags):
        own = ["--tasks=[three_ways,shown]", "--updates=[6,12]", "--trials_per_way=2", "--workers=1", "--sets=[1]"]
        own += ["--train_seeds=[0]", f"--output_dir={tmp_path / 'out'}", f"--results={tmp_path / 'results'}"]
        suite.main(parse_flags(SuiteConfig, [*own, *flags], "suite.py"))

    return main


def test_each_network_is_trained_once_and_tried_in_both_ways_at_both_checkpoints(start, fake, tmp_path):
    start()
    assert fake.names == ["ufrnn", "lerobot-train", *["lerobot-eval"] * 4] * 2
    (_, recorded), (_, trained), *tried = fake.commands[:6]
    assert recorded.items() >= {"env": "forks", "task": "three_ways", "seed": "1000", "episodes_per_kind": "5"}.items()
    assert (trained["save_freq"], trained["dataset.root"]) == ("6", recorded["root"])
    assert [(f["policy.path"][-23:-17], f.get("policy.recall.enabled")) for _, f in tried] == [
        (update, flag) for update in ("000006", "000012") for flag in (None, "false")
    ]
    assert {(f["env.type"], f["env.task"], f["seed"], f["eval.n_episodes"]) for _, f in tried} == {
        ("forks", "three_ways", "100000", "2")
    }
    table = read_counts(tmp_path / "results" / "counts.csv").set_index(KEY)[COUNTS[:-1]]
    assert len(table) == 8
    assert table.loc["three_ways", 1, 0, 12].to_dict("index") == {
        "ufrnn": dict(zip(COUNTS, (6, 6, 4, 4, 8, 160), strict=False)),
        "ufrnn+no_recall": dict(zip(COUNTS, (6, 2, 4, 0, 0, 40), strict=False)),
    }
    page = (tmp_path / "results" / "table.md").read_text()
    assert page.index("12 updates") < page.index("6 updates")
    assert "| three_ways | ufrnn+no_recall | 33 | 33 | 0 | 0.00 | 40 (57) | 1 x 6 |" in page
    assert imread(tmp_path / "results" / "picture.png").std() > 0.1


def test_what_is_done_is_not_done_again_and_what_failed_is_mended(start, fake, tmp_path):
    fake.fails = "shown/set1/ufrnn/seed0/train "
    with pytest.raises(RuntimeError, match=r"1 failed, see above: shown, set 1, ufrnn, seed 0: training\."):
        start()
    fake.fails = ""
    fake.commands.clear()
    start()
    assert fake.names == ["lerobot-train", *["lerobot-eval"] * 4]
    before = (tmp_path / "results" / "counts.csv").read_text()
    log = next((tmp_path / "out" / "shown").rglob("2_trials/update000006/trials.jsonl"))
    log.write_text(log.read_text()[:-20])  # as a kill leaves it
    fake.commands.clear()
    start()
    assert fake.names == ["lerobot-eval"]
    assert (tmp_path / "results" / "counts.csv").read_text() == before


def test_every_task_has_its_first_network_before_any_has_its_second():
    networks = plan(
        SuiteConfig(tasks=["lamp", "bends"], sets=[0, 1], train_seeds=[0, 1]), [suite.read_model(suite.MODEL)]
    )
    assert [network.name for network in networks][:3] == [
        f"{task}, ufrnn, seed 0" for task in ("lamp, set 0", "bends, set 0", "lamp, set 1")
    ]


@pytest.mark.parametrize(
    ("task", "way", "attempts", "needless"),
    [("three_ways", 2, (0, 1, 2), 0), ("three_ways", 2, (0, 1, 0, 2), 1), ("shown", 2, (1,), 1), ("shown", 1, (1,), 0)],
)
def test_a_try_is_needless_if_the_way_was_tried_before_or_was_shown(task, way, attempts, needless):
    ways = TASKS[task].suites
    assert needless_tries(TASKS[task], Trial(0, ways[way], True, 9, tuple(ways[each] for each in attempts))) == needless


def test_the_shortest_search_goes_back_to_the_fork_and_no_further():
    # To the fork 0.32, gates 0.175 behind it, ends 0.35: the median of three ways is the second.
    assert fewest_steps(TASKS["three_ways"]) == round((0.32 + 2 * 0.175 + 0.35) / 0.018)
    assert fewest_steps(TASKS["shown"]) == fewest_steps(TASKS["no_fork"]) == round((0.32 + 0.35) / 0.018)
    assert fewest_steps(TASKS["gives_way_later"]) == round(120 + 0.175 / 0.018)
    assert fewest_steps(TASKS["out_and_back"]) > fewest_steps(TASKS["three_ways"]) + (0.32 + 0.35) / 0.018 - 1


def test_the_interval_is_that_of_a_two_stage_bootstrap():
    index = pd.MultiIndex.from_product([["bends"], range(3), range(5)], names=["task", "set", "train_seed"])
    of_sets = pd.Series(np.repeat([20.0, 50.0, 80.0], 5), index)  # networks of a set do not differ
    assert bootstrap(of_sets) == (20, 80)  # each with probability 1/27
    of_seeds = pd.Series(np.tile([40.0, 45.0, 50.0, 55.0, 60.0], 3), index)
    low, high = bootstrap(of_seeds)
    assert (50 - low, high - 50) == pytest.approx([1.96 * math.sqrt(50 / 15)] * 2, rel=0.05)
    assert bootstrap(pd.Series(100.0, index)) is None


def test_the_mean_over_tasks_leaves_out_where_nothing_is_ambiguous():
    rows = [["bends", 0, 0, 9, "m", 10, 5, 4, 1, 0, 90.0, 82], ["shown", 0, 0, 9, "m", 10, 9, 0, 0, 2, 40.0, 37]]
    page = describe(pd.DataFrame([*rows, ["lamp", *rows[0][1:]]], columns=[*KEY, *COUNTS]))
    assert "| all ambiguous | m | 50 | 50 | 25 | 0.00 |" in page
    assert "| shown | m | 90 | 90 | - | 0.20 |" in page


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--tasks=[]"], "--tasks must be one or more, each once"),
        (["--tasks=[lamp,door]"], "got door too"),
        (["--updates=[1,500]"], "a checkpoint every 1 updates, over 200 in all"),
        (["--sets=[100]"], "`sets` must be at least 0 and at most 99, got"),
    ],
)
def test_a_bad_flag_ends_with_what_is_allowed(start, flags, message):
    with pytest.raises(ValueError, match=message):
        start(*flags)


def test_another_table_is_refused_before_the_work(start, fake, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "counts.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="first line must be task,set,train_seed,updates,model,trials,"):
        start()
    assert fake.names == []
