"""What do the networks open? Prints the tables of docs/results.md from the counts that sweep.py collected.

    python experiments/tables.py                                              # everything in experiments/results
    python experiments/tables.py --results=[experiments/results/ablation.csv]

A row of a CSV file is one network at one epoch, tried on one kind of door. Its trials are not independent samples of a
method: a network that fails at a door fails at it again and again. What is independent are networks, so a rate is the
mean over networks (training seeds) and its interval a 95 % t-interval over them, clipped to 0 to 100 %. A single
network has no interval. Networks that do not differ have none either: their spread of zero would claim that no network
ever differs.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from script import run

from lerobot_ufrnn.analysis.results import markdown

RESULTS = Path(__file__).parent / "results"
KEY = ["model", "train_seed", "epoch", "kind"]
SUCCESS_COUNTS = ["trials", "opened_150", "opened_300", "first_try_wrong", "recovered"]
HELD_COUNTS = ["trials", "held", "opened_after_hold", "tried_another_way"]
SUCCESS_RATES = {
    "opened in 30 s": ("opened_300", "trials"),
    "wrong first tries that were recovered": ("recovered", "first_try_wrong"),
    "opened in 15 s": ("opened_150", "trials"),
}
HELD_RATES = {
    "began to open, was held": ("held", "trials"),
    "of these, opened in 30 s": ("opened_after_hold", "held"),
    "of these, tried another way meanwhile": ("tried_another_way", "held"),
}
SAME = 1e-9  # difference in percentage points from which rates differ


@dataclass
class TablesConfig:
    """What to print."""

    results: list[Path] = field(default_factory=lambda: sorted(RESULTS.glob("*.csv")))  # tables of `sweep.py`


def read_table(path: Path, counts: Sequence[str] | None = None) -> pd.DataFrame:
    """Reads a table with these columns behind `KEY`, either kind when not given; refuses one whose counts cannot be."""
    if not path.exists():
        raise FileNotFoundError(f"There is no table of results at '{path}'; `python experiments/sweep.py` makes one.")
    allowed = [SUCCESS_COUNTS, HELD_COUNTS] if counts is None else [list(counts)]
    try:
        table = pd.read_csv(path, index_col=False, keep_default_na=False)
    except ValueError as error:  # empty, binary, or with lines of other lengths
        raise ValueError(f"{path} is no table of sweep.py: {error}.") from error
    if list(table)[:4] != KEY or list(table)[4:] not in allowed:
        lines = " or ".join(",".join([*KEY, *columns]) for columns in allowed)
        raise ValueError(f"{path} is no such table of sweep.py: its first line must be {lines}.")
    if table.empty:
        raise ValueError(f"{path} has no rows: the table is empty; `python experiments/sweep.py` fills it.")
    numbers = table.drop(columns=["model", "kind"]).apply(pd.to_numeric, errors="coerce")
    _refuse(path, ~(numbers == numbers.round()).all(axis=1), "is no row of the table, which are whole numbers")
    table[list(numbers)] = numbers.astype(int)
    _refuse(path, table.duplicated(KEY), "repeats a row: a table has one for a model, training seed, epoch and kind")
    _refuse(path, table.trials < 1, "counts no trials; it must be at least 1")
    for part, whole in rates_of(table).values():
        wrong = (table[part] < 0) | (table[part] > table[whole])
        _refuse(path, wrong, f"cannot be: {part} must be from 0 to {whole}")
    return table


def rates_of(table: pd.DataFrame) -> dict[str, tuple[str, str]]:
    """Which counts of a table make a rate: heading to part and whole."""
    return HELD_RATES if "held" in table else SUCCESS_RATES


def rates_of_networks(table: pd.DataFrame, by: Sequence[str] = ("model",)) -> pd.DataFrame:
    """Rates in percent of each network at its model's last epoch, a row for each of `by` and seed; NaN of nothing."""
    last = table[table.epoch == table.groupby("model").epoch.transform("max")]
    counts = last.groupby([*by, "train_seed"]).sum(numeric_only=True)
    return pd.DataFrame({name: 100 * counts[part] / counts[whole] for name, (part, whole) in rates_of(table).items()})


def interval(values: pd.Series, lowest: float = 0.0) -> tuple[float, float] | None:
    """95 % t-interval of a mean in percent, clipped to what it can be; None where values do not differ."""
    if len(values) < 2 or np.ptp(values) < SAME:
        return None
    return _clip(stats.ttest_1samp(values, 0), lowest)


