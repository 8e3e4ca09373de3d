"""Samples in which all readings are zero: a bus that does not answer for a moment."""

import numpy as np

from imu_calibration.core.samples import ImuSamples, runs_of

LONGEST_HELD_RUN_NS = 1_000_000_000
"""ns; longer runs pass and are found as a frozen sensor, with their time."""
MOST_HELD = 10_000
"""Samples of a run that are buffered, at most: stamps may be equal."""


class ZeroFilter:
    """
    Drops short runs of samples in which all six readings are exactly zero.

    An accelerometer that has measured a force before never reads zero on three axes for a sample.
    The result does not depend on the division into pieces.
    """

    def __init__(self) -> None:
        self.n_dropped = 0
        """Samples dropped so far."""
        # Whether the accelerometer has measured a force before.
        self._has_measured = False
        # Run of zeros at the end, which may become a long one, and whether a long one is open.
        self._open_run: ImuSamples | None = None
        self._in_long_run = False

    def push(self, samples: ImuSamples) -> ImuSamples:
        """Return the samples that pass; a run at the end waits until its length is known."""
        samples = samples.after(self._open_run)
        self._open_run = None
        has_force = np.asarray(samples.force_s.any(axis=1))
        zero = np.asarray(~has_force & ~samples.rate_s.any(axis=1))
        if not self._has_measured:
            # Zeros at the beginning may be an accelerometer that is absent.
            first = int(np.argmax(has_force)) if has_force.any() else len(samples)
            zero[:first] = False
            self._has_measured = first < len(samples)
        # A run at the beginning continues a long one, which has passed.
        continues_long_run = self._in_long_run
        self._in_long_run = False
        if not zero.any():
            return samples
        passes = np.ones(len(samples), bool)
        for start, stop in runs_of(zero):
            is_open = stop == len(samples)
            length_ns = samples.stamp_ns[stop - 1] - samples.stamp_ns[start]
            is_long = length_ns >= LONGEST_HELD_RUN_NS or stop - start >= MOST_HELD
            if is_long or (start == 0 and continues_long_run):
                self._in_long_run = is_open
                continue
            passes[start:stop] = False
            if is_open:
                self._open_run = samples.select(slice(start, stop))
            else:
                self.n_dropped += stop - start
        return samples.select(passes)

    def finish(self) -> int:
        """Drop the run at the end of the stream; return its number of samples."""
        n_open = 0 if self._open_run is None else len(self._open_run)
        self.n_dropped += n_open
        self._open_run = None
        return n_open
