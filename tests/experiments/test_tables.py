import statistics

import matplotlib.axes
import pandas as pd
import pytest
from curve import CurveConfig, draw
from curve import main as curve
from networks import add_to_table
from scipy import stats
from tables import (
    HELD_COUNTS,
    KEY,
    RESULTS,
    SUCCESS_COUNTS,
    TablesConfig,
    difference,
    differences,
    interval,
    main,
    read_table,
    summarize_networks,
)

HEADER = ",".join([*KEY, *SUCCESS_COUNTS])
HELD_HEADER = ",".join([*KEY, *HELD_COUNTS])


def results(model="ufrnn", opened=(9, 5), epochs=(100,), kinds=("push", "pull")) -> pd.DataFrame:
    """Networks of seed 0, 1, ... that opened so many of 10 doors of each kind, 4 of them tried in a wrong way first."""
    rows = [
        (model, seed, epoch, kind, 10, number // 2, number, 4, min(number, 4))
        for seed, number in enumerate(opened)
        for epoch in epochs
        for kind in kinds
    ]
    return pd.DataFrame(rows, columns=[*KEY, *SUCCESS_COUNTS])


def held(opened=(3, 8)) -> pd.DataFrame:
    rows = [("ufrnn", seed, 100, "pull", 10, 8, number, 0) for seed, number in enumerate(opened)]
    return pd.DataFrame(rows, columns=[*KEY, *HELD_COUNTS])


# ── Files ─────────────────────────────────────────────────────────────


def test_rows_are_merged_by_key_and_sorted(tmp_path):
    table = tmp_path / "results" / "table.csv"

    def add(rows):
        add_to_table(table, rows, KEY, lambda path: read_table(path, list(rows)[4:]))

    add(pd.concat([results(opened=(5,), kinds=("pull",)), results("act", (5,), kinds=("pull",))]))
    add(pd.concat([results(opened=(9,), kinds=("pull",)), results(opened=(5,), epochs=(20,))]))
    assert table.read_text().splitlines() == [
        HEADER,
        "act,0,100,pull,10,2,5,4,4",
        "ufrnn,0,20,pull,10,2,5,4,4",
        "ufrnn,0,20,push,10,2,5,4,4",
        "ufrnn,0,100,pull,10,4,9,4,4",
    ]
    assert [path.name for path in table.parent.iterdir() if path.suffix != ".lock"] == ["table.csv"]
    with pytest.raises(ValueError, match=f"first line must be {HELD_HEADER}"):
        add(held())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no table of sweep.py"),
        ("model,kind\n", f"first line must be {HEADER}"),
        (f"{HELD_HEADER}\nufrnn,0,100,pull,10,8,6,4\n", f"first line must be {HEADER}"),
        (f"{HEADER}\n", "the table is empty"),
        (f"{HEADER}\nufrnn,0,100,pull,10,3,5,6,2\nufrnn,0,100,push,10,3,5,6,x\n", "line 3 is no row"),
        (f"{HEADER}\nufrnn,0,100,pull,10,3,5,6\n", "line 2 is no row"),
        (f"{HEADER}\nufrnn,0,100,pull,10,3,5,6,2\nufrnn,0,100,pull,10,3,5,6,2\n", "line 3 repeats a row"),
        (f"{HEADER}\nufrnn,0,100,pull,0,0,0,0,0\n", "line 2 counts no trials"),
        (f"{HEADER}\nufrnn,0,100,pull,10,3,11,6,2\n", "line 2 cannot be: opened_300 must be from 0 to trials"),
        (f"{HEADER}\nufrnn,0,100,pull,10,3,5,1,2\n", "line 2 cannot be: recovered must be from 0 to first_try_wrong"),
    ],
)
def test_a_table_that_cannot_be_is_refused(tmp_path, text, message):
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_table(tmp_path / "table.csv", SUCCESS_COUNTS)


def test_a_missing_table_names_the_command_that_makes_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"`python experiments/sweep.py` makes one"):
        read_table(tmp_path / "table.csv")


# ── Intervals over networks ───────────────────────────────────────────


def test_the_interval_is_students_over_networks():
    rates = [70.0, 80.0, 84.0]
    half = 4.302653 * statistics.stdev(rates) / 3**0.5  # t of 2 degrees of freedom at 97.5 %, from a printed table
    assert interval(pd.Series(rates)) == pytest.approx((78 - half, 78 + half), rel=1e-6)


def test_an_interval_ends_where_rates_end():
    assert interval(pd.Series([5.0, 95.0])) == (0, 100)


@pytest.mark.parametrize("rates", [[100.0], [100.0, 100.0, 100.0]], ids=["one network", "no difference"])
def test_without_spread_there_is_no_interval(rates):
    assert interval(pd.Series(rates)) is None


def test_the_interval_of_a_difference_is_over_pairs_or_else_welchs():
    rates, others = pd.Series([70.0, 80.0, 84.0]), pd.Series([60.0, 79.0, 70.0])
    gaps = [10.0, 1.0, 14.0]
    half = 4.302653 * statistics.stdev(gaps) / 3**0.5
    assert difference(rates, others, True) == (pytest.approx(25 / 3), pytest.approx((25 / 3 - half, 25 / 3 + half)))
    shares = [statistics.variance(group) / 3 for group in (rates, others)]
    freedom = sum(shares) ** 2 / sum(share**2 / 2 for share in shares)  # Welch and Satterthwaite
    half = stats.t.ppf(0.975, freedom) * sum(shares) ** 0.5
    assert difference(rates, others, False) == (pytest.approx(25 / 3), pytest.approx((25 / 3 - half, 25 / 3 + half)))


