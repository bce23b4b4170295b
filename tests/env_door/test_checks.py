import math
from types import SimpleNamespace

import pytest
from draccus.utils import ParsingError

from env_door.checks import check_choice, check_pair, check_range


@pytest.mark.parametrize(
    ("value", "bounds"),
    [(1, {"low": 1}), (1, {"high": 1}), (0.5, {"above": 0, "below": 1}), ((1, 2), {"low": 1, "high": 2}), (-9.0, {})],
)
def test_values_within_their_range_pass(value, bounds):
    check_range(SimpleNamespace(field=value), "field", **bounds)
    check_pair(SimpleNamespace(field=(1, 1)), "field")


@pytest.mark.parametrize(
    ("value", "bounds"),
    [
        (0, {"low": 1}),
        (2, {"high": 1}),
        (0, {"above": 0}),
        (1, {"below": 1}),
        ((1, 3), {"high": 2}),
        (math.nan, {"low": 0}),
        (math.inf, {}),
    ],
)
def test_others_are_refused_by_field_value_and_bounds(value, bounds):
    with pytest.raises(ParsingError) as error:
        check_range(SimpleNamespace(good=bounds.get("low", 0.5), field=value), "field", unit="m", **bounds)
    assert "`field`" in str(error.value)
    assert str(value) in str(error.value)
    assert all(str(bound) in str(error.value) for bound in bounds.values())
    assert " m, got" in str(error.value)


@pytest.mark.parametrize(("value", "strictly"), [((2, 1), False), ((1, 1), True), ((1,), False), ((1, 2, 3), False)])
def test_pairs_must_be_two_numbers_in_order(value, strictly):
    with pytest.raises(ParsingError, match="`field` must hold two numbers"):
        check_pair(SimpleNamespace(field=value), "field", strictly=strictly)


def test_choices_are_listed_when_another_is_given():
    check_choice(SimpleNamespace(field="a"), "field", ("a", "b"))
    with pytest.raises(ParsingError, match=r"`field` must be one of \['a', 'b'\], got 'c'"):
        check_choice(SimpleNamespace(field="c"), "field", ("a", "b"))
