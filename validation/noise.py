"""Noise at rest: what one half of a recording says of the other half's Allan curve."""

import numpy as np
from scipy.special import chdtri

from imu_calibration.allan.identify import identify_noise, read_rest
from imu_calibration.allan.moment_fit import Whitener
from imu_calibration.allan.terms import predicted
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.base import AXES, SENSORS
from validation.recordings import BOARD, label, load
from validation.section import Section, text

RESTING = (
    ('shaft_pitch_slow', '/imu_fixed/data_raw'),
    ('xsens_counts', None),
    ('mpu9150_0', None),
    ('mpu9150_3', None),
    *((name, f'/imu_{k}/data_raw') for name in ('array_2', 'array_5') for k in BOARD),
)
"""
Recordings with rest in both halves; the fixed unit stands on the bench of a running motor, the
others are held or laid down by hand between turns.
"""
INSIDE = 0.90
"""
Share of the averaging times that must lie within their 95 % bands; neighbours on a curve go
together, so that few independent ones count.
"""
DRAWS = 2000
"""Times that the recordings are drawn anew for the interval of the share."""


def halves(imu):
    """Return the samples before and after the middle of the time at rest."""
    parts = read_rest([SampleBlock(imu)]).parts
    ends = np.cumsum([part.seconds for part in parts])
    middle = parts[int(np.searchsorted(ends, ends[-1] / 2))].end_ns
    at = int(np.searchsorted(imu.stamp_ns, middle))
    return imu.select(slice(0, at)), imu.select(slice(at, len(imu)))


def predicted_band(first, second, axis):
    """
    Return the 95 % band of an axis' Allan variances in `second` by the noise identified in `first`.

    Shape (2, n_scales).

    The scatter of the measured variance and the uncertainty of the fit together, as a chi-square.
    """
    found, moments = first.axes[axis], second.moments[axis]
    expected, freedom = predicted(moments, found)
    fit, own = found.fit, first.record.moments[axis]
    fitted = own.design(fit.processes)[-len(fit.covariance) :]
    seen = fit.coefficients > 0
    columns = Whitener(found.excess * fit.covariance)(fitted[:, seen])
    shares = second.moments[axis].scales
    design = np.column_stack(
        [
            shares.expectation(process) * moments.kept.of(process, shares.tau)
            for process in fit.processes
        ]
    )[:, seen]
    root = np.linalg.solve(np.linalg.cholesky(columns.T @ columns), design.T)
    freedom = 2.0 / (2.0 / freedom + (root**2).sum(axis=0) / expected**2)
    return expected * np.array([chdtri(freedom, tail) for tail in (0.975, 0.025)]) / freedom


def compare(imu):
    """
    Return whether the second half's averaging times lie inside, and a model test.

    Both are given for each of the six axes: whether each fitted averaging time of the second half
    lies inside, and whether a model explains the first half.
    """
    before, after = (SampleBlock(half) for half in halves(imu))
    first, second = identify_noise([before]), read_rest([after])
    found = []
    for axis in range(6):
        moments, fit = second.moments[axis], first.axes[axis]
        if moments is None or fit is None:
            raise ValueError('each half must have readings of both sensors, one has none')
        lower, upper = predicted_band(first, second, axis)
        measured, tau = moments.variance, second.curve.tau
        fitted = tau >= 0.999 * fit.shortest
        found.append((((lower <= measured) & (measured <= upper))[fitted], fit.excess))
    return found


def interval_of_share(counts, seed=0):
    """
    Return the 95 % interval of the share inside when the recordings are drawn again.

    The counts of (inside, all) have shape (n_recordings, 2).
    """
    drawn = counts[
        np.random.default_rng(seed).integers(len(counts), size=(DRAWS, len(counts)))
    ].sum(axis=1)
    return np.quantile(drawn[:, 0] / drawn[:, 1], (0.025, 0.975))


def run(folder, plots):
    """Return the section."""
    section = Section('Noise at rest: one half predicts the other')
    rows = []
    counts = []  # points (inside, all) of each recording
    axes = [f'{sensor} {letter}' for sensor in SENSORS for letter in AXES]
    for name, topic in RESTING:
        try:
            found = compare(load(folder, name, topic))
        except InputError as error:
            rows.append((label(name, topic), 'refused: ' + str(error).partition(';')[0], ''))
            continue
        # Only axes whose curve the model explains.
        explained = [points for points, excess in found if excess == 1]
        counts.append((sum(points.sum() for points in explained), sum(map(len, explained))))
        strange = [
            f'{axis} ({np.sqrt(excess):.1f} times)'
            for axis, (_, excess) in zip(axes, found)
            if excess > 1
        ]
        rows.append(
            (
                label(name, topic),
                ', '.join(f'{points.sum()} of {len(points)}' for points, _ in found),
                ', '.join(strange),
            )
        )
    inside, every = np.sum(counts, axis=0)
    least, most = interval_of_share(np.array(counts))
    section.claim(
        'noise fitted to the first half: Allan variances of the second inside their 95 % bands',
        f'at least {INSIDE:.0%}',
        f'{inside} of {every} ({inside / every:.1%}; {least:.0%} to {most:.0%} with other such'
        ' recordings)',
        inside >= INSIDE * every,
        headline=True,
    )
    section.say(text('noise'))
    section.table(
        (
            'recording',
            'inside, force x, y, z, rate x, y, z',
            'no model explains the curve, departs by',
        ),
        rows,
    )
    return section