@pytest.mark.parametrize("paired", [True, False])
def test_networks_that_do_not_differ_or_are_too_few_have_a_difference_without_interval(paired, recwarn):
    same, others, nothing = pd.Series([100.0, 100.0]), pd.Series([60.0, 70.0]), float("nan")
    assert difference(same, same - 10, paired) == (10, None)
    # 35 +- 12.71 * 5, with one degree of freedom
    assert difference(same, others, paired) == (35, pytest.approx((-28.53, 98.53), abs=0.01))
    assert difference(same, pd.Series([60.0, nothing]), paired) == (40, None)
    assert difference(same, pd.Series([nothing, nothing]), paired) == (pytest.approx(nothing, nan_ok=True), None)
    assert not recwarn


def test_a_row_tells_each_network_and_the_mean_of_the_last_epoch():
    table = pd.concat([results(opened=(9, 5)), results(opened=(0, 0), epochs=(20,)), results("act", (3,), (7,))])
    act, ufrnn = summarize_networks(table).to_numpy().tolist()
    assert act == ["act", "30", "30", "75", "10", "1 x 20", 7]
    assert ufrnn == ["ufrnn", "90, 50", "70 [0, 100]", "100", "30 [0, 100]", "2 x 20", 100]
    kinds = summarize_networks(table, ("model", "kind"))
    assert list(kinds.kind) == ["pull", "push"] * 2


def test_a_rate_of_nothing_is_left_out():
    table = results(opened=(9, 5, 2))
    table.loc[table.train_seed == 0, ["first_try_wrong", "recovered"]] = 0
    table.loc[table.train_seed == 1, "recovered"] = 0
    low_and_high = interval(pd.Series([0.0, 50.0]))
    cell = summarize_networks(table)["wrong first tries that were recovered"].item()
    assert cell == f"25 [{low_and_high[0]:.0f}, {low_and_high[1]:.0f}]"
    table[["first_try_wrong", "recovered"]] = 0
    assert summarize_networks(table)["wrong first tries that were recovered"].item() == "-"


def test_only_held_doors_count_after_the_hold():
    (row,) = summarize_networks(held()).to_numpy().tolist()
    assert row == ["ufrnn", "80, 80", "80", "69 [0, 100]", "0", "2 x 10", 100]  # 3 and 8 of 8


def test_models_of_several_networks_are_compared_and_variants_network_by_network():
    table = pd.concat([results(opened=(9, 8, 9)), results("ufrnn+blind", (6, 5, 6)), results("act", (3,))])
    table.loc[(table.train_seed == 1) & (table.model == "ufrnn"), "opened_300"] += 1
    (row,) = differences(table).to_numpy().tolist()
    assert row[:2] == ["ufrnn+blind - ufrnn", "-33 [-48, -19]"]  # -30, -40 and -30 points
    assert differences(results("act", (3,))).empty


def test_the_committed_tables_are_printed(capsys):
    main(TablesConfig())
    out = capsys.readouterr().out
    assert all(path.name in out for path in RESULTS.glob("*.csv"))
    assert "| sh_rnn_noise | 83, 71, 95 | 83 [53, 100] |" in out


# ── The curve ─────────────────────────────────────────────────────────


@pytest.fixture
def stacks(monkeypatch):
    """What is stacked in each panel: epochs and shares."""
    drawn = []
    plain = matplotlib.axes.Axes.stackplot
    monkeypatch.setattr(
        matplotlib.axes.Axes,
        "stackplot",
        lambda panel, x, y, **options: drawn.append((list(x), y.to_numpy().tolist())) or plain(panel, x, y, **options),
    )
    return drawn


def test_the_areas_of_all_kinds_sum_up_to_the_rate_of_all_networks(tmp_path, stacks):
    table = pd.concat([results(opened=(8,), epochs=(100, 200)), results(opened=(8, 4), epochs=(300,))])
    draw(table, tmp_path / "pictures" / "curve.png")
    assert (tmp_path / "pictures" / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert stacks == [([100, 200, 300], [[0.4, 0.4, 0.3], [0.4, 0.4, 0.3]])]


def test_a_model_with_a_single_epoch_is_left_out_and_refused_alone(tmp_path, stacks):
    once, twice = results("once"), results("twice", epochs=(100, 200))
    draw(pd.concat([once, twice]), tmp_path / "curve.png")
    assert [x for x, _ in stacks] == [[100, 200]]
    with pytest.raises(ValueError, match=r"run sweep.py with --epochs"):
        draw(once, tmp_path / "curve.png")


def test_the_curve_is_a_command(tmp_path):
    (tmp_path / "table.csv").write_text(results(epochs=(100, 200)).to_csv(index=False))
    curve(CurveConfig(tmp_path / "table.csv", tmp_path / "curve.png"))
    assert (tmp_path / "curve.png").exists()
