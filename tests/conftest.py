"""What holds for all tests."""

import os

import pytest


@pytest.fixture(autouse=True)
def ordinary_priority():
    """Takes real-time priority away again.

    The video encoder SVT-AV1, LeRobot's default, gives it to the process it is used in when that belongs to root, and
    for good: whatever ran beside such a test process would stand still for most of each second.
    """
    yield
    if hasattr(os, "SCHED_OTHER") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
