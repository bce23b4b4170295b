"""One way to refuse a field of a configuration: what was given, and what is allowed.

All raise a ParsingError, as the parser of LeRobot's command lines hides the text of a ValueError.
"""

import math
import operator
from collections.abc import Iterable

from draccus.utils import ParsingError


def check_range(
    config: object,
    *names: str,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
    unit: str = "",
) -> None:
    """Refuses fields out of their range. A field of several numbers is checked one by one; none may be NaN or infinite.

    `low` and `high` are allowed themselves, `above` and `below` are not; `unit` is theirs, for the message.
    """
    words = {"at least": operator.ge, "at most": operator.le, "above": operator.gt, "below": operator.lt}
    given = zip(words, (low, high, above, below), strict=True)
    bounds = {word: bound for word, bound in given if bound is not None}
    allowed = " and ".join(f"{word} {bound:g}" for word, bound in bounds.items()) or "finite"
    for name in names:
        value = getattr(config, name)
        for number in value if isinstance(value, Iterable) else (value,):
            if not (math.isfinite(number) and all(words[word](number, bound) for word, bound in bounds.items())):
                raise ParsingError(
                    f"`{name}` must be {allowed}{unit and ' ' + unit}, got {value} ({type(config).__name__})."
                )


def check_pair(config: object, *names: str, strictly: bool = False) -> None:
    """Refuses fields that are not two numbers in ascending order; `strictly` forbids equal ones, too."""
    for name in names:
        value = getattr(config, name)
        if len(value) != 2 or not (value[0] < value[1] if strictly else value[0] <= value[1]):
            raise ParsingError(f"`{name}` must hold two numbers, low {'<' if strictly else '<='} high, got {value}.")


def check_choice(config: object, name: str, allowed: Iterable[str]) -> None:
    """Refuses a field that is none of the values `allowed`."""
    if getattr(config, name) not in (allowed := list(allowed)):
        raise ParsingError(f"`{name}` must be one of {allowed}, got {getattr(config, name)!r}.")
