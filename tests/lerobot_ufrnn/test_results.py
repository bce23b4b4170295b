import csv
import math
from io import StringIO

import pytest

from env_door.trials import Trial
from lerobot_ufrnn.analysis.results import summarize, to_csv, to_markdown, wilson_interval


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


def test_counts_keep_first_tries_and_recoveries_apart():
    push, slide, overall = summarize(TRIALS)
    assert (push.kind, push.trials, push.opened_150, push.opened_300) == ("push", 5, 2, 3)
    assert (push.first_try, push.first_try_wrong, push.recovered, push.untried) == (1, 3, 2, 1)
    assert (slide.opened_300, slide.first_try, slide.first_try_wrong) == (1, 1, 0)
    assert (overall.kind, overall.trials, overall.opened_300, overall.recovered) == ("all", 6, 4, 2)


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (3, 10), (10, 10), (1, 1), (57, 100)])
def test_wilson_interval_is_its_closed_form(successes, trials):
    z = 1.959963984540054
    rate = successes / trials
    centre = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    low, high = wilson_interval(successes, trials)
    assert low == pytest.approx(max(0, centre - half), abs=1e-9)
    assert high == pytest.approx(min(1, centre + half), abs=1e-9)


def test_the_tables_say_the_same_to_people_and_to_programs():
    rows = summarize(TRIALS)
    text = to_markdown(rows)
    assert (
        "| push | 2/5 = 40% [12%, 77%] | 3/5 = 60% [23%, 88%] | 1/5 = 20% [4%, 62%] | 2/3 = 67% [21%, 94%] | 1 |"
        in text
    )
    table = list(csv.DictReader(StringIO(to_csv(rows))))
    assert [(row["kind"], row["opened_300"]) for row in table] == [("push", "3"), ("slide", "1"), ("all", "4")]


def test_no_trials_are_no_table():
    with pytest.raises(ValueError, match="no trials to summarise"):
        summarize([])