def difference(rates: pd.Series, others: pd.Series, paired: bool) -> tuple[float, tuple[float, float] | None]:
    """Difference of two means over networks in percentage points, and its 95 % interval; None where nothing differs.

    `paired` if networks of the same seed are the same networks that act in another way; otherwise it is Welch's.
    """
    if paired:
        gaps = (rates - others).dropna()
        return round(gaps.mean(), 9), interval(gaps, lowest=-100)  # no difference of rounding
    rates, others = rates.dropna(), others.dropna()
    gap = rates.mean() - others.mean()
    if min(len(rates), len(others)) < 2 or max(np.ptp(rates), np.ptp(others)) < SAME:
        return gap, None
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # networks of one model may not differ
        return gap, _clip(stats.ttest_ind(rates, others, equal_var=False), lowest=-100)


def _clip(test: Any, lowest: float) -> tuple[float, float]:
    low, high = np.clip(test.confidence_interval(0.95), lowest, 100)
    return float(low), float(high)


def summarize_networks(table: pd.DataFrame, by: Sequence[str] = ("model",)) -> pd.DataFrame:
    """Cells of text such as `83 [53, 100]`: the first rate of each network, then each over networks, in percent."""
    rates = rates_of_networks(table, by)
    groups = rates.groupby(list(by))
    first = next(iter(rates))
    summary = groups[first].apply(lambda each: ", ".join(map(_number, each))).to_frame(f"{first}: each")
    for name in rates:
        summary[f"{name}: mean" if name == first else name] = groups[name].apply(
            lambda each: mean_text(each.mean(), interval(each.dropna()))
        )
    last = table[table.epoch == table.groupby("model").epoch.transform("max")]
    of_network = last.groupby([*by, "train_seed"]).trials.sum().groupby(list(by))
    summary["networks x trials"] = of_network.apply(
        lambda trials: f"{len(trials)} x {'/'.join(map(str, trials.unique()))}"
    )
    summary["epoch"] = last.groupby(list(by)).epoch.max()
    return summary.reset_index()


def differences(table: pd.DataFrame) -> pd.DataFrame:
    """How each two models of several networks differ, in percentage points with 95 % intervals over networks."""
    by_model = {
        model: rates.droplevel("model") for model, rates in rates_of_networks(table).groupby("model") if len(rates) > 1
    }
    rows = []
    # From the last name back, which is `ufrnn` minus its baselines.
    for (model, rates), (other, of_other) in combinations(reversed(by_model.items()), 2):
        paired = model.split("+")[0] == other.split("+")[0]
        cells = {name: mean_text(*difference(rates[name], of_other[name], paired), "+") for name in rates}
        rows.append({"difference": f"{model} - {other}", **cells})
    return pd.DataFrame(rows)


def describe(table: pd.DataFrame) -> str:
    """All that a table says: by model, how models differ, by kind of door."""
    sections = {
        "Percent of trials: each network, and mean [95 % over networks]": summarize_networks(table),
        "Differences in percentage points [95 % over networks]": differences(table),
        "Door by door": summarize_networks(table, ("model", "kind")),
    }
    return "\n".join(f"{title}:\n\n{markdown(rows)}" for title, rows in sections.items() if not rows.empty)


def mean_text(value: float, bounds: tuple[float, float] | None, sign: str = "") -> str:
    """A mean with its interval, such as `83 [53, 100]`."""
    if math.isnan(value):  # a rate of nothing
        return "-"
    return _number(value, sign) + (f" [{', '.join(_number(bound, sign) for bound in bounds)}]" if bounds else "")


def _number(value: float, sign: str = "") -> str:
    # With a digit more where rounding would make a failure or a success disappear.
    return f"{value:{sign}.{1 if 0 < abs(value) < 0.5 or 99.5 <= abs(value) < 100 else 0}f}"


def _refuse(path: Path, wrong: pd.Series, problem: str) -> None:
    if wrong.any():
        raise ValueError(f"{path}, line {wrong.idxmax() + 2} {problem}: repair or remove it.")


def main(config: TablesConfig) -> None:
    """Prints the tables."""
    for path in config.results:
        print(f"## {path.name}\n\n{describe(read_table(path))}\n")


if __name__ == "__main__":
    run(main, TablesConfig)
