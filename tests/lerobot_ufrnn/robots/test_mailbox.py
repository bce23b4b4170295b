"""The mailbox between the servo process and its owner."""

import multiprocessing
import sys
import threading

import numpy as np
import pytest

from lerobot_ufrnn.robots.ur5e_robotiq.servo import Mailbox


@pytest.fixture
def hasty_threads():
    """Threads that take turns all the time."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def test_a_reader_never_sees_half_a_vector(hasty_threads):
    mailbox = Mailbox(multiprocessing.get_context("spawn"), 5)
    last = 20_000
    writer = threading.Thread(target=lambda: [mailbox.write(np.full(5, float(n))) for n in range(1, last + 1)])
    seen, _ = mailbox.read()
    assert seen == 0
    writer.start()
    while seen < last:
        is_running = writer.is_alive()
        count, values = mailbox.read()
        assert count >= seen
        assert (values == count).all()
        assert is_running or count == last
        seen = count


def test_a_writer_that_stops_half_way_leaves_the_last_whole_vector():
    mailbox = Mailbox(multiprocessing.get_context("spawn"), 2)
    shared = np.frombuffer(mailbox._shared)
    for value in (1.0, 2.0):
        mailbox.write(np.full(2, value))
        before = shared.copy()
        mailbox.write(np.full(2, 7.0))
        after = shared.copy()
        for written in np.flatnonzero(after != before)[1:]:  # the count, at the front, comes last
            shared[:] = before
            shared[written] = after[written]
            count, values = mailbox.read()
            assert (count, values.tolist()) == (int(before[0]), [value, value])
        shared[:] = before
