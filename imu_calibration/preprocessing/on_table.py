"""
Agreement of the IMU with the joints.

Exchanged or reversed axes, delay, and rotation against the table.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np

from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import REFUSE, CheckFinding
from imu_calibration.preprocessing.window import Window

MIN_MATCH = 0.8
"""Agreement from which on an exchange of axes describes the matrix."""
POOR = 0.6
"""Agreement of the axes as they are below which they are wrong; a turn by 60 degrees has 0.67."""
AGREEMENT_TIE = 0.05


def signed_permutations() -> np.ndarray:
    """
    Return the 48 matrices that exchange axes and signs, shape (48, 3, 3).

    The identity is first. The rest is ordered by number of changes.
    """
    every_sign = product((1.0, -1.0), repeat=3)
    found = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order, signs in product(permutations(range(3)), every_sign)
    ]
    return np.array(sorted(found, key=lambda matrix: (matrix != np.eye(3)).any(axis=1).sum()))


@dataclass(frozen=True, eq=False)
class AxisMatch:
    """Assignment of measured axes to the axes of a reference."""

    matrix: np.ndarray
    """Closest signed permutation in ``measured = scale * matrix @ reference``, shape (3, 3)."""
    agreement: float
    """1: exactly as `matrix`."""
    as_they_are: float
    """1: every axis is that of the reference; -1: all turned round."""
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
        return [(i, j, sign) for i, j, sign in _wrong_axes(self.matrix) if seen[j, j] > 0.5]

    def words(self, seen: np.ndarray) -> str:
        """Return these exchanges in words; '' where no exchange of axes explains the matrix."""
        return ', '.join(_axis_phrases(self.matrix, seen)) if self.agreement > MIN_MATCH else ''


def _wrong_axes(matrix):
    """
    Return (row, column, sign) of the entries of a signed permutation that differ from the identity.
    """
    found = []
    for i, j in np.argwhere(matrix):
        if i != j or matrix[i, j] < 0:
            found.append((int(i), int(j), float(matrix[i, j])))
    return found


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
    inside = matrix @ seen
    scale = np.sqrt((inside**2).sum() / np.trace(seen))
    candidates = signed_permutations()
    scores = np.einsum('kij,ij->k', candidates, inside) / (scale * np.trace(seen))
    best = scores.max()
    near = scores >= best - AGREEMENT_TIE
    proper = np.linalg.det(candidates) > 0
    return AxisMatch(
        candidates[np.argmax(near)],
        float(best),
        float(scores[0]),
        bool((near & proper).any()),
        bool((near & ~proper).any()),
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
    time = np.concatenate([window.time for window in windows])
    every = slice(None, None, max(1, len(time) // MAX_TESTED_SAMPLES))
    time = time[every]
    motion = JointMotion.concatenate(window.motion for window in windows).select(every)
    measured = np.concatenate([np.hstack([window.rate_s, window.force_s]) for window in windows])[
        every
    ]
    rate = measured[:, :3] = measured[:, :3] - np.median(measured[:, :3], axis=0)
    squares = np.stack(
        [
            ((rate - reference_motion(table, motion).rate_s) ** 2).sum(axis=1),
            (rate**2).sum(axis=1),
            np.ones(len(time)),
        ]
    )
    piece = ((time - time.min()) / TESTED_PIECE_SECONDS).astype(int)
    residual, power, count = np.array([np.bincount(piece, weights=each) for each in squares])
    tested = power > TESTED_RATE**2 * count
    part = (tested & (residual > (1.0 - SAME) * power))[piece]
    if part.sum() < MIN_TESTED_SAMPLES:
        return None
    for chosen, span in (
        (tested[piece], None),
        (part, (float(time[part].min()), float(time[part].max()))),
    ):
        (order, signs), axes, instead, share = _best(measured[chosen], motion.select(chosen), table)
        joints = _joint_phrases(table.joint_names, order, signs)
        if share >= LEAST_SHARE_EXPLAINED and (joints or _axis_phrases(axes)):
            return Exchange(
                joints, _axis_phrases(axes), _axis_phrases(instead) if joints else (), share, span
            )
    return None


def _best(measured, motion, table):
    """
    Return the axes and the shares of the best candidate.

    The result is ((order, signs), matrix of the axes, that of the best candidate without joints,
    share explained) of the best candidate.
    """
    candidates = _candidates(motion.position.shape[1])
    axes = signed_permutations()
    shares = np.empty((2, len(candidates), len(axes)))
    for k, (order, signs) in enumerate(candidates):
        parts = (
            getattr(motion, name)[:, order] * signs
            for name in ('position', 'rate', 'acceleration', 'jerk')
        )
        reference = reference_motion(table, JointMotion(motion.time, *parts))
        for row, known, expected in zip(
            shares, (measured[:, :3], measured[:, 3:]), (reference.rate_s, reference.force_s)
        ):
            cross = np.einsum('pij,ij->p', axes, known.T @ expected)
            row[k] = (2.0 * cross - (expected**2).sum()) / max((known**2).sum(), 1e-300)
    near = shares[0] >= shares[0].max() - AGREEMENT_TIE
    near &= shares[1] >= shares[1][near].max() - AGREEMENT_TIE
    joint_changes = [
        np.count_nonzero((np.array(order) != range(len(order))) | (np.array(signs) < 0))
        for order, signs in candidates
    ]
    axis_changes = (axes != np.eye(3)).any(axis=2).sum(axis=1)
    changes = np.add.outer(joint_changes, axis_changes) + np.logical_and.outer(
        joint_changes, axis_changes
    )
    k, p = np.unravel_index(np.argmin(np.where(near, changes, np.inf)), changes.shape)
    return candidates[k], axes[p], axes[np.argmax(near[0])], float(shares[0, k, p])


def _candidates(n_joints):
    """
    Return (index of the joint with the readings of each joint, signs) of candidates.

    The description itself is the first of the candidates.
    """
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


def _joint_phrases(names, order, signs):
    phrases = []
    for k, (j, sign) in enumerate(zip(order, signs)):
        if k != j and sign > 0:
            phrases.append(f'{names[k]} turns as {names[j]} should')
        elif k != j:
            phrases.append(f'{names[k]} turns as {names[j]} should, reversed')
        elif sign < 0:
            phrases.append(f'{names[k]} turns the other way round')
    return tuple(phrases)


def _axis_phrases(axes, seen=np.eye(3)):
    return tuple(
        f"measured {'xyz'[i]} is {'minus ' if sign < 0 else ''}the reference's {'xyz'[j]}"
        for i, j, sign in _wrong_axes(axes)
        if seen[j, j] > 0.5
    )


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


def same_motion(moments: tuple, windows: list[Window], table: Table) -> CheckFinding | None:
    """
    Return the cause if the gyroscope does not measure the motion of the joints, otherwise None.

    Causes: an IMU that rests while the table turns, a delay between the streams, and a different
    motion.

    Parameters
    ----------
    moments : tuple of three arrays (3, 3)
        Sums of products of rates: measured with reference, reference with itself, measured with
        itself.
    windows : list of Window
        Stored moving windows with their samples; without them, no delay is found.
    table : Table

    """
    cross, reference, measured = moments
    matrix = cross @ np.linalg.pinv(reference, rcond=0.01)
    gain = np.sqrt(np.trace(matrix @ reference @ matrix.T) / np.trace(reference))
    explained = np.trace(matrix @ reference @ matrix.T) / max(np.trace(measured), 1e-300)
    # Other checks report units, signs and axes.
    if explained >= SAME and gain > 0.1 * MIN_RATE_GAIN:
        return a_period_late(windows, table) if explained < 1.0 - SHARE_TIE else None
    key = 'imu_topic'
    cause = 'this IMU does not turn when the table does; give the topic of the IMU on the table'
    if np.trace(measured) > MIN_RATE_GAIN * np.trace(reference):
        cause = _cause(windows, table)
        key = None
    elif gain > MIN_RATE_GAIN:
        return None
    if not cause:
        key = 'imu_topic'
        cause = (
            'its motion is not that of the table; give the topic of the IMU on the table, and'
            ' check the names of the joints and both clocks'
        )
    return CheckFinding(
        'on_table',
        REFUSE,
        'the gyroscope must measure the motion of the joints, they explain '
        f'{100 * min(explained, 1.0):.0f} % of its rates at a gain of {gain:.2g}: {cause}',
        key=key,
    )


def exchanged(exchange: Exchange, windows: list[Window], table: Table) -> CheckFinding | None:
    """
    Return the finding of joints or IMU axes that are exchanged or reversed.

    Or None if a delay explains the rates better.
    """
    shift = _best_shift(windows, table)
    late = abs(shift.seconds) > LEAST_SHIFT and shift.share > exchange.share - SHARE_TIE
    if late and shift.share > exchange.share + SHARE_TIE:
        return None
    phrases = ', '.join(exchange.joints + exchange.axes) + (
        f' (or {", ".join(exchange.instead)})' if exchange.instead else ''
    )
    span = '' if exchange.span is None else ' from {:.0f} s to {:.0f} s'.format(*exchange.span)
    remedy = (
        'correct names and axes in the table description, or the joint states'
        if exchange.joints
        else 'correct the axes in the driver of the IMU'
    ) + ('' if exchange.span is None else ', or exclude that time')
    return CheckFinding(
        'on_table',
        REFUSE,
        f'the rates of the gyroscope must agree with the joints{span}, '
        f'{100 * exchange.share:.0f} % of them are explained if {phrases}; {remedy}'
        + (f'; or {_late(shift.seconds)}' if late else ''),
    )


def _cause(windows, table):
    """Return the delay with which the streams agree, or ''."""
    shift = _best_shift(windows, table)
    late = abs(shift.seconds) > LEAST_SHIFT and shift.share > max(SAME, shift.unshifted + SHARE_TIE)
    return _late(shift.seconds) if late else ''


def a_period_late(windows: Sequence[Window], table: Table) -> CheckFinding | None:
    """
    Return the finding for streams that agree clearly better with a delay, or None.

    Beyond the range of a lag: clocks that differ, or streams of a repeating motion that are a
    period apart.
    """
    shift, share, unshifted, ambiguous = _best_shift(windows, table)
    # opposite rates: a wrong sign, or half a period
    if (
        ambiguous
        or abs(shift) <= LEAST_SHIFT
        or unshifted < -SAME
        or share < max(LEAST_SHARE_EXPLAINED, unshifted + SHARE_TIE)
    ):
        return None
    return CheckFinding(
        'on_table',
        REFUSE,
        'both streams must share one clock, the joints explain'
        f' {100 * max(unshifted, 0.0):.0f} % of the rates with a delay up to {LEAST_SHIFT} s and'
        f' {100 * share:.0f} % with a larger one: {_late(shift)}',
    )


def _late(shift):
    side = 'behind' if shift > 0 else 'ahead of'
    return (
        f'the stamps of the IMU are about {abs(shift):.1f} s {side} those of the joints; '
        'set both clocks by one source, or stamp in the drivers'
    )


class _Shift(NamedTuple):
    """A delay of the IMU's stamps and the shares of the rates that the joints then explain."""

    seconds: float
    """Positive: the IMU's stamps are late."""
    share: float
    """Share explained with this delay."""
    unshifted: float
    """Largest one within +-LEAST_SHIFT, the range of a lag; negative if the rates are opposite."""
    ambiguous: bool
    """
    Whether it is one period of a repeating motion from a peak within the range of a lag, and a
    delay of the other sign is as good.
    """


