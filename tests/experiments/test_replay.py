"""Demonstrations carried out one after the other: on a line with a wall, and in a task."""

import itertools
import json

import numpy as np
import pandas as pd
import pytest
import replay
import suite
from replay import Replay, ReplayConfig, endless
from suite import read_counts

from lerobot_ufrnn.commands import parse_flags


def line(end: float) -> tuple[np.ndarray, np.ndarray]:
    """States and actions of a demonstration from 0 to an end, a tenth a step."""
    states = np.linspace(0, end, round(abs(end) * 10) + 1)[:, None]
    return states, np.concatenate((states[1:], states[-1:]))


def carry_out(policy: Replay, steps: int, wall: float = np.inf) -> np.ndarray:
    """Where a point goes that moves at most 0.15 a step and is stopped by a wall."""
    places = [0.0]
    for _ in range(steps):
        asked = float(policy.act(np.array(places[-1:]))[0]) - places[-1]
        places.append(min(places[-1] + np.clip(asked, -0.15, 0.15), wall))
    return np.array(places)


def test_a_demonstration_is_carried_out_at_its_pace_then_taken_back_before_the_next_one():
    places = carry_out(Replay([line(2), line(-1)], itertools.cycle([0, 1])), 90)
    assert places[:21] == pytest.approx(np.linspace(0, 2, 21), abs=0.15)
    assert places[21:30] == pytest.approx(2.0)  # it waits at the end
    assert places.argmin() > 50
    assert places.min() == pytest.approx(-1.0)


def test_one_that_is_blocked_is_taken_back_after_a_while():
    places = carry_out(Replay([line(2), line(-1)], itertools.cycle([0, 1])), 70, wall=0.5)
    assert places.max() == 0.5
    assert 14 <= (places == 0.5).sum() <= 22  # 1.5 s
    assert places.min() == pytest.approx(-1.0)


def test_orders_take_each_in_turn_or_any_or_those_of_the_right_kind():
    kinds = ["a", "b", "c", "a"]
    in_turn = list(itertools.islice(endless("in turn", kinds, "a", (0, 3)), 8))
    assert sorted(in_turn[:4]) == [0, 1, 2, 3]
    assert in_turn[4:] == in_turn[:4]
    at_random = list(itertools.islice(endless("at random", kinds, "a", (0, 3)), 200))
    assert set(at_random) == {0, 1, 2, 3}
    assert any(one == next_one for one, next_one in itertools.pairwise(at_random))
    assert set(itertools.islice(endless("known", kinds, "a", (0, 3)), 20)) == {0, 3}


def test_rows_are_added_to_the_table_of_the_suite(tmp_path, monkeypatch, capsys):
    def record(root, _folder, flags, wanted):
        """Ways of `two_ways`, as straight lines."""
        assert (flags["task"], wanted) == ("two_ways", 2)
        rows = [
            {"episode_index": number, "index": 100 * number + step, "observation.state": place, "action": place}
            for number, side in enumerate((-1, 1))
            for step, place in enumerate(
                [(0.5, 0.08 + 0.02 * step) for step in range(17)] + [(0.5 + side * 0.02 * k, 0.4) for k in range(19)]
            )
        ]
        for path in (root / "data" / "chunk-000", root / "meta"):
            path.mkdir(parents=True)
        pd.DataFrame(rows).to_parquet(root / "data" / "chunk-000" / "file-000.parquet")
        noted = {"settings": {}, "episodes": [{"kind": f"two_ways_{way}"} for way in (0, 1)]}
        (root / "meta" / "door_recording.json").write_text(json.dumps(noted))

    monkeypatch.setattr(suite, "record_missing", record)
    flags = ["--tasks=[two_ways]", "--sets=[0]", "--orders=[known]", "--trials_per_way=1", "--episodes_per_way=1"]
    flags += [f"--output_dir={tmp_path}", f"--results={tmp_path}"]
    replay.main(parse_flags(ReplayConfig, flags, "replay.py"))
    row = read_counts(tmp_path / "counts.csv").iloc[0]
    assert (row.task, row.model, row.trials, row.opened, row.wrong_first) == ("two_ways", "replay known", 2, 2, 0)
    assert "two_ways, set 0, known: 2 of 2, recovered 0 of 0" in capsys.readouterr().out


@pytest.mark.parametrize("flag", ["--tasks=[window]", "--orders=[backwards]", "--trials_per_way=0"])
def test_flags_out_of_range_are_refused_by_name(flag):
    with pytest.raises(Exception, match=flag[2:7]):
        parse_flags(ReplayConfig, [flag], "replay.py")
