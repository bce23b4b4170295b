"""The table of constants, without a network."""

from types import SimpleNamespace

import constants
import pandas as pd
from constants import COUNTS, KEY, change, changes, describe, usual_values

from lerobot_ufrnn import recall
from lerobot_ufrnn.configuration_ufrnn import RecallConfig


def test_every_constant_is_tried_smaller_and_larger_within_its_bounds():
    tried = changes()
    assert tried[0] == ("none", 0.0)
    for name, usual in usual_values().items():
        smaller, larger = (value for other, value in tried if other == name)
        assert abs(smaller) < abs(usual) < abs(larger)
        if name in constants.FIELDS:
            RecallConfig(**{name: smaller}), RecallConfig(**{name: larger})  # neither is refused


def test_a_change_lasts_as_long_as_its_trials():
    policy = SimpleNamespace(
        config=SimpleNamespace(recall=RecallConfig()), demonstrations=SimpleNamespace(train=lambda mode: mode)
    )
    with change(policy, "stay", 1.25):
        assert policy.config.recall.stay == 1.25
    with change(policy, "BARRED", 2.5):
        assert recall.BARRED == 2.5
    with change(policy, "none", 0.0):
        pass
    assert (policy.config.recall.stay, recall.BARRED) == (RecallConfig().stay, usual_values()["BARRED"])


def test_the_table_tells_what_is_lost_where():
    rows = [("none", 0.0, task, 10, 10, 6, 6) for task in ("three_ways", "bends", "shown")]
    rows += [("stay", 2.0, task, 10, opened, 6, 6) for task, opened in (("three_ways", 10), ("bends", 7), ("shown", 4))]
    page = describe(pd.DataFrame(rows, columns=[*KEY, *COUNTS]))
    # Of the ambiguous tasks 85 %; the one that loses most may be another one.
    assert "| `stay` | 1.5 | - | 2: 85 (shown -60) |" in page
    assert "mean over 2 ambiguous tasks (as it is: 100)" in page
