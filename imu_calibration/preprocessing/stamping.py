"""
Relation of the stamps of one stream to its sampling.

An IMU samples by its own clock; its stamps are often times of arrival: eight at once from a USB packet, delayed by the bus, or
rounded to milliseconds. Where the stamps are near a line through the sample number, the line gives the sampling times
(`COUNTED`); where they diverge from every line the sampling itself is irregular, and the stamps are used unchanged.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np


class Stamping(StrEnum):
    """Use of a stretch of stamps."""

    REGULAR = 'regular'
    """Steps of a clock, or integer multiples where samples were lost: the stamps are used unchanged."""
    COUNTED = 'counted'
    """Steps scatter about a line through the number of the sample: times are computed from that line."""
    IRREGULAR = 'irregular'
    """Steps scatter and follow no line: the stamps are the best estimate of the sampling times."""


REGULAR, COUNTED, IRREGULAR = Stamping
EARLY, LATE = 0.5, 1.5
"""A step between these many periods is a regular one."""
WHOLE = 0.1
"""A longer step within this share of a period of an integer number of periods is regular too: samples were lost."""
IRREGULAR_SHARE = 0.05
"""Largest share of irregular steps."""
MOST_LOST = 4
"""Largest number of lost samples per received one; beyond it the usual step is not the period."""
LAG = 64
"""Lag, in samples, at which the variance of stamp differences is compared with the variance at lag one."""
DRIFTING = 16.0
"""
Ratio of these variances from which the steps are independent of one another, so that the stamps diverge from every line.

It is about 1 for jitter about a line, `LAG` for independent steps, and below 11 for packets of up to 100 samples.
"""
PAUSE_NS = 1_000_000_000
"""A longer step is a pause; counting restarts after it."""
SKEWED = 0.35
"""Largest share of the range of times of arrival below their median: 0.5 of symmetric jitter, 0.17 of exponential lateness."""
PACKET = 1.5
"""Samples received together, on average, from which stamps are those of packets."""
LEAST = 16
"""Fewest steps for an estimate of the period."""


@dataclass(frozen=True)
class StampLine:
    """Distribution of stamps about a line through the number of the sample."""

    word: Stamping
    """Use of the stamps."""
    period_ns: float
    """Sampling period."""
    low_ns: float = 0.0
    """Smallest distance of a stamp from the line of the sampling times."""
    high_ns: float = 0.0
    """Largest distance."""
    at_once: float = 1.0
    """Samples received together, on average."""

    @property
    def arrivals(self) -> bool:
        """Whether the stamps are times of arrival, which can only be late."""
        return self.low_ns >= 0 and self.high_ns > 0

    def __str__(self) -> str:
        rate = 1e9 / self.period_ns
        if self.word == REGULAR:
            return f'stamps are regular at {rate:.4g} Hz'
        if self.word == IRREGULAR:
            return f'the steps between stamps scatter and follow no clock near {rate:.4g} Hz'
        if self.at_once >= PACKET:
            return f'stamps are times of arrival, about {self.at_once:.0f} samples at once; regular times at {rate:.4g} Hz are drawn ' \
                'through them'
        return (f'stamps scatter by {1e-6 * (self.high_ns - self.low_ns):.3g} ms about a clock; regular times at {rate:.4g} Hz are drawn '
                'through them')


def describe_stamps(stamp_ns: np.ndarray) -> StampLine | None:
    """
    Return the StampLine of the stamps of one stretch in the order of arrival, None when they are too few.

    Parameters
    ----------
    stamp_ns : ndarray of int64, shape (n,)
        Without repeated messages; at least 256 are required to separate counted from irregular stamps.

    """
    step = np.diff(stamp_ns)
    step = step[np.abs(step) <= PAUSE_NS]
    if len(step) < LEAST:
        return None
    in_order = np.diff(np.sort(stamp_ns))   # exchanged neighbours are no error of the stamps
    in_order = in_order[in_order <= PAUSE_NS]
    line = _regular(in_order, float(np.median(in_order)))
    if line is not None or len(stamp_ns) < 4 * LAG:
        return line
    period = float(step.mean())
    apart = (stamp_ns[LAG:] - stamp_ns[:-LAG]).astype(float)
    apart = apart[np.abs(apart - LAG * period) <= PAUSE_NS]
    apart = _without_losses(apart, float(np.min(in_order[in_order > 0], initial=PAUSE_NS)))
    if period > 0 and len(apart) and apart.var() <= DRIFTING * step.var():
        line = _line(stamp_ns, step, float(apart.mean()) / LAG)
        if line.period_ns >= 1.0:
            return line
    # Where more than half of the samples are lost the usual step is two periods.
    return _regular(in_order, float(np.quantile(in_order, 0.1))) or StampLine(IRREGULAR, max(period, 1.0))


def _regular(step: np.ndarray, usual: float) -> StampLine | None:
    if usual <= 0 or regular_share(step, usual) < 1 - IRREGULAR_SHARE:
        return None
    number = np.rint(step / usual)
    # the sample is late, and the next one earlier
    number[(step <= LATE * usual) | ((number < MOST_LOST) & (np.abs(step / usual - number) > WHOLE))] = 1.0
    used = (step > 0) & (number <= MOST_LOST)
    return StampLine(REGULAR, float(step[used].sum() / number[used].sum()))


def regular_share(step: np.ndarray, period: float) -> float:
    """Return the share of steps consistent with one clock and lost samples; 0 when more than `MOST_LOST` would be lost."""
    number = np.rint(step / period)
    whole = np.abs(step / period - number)
    good = ((step > EARLY * period) & (step <= LATE * period)) | ((number >= 2) & (whole <= WHOLE))
    lost = float(np.sum(number[good] - 1, where=number[good] > 1))
    return 0.0 if lost > MOST_LOST * len(step) else float(good.mean())


def _without_losses(apart: np.ndarray, resolution: float) -> np.ndarray:
    """Return the differences across `LAG` steps, without the ones that contain lost samples or a pause."""
    off = np.abs(apart - np.median(apart)) if len(apart) else apart
    return apart[off <= 3 * np.median(off) + 0.5 * np.median(apart) / LAG + resolution] if len(apart) else apart


def _line(stamp_ns: np.ndarray, step: np.ndarray, period: float) -> StampLine:
    """
    Return the line of stamps near it: through the earliest ones of times of arrival, otherwise through their median.

    Times of arrival keep the order, are late by more than a period, and arrive in packets or with a distribution skewed to late stamps. The
    earliest of symmetric jitter is no sampling time: with 3 ms (Gaussian) it is 7 ms early and scatters three times as much as the mean.
    """
    number = np.arange(len(stamp_ns))
    residual = (stamp_ns - stamp_ns[0]) - period * number
    residual = residual - np.polynomial.Polynomial.fit(number, residual, 1)(number)
    low, middle, high = np.quantile(residual, (0.02, 0.5, 0.98))
    at_once = len(step) / max(int(np.count_nonzero(step > EARLY * period)), 1)
    skewed = middle - low < SKEWED * (high - low)
    arrivals = high - low > period and np.all(step >= 0) and (at_once >= PACKET or skewed)
    origin = low if arrivals else middle
    return StampLine(COUNTED, period, low - origin, high - origin, at_once if arrivals else 1.0)
