"""When the next solution is due."""

import numpy as np


class SolvePacer:
    """Says when the next solution is due, so that solving takes no more than a share of the time."""

    def __init__(self, share: float):
        self._share, self._next = share, -np.inf

    def due(self, now: float) -> bool:
        """Return whether enough time has passed; `now` in s of a steady clock."""
        return now >= self._next

    def note(self, start: float, end: float) -> None:
        """Take note of a solution that was worked on from `start` to `end`."""
        self._next = start + (end - start) / self._share
