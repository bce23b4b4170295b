from dataclasses import replace
from io import StringIO
from itertools import product

import numpy as np
import pandas as pd
import pytest

from env_door.trials import Trial
from lerobot_ufrnn.analysis.results import count_by_door, markdown, to_markdown, wilson_interval


def trial(kind: str, success: bool, steps: int, *attempts: str) -> Trial:
    return Trial(seed=0, door_kind=kind, success=success, steps=steps, attempts=attempts, opening=0.0, door_offset=0.0)


TRIALS = [
    trial("push", True, 90, "push"),
    trial("push", True, 150, "pull", "push"),
    trial("push", True, 151, "slide", "pull", "push"),
    trial("push", False, 300, "pull"),
    trial("push", False, 300),
    trial("slide", True, 100, "slide"),
]
HELD_TRIALS = [
    replace(TRIALS[0], held_at=70, tried_while_held=("pull", "slide")),
    replace(TRIALS[3], held_at=70, attempts=("pull", "push")),
    replace(TRIALS[5], held_at=70),
]


def row(counts: pd.DataFrame, kind: str, *columns: str) -> list[int]:
    return counts.loc[kind, list(columns)].tolist()


def test_held_doors_are_counted_apart():
    counts = count_by_door([*TRIALS[:2], *HELD_TRIALS])
    columns = ("held", "opened_after_hold", "tried_another_way")
    assert row(counts, "push", "trials", "opened_300", *columns) == [4, 3, 2, 1, 1]
    assert row(counts, "slide", *columns) == [1, 1, 0]
    assert row(counts, "all", *columns) == [3, 2, 1]
    text = to_markdown(counts)
    assert "| all | 3/5 = 60% [23%, 88%] | 2/3 = 67% [21%, 94%] | 1/3 = 33% [6%, 79%] |\n" in text
    assert "held" not in to_markdown(count_by_door(TRIALS))


def test_counts_keep_first_tries_and_recoveries_apart():
    counts = count_by_door(TRIALS)
    assert counts.index.tolist() == ["push", "slide", "all"]
    assert row(counts, "push", "trials", "opened_150", "opened_300") == [5, 2, 3]
    assert row(counts, "push", "first_try", "first_try_wrong", "recovered", "untried") == [1, 3, 2, 1]
    assert row(counts, "slide", "opened_300", "first_try", "first_try_wrong") == [1, 1, 0]
    assert row(counts, "all", "trials", "opened_300", "recovered") == [6, 4, 2]
    counts = count_by_door([trial("push", True, 90, "push", "pull", "push")])  # wrong after the right one: no recovery
    assert row(counts, "all", "opened_300", "first_try", "first_try_wrong", "recovered") == [1, 0, 0, 0]


@pytest.mark.parametrize(("successes", "trials"), [(1, 1), *product((0, 3, 10), (10, 57, 300))])
def test_the_interval_is_that_of_wilson(successes, trials):
    """Its bounds are the rates from which the measured one is 1.96 of their own standard deviations off."""
    rate, weight = successes / trials, 1.959963984540054**2 / trials
    expected = np.roots([1 + weight, -2 * rate - weight, rate**2])
    assert wilson_interval(successes, trials) == pytest.approx(sorted(expected), abs=1e-9)


def test_the_tables_say_the_same_to_people_and_to_programs():
    counts = count_by_door(TRIALS)
    text = to_markdown(counts)
    rates = "2/5 = 40% [12%, 77%] | 3/5 = 60% [23%, 88%] | 1/5 = 20% [4%, 62%] | 2/3 = 67% [21%, 94%] | 1"
    assert f"| push | {rates} |\n" in text
    assert f"| slide | {'1/1 = 100% [21%, 100%] | ' * 3}- | 0 |\n" in text  # without trials there is no rate
    assert "over the trials of one network" in text
    pd.testing.assert_frame_equal(pd.read_csv(StringIO(counts.to_csv()), index_col="kind"), counts)
    other = pd.DataFrame({"name": ["a", "b"], "count": [1, 2]}, index=[7, 8])
    assert markdown(other) == "| name | count |\n| --- | --- |\n| a | 1 |\n| b | 2 |\n"


def test_no_trials_are_no_table():
    with pytest.raises(ValueError, match="no trials to count"):
        count_by_door([])
