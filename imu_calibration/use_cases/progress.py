"""The progress of one phase, counted in items."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from imu_calibration.progress import report


@contextmanager
def progress_bar(phase: str, total: float) -> Iterator[Callable[[float], None]]:
    """Give a function that takes the number of items done since its last call; a total of 0 reports nothing."""
    done = 0.0

    def advance(count):
        nonlocal done
        done += count
        if total:
            report(phase, done, total)
    advance(0)
    yield advance
