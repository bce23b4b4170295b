"""Tables of success rates with Wilson intervals, each model at its last epoch and pooled over training seeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from .evaluation_table import EvaluationRow, InterferenceRow, ProtocolRow, last_epochs, read_table, total
from .results import format_rate, newcombe_interval, wilson_interval

MINUS, DASH = "\N{MINUS SIGN}", "\N{EN DASH}"


@dataclass(frozen=True)
class Rate:
    """Successes out of trials.

    Attributes:
        successes (`int`): number of successes.
        trials (`int`): number of trials; there is no rate of none.
    """

    successes: int
    trials: int

    @property
    def percent(self) -> float:
        """`float`: success rate in percent."""
        return 100 * self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """`tuple[float, float]`: 95 % Wilson interval in percent."""
        low, high = wilson_interval(self.successes, self.trials)
        return 100 * low, 100 * high


@dataclass(frozen=True)
class RateColumn:
    """Which counts of an evaluation make a rate.

    Attributes:
        heading (`str`): what is counted.
        successes (`str`): column of the successes.
        trials (`str`): column of what they are a part of.
        less (`str`): column to subtract from the successes; may be empty.
    """

    heading: str
    successes: str
    trials: str = "trials"
    less: str = ""

    def of(self, rows: Sequence[EvaluationRow]) -> Rate:
        """The rate, pooled over rows."""
        less = total(rows, self.less) if self.less else 0
        return Rate(total(rows, self.successes) - less, total(rows, self.trials))


SUCCESS_COLUMNS = (
    RateColumn("opened in 30 s", "opened_300"),
    RateColumn("recovered from a wrong guess", "recovered", "first_try_wrong"),
    RateColumn("opened, first guess right", "opened_300", less="recovered"),
    RateColumn("opened in 15 s", "opened_150"),
)
INTERFERENCE_COLUMNS = (
    RateColumn("began to open, was held", "held"),
    RateColumn("of these, opened in 30 s", "opened_after_hold", "held"),
    RateColumn("of these, tried another way meanwhile", "tried_another_way", "held"),
)


@dataclass(frozen=True)
class Table:
    """What a page or a terminal shows as a table.

    Attributes:
        caption (`str`): what its numbers are.
        columns (`list[str]`): headings.
        num_names (`int`): how many of the first columns name the row.
        rows (`list[list[str | int | Rate]]`): cells.
    """

    caption: str
    columns: list[str]
    num_names: int
    rows: list[list[str | int | Rate]]

    def to_markdown(self) -> str:
        """`str`: the table for a terminal, its rates with counts and 95 % Wilson intervals."""
        lines = [self.columns, ["---"] * len(self.columns)]
        for row in self.rows:
            lines.append(
                [format_rate(cell.successes, cell.trials) if isinstance(cell, Rate) else str(cell) for cell in row]
            )
        return "".join([f"{self.caption}:\n\n", *(f"| {' | '.join(line)} |\n" for line in lines)])


def read_rows[Row: EvaluationRow](path: Path, row_type: type[Row], columns: Sequence[RateColumn]) -> list[Row]:
    """Reads a table of evaluations and refuses one whose rates cannot be.

    Args:
        path (`Path`):
            CSV file.
        row_type (`type[Row]`):
            Which table it is.
        columns (`Sequence[RateColumn]`):
            Rates that it must have.

    Returns:
        `list[Row]`: its rows.

    Raises:
        ValueError: If it is another kind of table, is empty, repeats a row or counts more of a part than of the whole.
    """
    try:
        rows = read_table(path, row_type)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a text file: {error}.") from error
    if not rows:
        raise ValueError(f"{path} has no rows below its first line: `ufrnn protocol` adds them.")
    seen = set()
    for number, row in enumerate(rows, start=2):
        if row.trials < 1:
            raise ValueError(f"{path}, line {number} counts {row.trials} trials; it must be at least 1.")
        if row.key in seen:
            raise ValueError(f"{path}, line {number} repeats {row.key}: a table has one row for it.")
        seen.add(row.key)
        for column in columns:
            rate = column.of([row])
            if not 0 <= rate.successes <= rate.trials:
                raise ValueError(
                    f"{path}, line {number} cannot be: '{column.heading}' would be {rate.successes} of {rate.trials}."
                )
    return rows


def summarize(
    rows: Sequence[EvaluationRow], columns: Sequence[RateColumn], caption: str, by_kind: bool = False
) -> Table:
    """One row a model, or a model and kind of door.

    Args:
        rows (`Sequence[EvaluationRow]`):
            The counts.
        columns (`Sequence[RateColumn]`):
            Rates to show.
        caption (`str`):
            What the table is of.
        by_kind (`bool`, *optional*, defaults to `False`):
            Tell kinds of doors apart.

    Returns:
        `Table`: the table.
    """
    cells: list[list[str | int | Rate]] = []
    for model, of_model in last_epochs(rows).items():
        for kind in dict.fromkeys(row.kind for row in of_model) if by_kind else (None,):
            group = [row for row in of_model if kind in (None, row.kind)]
            seeds = len({row.train_seed for row in group})
            names = [model] if kind is None else [model, kind]
            cells.append([*names, *(column.of(group) for column in columns), group[0].epoch, seeds])
    names = ["model", "door"] if by_kind else ["model"]
    return Table(caption, [*names, *(column.heading for column in columns), "epoch", "seeds"], len(names), cells)


def compare(rows: Sequence[EvaluationRow], columns: Sequence[RateColumn], caption: str) -> Table:
    """How each two models differ, in percentage points with 95 % Newcombe intervals.

    Args:
        rows (`Sequence[EvaluationRow]`):
            The counts.
        columns (`Sequence[RateColumn]`):
            Rates to compare.
        caption (`str`):
            What the table is of.

    Returns:
        `Table`: a row for each two models.
    """
    cells: list[list[str | int | Rate]] = []
    # From the last name back, which is `ufrnn` minus its baselines.
    for (model, of_model), (other, of_other) in combinations(reversed(last_epochs(rows).items()), 2):
        points = [_difference(column.of(of_model), column.of(of_other)) for column in columns]
        cells.append([f"{model} {MINUS} {other}", *points])
    return Table(caption, ["difference", *(column.heading for column in columns)], 1, cells)


def success_tables(rows: Sequence[ProtocolRow]) -> list[Table]:
    """What undisturbed trials say: by model, how models differ if there are two or more, and by kind of door."""
    tables = [
        summarize(rows, SUCCESS_COLUMNS, "Doors opened, model by model"),
        compare(rows, SUCCESS_COLUMNS, "Differences in percentage points, with 95 % Newcombe intervals"),
        summarize(rows, SUCCESS_COLUMNS, "Doors opened, door by door", by_kind=True),
    ]
    return [table for table in tables if table.rows]


def interference_tables(rows: Sequence[InterferenceRow]) -> list[Table]:
    """What trials with a held door say: by model, and by kind of door."""
    return [
        summarize(rows, INTERFERENCE_COLUMNS, "Trials with a held door, model by model"),
        summarize(rows, INTERFERENCE_COLUMNS, "Trials with a held door, door by door", by_kind=True),
    ]


def _difference(rate: Rate, other: Rate) -> str:
    if not (rate.trials and other.trials):
        return DASH
    low, high = newcombe_interval(rate.successes, rate.trials, other.successes, other.trials)
    points = rate.percent - other.percent
    return f"{points:+.0f} [{100 * low:+.0f}, {100 * high:+.0f}]".replace("-", MINUS)
