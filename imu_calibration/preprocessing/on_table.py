"""
Agreement of the IMU with the joints.

Exchanged or reversed axes, delay, and rotation against the table.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np

from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import REFUSE, CheckFinding
from imu_calibration.preprocessing.window import MotionReadings, Window, motion_readings

MIN_MATCH = 0.8
"""Agreement from which on an exchange of axes describes the matrix."""
POOR = 0.6
"""Agreement of the axes as they are below which they are wrong; a turn by 60 degrees has 0.67."""
AGREEMENT_TIE = 0.05
"""Agreements and shares that differ by less count as equal."""


def signed_permutations() -> np.ndarray:
    """
    Return the 48 matrices that exchange axes and signs, shape (48, 3, 3).

    The identity is first. The rest is ordered by number of changes.
    """
    all_signs = list(product((1.0, -1.0), repeat=3))
    matrices = []
    for order in permutations(range(3)):
        for signs in all_signs:
            matrices.append(np.eye(3)[list(order)] * np.array(signs)[:, None])
    return np.array(sorted(matrices, key=lambda matrix: (matrix != np.eye(3)).any(axis=1).sum()))


@dataclass(frozen=True, eq=False)
class AxisMatch:
    """Assignment of measured axes to the axes of a reference."""

    matrix: np.ndarray
    """Closest signed permutation in ``measured = scale * matrix @ reference``, shape (3, 3)."""
    agreement: float
    """Correlation of the measured matrix with `matrix`; 1: equal up to the scale."""
    as_they_are: float
    """The same with the identity; 1: every axis is that of the reference; -1: all are reversed."""
    turned: bool
    """Whether a rotation explains it."""
    mirrored: bool
    """Whether a reflection explains it; with few turns both may."""

    @property
    def wrong(self) -> bool:
        """Return whether the axes differ from those of the reference."""
        return self.as_they_are < POOR

    def exchanges(self, seen: np.ndarray = np.eye(3)) -> list[tuple[int, int, float]]:
        """
        Return (measured axis, reference axis, sign) of each wrong axis.

        For the reference axes with motion.
        """
        return _wrong_axes(self.matrix, seen)

    def words(self, seen: np.ndarray) -> str:
        """Return these exchanges in words; '' where no exchange of axes explains the matrix."""
        return ', '.join(_axis_phrases(self.matrix, seen)) if self.agreement > MIN_MATCH else ''


def _wrong_axes(matrix: np.ndarray, seen: np.ndarray) -> list[tuple[int, int, float]]:
    """
    Return (row, column, sign) of the entries of a signed permutation that differ from the identity.

    In the columns of the reference axes with motion, which are `seen`.
    """
    entries = []
    for i, j in np.argwhere(matrix):
        is_changed = i != j or matrix[i, j] < 0
        if is_changed and seen[j, j] > 0.5:
            entries.append((int(i), int(j), float(matrix[i, j])))
    return entries


def match_axes(matrix: np.ndarray, seen: np.ndarray = np.eye(3)) -> AxisMatch:
    """
    Return the `AxisMatch` of ``measured = matrix @ reference``.

    Parameters
    ----------
    matrix : array, shape (3, 3)
        Up to a common positive factor; only ``matrix @ seen`` is used.
    seen : array, shape (3, 3)
        Projector on the directions in which the reference moved.

    """
    # Correlation of each candidate, (48, 3, 3), with the matrix: 1 if it is equal up to the scale.
    projected = matrix @ seen
    scale = np.sqrt((projected**2).sum() / np.trace(seen))
    candidates = signed_permutations()
    agreements = np.einsum('kij,ij->k', candidates, projected) / (scale * np.trace(seen))
    best = agreements.max()
    is_near_best = agreements >= best - AGREEMENT_TIE
    is_rotation = np.linalg.det(candidates) > 0
    return AxisMatch(
        matrix=candidates[np.argmax(is_near_best)],
        agreement=float(best),
        as_they_are=float(agreements[0]),
        turned=bool((is_near_best & is_rotation).any()),
        mirrored=bool((is_near_best & ~is_rotation).any()),
    )


SAME = 0.5
"""
Smallest share of the measured rates that the reference explains on the same table, as a squared
correlation.
"""
LEAST_SHARE_EXPLAINED = 0.8
"""Smallest share explained of an exchange that is reported."""
TESTED_PIECE_SECONDS = 5.0
"""Duration of the pieces of a recording that are tested separately, s."""
TESTED_RATE = 0.02
"""Smallest rms rate for a test, rad/s."""
MIN_TESTED_SAMPLES, MAX_TESTED_SAMPLES = 20, 5_000
"""Samples that are tested."""
MAX_PERMUTED_JOINTS = 3
"""
All orders and signs are tested up to this number of joints; above it, each sign and each exchange
of two joints.
"""


class Exchange(NamedTuple):
    """
    Signs and order of joints, and IMU axes, with which the reference explains the measured rates.
    """

    joints: tuple[str, ...]
    """One phrase per joint to correct."""
    axes: tuple[str, ...]
    """One phrase per IMU axis to correct, in addition."""
    instead: tuple[str, ...]
    """
    One phrase per IMU axis; with these corrections and unchanged joints, rates and specific force
    are explained equally well.
    """
    share: float
    """
    Share of the rates that it explains, ``1 - sum |measured - reference|^2 / sum |measured|^2``.
    """
    span: tuple[float, float] | None
    """(start, stop) of the part of the recording to which it applies, s; None: all of it."""


def find_exchange(windows: Sequence[Window], table: Table) -> Exchange | None:
    """
    Return the `Exchange` that explains rates that the table as described does not explain, or None.

    Order and signs of joints are combined with the 48 signed permutations P of the IMU axes; the
    share is that of ``P @ rate_s``. Candidates with equal shares of the rates are separated by the
    specific force, then by the number of changes.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    table : Table

    """
    windows = [
        window
        for window in windows
        if len(window) >= MIN_TESTED_SAMPLES and len(window.motion) == len(window)
    ]
    if not windows:
        return None
    readings = motion_readings(windows, MAX_TESTED_SAMPLES)
    readings = replace(readings, rate_s=readings.rate_s - np.median(readings.rate_s, axis=0))

    # Pieces of the recording with motion, and those of them that the table does not explain.
    piece = ((readings.time - readings.time.min()) / TESTED_PIECE_SECONDS).astype(int)
    error = readings.rate_s - reference_motion(table, readings.motion).rate_s
    residual = np.bincount(piece, weights=(error**2).sum(axis=1))
    power = np.bincount(piece, weights=(readings.rate_s**2).sum(axis=1))
    moves = power > TESTED_RATE**2 * np.bincount(piece)
    moving = readings.select(moves[piece])
    unexplained = readings.select((moves & (residual > (1.0 - SAME) * power))[piece])
    if len(unexplained) < MIN_TESTED_SAMPLES:
        return None

    # An exchange in the complete recording, then one in the unexplained pieces only.
    unexplained_span = (float(unexplained.time.min()), float(unexplained.time.max()))
    for tested, span in ((moving, None), (unexplained, unexplained_span)):
        best = _best_candidate(tested, table)
        joints = _joint_phrases(table.joint_names, best.order, best.signs)
        axes = _axis_phrases(best.axes)
        if best.share >= LEAST_SHARE_EXPLAINED and (joints or axes):
            instead = _axis_phrases(best.axes_alone) if joints else ()
            return Exchange(joints, axes, instead, best.share, span)
    return None


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Order and signs of joints, and IMU axes, that explain the readings best."""

    order: list[int]
    """Index of the joint with the readings of each joint."""
    signs: list[float]
    """Factor of these readings, 1 or -1."""
    axes: np.ndarray
    """Signed permutation P of the IMU axes, shape (3, 3)."""
    axes_alone: np.ndarray
    """The one that explains the readings best with the joints as described, shape (3, 3)."""
    share: float
    """Share of the rates that is explained."""


