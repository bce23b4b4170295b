"""The table of interference: what became of the doors that somebody held once they had begun to open."""

from collections.abc import Iterable
from dataclasses import dataclass

from .evaluation_table import EvaluationRow, last_epochs, rate


@dataclass(frozen=True)
class InterferenceRow(EvaluationRow):
    """Trials of one checkpoint on one kind of door, in counts.

    Attributes:
        held (`int`): trials in which the door began to open and so was held.
        opened_after_hold (`int`): of those, opened within 300 steps (30 s).
        tried_another_way (`int`): of those held, trials with another direction tried meanwhile.
    """

    held: int
    opened_after_hold: int
    tried_another_way: int


def to_markdown(rows: Iterable[InterferenceRow]) -> str:
    """The summary for people: each model at its last epoch, pooled over training seeds.

    Args:
        rows (`Iterable[InterferenceRow]`):
            The table.

    Returns:
        `str`: rates with 95 % Wilson intervals, as if trials were independent.
    """
    lines = [
        "| model | epoch | seeds | held | opened after that, in 30 s | tried another way meanwhile |",
        "|---|---|---|---|---|---|",
    ]
    for model, of_model in last_epochs(rows).items():
        seeds = len({row.train_seed for row in of_model})
        lines.append(
            f"| {model} | {of_model[0].epoch} | {seeds} | {rate(of_model, 'held')} "
            f"| {rate(of_model, 'opened_after_hold', 'held')} | {rate(of_model, 'tried_another_way', 'held')} |"
        )
    return "\n".join(lines) + "\n"
