"""Windows of a recording with their samples, for a search over effects: all of a short one, evenly spread ones of a long one."""

from imu_calibration.segmentation.window import Window

MOST_SAMPLES = 100_000
"""Most samples kept; beyond it every second window of each kind is removed."""


class SpreadWindows:
    """
    Every so many-th window of each kind, so that memory and the time of a search are bounded.

    The selection depends only on the recording.
    """

    def __init__(self) -> None:
        self.n_samples, self._stride, self._counts, self._kept = 0, 1, {}, []

    def add(self, window: Window) -> None:
        """Add a window in order of time, as a copy in separate memory (`owned_window`)."""
        number = self._counts[window.kind] = self._counts.get(window.kind, -1) + 1
        if number % self._stride:
            return
        self._kept.append((number, window))
        self.n_samples += len(window.time)
        while self.n_samples > MOST_SAMPLES and len(self._kept) > 1:
            self._stride *= 2
            self._kept = [(number, window) for number, window in self._kept if number % self._stride == 0]
            self.n_samples = sum(len(window.time) for _, window in self._kept)

    def copy(self) -> 'SpreadWindows':
        """Return an independent copy; the windows are shared."""
        twin = SpreadWindows()
        twin.n_samples, twin._stride, twin._counts, twin._kept = self.n_samples, self._stride, dict(self._counts), list(self._kept)
        return twin

    @property
    def windows(self) -> list[Window]:
        """The windows kept, in order of time."""
        return [window for _, window in self._kept]
