"""Frozen parts during motion: a gyroscope that repeats one reading, or one of several joints with a constant state."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.core.samples import smallest_step
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.frozen_parts import TURNS
from imu_calibration.preprocessing.recording_evidence import REFUSE, CheckFinding
from imu_calibration.preprocessing.window import Window

LASTING = 1.0
"""Least duration of a standstill, s; shorter ones are handled by other checks."""
STILL = 1e-6
"""Largest rate of a joint with a repeated state after smoothing of the positions, rad/s."""
ALONG = 0.8
"""Share of the unexplained rate that lies along the axis of a joint that is frozen, as a mean square."""
OWN = 0.3
"""The unexplained rate along that axis is at least this share of the measured rate along it: a wrong gain causes less."""
OFTEN = 0.25
"""Share of repeated readings of one axis from which the steps of a gyroscope are coarser than its noise."""


def standing_still(windows: Sequence[Window], table: Table) -> CheckFinding | None:
    """
    Return the part that is frozen for a second or more while the remaining parts turn, or None.

    A joint is frozen when its state is constant while the gyroscope measures a rate about its axis that the other joints do not explain.
    A gyroscope with steps coarser than its noise may repeat a reading while the reference rate stays within one step.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    table : Table

    """
    windows = [window for window in windows if len(window) > 2 and len(window.motion) == len(window)]
    if not windows:
        return None
    expected = [reference_motion(table, window.motion).rate_s for window in windows]
    turning = [np.linalg.norm(rate, axis=1) > TURNS for rate in expected]
    repeats = [np.diff(window.rate_s, axis=0) == 0 for window in windows]
    same = [np.append(each.all(axis=1), False) for each in repeats]
    bias = np.median(np.concatenate([window.rate_s - rate for window, rate in zip(windows, expected)]), axis=0)
    coarse = np.concatenate(repeats).mean() > OFTEN
    step = np.min([smallest_step(window.rate_s) for window in windows], axis=0)
    known = np.isfinite(step)   # an axis without motion has the steps of the other axes
    step = np.where(known, step, step[known].max(initial=0.0)) if coarse else np.zeros(3)
    spans = _joined((float(window.time[start]), float(window.time[stop - 1]))
                    for window, flags, turns, rate in zip(windows, same, turning, expected) for start, stop in _runs(flags)
                    if window.time[stop - 1] - window.time[start] >= LASTING and turns[start:stop].mean() > 0.5
                    and not _rounded(window.rate_s[start], rate[start:stop], bias, step))
    if spans:
        return CheckFinding('frozen', REFUSE, 'the gyroscope must measure all the time, '
                            f'it repeats one reading {_words(spans)} while the joints turn; '
                            'check the sensor and its driver, and exclude that time')
    for k, name in enumerate(table.joint_names):
        spans = _joined(span for window, rate in zip(windows, expected) for span in _frozen(window, table, rate + bias, joint=k))
        if spans:
            return CheckFinding('frozen', REFUSE, 'joint states must follow the table, '
                                f'{name} is constant {_words(spans)} while the IMU turns about its '
                                'axis; check the driver of the table, and exclude that time')
    return None


def _frozen(window, table, expected, *, joint):
    """Yield (start, stop) in which a joint's state is constant while the residual rate is along its axis."""
    for start, stop in _runs(np.abs(window.motion.rate[:, joint]) < STILL):
        if window.time[stop - 1] - window.time[start] < LASTING:
            continue
        motion, rest = window.motion.select(slice(start, stop)), (window.rate_s - expected)[start:stop]
        faster = motion.rate.copy()
        faster[:, joint] += 1.0
        axis = reference_motion(table, replace(motion, rate=faster)).rate_s - reference_motion(table, motion).rate_s
        along, measured = (rest * axis).sum(axis=1), (window.rate_s[start:stop] * axis).sum(axis=1)
        square = float(along @ along)
        if square > len(along) * TURNS**2 and square > ALONG * (rest**2).sum() and square > OWN**2 * (measured @ measured):
            yield float(window.time[start]), float(window.time[stop - 1])


def _rounded(reading, expected, bias, step):
    """Return whether one reading represents the reference rates, shape (n, 3), up to one step per axis and wrong gains and axes."""
    error = np.linalg.norm(reading - expected - bias, axis=1)
    return bool((np.ptp(expected, axis=0) <= step).all() and (error <= np.linalg.norm(step) + OWN * np.linalg.norm(expected, axis=1)).all())


def _runs(flags):
    """Return (start, stop) of the runs of true flags, shape (n, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(flags, int), [0]]))).reshape(-1, 2)


def _joined(spans):
    """Return spans in order, merged where the gap is below a second."""
    joined: list[tuple[float, float]] = []
    for start, stop in sorted(spans):
        if joined and start - joined[-1][1] < LASTING:
            joined[-1] = (joined[-1][0], max(stop, joined[-1][1]))
        else:
            joined.append((start, stop))
    return joined


def _words(spans):
    words = [f'from {start:.1f} s to {stop:.1f} s' for start, stop in spans[:3]]
    return ', '.join(words) + (f' and {len(spans) - 3} times more' if len(spans) > 3 else '')
