import csv
import math
from dataclasses import replace
from io import StringIO

import pytest

from env_door.trials import Trial
from lerobot_ufrnn.analysis.results import newcombe_interval, summarize, to_csv, to_markdown, wilson_interval


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


def test_held_doors_are_counted_apart():
    push, slide, overall = summarize([*TRIALS[:2], *HELD_TRIALS])
    assert (push.trials, push.opened_300, push.held, push.opened_after_hold, push.tried_another_way) == (4, 3, 2, 1, 1)
    assert (slide.held, slide.opened_after_hold, slide.tried_another_way) == (1, 1, 0)
    assert (overall.held, overall.opened_after_hold, overall.tried_another_way) == (3, 2, 1)
    assert "| all | 3/5 = 60% [23%, 88%] | 2/3 = 67% [21%, 94%] | 1/3 = 33% [6%, 79%] |\n" in to_markdown([overall])
    assert "held" not in to_markdown(summarize(TRIALS))


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


@pytest.mark.parametrize(
    ("counts", "interval"),
    [
        ((56, 70, 48, 80), (0.0524, 0.3339)),
        ((9, 10, 3, 10), (0.1705, 0.8090)),
        ((6, 7, 2, 7), (0.0582, 0.8062)),
        ((5, 56, 0, 29), (-0.0381, 0.1926)),
        ((0, 10, 0, 20), (-0.1611, 0.2775)),
        ((0, 10, 0, 10), (-0.2775, 0.2775)),
        ((10, 10, 0, 20), (0.6791, 1.0)),
        ((10, 10, 0, 10), (0.6075, 1.0)),
    ],
)
def test_newcombe_interval_is_that_of_the_paper(counts, interval):
    """Newcombe (1998), Table II, method 10."""
    assert newcombe_interval(*counts) == pytest.approx(interval, abs=5e-5)


def test_a_wrong_try_after_the_right_one_is_no_recovery():
    overall = summarize([trial("push", True, 90, "push", "pull", "push")])[-1]
    assert (overall.opened_300, overall.first_try, overall.first_try_wrong, overall.recovered) == (1, 0, 0, 0)


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
