"""Being told to end while the arm is in use."""

import os
import signal
import threading

import pytest

from lerobot_ufrnn.robots.ur5e_robotiq.robot import OrderlyEnd

ENDING = [signal.SIGTERM, signal.SIGHUP]


@pytest.fixture(autouse=True)
def _as_at_first():
    """Signals as Python has them when it starts."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDING)
def test_a_program_that_is_told_to_end_closes_what_it_has_open_undisturbed(number):
    ending, closed = OrderlyEnd(), []

    def work():
        try:
            os.kill(os.getpid(), number)
        finally:
            for impatient in ENDING:
                os.kill(os.getpid(), impatient)
            closed.append("all")

    ending.begin()
    with pytest.raises(SystemExit) as end:
        work()
    assert closed == ["all"]
    assert end.value.code == 128 + number
    ending.end()
    assert signal.getsignal(signal.SIGTERM) == signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_what_a_program_does_on_a_signal_by_itself_it_goes_on_doing():
    told = []
    signal.signal(signal.SIGTERM, lambda *_: told.append("before"))
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    ending = OrderlyEnd()
    ending.begin()
    for number in ENDING:
        os.kill(os.getpid(), number)
    ending.end()
    os.kill(os.getpid(), signal.SIGTERM)
    assert told == ["before", "before"]
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def test_a_signal_that_somebody_takes_over_later_stays_with_them():
    ending = OrderlyEnd()
    ending.begin()
    signal.signal(signal.SIGTERM, later := lambda *_: None)
    ending.end()
    assert signal.getsignal(signal.SIGTERM) is later
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_in_another_thread_signals_are_left_alone():
    ending = OrderlyEnd()
    thread = threading.Thread(target=lambda: (ending.begin(), ending.end()))
    thread.start()
    thread.join()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