def _best_candidate(readings: MotionReadings, table: Table) -> _Candidate:
    """
    Return the candidate that explains most of the rates, then of the force, with fewest changes.

    With a signed permutation P the share of the readings m explained by the reference r is::

        1 - sum |P m - r|^2 / sum |m|^2 = (2 sum (P m) . r - sum |r|^2) / sum |m|^2
    """
    motion = readings.motion
    candidates = _candidates(motion.position.shape[1])
    axes = signed_permutations()
    rate_share = np.empty((len(candidates), len(axes)))
    force_share = np.empty((len(candidates), len(axes)))
    for k, (order, signs) in enumerate(candidates):
        changed = JointMotion(
            motion.time,
            motion.position[:, order] * signs,
            motion.rate[:, order] * signs,
            motion.acceleration[:, order] * signs,
            motion.jerk[:, order] * signs,
        )
        reference = reference_motion(table, changed)
        rate_share[k] = _shares_of_axes(axes, readings.rate_s, reference.rate_s)
        force_share[k] = _shares_of_axes(axes, readings.force_s, reference.force_s)
    is_near = rate_share >= rate_share.max() - AGREEMENT_TIE
    is_near &= force_share >= force_share[is_near].max() - AGREEMENT_TIE

    # Numbers of changed joints and axes; a change of both kinds counts as one more.
    joint_changes = []
    for order, signs in candidates:
        is_changed = (np.array(order) != range(len(order))) | (np.array(signs) < 0)
        joint_changes.append(np.count_nonzero(is_changed))
    axis_changes = (axes != np.eye(3)).any(axis=2).sum(axis=1)
    has_both = np.logical_and.outer(joint_changes, axis_changes)
    changes = np.add.outer(joint_changes, axis_changes) + has_both
    k, p = np.unravel_index(np.argmin(np.where(is_near, changes, np.inf)), changes.shape)
    order, signs = candidates[k]
    return _Candidate(
        order=order,
        signs=signs,
        axes=axes[p],
        axes_alone=axes[np.argmax(is_near[0])],
        share=float(rate_share[k, p]),
    )


