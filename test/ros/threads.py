"""Waiting for what other threads of the test's own process do."""

import time


def until(condition, what, patience=20.0):
    """Wait until a condition holds; fail with `what` when it does not in time."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, f'waited in vain for {what}'
        time.sleep(0.01)