@dataclass(frozen=True)
class Delay:
    """A delay between the streams that explains opposite rates."""

    words: str
    """Cause and remedy."""
    sure: bool
    """Whether it explains more of the rates than a wrong sign, by more than SHARE_TIE."""


def signs_or_delay(windows: list[Window], table: Table) -> Delay | None:
    """
    Return the delay that explains rates of the opposite sign.

    Or None if a sign explains them better.

    For sweeps to and fro, half a period of delay and a wrong sign differ only by the differences
    between the sweeps.

    Parameters
    ----------
    windows : list of Window
        Moving windows with their samples.
    table : Table

    """
    shift, share, unshifted, _ = _best_shift(windows, table)
    if abs(shift) <= LEAST_SHIFT or share < SAME or share < -unshifted - SHARE_TIE:
        return None
    return Delay(_late(shift), share > -unshifted + SHARE_TIE)


def _best_shift(windows: Sequence[Window], table: Table) -> _Shift:
    """
    Return the `_Shift` that explains the rates best; of equally good ones, the smallest.

    Without samples, no shift.

    ``share(s) = c |c| / (e_m e_r)`` with c the sum of measured(t) reference(t - s) and e their sums
    of squares, all of the same pairs.
    """
    windows = [window for window in windows if len(window) >= MIN_TESTED_SAMPLES]
    if not windows:
        return _Shift(0.0, 0.0, 0.0, False)
    period = float(np.median([window.period for window in windows]))
    start = windows[0].time[0]
    end = windows[-1].time[-1]
    measured, reference = np.zeros((2, int((end - start) / period) + 2, 3))
    inside = np.zeros((len(measured), 1))
    bias = np.median(np.concatenate([window.rate_s for window in windows]), axis=0)
    for window in windows:
        first = int(np.ceil((window.time[0] - start) / period))
        grid = start + period * np.arange(first, int((window.time[-1] - start) / period) + 1)
        part = slice(first, first + len(grid))
        inside[part] = 1.0
        for line, rate in (
            (measured, window.rate_s - bias),
            (reference, reference_motion(table, window.motion).rate_s),
        ):
            line[part] = np.stack(
                [np.interp(grid, window.time, column) for column in rate.T], axis=1
            )
    measured, reference = (
        inside * (line - line.sum(axis=0) / inside.sum()) for line in (measured, reference)
    )
    most = min(int(LARGEST_SHIFT / period), len(measured) // 2)
    power = [(line**2).sum(axis=1, keepdims=True) for line in (measured, reference)]
    products = _correlations(measured, reference, most)
    energies = [
        _correlations(power[0], inside, most),
        _correlations(inside, power[1], most),
    ]
    paired = np.logical_and(*(energy > 0.5 * whole.sum() for energy, whole in zip(energies, power)))
    shares = np.where(
        paired, products * np.abs(products) / np.maximum(np.prod(energies, axis=0), 1e-300), 0.0
    )
    middle = RESOLVED * most
    lag = int(RESOLVED * LEAST_SHIFT / period)
    near = np.abs(shares[middle - lag : middle + lag + 1])
    place = int(np.argmax(near)) + middle - lag
    # The nearest peak to zero delay among those within SHARE_TIE of the highest: periodic motion
    # has many.
    inner = shares[1:-1]
    peaks = 1 + np.flatnonzero(
        (inner >= shares[:-2]) & (inner >= shares[2:]) & (inner >= shares.max() - SHARE_TIE)
    )
    best = int(peaks[np.argmin(np.abs(peaks - middle))]) if len(peaks) else int(np.argmax(shares))
    other = shares[middle + lag + 1 :] if best < middle else shares[: max(middle - lag, 0)]
    twin = (
        0 < place - middle + lag < 2 * lag
        and shares[best] < 1.0 - SHARE_TIE
        and other.max(initial=-1.0) > shares[best] - SHARE_TIE
    )
    return _Shift(
        (best - middle) * period / RESOLVED, float(shares[best]), float(shares[place]), bool(twin)
    )


def _correlations(first, second, most):
    """
    Return the sums of first(t) second(t - s) for s up to +-most samples.

    s is in steps of 1 / RESOLVED of a sample.
    """
    size = 1 << int(np.ceil(np.log2(2 * len(first))))
    sums = np.fft.irfft(
        (np.fft.rfft(first, size, axis=0) * np.conj(np.fft.rfft(second, size, axis=0))).sum(axis=1),
        size,
    )
    shifts = np.arange(-most, most + 1)
    from scipy.interpolate import CubicSpline  # here, because its import is slow

    return CubicSpline(shifts, sums[shifts])(
        np.arange(-most * RESOLVED, most * RESOLVED + 1) / RESOLVED
    )
