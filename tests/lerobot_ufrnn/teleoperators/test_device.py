import pytest
from teleoperators_fakes import Clock

from lerobot_ufrnn.teleoperators.device import DeviceUnavailableError, EventStreamDevice


def test_each_state_lasts_until_the_next_and_the_end_is_at_rest(tmp_path):
    clock = Clock()
    path = tmp_path / "events.jsonl"
    path.write_text(
        '{"time": 0.5, "twist": [1, 0, 0, 0, 0, 0]}\n'
        '{"time": 1.0, "twist": [0, 0, 0, 0, 0, -0.5], "buttons": ["open"]}\n'
        '{"time": 2.0, "twist": [1, 1, 1, 1, 1, 1], "buttons": ["close"]}\n'
    )
    device = EventStreamDevice(path, clock)
    device.open()
    clock.now += 60  # the time of the stream starts at the first read
    expected = {0.0: (0, 0), 0.25: (0, 0), 0.5: (1, 0), 0.99: (1, 0), 1.0: (0, -0.5), 1.9: (0, -0.5), 2.0: (0, 0)}
    start = clock.now
    for moment, (ahead, turn) in (expected | {500.0: (0, 0)}).items():
        clock.now = start + moment
        state = device.read()
        assert (state.twist[0], state.twist[5]) == (ahead, turn)
        assert state.buttons == (frozenset({"open"}) if turn else frozenset())


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("{", "Line 2"),
        ("[1, 2]", "must be an object"),
        ('{"time": 1}', "`twist`"),
        ('{"time": 1, "twist": [0, 0, 0]}', r"shape \(3,\)"),
        ('{"time": 1, "twist": [0, 0, 0, 0, 0, NaN]}', "not finite"),
        ('{"time": 1, "twist": [0, 0, 0, 0, 0, "x"]}', "Line 2"),
        ('{"time": -1, "twist": [0, 0, 0, 0, 0, 0]}', "not negative"),
        ('{"time": 0.1, "twist": [0, 0, 0, 0, 0, 0]}', "before 0.5"),
        ('{"time": 1, "twist": [0, 0, 0, 0, 0, 0], "buttons": ["fire"]}', "only open, close are known"),
        ('{"time": 1, "twist": [0, 0, 0, 0, 0, 0], "buttons": "open"}', "list of names"),
        ('{"time": 1, "twist": [0, 0, 0, 0, 0, 0], "speed": 2}', "perhaps `buttons`"),
    ],
)
def test_a_wrong_line_is_named_before_anything_moves(tmp_path, line, reason):
    path = tmp_path / "events.jsonl"
    path.write_text('{"time": 0.5, "twist": [0, 0, 0, 0, 0, 0]}\n' + line + "\n")
    with pytest.raises(DeviceUnavailableError, match=reason):
        EventStreamDevice(path).open()


def test_a_missing_or_empty_file_is_told(tmp_path):
    with pytest.raises(DeviceUnavailableError, match="cannot be read"):
        EventStreamDevice(tmp_path / "none.jsonl").open()
    (tmp_path / "empty.jsonl").touch()
    with pytest.raises(DeviceUnavailableError, match="holds no events; each line is one"):
        EventStreamDevice(tmp_path / "empty.jsonl").open()
