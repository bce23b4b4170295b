"""The mailbox between the servo process and its owner."""

import multiprocessing
import sys
import threading

import numpy as np

from lerobot_ufrnn.robots.ur5e_robotiq.servo import Mailbox


def test_a_reader_never_sees_half_a_vector():
    mailbox = Mailbox(multiprocessing.get_context("spawn"), 5)
    assert mailbox.read()[0] == 0
    last = 20_000

    def write_often():
        for number in range(1, last + 1):
            mailbox.write(np.full(5, float(number)))

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    writer = threading.Thread(target=write_often)
    writer.start()
    try:
        seen, is_running = 0, True
        while is_running:
            is_running = writer.is_alive()
            count, values = mailbox.read()
            assert count >= seen
            assert (values == count).all()
            seen = count
    finally:
        writer.join()
        sys.setswitchinterval(before)
    assert seen == last


def test_a_writer_that_stops_half_way_leaves_the_last_whole_vector():
    mailbox = Mailbox(multiprocessing.get_context("spawn"), 2)
    for value in (1.0, 2.0):
        mailbox.write(np.full(2, value))
        before = np.frombuffer(bytes(mailbox._shared))
        mailbox.write(np.full(2, 7.0))
        after = np.frombuffer(bytes(mailbox._shared))
        for written in np.flatnonzero(after != before)[1:]:  # the count, at the front, comes last
            np.frombuffer(mailbox._shared)[:] = before
            np.frombuffer(mailbox._shared)[written] = after[written]
            count, values = mailbox.read()
            assert (count, values.tolist()) == (int(before[0]), [value, value])
        np.frombuffer(mailbox._shared)[:] = before
