"""Success per door, first tries and recoveries apart, with intervals over the trials of one network."""

from collections.abc import Sequence

import pandas as pd
from scipy.stats import binomtest

from env_door.trials import Trial

HALF_TIME = 150
"""Steps of a demonstration; a trial may take twice as long, which leaves time to recover from a wrong try."""

RATES = {
    "opened in 15 s": ("opened_150", "trials"),
    "opened in 30 s": ("opened_300", "trials"),
    "at the first try": ("first_try", "trials"),
    "recovered from a wrong one": ("recovered", "first_try_wrong"),
}
HELD_RATES = {
    "held": ("held", "trials"),
    "opened after that, in 30 s": ("opened_after_hold", "held"),
    "tried another way meanwhile": ("tried_another_way", "held"),
}
WHAT_INTERVALS_ARE_OVER = (
    "In brackets: 95 % Wilson intervals over the trials of one network; networks trained with other seeds may differ "
    "by more.\n"
)


def count_by_door(trials: Sequence[Trial]) -> pd.DataFrame:
    """Counts the trials of one evaluation: a row for each kind of door, in order of appearance, and `all`.

    Columns are `trials`; `opened_150`, `opened_300`: opened within 150 and 300 steps (15 and 30 s); `first_try`: opened
    with no wrong direction tried before; `first_try_wrong`: first direction was wrong; `recovered`: of those, opened
    within 300 steps; `untried`: the unlatched door was never loaded in any direction; `held`: somebody held the door
    once it had begun to open; of those `opened_after_hold` within 300 steps, and `tried_another_way` meanwhile.
    """
    if not trials:
        raise ValueError("There are no trials to count; run lerobot-eval with --env.trial_log=<file> first.")
    rows = []
    for trial in trials:
        opened = trial.success and trial.steps <= 2 * HALF_TIME
        rows.append(
            {
                "kind": trial.door_kind,
                "trials": 1,
                "opened_150": opened and trial.steps <= HALF_TIME,
                "opened_300": opened,
                "first_try": trial.first_try,
                "first_try_wrong": trial.first_try_wrong,
                "recovered": opened and trial.first_try_wrong,
                "untried": not trial.attempts,
                "held": trial.held_at is not None,
                "opened_after_hold": opened and trial.opened_after_hold,
                "tried_another_way": bool(trial.tried_while_held),
            }
        )
    counts = pd.DataFrame(rows).groupby("kind", sort=False).sum().astype(int)
    counts.loc["all"] = counts.sum()
    return counts


def to_markdown(counts: pd.DataFrame) -> str:
    """What `count_by_door` counted as Markdown, with intervals."""
    return "\n".join([*(markdown(table.reset_index()) for table in rate_tables(counts)), WHAT_INTERVALS_ARE_OVER])


def rate_tables(counts: pd.DataFrame) -> list[pd.DataFrame]:
    """What `count_by_door` counted as a table of rates with intervals; a second one if doors were held."""
    tables = [_rates(counts, RATES).assign(**{"no try at all": counts["untried"]})]
    return tables + [_rates(counts, HELD_RATES)] * bool(counts["held"].any())


def _rates(counts: pd.DataFrame, columns: dict[str, tuple[str, str]]) -> pd.DataFrame:
    rates = {
        heading: [format_rate(*row) for row in counts[[part, whole]].itertuples(index=False)]
        for heading, (part, whole) in columns.items()
    }
    return pd.DataFrame(rates, index=counts.index.rename("kind"))


def markdown(table: pd.DataFrame) -> str:
    """A table as Markdown, without its index."""
    lines = [table.columns, ["---"] * table.shape[1], *table.itertuples(index=False)]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


def format_rate(successes: int, trials: int) -> str:
    """Counts, rate and 95 % Wilson interval, such as `3/5 = 60% [23%, 88%]`; `-` without trials."""
    if trials == 0:
        return "-"
    low, high = wilson_interval(successes, trials)
    return f"{successes}/{trials} = {successes / trials:.0%} [{low:.0%}, {high:.0%}]"


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % Wilson score interval of a success rate: lower and upper bound, from 0 to 1."""
    interval = binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
