"""When the next solution is due."""

import numpy as np


class SolvePacer:
    """Schedules the next solution so that solving uses at most a given share of the time."""

    def __init__(self, share: float):
        self._share, self._next = share, -np.inf

    def due(self, now: float) -> bool:
        """Return whether enough time has passed; `now` in s of a steady clock."""
        return now >= self._next

    def note(self, start: float, end: float) -> None:
        """Record a solution that was computed from `start` to `end`."""
        self._next = start + (end - start) / self._share
