import pytest

from lerobot_ufrnn.benchmarks.environment import measure_env


def test_every_way_is_measured():
    rows = measure_env(seconds=0.5, batch_size=2, with_async=False)
    assert [row.name for row in rows] == [
        "physics only",
        "with 128 px picture",
        "with 128 px picture and 192 px video frame",
        "batch of 2, sync",
    ]
    for row in rows:
        assert row.calls >= 1
        assert 0 < row.low <= row.median <= row.high


@pytest.mark.parametrize(
    "arguments", [{"seconds": 0.0}, {"seconds": -1.0}, {"seconds": float("nan")}, {"batch_size": 1}]
)
def test_bad_arguments_are_refused(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        measure_env(**arguments)
