"""Success per door with Wilson intervals, first tries and recoveries apart."""

import csv
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from io import StringIO
from typing import Any

from scipy.stats import binomtest

from env_door.trials import Trial

HALF_TIME = 150
"""Steps of a demonstration; a trial may take twice as long, which leaves time to recover from a wrong try."""


@dataclass(frozen=True)
class DoorResult:
    """Trials on one kind of door, in counts.

    Attributes:
        kind (`str`): kind of door, or `all`.
        trials (`int`): number of trials.
        opened_150 (`int`): opened within 150 steps (15 s).
        opened_300 (`int`): opened within 300 steps (30 s).
        first_try (`int`): opened with no wrong direction tried before.
        first_try_wrong (`int`): trials whose first direction was wrong.
        recovered (`int`): of those, opened within 300 steps.
        untried (`int`): trials in which the unlatched door was never loaded in any direction.
        held (`int`): trials in which somebody held the door once it had begun to open.
        opened_after_hold (`int`): of those, opened within 300 steps.
        tried_another_way (`int`): of those held, trials with another direction tried meanwhile.
    """

    kind: str
    trials: int
    opened_150: int
    opened_300: int
    first_try: int
    first_try_wrong: int
    recovered: int
    untried: int
    held: int
    opened_after_hold: int
    tried_another_way: int


def summarize(trials: Sequence[Trial]) -> list[DoorResult]:
    """Counts per kind of door, in the order of first appearance, and over all doors.

    Args:
        trials (`Sequence[Trial]`):
            Finished trials.

    Returns:
        `list[DoorResult]`: one row a kind, then `all`.

    Raises:
        ValueError: If there are no trials.
    """
    if not trials:
        raise ValueError("There are no trials to summarise; run lerobot-eval with --env.trial_log=<file> first.")
    kinds = list(dict.fromkeys(trial.door_kind for trial in trials))
    rows = [_count(kind, [trial for trial in trials if trial.door_kind == kind]) for kind in kinds]
    return [*rows, _count("all", trials)]


def _count(kind: str, trials: Sequence[Trial]) -> DoorResult:
    opened = [trial for trial in trials if trial.success and trial.steps <= 2 * HALF_TIME]
    return DoorResult(
        kind=kind,
        trials=len(trials),
        opened_150=sum(trial.steps <= HALF_TIME for trial in opened),
        opened_300=len(opened),
        first_try=sum(trial.first_try for trial in trials),
        first_try_wrong=sum(trial.first_try_wrong for trial in trials),
        recovered=sum(trial.first_try_wrong for trial in opened),
        untried=sum(not trial.attempts for trial in trials),
        held=sum(trial.held_at is not None for trial in trials),
        opened_after_hold=sum(trial.opened_after_hold for trial in opened),
        tried_another_way=sum(bool(trial.tried_while_held) for trial in trials),
    )


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a success rate.

    Args:
        successes (`int`):
            Number of successes.
        trials (`int`):
            Number of trials, at least 1.
        confidence (`float`, *optional*, defaults to `0.95`):
            Confidence level.

    Returns:
        `tuple[float, float]`: lower and upper bound, from 0 to 1.
    """
    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def newcombe_interval(
    successes: int, trials: int, other_successes: int, other_trials: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Hybrid score interval of the difference between two success rates, of independent trials.

    Method 10 of R. G. Newcombe: Interval estimation for the difference between independent proportions: comparison of
    eleven methods. Statistics in Medicine 17, 873-890 (1998).

    Args:
        successes (`int`):
            Number of successes.
        trials (`int`):
            Number of trials, at least 1.
        other_successes (`int`):
            Number of successes to compare with.
        other_trials (`int`):
            Number of their trials, at least 1.
        confidence (`float`, *optional*, defaults to `0.95`):
            Confidence level.

    Returns:
        `tuple[float, float]`: lower and upper bound of the first rate minus the other, from -1 to 1.
    """
    rate, other_rate = successes / trials, other_successes / other_trials
    low, high = wilson_interval(successes, trials, confidence)
    other_low, other_high = wilson_interval(other_successes, other_trials, confidence)
    difference = rate - other_rate
    return (
        difference - math.hypot(rate - low, other_high - other_rate),
        difference + math.hypot(high - rate, other_rate - other_low),
    )


def format_rate(successes: int, trials: int) -> str:
    """Counts, rate and 95 % Wilson interval, such as `3/5 = 60% [23%, 88%]`; `-` without trials."""
    if trials == 0:
        return "-"
    low, high = wilson_interval(successes, trials)
    return f"{successes}/{trials} = {successes / trials:.0%} [{low:.0%}, {high:.0%}]"


def to_markdown(rows: Sequence[DoorResult]) -> str:
    """The table for people: counts, success rate and its 95 % Wilson interval; a second one if doors were held."""
    lines = [
        "| door | opened in 15 s | opened in 30 s | at the first try | recovered from a wrong one | no try at all |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row.kind} | {format_rate(row.opened_150, row.trials)} | {format_rate(row.opened_300, row.trials)} "
            f"| {format_rate(row.first_try, row.trials)} | {format_rate(row.recovered, row.first_try_wrong)} "
            f"| {row.untried} |"
        )
    if any(row.held for row in rows):
        lines += ["", "| door | held | opened after that, in 30 s | tried another way meanwhile |", "|---|---|---|---|"]
        lines += [
            f"| {row.kind} | {format_rate(row.held, row.trials)} | {format_rate(row.opened_after_hold, row.held)} "
            f"| {format_rate(row.tried_another_way, row.held)} |"
            for row in rows
        ]
    return "\n".join(lines) + "\n"


def to_csv(rows: Sequence[Any]) -> str:
    """The table for programs: the fields of dataclasses of one type, a row each; one or more."""
    text = StringIO()
    writer = csv.DictWriter(text, [column.name for column in fields(rows[0])], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()
