"""The table of undisturbed trials: how many doors were opened, and how many after a wrong try."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

from .evaluation_table import EvaluationRow, last_epochs, rate, total
from .results import newcombe_interval


@dataclass(frozen=True)
class ProtocolRow(EvaluationRow):
    """Trials of one checkpoint on one kind of door, in counts.

    Attributes:
        opened_150 (`int`): opened within 150 steps (15 s).
        opened_300 (`int`): opened within 300 steps (30 s).
        first_try_wrong (`int`): trials whose first direction was wrong.
        recovered (`int`): of those, opened within 300 steps.
    """

    opened_150: int
    opened_300: int
    first_try_wrong: int
    recovered: int


def to_markdown(rows: Iterable[ProtocolRow]) -> str:
    """The summary for people: each model at its last epoch, pooled over training seeds, and how the models differ.

    Intervals are those of independent trials. Trials of one training run have more in common than that, so that the
    spread over training seeds (`ufrnn curve`) is to be read beside them.

    Args:
        rows (`Iterable[ProtocolRow]`):
            The table.

    Returns:
        `str`: rates with 95 % Wilson intervals, then differences in percentage points with 95 % Newcombe intervals.
    """
    models = last_epochs(rows)
    lines = [
        "| model | epoch | seeds | opened in 15 s | opened in 30 s | worst door, in 30 s | recovered wrong tries |",
        "|---|---|---|---|---|---|---|",
    ]
    for model, of_model in models.items():
        doors = {kind: [row for row in of_model if row.kind == kind] for kind in {row.kind for row in of_model}}
        worst = min(sorted(doors), key=lambda kind: total(doors[kind], "opened_300") / total(doors[kind], "trials"))
        seeds = len({row.train_seed for row in of_model})
        lines.append(
            f"| {model} | {of_model[0].epoch} | {seeds} | {rate(of_model, 'opened_150')} "
            f"| {rate(of_model, 'opened_300')} | {worst} {rate(doors[worst], 'opened_300')} "
            f"| {rate(of_model, 'recovered', 'first_try_wrong')} |"
        )
    if len(models) > 1:
        lines += ["", "| difference | opened in 30 s, points |", "|---|---|"]
    for (model, of_model), (other, of_other) in combinations(models.items(), 2):
        opened, trials = total(of_model, "opened_300"), total(of_model, "trials")
        others_opened, others_trials = total(of_other, "opened_300"), total(of_other, "trials")
        low, high = newcombe_interval(opened, trials, others_opened, others_trials)
        difference = opened / trials - others_opened / others_trials
        lines.append(f"| {model} - {other} | {100 * difference:+.0f} [{100 * low:+.0f}, {100 * high:+.0f}] |")
    return "\n".join(lines) + "\n"