def _shares_of_axes(axes: np.ndarray, measured: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the share of the readings, (n, 3), explained with each permutation of the axes."""
    cross = np.einsum('pij,ij->p', axes, measured.T @ reference)
    return (2.0 * cross - (reference**2).sum()) / max((measured**2).sum(), 1e-300)


def _candidates(n_joints: int) -> list[tuple[list[int], list[float]]]:
    """Return `order` and `signs` of the candidates; those of the description are the first."""
    identity = list(range(n_joints))
    plus = [1.0] * n_joints
    if n_joints <= MAX_PERMUTED_JOINTS:
        all_signs = list(product((1.0, -1.0), repeat=n_joints))
        pairs = product(permutations(identity), all_signs)
        return [(list(order), list(signs)) for order, signs in pairs]

    # Of more joints one is reversed, or two are exchanged.
    candidates = [(identity, plus)]
    for joint in identity:
        signs = list(plus)
        signs[joint] = -1.0
        candidates.append((identity, signs))
    for a, b in combinations(identity, 2):
        order = list(identity)
        order[a], order[b] = b, a
        candidates.append((order, plus))
    return candidates


def _joint_phrases(names: Sequence[str], order: list[int], signs: list[float]) -> tuple[str, ...]:
    """Return a phrase for each joint that is exchanged or reversed."""
    phrases = []
    for k, (j, sign) in enumerate(zip(order, signs)):
        if k != j and sign > 0:
            phrases.append(f'{names[k]} turns as {names[j]} should')
        elif k != j:
            phrases.append(f'{names[k]} turns as {names[j]} should, reversed')
        elif sign < 0:
            phrases.append(f'{names[k]} turns the other way round')
    return tuple(phrases)


def _axis_phrases(axes: np.ndarray, seen: np.ndarray = np.eye(3)) -> tuple[str, ...]:
    """Return a phrase for each wrong axis of a permutation, of reference axes with motion."""
    phrases = []
    for i, j, sign in _wrong_axes(axes, seen):
        minus = 'minus ' if sign < 0 else ''
        phrases.append(f"measured {'xyz'[i]} is {minus}the reference's {'xyz'[j]}")
    return tuple(phrases)


MIN_RATE_GAIN = 0.05
"""
Smallest gain of the measured rates with respect to the rates of the table for an IMU on the table.
"""
LARGEST_SHIFT = 60.0
"""Largest delay between the streams that is tested, s."""
LEAST_SHIFT = 0.05
"""Smaller delays are estimated as a lag, s."""
SHARE_TIE = 0.02
"""Shares explained that differ by less do not separate a delay from a wrong sign or from a lag."""
RESOLVED = 4
"""Shifts that are tested per sampling period: the rates of fast sweeps differ within one period."""


@dataclass(frozen=True, eq=False)
class ProductSums:
    """Sums of products of measured readings and readings expected by the joints, (3, 3) each."""

    cross: np.ndarray
    """Measured with reference."""
    reference: np.ndarray
    """Reference with itself."""
    measured: np.ndarray
    """Measured with itself."""


def same_motion(sums: ProductSums, windows: list[Window], table: Table) -> CheckFinding | None:
    """
    Return the cause if the gyroscope does not measure the motion of the joints, otherwise None.

    Causes: an IMU that rests while the table turns, a delay between the streams, and a different
    motion.

    Parameters
    ----------
    sums : ProductSums
        Of the rates.
    windows : list of Window
        Stored moving windows with their samples; without them, no delay is found.
    table : Table

    """
    # Least squares ``measured = matrix @ reference``.
    matrix = sums.cross @ np.linalg.pinv(sums.reference, rcond=0.01)
    fitted_power = np.trace(matrix @ sums.reference @ matrix.T)
    gain = np.sqrt(fitted_power / np.trace(sums.reference))
    explained = fitted_power / max(np.trace(sums.measured), 1e-300)
    # Other checks report units, signs and axes.
    if explained >= SAME and gain > 0.1 * MIN_RATE_GAIN:
        return a_period_late(windows, table) if explained < 1.0 - SHARE_TIE else None
    # An IMU that rests, that is late, or that moves otherwise.
    turns = np.trace(sums.measured) > MIN_RATE_GAIN * np.trace(sums.reference)
    if not turns and gain > MIN_RATE_GAIN:
        return None
    delay_cause = _delay_cause(windows, table) if turns else ''
    cause = 'this IMU does not turn when the table does; give the topic of the IMU on the table'
    if turns:
        cause = delay_cause or (
            'its motion is not that of the table; give the topic of the IMU on the table, and'
            ' check the names of the joints and both clocks'
        )
    return CheckFinding(
        'on_table',
        REFUSE,
        'the gyroscope must measure the motion of the joints, they explain '
        f'{100 * min(explained, 1.0):.0f} % of its rates at a gain of {gain:.2g}: {cause}',
        key=None if delay_cause else 'imu_topic',
    )


def exchanged(exchange: Exchange, windows: list[Window], table: Table) -> CheckFinding | None:
    """
    Return the finding of exchanged or reversed axes; None if a delay explains the rates better.
    """
    delay = _estimate_delay(windows, table)
    is_late = abs(delay.seconds) > LEAST_SHIFT and delay.share > exchange.share - SHARE_TIE
    if is_late and delay.share > exchange.share + SHARE_TIE:
        return None
    phrases = ', '.join(exchange.joints + exchange.axes)
    if exchange.instead:
        phrases += f' (or {", ".join(exchange.instead)})'
    span = '' if exchange.span is None else ' from {:.0f} s to {:.0f} s'.format(*exchange.span)
    remedy = 'correct the axes in the driver of the IMU'
    if exchange.joints:
        remedy = 'correct names and axes in the table description, or the joint states'
    if exchange.span is not None:
        remedy += ', or exclude that time'
    return CheckFinding(
        'on_table',
        REFUSE,
        f'the rates of the gyroscope must agree with the joints{span}, '
        f'{100 * exchange.share:.0f} % of them are explained if {phrases}; {remedy}'
        + (f'; or {_late(delay.seconds)}' if is_late else ''),
    )


def _delay_cause(windows: Sequence[Window], table: Table) -> str:
    """Return the delay with which the streams agree, in words, or ''."""
    delay = _estimate_delay(windows, table)
    is_better = delay.share > max(SAME, delay.share_near_zero + SHARE_TIE)
    return _late(delay.seconds) if abs(delay.seconds) > LEAST_SHIFT and is_better else ''


def a_period_late(
    windows: Sequence[Window], table: Table, *, least_share: float = 0.0
) -> CheckFinding | None:
    """
    Return the finding for streams that agree clearly better with a delay, or None.

    Beyond the range of a lag: clocks that differ, or streams of a repeating motion that are a
    period apart. With the delay the joints explain `least_share` of the rates at least.
    """
    delay = _estimate_delay(windows, table)
    # A smaller delay is estimated as a lag, with the other parameters.
    if delay.ambiguous or abs(delay.seconds) <= LEAST_SHIFT:
        return None
    # Opposite rates: a wrong sign, or half a period.
    if delay.share_near_zero < -SAME:
        return None
    if delay.share < max(LEAST_SHARE_EXPLAINED, least_share, delay.share_near_zero + SHARE_TIE):
        return None
    return CheckFinding(
        'on_table',
        REFUSE,
        'both streams must share one clock, the joints explain'
        f' {100 * max(delay.share_near_zero, 0.0):.0f} % of the rates with a delay up to'
        f' {LEAST_SHIFT} s and {100 * delay.share:.0f} % with a larger one:'
        f' {_late(delay.seconds)}',
    )


def _late(seconds: float) -> str:
    """Return a delay of the IMU's stamps in words, with the remedy."""
    side = 'behind' if seconds > 0 else 'ahead of'
    return (
        f'the stamps of the IMU are about {abs(seconds):.1f} s {side} those of the joints; '
        'set both clocks by one source, or stamp in the drivers'
    )


@dataclass(frozen=True)
class Delay:
    """A delay between the streams that explains opposite rates."""

    words: str
    """Cause and remedy."""
    sure: bool
    """Whether it explains more of the rates than a wrong sign, by more than SHARE_TIE."""


def signs_or_delay(windows: list[Window], table: Table) -> Delay | None:
    """
    Return the delay that explains rates of the opposite sign; None if a sign explains them better.

    For sweeps to and fro, half a period of delay and a wrong sign differ only by the differences
    between the sweeps.

    Parameters
    ----------
    windows : list of Window
        Moving windows with their samples.
    table : Table

    """
    delay = _estimate_delay(windows, table)
    # A smaller delay is estimated as a lag, and the joints must explain the rates at all.
    if abs(delay.seconds) <= LEAST_SHIFT or delay.share < SAME:
        return None
    # Reversed signs of the reference change the sign of the correlation, and thereby of the share.
    share_with_reversed_sign = -delay.share_near_zero
    if delay.share < share_with_reversed_sign - SHARE_TIE:
        return None
    return Delay(_late(delay.seconds), delay.share > share_with_reversed_sign + SHARE_TIE)


@dataclass(frozen=True)
class _DelayEstimate:
    """A delay of the IMU's stamps and the shares of the rates that the joints explain with it."""

    seconds: float
    """Delay, s; positive: the IMU's stamps are late."""
    share: float
    """Share explained with this delay."""
    share_near_zero: float
    """Largest one within +-LEAST_SHIFT, the range of a lag; negative if the rates are opposite."""
    ambiguous: bool
    """
    Whether it is one period of a repeating motion from a peak within the range of a lag, and a
    delay of the other sign is as good.
    """


def _estimate_delay(windows: Sequence[Window], table: Table) -> _DelayEstimate:
    """
    Return the delay that explains the rates best; of equally good ones, the smallest.

    Without samples, a delay of zero.
    """
    windows = [window for window in windows if len(window) >= MIN_TESTED_SAMPLES]
    if not windows:
        return _DelayEstimate(0.0, 0.0, 0.0, False)
    rates = _resample_rates(windows, table)
    max_lag = min(int(LARGEST_SHIFT / rates.period), len(rates.measured) // 2)
    shares = _shares_explained(rates, max_lag)

    # `shares` has the delay zero at index `zero`, and the range of a lag up to `reach` from it, in
    # which the largest share is that of `peak_near_zero`.
    zero = RESOLVED * max_lag
    reach = int(RESOLVED * LEAST_SHIFT / rates.period)
    shares_near_zero = np.abs(shares[zero - reach : zero + reach + 1])
    peak_near_zero = int(np.argmax(shares_near_zero)) + zero - reach
    # The nearest peak to zero delay among those within SHARE_TIE of the highest: periodic motion
    # has many.
    inner = shares[1:-1]
    is_peak = (inner >= shares[:-2]) & (inner >= shares[2:])
    peaks = 1 + np.flatnonzero(is_peak & (inner >= shares.max() - SHARE_TIE))
    best = int(peaks[np.argmin(np.abs(peaks - zero))] if len(peaks) else np.argmax(shares))
    # Ambiguous: a peak inside the range of a lag, not the slope of one beyond; a best delay that
    # does not explain everything; and a delay of the other sign, beyond the range, that is as good.
    has_inner_peak = 0 < peak_near_zero - zero + reach < 2 * reach
    is_incomplete = shares[best] < 1.0 - SHARE_TIE
    shares_of_other_sign = shares[: max(zero - reach, 0)]
    if best < zero:
        shares_of_other_sign = shares[zero + reach + 1 :]
    has_rival = shares_of_other_sign.max(initial=-1.0) > shares[best] - SHARE_TIE
    return _DelayEstimate(
        seconds=(best - zero) * rates.period / RESOLVED,
        share=float(shares[best]),
        share_near_zero=float(shares[peak_near_zero]),
        ambiguous=bool(has_inner_peak and is_incomplete and has_rival),
    )


@dataclass(frozen=True, eq=False)
class _ResampledRates:
    """Rates of the IMU and of the joints at n equidistant times, zero without samples."""

    measured: np.ndarray
    """Measured rates minus their mean, rad/s, shape (n, 3)."""
    reference: np.ndarray
    """Rates of the joints minus their mean, rad/s, shape (n, 3)."""
    has_samples: np.ndarray
    """1 where there are samples, else 0, shape (n, 1)."""
    period: float
    """Distance of the times, s."""


def _resample_rates(windows: Sequence[Window], table: Table) -> _ResampledRates:
    """Return the rates of windows, interpolated linearly at multiples of the median period."""
    period = float(np.median([window.period for window in windows]))
    start = windows[0].time[0]
    end = windows[-1].time[-1]
    n_times = int((end - start) / period) + 2
    measured = np.zeros((n_times, 3))
    reference = np.zeros((n_times, 3))
    has_samples = np.zeros((n_times, 1))
    bias = np.median(np.concatenate([window.rate_s for window in windows]), axis=0)
    for window in windows:
        first = int(np.ceil((window.time[0] - start) / period))
        grid = start + period * np.arange(first, int((window.time[-1] - start) / period) + 1)
        part = slice(first, first + len(grid))
        has_samples[part] = 1.0
        measured_rate = window.rate_s - bias
        reference_rate = reference_motion(table, window.motion).rate_s
        for axis in range(3):
            measured[part, axis] = np.interp(grid, window.time, measured_rate[:, axis])
            reference[part, axis] = np.interp(grid, window.time, reference_rate[:, axis])
    n_samples = has_samples.sum()
    return _ResampledRates(
        measured=has_samples * (measured - measured.sum(axis=0) / n_samples),
        reference=has_samples * (reference - reference.sum(axis=0) / n_samples),
        has_samples=has_samples,
        period=period,
    )


def _shares_explained(rates: _ResampledRates, max_lag: int) -> np.ndarray:
    """
    Return the share of the measured rates that the joints explain with each delay.

    With w(t) = 1 where there are samples, else 0::

        c(s)   = sum measured(t) . reference(t - s)
        e_m(s) = sum |measured(t)|^2 w(t - s)
        e_r(s) = sum w(t) |reference(t - s)|^2
        share  = c |c| / (e_m e_r)

    Delays up to +-`max_lag` samples in steps of 1 / RESOLVED.
    """
    measured_power = (rates.measured**2).sum(axis=1, keepdims=True)
    reference_power = (rates.reference**2).sum(axis=1, keepdims=True)
    cross = _correlations(rates.measured, rates.reference, max_lag)
    measured_energy = _correlations(measured_power, rates.has_samples, max_lag)
    reference_energy = _correlations(rates.has_samples, reference_power, max_lag)
    # Not from a small common part: at least half of both motions must remain in the pairs.
    is_common = measured_energy > 0.5 * measured_power.sum()
    is_common &= reference_energy > 0.5 * reference_power.sum()
    energy = np.maximum(measured_energy * reference_energy, 1e-300)
    return np.where(is_common, cross * np.abs(cross) / energy, 0.0)


def _correlations(first: np.ndarray, second: np.ndarray, max_lag: int) -> np.ndarray:
    """
    Return the sums of first(t) second(t - s) for s up to +-`max_lag` samples, columns added.

    s is in steps of 1 / RESOLVED of a sample, interpolated by a cubic spline.
    """
    from scipy.interpolate import CubicSpline  # here, because its import is slow

    # By the FFT, with zeros behind the values, so that the shifted ends do not meet. A negative lag
    # is a negative index of `sums`.
    size = 1 << int(np.ceil(np.log2(2 * len(first))))
    spectrum = np.fft.rfft(first, size, axis=0) * np.conj(np.fft.rfft(second, size, axis=0))
    sums = np.fft.irfft(spectrum.sum(axis=1), size)
    lags = np.arange(-max_lag, max_lag + 1)
    fine_lags = np.arange(-max_lag * RESOLVED, max_lag * RESOLVED + 1) / RESOLVED
    return CubicSpline(lags, sums[lags])(fine_lags)
