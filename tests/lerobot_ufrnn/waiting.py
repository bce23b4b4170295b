"""Waiting for what another thread or process does."""

import time
from collections.abc import Callable


def wait_until(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    """Returns as soon as the condition holds.

    Args:
        condition (`Callable[[], bool]`):
            What is waited for.
        seconds (`float`, *optional*, defaults to `10.0`):
            For how long at most.

    Raises:
        AssertionError: If it does not hold in time.
    """
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"did not come true within {seconds} s"
        time.sleep(0.005)
