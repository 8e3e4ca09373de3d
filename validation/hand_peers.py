"""
Published programs for a calibration by hand, written again from their descriptions.

What people would use instead.
"""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from validation.second_opinions import Forward, fit_norm

GUARD, QUIET_RATE = 60, 0.13
"""imu-calib: samples kept out on both sides of a motion, and the rate that is one, rad/s."""
HALF_WINDOW, PER_REST, MULTIPLIERS, LEAST_RESTS = 50, 100, range(2, 11), 12
"""
imu_tk: half of the window of the variance, samples that are used of a rest, factors of the
threshold, least number of rests.
"""


def imu_tk(imu, ranges, gravity, without=None):
    """
    Return (accelerometer, gyroscope) as imu_tk does (Tedaldi et al., ICRA 2014).

    It uses the means of rests, and the gyroscope's bias is free.

    The rest at the beginning, `ranges[0]`, sets the threshold of the variance; the others it finds
    itself. None: it finds too few. Turns that overlap the slice `without` are not used.
    """
    first, time, best = ranges[0], 1e-9 * (imu.stamp_ns - imu.stamp_ns[0]), None
    variance, threshold = (
        _variance(imu.force_s),
        np.linalg.norm(imu.force_s[first].var(axis=0, ddof=1)),
    )
    for multiplier in MULTIPLIERS:
        rests = [
            piece
            for piece in _runs(variance < multiplier * threshold)
            if piece.stop - piece.start >= PER_REST
        ]
        if len(rests) < LEAST_RESTS:
            continue
        pieces = [
            slice(
                (rest.start + rest.stop - PER_REST) // 2, (rest.start + rest.stop + PER_REST) // 2
            )
            for rest in rests
        ]
        force = _means(imu, pieces)
        sensor = fit_norm(force, gravity)
        cost = np.sum(sensor.norm_errors(force, gravity) ** 2)
        best = (cost, sensor, pieces, force) if best is None or cost < best[0] else best
    if best is None:
        return None
    _, sensor, pieces, force = best
    turns = [
        (np.diff(time[a.stop : b.start]), imu.rate_s[a.stop : b.start])
        for a, b in zip(pieces, pieces[1:])
    ]
    return sensor, _gyroscope(
        *_other_turns(turns, sensor.directions(force), pieces, without),
        bias=imu.rate_s[first].mean(axis=0),
        loss='linear',
    )


def imu_calib(imu, ranges, gravity, without=None):
    """
    Return (accelerometer, gyroscope) as imu-calib (M. Mikov) does.

    A fixed threshold of the rate, even times, a soft loss.
    """
    first, rests = ranges[0], _resting(imu, ranges[0])
    step = 1e-9 * (imu.stamp_ns[-1] - imu.stamp_ns[0]) / (len(imu) - 1)
    samples = imu.force_s[np.concatenate([np.arange(rest.start, rest.stop) for rest in rests])]
    sensor = fit_norm(samples, gravity, loss='soft_l1')
    turns = [
        (np.full(b.start - a.stop + 9, step), imu.rate_s[a.stop - 5 : b.start + 5])
        for a, b in zip(rests, rests[1:])
    ]
    return sensor, _gyroscope(
        *_other_turns(turns, sensor.directions(_means(imu, rests)), rests, without),
        bias=imu.rate_s[first].mean(axis=0),
        loss='soft_l1',
    )


def norm_fit(imu, ranges, gravity):
    """
    Return (accelerometer, None).

    Scipy's fit of the length of gravity to the means of the rests that imu-calib finds.
    """
    return fit_norm(_means(imu, _resting(imu, ranges[0])), gravity), None


def six_faces(imu, ranges, gravity):
    """
    Return (accelerometer, None).

    Bias and matrix by least squares from the rests nearest to the six faces, taken as exact.
    """
    force = _means(imu, ranges)
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    near = force[np.argmax(faces @ force.T, axis=1)]
    solution = np.linalg.lstsq(np.column_stack([np.ones(6), gravity * faces]), near, rcond=None)[0]
    return Forward(solution[0], solution[1:].T), None


def _variance(values):
    """
    Return the norm of the variances of the axes in the window about each sample.

    It is infinite at the ends, shape (n,).
    """
    sums = np.pad(
        np.cumsum(
            np.stack([values - values.mean(axis=0), (values - values.mean(axis=0)) ** 2]), axis=1
        ),
        ((0, 0), (1, 0), (0, 0)),
    )
    width, result = 2 * HALF_WINDOW + 1, np.full(len(values), np.inf)
    total, square = sums[:, width:] - sums[:, :-width]
    result[HALF_WINDOW:-HALF_WINDOW] = np.linalg.norm(
        (square - total**2 / width) / (width - 1), axis=1
    )
    return result


def _resting(imu, first):
    """
    Return the rests of imu-calib.

    The rate, less its mean in the first rest, below a threshold, and no motion close by.
    """
    busy = np.linalg.norm(imu.rate_s - imu.rate_s[first].mean(axis=0), axis=1) >= QUIET_RATE
    return _runs(np.convolve(busy, np.ones(2 * GUARD + 1), 'same') < 0.5)


def _runs(mask):
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2])]


def _means(imu, rests):
    """Return the mean specific force of each rest, shape (n, 3)."""
    return np.array([imu.force_s[rest].mean(axis=0) for rest in rests])


def _other_turns(turns, up, rests, without):
    """
    Return (turns, gravity before them, gravity after them) of the usable turns.

    These are the turns between rests that do not overlap the slice `without`.
    """
    used = np.array(
        [
            k
            for k, (a, b) in enumerate(zip(rests, rests[1:]))
            if without is None or b.start <= without.start or a.stop >= without.stop
        ],
        int,
    )
    return [turns[k] for k in used], up[used], up[used + 1]


def _gyroscope(turns, first, last, *, bias, loss):
    """
    Return the gyroscope, bias and matrix, that turns gravity from rest to rest.

    Each turn has the directions `first` and `last`.
    """

    def misses(values):
        inverse = np.linalg.inv(values[3:].reshape(3, 3))
        return np.concatenate(
            [
                turned((rate - values[:3]) @ inverse.T, step).T @ before - after
                for (step, rate), before, after in zip(turns, first, last)
            ]
        )

    found = least_squares(
        misses, np.concatenate([bias, np.eye(3).ravel()]), x_scale='jac', loss=loss
    ).x
    return Forward(found[:3], found[3:].reshape(3, 3))


def turned(rate, step):
    """
    Return the rotation matrix, end to start, of rates with `step` s between them.

    `step` is one or n - 1 (trapezoids, commutator of neighbours).
    """
    step = np.broadcast_to(step, len(rate) - 1)[:, None]
    mats = Rotation.from_rotvec(
        0.5 * step * (rate[1:] + rate[:-1]) + step**2 / 12 * np.cross(rate[:-1], rate[1:])
    ).as_matrix()
    while len(mats) > 1:
        mats = np.concatenate([mats, np.eye(3)[None]]) if len(mats) % 2 else mats
        mats = mats[0::2] @ mats[1::2]
    return mats[0]
