"""
Two IMUs on one rigid body.

Readings calibrated by hand, rotation and time offset of B relative to A, weighted integrals over
windows.
"""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.core.samples import AlignedArrays, ImuSamples
from imu_calibration.kinematics.rotations import nearest_rotation, skew
from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.references.gravity.hand_calibration import HandCalibration, calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions

SINE_POWER = 6
"""
The weight is sin^6: with eight samples per window its sums equal its integrals, and its ends are
smooth to fifth order.
"""
SAMPLES_LEAST = 8
"""Samples per window; with fewer the sums depend on the positions of the samples."""
INTEGRATION_SECONDS = 0.12
"""
Length of the windows over which the motion is integrated, s; never below `SAMPLES_LEAST`. In
shorter ones the noise of the angular acceleration shortens the arm, in longer ones fast motion
averages out.
"""
MAX_BRIDGED_SECONDS = 0.1
"""Windows do not bridge longer holes, s; never below five periods."""
OFFSET_ROUNDS = 4
"""Repeated estimates of the delay between the stamps of the two IMUs."""
MAX_GATHERED_NUMBERS = 4_000_000
"""Numbers per gather operation."""


@dataclass(frozen=True, eq=False)
class Windows(AlignedArrays):
    """
    Windows of one length over one stream.

    For a signal x and the weight phi of a window (zero at its ends, integral 1): ``mean = int phi x
    dt`` and, by parts, ``slope = int phi dx/dt dt = -int (dphi/dt) x dt``. Both apply the same
    low-pass, so an equation between x, its derivative and other signals also holds for its weighted
    integrals, for any motion between the samples.
    """

    index: np.ndarray
    """Indices of the samples of each window, padded, shape (n_windows, width)."""
    weight: np.ndarray
    """Quadrature weights of `mean`, zero for padding, shape (n_windows, width)."""
    weight_slope: np.ndarray
    """Quadrature weights of `slope`, 1/s, shape (n_windows, width)."""

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted means of values (n, k), shape (n_windows, k)."""
        return _weighted(self.index, self.weight, values)

    def slope(self, values: np.ndarray) -> np.ndarray:
        """
        Return the weighted means of the time derivative of values (n, k), shape (n_windows, k).
        """
        return _weighted(self.index, self.weight_slope, values)

    def touches(self, flags: np.ndarray) -> np.ndarray:
        """Return which windows contain a flagged sample, shape (n_windows,)."""
        return np.any(flags[self.index] & (self.weight > 0), axis=1)


def make_windows(time: np.ndarray, centres: np.ndarray, length: float) -> Windows:
    """
    Return the windows of `length` seconds around `centres` over the samples at `time`.

    With ``phase = pi (t - begin) / length``, and the mean 5/16 of sin^6 over a window::

        phi     = sin^6(phase) / (5/16) / length
        dphi/dt = 6 sin^5(phase) cos(phase) (pi / length) / (5/16) / length

    Each sample counts for the time step around it.

    Parameters
    ----------
    time : array, shape (n,)
        Rising, s.
    centres : array, shape (n_windows,)
        s; windows should lie inside the stream.
    length : float
        Full length, s.

    """
    # Window k has the samples first[k] to stop[k] - 1. All windows get the width of the longest;
    # their entries after the last sample are not `inside` and have no weight.
    first = np.searchsorted(time, centres - length / 2, side='right')
    stop = np.searchsorted(time, centres + length / 2, side='left')
    width = max(int(np.max(stop - first, initial=1)), 1)
    entry = np.arange(width)
    index = np.minimum(first[:, None] + entry, len(time) - 1)
    inside = entry < (stop - first)[:, None]

    phase = np.pi * ((time[index] - centres[:, None]) / length + 0.5)
    sine = np.sin(phase)
    relative_step = np.gradient(time)[index] / length
    norm = 1 / 0.3125
    weight = np.where(inside, norm * sine**SINE_POWER * relative_step, 0.0)
    factor = -norm * SINE_POWER * np.pi / length
    slope = factor * sine ** (SINE_POWER - 1) * np.cos(phase) * relative_step
    return Windows(index, weight, weight_slope=np.where(inside, slope, 0.0))


def _weighted(index: np.ndarray, weight: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    Return the weighted sums of values (n, k) over windows, shape (n_windows, k).

    They are computed in blocks of windows, which bounds the memory.
    """
    block = max(1, MAX_GATHERED_NUMBERS // (index.shape[1] * values.shape[1]))
    sums = [np.zeros((0, values.shape[1]))]
    for start in range(0, len(index), block):
        part = slice(start, start + block)
        sums.append(np.einsum('mw,mwk->mk', weight[part], values[index[part]]))
    return np.concatenate(sums)


def holes(time: np.ndarray, longest: float) -> np.ndarray:
    """Return flags of samples next to a step longer than `longest` seconds, shape (n,)."""
    is_hole = np.diff(time) > longest
    return np.concatenate([is_hole, [False]]) | np.concatenate([[False], is_hole])


@dataclass(frozen=True, eq=False)
class PairedImu:
    """One IMU of the pair, compensated."""

    time: np.ndarray
    """Seconds since A's first sample on its own clock, shape (n,)."""
    force: np.ndarray
    """Specific force in the frame of this IMU, m/s^2, shape (n, 3)."""
    rate: np.ndarray
    """Angular rate in the frame of this IMU, rad/s, shape (n, 3)."""
    flagged: np.ndarray
    """Samples at the end of the range or next to a hole, shape (n,)."""
    calibration: HandCalibration | None
    """Calibration by hand from the same samples; None: only the rates' bias at rest was removed."""
    period: float
    """Median step, s."""

    @classmethod
    def make(cls, imu: ImuSamples, start_ns: int) -> 'PairedImu':
        """Compensate the samples of one IMU with a calibration from their own poses."""
        time = 1e-9 * (imu.stamp_ns - start_ns)
        keep = np.concatenate([[True], np.diff(time) > 0])  # repeated stamps add no new time
        imu = imu.select(keep)
        time = time[keep]
        period = float(np.median(np.diff(time)))
        flagged = (
            clipped(imu.force_s)
            | clipped(imu.rate_s)
            | holes(time, max(MAX_BRIDGED_SECONDS, 5 * period))
        )
        still = find_still(imu)
        try:
            calibration = calibrate_by_hand(imu, HandOptions(), still)
            force, rate = calibration.compensate(imu.force_s, imu.rate_s)
        except NotObservableError:
            bias = np.zeros(3)
            if still:
                bias = np.mean([imu.rate_s[rest].mean(0) for rest in still], axis=0)
            calibration = None
            force = imu.force_s
            rate = imu.rate_s - bias
        return cls(time, force, rate, flagged, calibration, period)


def clipped(values: np.ndarray) -> np.ndarray:
    """
    Return which samples are at the end of the range, shape (n,).

    The end of the range is a largest reading of one sign, over all axes, that occurs repeatedly; a
    largest reading that occurs at most twice is due to the motion. The two ends may differ by one
    count.
    """
    flagged = np.zeros(len(values), bool)
    for signed in (values, -values):
        at_end = signed >= signed.max() - 1e-9 * np.abs(signed).max()
        if np.sum(at_end) > 2:
            flagged |= np.any(at_end, axis=1)
    return flagged


def require_overlap(imu_a: ImuSamples, imu_b: ImuSamples) -> None:
    """Refuse IMUs that were not recorded at the same time."""
    if len(imu_a) < 2 * SAMPLES_LEAST or len(imu_b) < 2 * SAMPLES_LEAST:
        raise InputError(
            f'both IMUs must have at least {2 * SAMPLES_LEAST} samples, got {len(imu_a)} and'
            f' {len(imu_b)}; check the topics',
            code='too_few_samples',
        )
    overlap = min(imu_a.stamp_ns[-1], imu_b.stamp_ns[-1]) - max(
        imu_a.stamp_ns[0], imu_b.stamp_ns[0]
    )
    if overlap <= 0:
        raise InputError(
            'the two IMUs must have been recorded at the same time, their stamps differ by'
            f' {-1e-9 * overlap:.1f} s; check the clocks',
            code='no_overlap',
        )


def window_length(a: PairedImu, b: PairedImu) -> float:
    """Return the length of the windows, s."""
    return max(INTEGRATION_SECONDS, SAMPLES_LEAST * max(a.period, b.period))


def window_centres(a: PairedImu, b: PairedImu, *, offset: float, length: float) -> np.ndarray:
    """
    Return the middles of the windows over the common time of both IMUs, s on A's clock.

    The first one is on a sample of A. They are ``length / SAMPLES_LEAST`` apart, at least a period
    of A.
    """
    step = max(a.period, length / SAMPLES_LEAST)
    # Half a window, and 0.1 s for windows that are shifted by a delay.
    margin = 0.51 * length + 0.1
    begin = max(a.time[0], b.time[0] - offset) + margin
    end = min(a.time[-1], b.time[-1] - offset) - margin
    if end - begin < step:
        raise InputError(
            f'the two IMUs must overlap by more than {2 * margin:.1f} s, got'
            f' {end - begin + 2 * margin:.1f} s; record longer'
        )
    first = a.time[np.searchsorted(a.time, begin)]
    return first + step * np.arange(int((end - first) / step) + 1)


@dataclass(frozen=True, eq=False)
class RelativeRotation:
    """Rotation and time offset of B relative to A."""

    mat_ab: np.ndarray
    """Rotation, B's frame to A's, shape (3, 3)."""
    cov: np.ndarray
    """Covariance of its error as a rotation vector, rad^2, shape (3, 3)."""
    offset: float
    """Delay of B's stamps, s."""


def relative_rotation(a: PairedImu, b: PairedImu) -> RelativeRotation:
    """
    Return the rotation and the time offset of B relative to A.

    The offset is estimated from the rates. So is the rotation, unless both IMUs were calibrated:
    then it is estimated from the directions of gravity at rest.
    """
    offset = 0.0
    length = window_length(a, b)
    for _ in range(OFFSET_ROUNDS):
        centres = window_centres(a, b, offset=offset, length=length)
        over_a = make_windows(a.time, centres, length)
        over_b = make_windows(b.time, centres + offset, length)
        is_used = ~(over_a.touches(a.flagged) | over_b.touches(b.flagged))
        over_a = over_a.select(is_used)
        over_b = over_b.select(is_used)
        rate_a = over_a.mean(a.rate)
        rate_b = over_b.mean(b.rate)
        alpha = over_a.slope(a.rate)
        mat_ab = nearest_rotation(rate_a.T @ rate_b)
        # The delay d of B changes its rate by ``-d alpha``: least squares.
        difference = rate_b @ mat_ab.T - rate_a
        offset -= float(np.sum(difference * alpha) / max(np.sum(alpha * alpha), 1e-300))

    at_rest = _directions_at_rest(a, b, offset)
    if at_rest is None:
        # Windows of the rates overlap: about so many consecutive ones have common errors.
        return _rotation_between(rate_a, rate_b, offset, overlap=SAMPLES_LEAST)
    return _rotation_between(*at_rest, offset, overlap=1)


def _rotation_between(
    vectors_a: np.ndarray, vectors_b: np.ndarray, offset: float, *, overlap: int
) -> RelativeRotation:
    """
    Return the rotation that turns the vectors of B into those of A, with its covariance.

    A small turn e changes a vector v of A by ``e x v = -[v x] e``, so that with errors of the
    variance s^2 per component the information on e is ``sum [v x]' [v x] / s^2``.

    Parameters
    ----------
    vectors_a, vectors_b : array, shape (n, 3)
    offset : float
        Delay of B's stamps, s.
    overlap : int
        Number of consecutive vectors with common errors.

    """
    mat_ab = nearest_rotation(vectors_a.T @ vectors_b)
    residual = vectors_a - vectors_b @ mat_ab.T
    cross = skew(vectors_a)
    information = np.einsum('nki,nkj->ij', cross, cross) + 1e-12 * np.eye(3)
    covariance = overlap * np.mean(residual**2) * np.linalg.inv(information)
    return RelativeRotation(mat_ab, covariance, offset)


def _directions_at_rest(
    a: PairedImu, b: PairedImu, offset: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """
    Return the mean forces of A and B in the poses of A, m/s^2, each of shape (k, 3).

    None with fewer than four poses, or where an IMU has no calibration from poses.
    """
    if a.calibration is None or b.calibration is None:
        return None
    forces_a = []
    forces_b = []
    for start, stop in zip(a.calibration.poses.start, a.calibration.poses.stop):
        begin = a.time[start]
        end = a.time[stop - 1]
        in_b = slice(*np.searchsorted(b.time, (begin + offset, end + offset)))
        if in_b.stop - in_b.start >= 2:
            forces_a.append(a.force[start:stop].mean(0))
            forces_b.append(b.force[in_b].mean(0))
    if len(forces_a) < 4:
        return None
    return np.array(forces_a), np.array(forces_b)
