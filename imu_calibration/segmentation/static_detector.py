"""Rest found from the IMU alone, for recordings without a table."""

import numpy as np

from imu_calibration.errors import InputError
from imu_calibration.samples import ImuSamples
from imu_calibration.segmentation.quiet_detector import SPANS, QuietFloor, least_variance, quiet_samples
from imu_calibration.segmentation.window_settings import WindowSettings

_TURNING_SD = 30.0
"""A mean rate that many noise sds, and a hundredth of the largest rate, off the usual one is a steady turn, not a bias."""

_LARGEST_GROWTH = 4.0
"""Bias wander over a long rest adds less variance than this."""


def find_still(imu: ImuSamples, settings: WindowSettings = WindowSettings()) -> list[slice]:
    """
    Find the intervals in which the IMU alone shows rest.

    Compares short-time variances with the quietest tenth of the recording, so any unit will do, counts too. The
    first `settling` seconds of an interval are left out, except at the start of the recording; steady turns and intervals shorter than
    `static_minimum` are not reported.

    Parameters
    ----------
    imu : ImuSamples
        Cleaned samples (`BlockCleaner`): finite, stamps not going backwards.
    settings : WindowSettings

    Returns
    -------
    list of slice
        Sample ranges, in order.

    Raises
    ------
    InputError
        When a sample is not finite or a stamp goes backwards.

    """
    step = np.diff(imu.stamp_ns)
    if not (np.isfinite(imu.force_s).all() and np.isfinite(imu.rate_s).all()):
        raise InputError('samples must be finite to search for rest, got NaN or infinite values; drop them first')
    if np.any(step < 0):
        raise InputError('stamps must not go backwards in the search for rest, got a backward step; clean the stream first')
    if not np.any(step > 0):
        return []
    period = np.median(step[step > 0]) / 1e9
    quiet = quiet_samples(imu.force_s, imu.rate_s, period, ratio=settings.quiet_ratio, longest=settings.static_minimum, floor=QuietFloor())
    found = [piece for piece in _intervals(imu.stamp_ns, quiet, period, settings) if _keeps_attitude(imu.force_s[piece], period)]
    return _not_turning(imu.rate_s, found)


def _intervals(stamp_ns, quiet, period, settings):
    time = (stamp_ns - stamp_ns[0]) / 1e9
    hole = np.diff(time) > max(settings.gap, 5 * period)
    begins = quiet & np.concatenate([[True], ~quiet[:-1] | hole])
    ends = quiet & np.concatenate([~quiet[1:] | hole, [True]])
    found = []
    for first, last in zip(np.flatnonzero(begins), np.flatnonzero(ends), strict=True):
        start = first if first == 0 else int(np.searchsorted(time, time[first] + settings.settling))
        if start <= last and time[last] - time[start] + period >= settings.static_minimum:
            found.append(slice(int(start), int(last) + 1))
    return found


def _keeps_attitude(force, period):
    """Tell whether the scatter over the whole interval is that of short spans: where everything shakes, slow turns look quiet."""
    width = min(max(10, int(round(SPANS[0] / period))), len(force))
    pieces = force[:len(force) // width * width].reshape(-1, width, 3)
    local = np.mean(pieces.var(axis=1, ddof=1).sum(axis=1)) + least_variance(force)
    return force.var(axis=0).sum() <= _LARGEST_GROWTH * local


def _not_turning(rate, found):
    if len(found) < 2:
        return found
    means = np.array([rate[piece].mean(axis=0) for piece in found])
    noise = np.median([rate[piece].std(axis=0) for piece in found], axis=0)
    usual = np.median(means, axis=0)
    limit = np.maximum(_TURNING_SD * noise, 0.01 * np.abs(rate - usual).max(axis=0))
    return [piece for piece, mean in zip(found, means, strict=True) if np.all(np.abs(mean - usual) <= limit)]
