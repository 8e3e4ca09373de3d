"""Rest detected from IMU data only, for recordings without a table."""

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.preprocessing.quiet_detector import BELOW, SPANS, QuietFloor, least_variance, low_passed, quiet_samples
from imu_calibration.preprocessing.window import WindowSettings

_TURNING_SD = 30.0
"""A mean rate that differs from the usual one by this many noise sds and a hundredth of the largest rate is a steady turn, not a bias."""

_STEP_SPAN = 0.5
"""Duration of the means whose differences show a transition from rest to a slow turn, s."""
_ENOUGH = 6
"""Fewest intervals for the scatter of their mean rates."""
_SCATTERS = 8.0
"""A mean rate that differs from both neighbours by this many times the scatter (at least the noise of one sample) is a turn."""

_LEAVES = 5.0
"""A low-passed reading that differs from the mean of the middle half by more than this many sds belongs to the turn before or after."""

_LARGEST_GROWTH = 4.0
"""Bias wander over a long rest adds less variance than this."""


def find_still(imu: ImuSamples, settings: WindowSettings = WindowSettings()) -> list[slice]:
    """
    Find the intervals of rest from IMU data only.

    Compares short-time variances with the quietest tenth of the recording, so any unit is allowed, also counts. The
    first `settling` seconds of an interval are excluded, except at the start of the recording; steady turns and intervals shorter than
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
        raise InputError('samples must be finite to search for rest, got NaN or infinite values; drop them first', code='not_finite')
    if np.any(step < 0):
        raise InputError('stamps must not decrease in the search for rest, got a backward step; clean the stream first',
                         code='stamps_backwards')
    if not np.any(step > 0):
        return []
    period = np.median(step[step > 0]) / 1e9
    quiet = quiet_samples(imu.force_s, imu.rate_s, period, ratio=settings.quiet_ratio, longest=settings.static_minimum, floor=QuietFloor())
    found = [piece for piece in _intervals(imu.stamp_ns, quiet, period, settings) if _keeps_attitude(imu.force_s[piece], period)]
    found = _at_one_rate(imu.rate_s, found, period, settings.static_minimum)
    return _not_turning(imu.rate_s, _trimmed(imu, found, period, settings.static_minimum))


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
    """Return whether the scatter over the interval equals the scatter over short spans: under vibration, slow turns are quiet."""
    width = min(max(10, int(round(SPANS[0] / period))), len(force))
    pieces = force[:len(force) // width * width].reshape(-1, width, 3)
    local = np.mean(pieces.var(axis=1, ddof=1).sum(axis=1)) + least_variance(force)
    return force.var(axis=0).sum() <= _LARGEST_GROWTH * local


def _at_one_rate(rate, found, period, shortest):
    """Divide intervals where the rate changes by more than its noise: a transition from rest to a slow turn that is as quiet."""
    if not found:
        return found
    noise = np.median([rate[piece].std(axis=0) for piece in found], axis=0)
    width, parts = max(10, int(round(_STEP_SPAN / period))), []
    for piece in found:
        count = (piece.stop - piece.start) // width
        means = rate[piece.start:piece.start + count * width].reshape(count, width, 3).mean(axis=1)
        steps = np.flatnonzero(np.any(np.abs(np.diff(means, axis=0)) > np.maximum(noise, _least_step(rate)), axis=1)) + 1
        edges = [piece.start, *(piece.start + width * steps), piece.stop]
        parts += [slice(int(a), int(b)) for a, b in zip(edges, edges[1:]) if (b - a) * period >= shortest or len(edges) == 2]
    return parts


def _least_step(rate):
    """Return the least rate step, shape (3,): a thousandth of the largest rate."""
    return 1e-3 * np.abs(rate - np.median(rate, axis=0)).max(axis=0)


def _trimmed(imu, found, period, shortest):
    """Trim both ends of intervals where the low-passed readings exceed the scatter of the middle: a turn begins below the noise."""
    first, last = (np.array([getattr(piece, end) for piece in found], int) for end in ('start', 'stop'))
    width = 2 * int(round(BELOW / period / 2)) + 1
    for values in (imu.force_s, imu.rate_s) if found else ():
        slow = low_passed(values, width)
        middles = [slice(*np.linspace(a, b, 5).astype(int)[1:4:2]) for a, b in zip(first, last)]
        centres = [slow[middle].mean(axis=0) for middle in middles]
        spread = [np.mean((slow[middle] - centre)**2) for middle, centre in zip(middles, centres)]
        spread = np.maximum(np.maximum(spread, np.median(spread)), least_variance(values) / 3 / width)
        for k, (middle, centre) in enumerate(zip(middles, centres)):
            off = np.sum((slow[first[k]:last[k]] - centre)**2, axis=1) > 3 * _LEAVES**2 * spread[k]
            before, after = off[:middle.start - first[k]], off[middle.stop - first[k]:]
            last[k] = middle.stop + int(np.argmax(after)) if after.any() else last[k]
            first[k] = middle.start - int(np.argmax(before[::-1])) if before.any() else first[k]
    return [slice(int(a), int(b)) for a, b in zip(first, last) if (b - a) * period >= shortest]


def _not_turning(rate, found):
    """Exclude intervals whose mean rate differs significantly from their neighbours: slow and steady turns."""
    if len(found) < 2:
        return found
    means = np.array([rate[piece].mean(axis=0) for piece in found])
    noise = np.median([rate[piece].std(axis=0) for piece in found], axis=0)
    usual = np.median(means, axis=0)
    limit = np.maximum(_TURNING_SD * noise, 0.01 * np.abs(rate - usual).max(axis=0))
    keep = np.all(np.abs(means - usual) <= limit, axis=1)
    if len(found) >= _ENOUGH:   # an isolated deviation from both neighbours; the drift of warming biases is smooth
        step = np.diff(means, axis=0)
        alone = np.minimum(np.minimum(np.abs(step[:-1]), np.abs(step[1:])), 0.5 * np.abs(step[1:] - step[:-1]))
        scatter = np.median(np.abs(step), axis=0) / (0.6745 * np.sqrt(2))
        keep[1:-1] &= np.all(alone <= np.maximum(_SCATTERS * scatter, noise), axis=1)
    return [piece for piece, kept in zip(found, keep, strict=True) if kept]
