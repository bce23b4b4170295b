"""Tables of evaluations: one row a model, training seed, epoch and kind of door, counts only."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from .results import DoorResult
from .results import to_csv as fields_to_csv


@dataclass(frozen=True)
class EvaluationRow:
    """Trials of one checkpoint on one kind of door; each table adds its counts, named as in `DoorResult`.

    Attributes:
        model (`str`): name of the model.
        train_seed (`int`): seed of its training.
        epoch (`int`): epoch of the checkpoint.
        kind (`str`): kind of door.
        trials (`int`): number of trials.
    """

    model: str
    train_seed: int
    epoch: int
    kind: str
    trials: int

    @property
    def key(self) -> tuple[str, int, int, str]:
        """`tuple[str, int, int, str]`: what was tried; a table has one row for it."""
        return self.model, self.train_seed, self.epoch, self.kind


@dataclass(frozen=True)
class ProtocolRow(EvaluationRow):
    """Undisturbed trials of one checkpoint on one kind of door, in counts.

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


@dataclass(frozen=True)
class InterferenceRow(EvaluationRow):
    """Trials of one checkpoint on one kind of door that somebody held once it had begun to open, in counts.

    Attributes:
        held (`int`): trials in which the door began to open and so was held.
        opened_after_hold (`int`): of those, opened within 300 steps (30 s).
        tried_another_way (`int`): of those held, trials with another direction tried meanwhile.
    """

    held: int
    opened_after_hold: int
    tried_another_way: int


def columns_of(row_type: type[EvaluationRow]) -> list[str]:
    """Names of the columns of a table."""
    return [column.name for column in fields(row_type)]


def rows_of[Row: EvaluationRow](
    row_type: type[Row], model: str, train_seed: int, epoch: int, doors: Iterable[DoorResult]
) -> list[Row]:
    """The rows of one checkpoint.

    Args:
        row_type (`type[Row]`):
            Of which table.
        model (`str`):
            Name of the model.
        train_seed (`int`):
            Seed of its training.
        epoch (`int`):
            Epoch of the checkpoint.
        doors (`Iterable[DoorResult]`):
            What `summarize` counted; its row `all` is left out.

    Returns:
        `list[Row]`: one row a kind of door.
    """
    counts = columns_of(row_type)[4:]
    return [
        row_type(model, train_seed, epoch, door.kind, *(getattr(door, name) for name in counts))
        for door in doors
        if door.kind != "all"
    ]


def read_table[Row: EvaluationRow](path: Path, row_type: type[Row]) -> list[Row]:
    """Reads a table.

    Args:
        path (`Path`):
            CSV file of `to_csv`.
        row_type (`type[Row]`):
            Which table it is.

    Returns:
        `list[Row]`: its rows.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is another kind of table; the message names the line.
    """
    if not path.exists():
        raise FileNotFoundError(f"There is no table of results at '{path}'; `ufrnn protocol` makes one.")
    columns = columns_of(row_type)
    lines = list(csv.reader(path.read_text().splitlines()))
    if not lines or lines[0] != columns:
        raise ValueError(f"{path} is not such a table of `ufrnn protocol`: its first line must be {','.join(columns)}.")
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            model, train_seed, epoch, kind, *counts = line
            rows.append(row_type(model, int(train_seed), int(epoch), kind, *map(int, counts)))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}, line {number} is no row of the table ({error}): repair or remove it.") from error
    return rows


def to_csv(rows: Sequence[EvaluationRow]) -> str:
    """The table as CSV, sorted: one row or more, all of the same table."""
    return fields_to_csv(sorted(rows, key=lambda row: row.key))


def total(rows: Iterable[EvaluationRow], name: str) -> int:
    """Sum of a column of counts."""
    return sum(getattr(row, name) for row in rows)


def last_epochs[Row: EvaluationRow](rows: Iterable[Row]) -> dict[str, list[Row]]:
    """For each model, by name, the rows of its last epoch."""
    models: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: row.key):
        models.setdefault(row.model, []).append(row)
    return {
        model: [row for row in of_model if row.epoch == max(row.epoch for row in of_model)]
        for model, of_model in models.items()
    }
