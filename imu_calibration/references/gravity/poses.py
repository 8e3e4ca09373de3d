"""
Poses and turns from samples.

Means over the intervals held still, with standard errors, and the readings between them.
"""

from collections.abc import Callable, Sequence

import numpy as np

from imu_calibration.core.samples import ImuSamples, rounding_variance, runs_of, smallest_step
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.sensor_noise import SensorNoise
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.kinematics.strapdown import total_rotation
from imu_calibration.preprocessing.dead_band import dead_bands
from imu_calibration.preprocessing.full_scale import LEAST_TURNS, MOST_TURNS, believed_factor
from imu_calibration.preprocessing.stamping import (
    LAG,
    MAX_REGULAR_STEP,
    MOST_LOST,
    WHOLE_STEP_SHARE,
)
from imu_calibration.references.gravity.equations import HiddenRates, Poses, State, TurnData
from imu_calibration.references.gravity.hand_parameters import KnownTurn
from imu_calibration.references.gravity.sway import sway_at_rest

CREEPS = 3.0
"""
Mean square of the slopes of forces across gravity, relative to its expectation from noise, above
which poses creep.
"""

ATTITUDES_APART = 0.2
"""Attitudes closer than this count as one pose, rad."""
DITHER = 3.0
"""
Variance of readings over that of rounding below which rounding is not averaged: half a step; 1 % of
a step remains above.
"""


def average_poses(
    imu: ImuSamples, ranges: Sequence[tuple[int, int]], temperature_c: np.ndarray | None = None
) -> Poses:
    """
    Return the means over the intervals, with their sd from the noise within the intervals.

    `temperature_c` is that of the samples, shape (n,), when it was recorded.

    The noise need not be white: the scatter of means of pieces of half a second or more determines
    the factor over white noise.
    """
    parts = {
        'accelerometer': [imu.force_s[a:b] for a, b in ranges],
        'gyroscope': [imu.rate_s[a:b] for a, b in ranges],
    }
    rounding = {
        'accelerometer': rounding_variance(imu.force_s),
        'gyroscope': rounding_variance(imu.rate_s),
    }
    noise = {sensor: _pooled_noise(part, rounding[sensor]) for sensor, part in parts.items()}
    count = np.array([b - a for a, b in ranges])
    means, sems = [], []
    for sensor in SENSORS:
        means.append(np.array([part.mean(0) for part in parts[sensor]]))
        variance = noise[sensor].low_variance / count[:, None]
        sems.append(np.sqrt(_with_rounding(variance, parts[sensor], rounding[sensor])))
    start, stop = np.array(ranges).T
    time = 1e-9 * (0.5 * (imu.stamp_ns[start] + imu.stamp_ns[stop - 1]) - imu.stamp_ns[0])
    length = 1e-9 * (imu.stamp_ns[stop - 1] - imu.stamp_ns[start])
    creep = _creep(parts['accelerometer'], length, noise['accelerometer'])
    warm = (
        None if temperature_c is None else np.array([temperature_c[a:b].mean() for a, b in ranges])
    )
    return Poses(
        means[0],
        means[1] - creep,
        sems[0],
        sems[1],
        start=start,
        stop=stop,
        time=time,
        temperature_c=warm,
        noise=noise,
        half_turn=0.5 * length[:, None] * creep,
        sway=sway_at_rest(parts['accelerometer'], parts['gyroscope'], length),
        period=float(np.median(np.diff(imu.stamp_ns))) * 1e-9,
        hidden=_hidden_rates(imu.rate_s, parts['gyroscope'], means[1]),
    )


def _with_rounding(
    variance: np.ndarray, parts: Sequence[np.ndarray], rounding: np.ndarray
) -> np.ndarray:
    """
    Return the variance of the means, at least that of rounding where it matters.

    Rounding matters where readings scatter by less than half a step and do not average it.
    """
    within = np.array([part.var(axis=0) for part in parts])
    return np.where(within < DITHER * rounding, np.maximum(variance, rounding), variance)


def _hidden_rates(
    rate_s: np.ndarray, parts: Sequence[np.ndarray], means: np.ndarray
) -> HiddenRates:
    """
    Return the `HiddenRates` of poses with the readings `parts` and their means (k, 3).

    A mean of readings with the variance v and the step h has a rounding error of the variance
    ``h^2 / 12 exp(-4 pi^2 v / h^2)``: noise of half a step averages it. The bias, and with it the
    error, is the same in all poses.
    """
    step = smallest_step(rate_s)
    step = np.where(np.isfinite(step), step, 0.0)
    bands = np.where(np.any(means != 0.0, axis=0), 0.0, dead_bands(rate_s, step))
    scatter = np.mean([part.var(axis=0) for part in parts], axis=0)
    # Between two steps the readings scatter by up to half a step without any noise: the noise is
    # that of the calmest axis.
    in_steps = np.min(scatter[step > 0.0] / step[step > 0.0] ** 2, initial=np.inf)
    rounding_sd = step / np.sqrt(12.0) * np.exp(-2.0 * np.pi**2 * in_steps)
    return HiddenRates(tuple(bands.tolist()), tuple(rounding_sd.tolist()), tuple(step.tolist()))


def _creep(forces: Sequence[np.ndarray], length: np.ndarray, noise: SensorNoise) -> np.ndarray:
    """
    Return the rates at which the attitude creeps in each pose, as observable from gravity, rad/s.

    Shape (k, 3).

    ``d force / dt = -rate x force``: the part across gravity. Zero where the slopes of all poses
    together are no more than noise.
    """
    rates = np.zeros((len(forces), 3))
    excess = 0.0
    for pose, (force, seconds) in enumerate(zip(forces, length)):
        since = np.linspace(-0.5, 0.5, len(force)) * seconds
        slope = since @ force / (since @ since)
        up = force.mean(axis=0)
        rates[pose] = np.cross(slope, up) / (up @ up)
        across = np.cross(up, rates[pose])
        excess += across @ across * (since @ since) / np.mean(noise.low_variance)
    return rates if excess > CREEPS * 2 * len(forces) else np.zeros_like(rates)


def noise_statistics(poses: Poses) -> dict:
    """Return noise and tilt within the intervals as plain numbers."""
    found = {}
    for sensor, name in zip(SENSORS, ('force', 'rate')):
        noise = poses.noise[sensor]
        found |= {
            f'{name}_noise_sd': noise.white_sd.tolist(),
            f'{name}_noise_colour': np.sqrt(noise.inflation).tolist(),
        }
    return found | {'period': poses.period, 'sway': poses.sway}


def _pooled_noise(
    parts: Sequence[np.ndarray], rounding: np.ndarray, pieces: int = 8
) -> SensorNoise:
    """
    Return the SensorNoise of samples.

    From the median of the intervals and how much means of pieces scatter more than white noise.
    """
    floor = 1e-9 * max(1e-3, max(np.max(np.abs(p)) for p in parts))
    within = (
        np.sqrt(np.maximum(np.median([p.var(0, ddof=1) for p in parts], axis=0), rounding)) + floor
    )
    ratios = []
    for part in parts:
        length = len(part) // pieces
        if length >= 4:
            means = part[: length * pieces].reshape(pieces, length, 3).mean(1)
            # differences of neighbours: a slow drift belongs to the scatter between poses, not here
            ratios.append(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0) * length / within**2)
    if not ratios:
        return SensorNoise(within**2, np.ones(3))
    ratio = np.mean(ratios, axis=0)
    margin = 2 * np.sqrt(3 / (len(ratios) * (pieces - 1)))
    return SensorNoise(within**2, np.where(ratio > 1 + margin, ratio, 1.0))


def distinct_attitudes(force: np.ndarray) -> int:
    """
    Return how many of the mean readings (k, 3) point in separate directions.

    The directions are more than `ATTITUDES_APART` from each other.
    """
    kept = []
    for direction in unit_rows(force):
        if all(np.arccos(np.clip(direction @ other, -1, 1)) > ATTITUDES_APART for other in kept):
            kept.append(direction)
    return len(kept)


MAX_RANGE_READINGS = 4000
"""Largest readings among which the end of the range is searched."""
TOP = 20
"""Readings below the largest whose density is estimated."""
CROWDED = 20.0
"""
The extreme is the end of the range when it has this many times the readings expected by chance.
"""
CERTAIN = 1e-3
"""
If fewer readings than this are expected, two equal ones are the end of the range, also neighbours.
"""
LINE = 20.0
"""
Duration over which a clock is straight, s: long against the jitter of its stamps, short against the
drift of its rate.
"""
UNDECIDED = 1.02
"""
Factor by which interpolation errors at even times may exceed those at the stamps, due to noise.
"""
TURN_LONGEST = 30.0
"""Longer stretches between two poses are not used, s: drift and clipping enter."""
MAX_TURN_GAP = 0.1
"""A turn with a longer hole in it is not used, s; never below five periods."""
KNOWN_TURN_SD = 0.017
"""Accuracy of the angle and of the axis of full turns made by hand, rad."""
SAMPLES_AT_ONCE = 16384
"""Samples that are processed together: copies of a long recording are large."""
SUMMIT = 3
"""Neighbours in one coarse step at the top of a smooth turn."""


def collect_turns(
    time: np.ndarray, imu: ImuSamples, *, poses: Poses, temperature_c: np.ndarray | None = None
) -> tuple[list[TurnData], dict[str, int]]:
    """
    Return (turns between consecutive poses, {reason: count of excluded ones}).

    `temperature_c` is that of the samples or None.
    """
    turns = []
    dropped = {}
    rate = imu.rate_s
    limit = max(MAX_TURN_GAP, 5 * poses.period)
    ended = at_range_end(rate)
    density = np.mean(poses.noise['gyroscope'].low_variance) * poses.period
    for first in range(len(poses) - 1):
        piece = slice(poses.stop[first] - 1, poses.start[first + 1] + 1)
        reason = _unusable(time[piece], ended[piece], limit)
        if reason:
            dropped[reason] = dropped.get(reason, 0) + 1
            continue
        noise_variance = density * (time[piece][-1] - time[piece][0])
        noise_variance += _slow_rounding_variance(time[piece], rate[piece], poses.hidden)
        turns.append(
            TurnData(
                time[piece],
                rate[piece],
                imu.force_s[piece],
                first,
                first + 1,
                noise_variance,
                temperature_c=None if temperature_c is None else temperature_c[piece],
            )
        )
    return turns, dropped


def _slow_rounding_variance(
    time: np.ndarray, rate: np.ndarray, hidden: HiddenRates | None
) -> float:
    """
    Return the variance of the angle of a turn from rounding at its slow ends, rad^2, axis mean.

    Within a step of zero the rounding error keeps its sign: ``(rounding_sd * slow time)^2``.
    """
    if hidden is None:
        return 0.0
    slow = np.abs(rate[:-1]) <= hidden.step
    slow_seconds = np.diff(time) @ slow
    return float(np.mean(np.square(hidden.rounding_sd * slow_seconds)))


def _unusable(time: np.ndarray, ended: np.ndarray, gap: float) -> str:
    if time[-1] - time[0] > TURN_LONGEST:
        return 'too long'
    if np.max(np.diff(time)) > gap:
        return 'gap'
    return 'clipped' if ended.any() else ''


def at_range_end(rate: np.ndarray) -> np.ndarray:
    """
    Return which samples are at the end of the gyroscope's range, shape (n,).

    At the end of the range, different motions end at the same reading, on either side and on all
    axes; without it two readings are hardly ever both the largest, if the converter's step is finer
    than the distance between the largest readings.

    Parameters
    ----------
    rate : array, shape (n, 3)
        Readings in any unit.

    """
    fresh = np.ones(len(rate), bool)  # a reading published twice is one reading
    fresh[1:] = np.logical_or.reduce([axis[1:] != axis[:-1] for axis in rate.T])
    ended = np.zeros(len(rate), bool)
    ended |= _at_end(np.abs, rate.T, fresh)
    for axis in rate.T:
        for signed in (np.positive, np.negative):
            ended |= _at_end(signed, axis[None], fresh)
    return ended


def _at_end(signed: Callable, axes: np.ndarray, fresh: np.ndarray) -> np.ndarray:
    """
    Return the samples at the largest value of ``signed(axes)``.

    Shape (m, n), when that is the end of a range.
    """
    some = np.sort(np.concatenate([_largest(signed, axis, fresh) for axis in axes]))[
        -MAX_RANGE_READINGS:
    ]
    step = np.diff(some)
    step = step[step > 1e-9 * np.abs(some[-1])].min(initial=np.inf)
    # Two's complement: one end is larger by a step.
    margin = 1.5 * step if np.isfinite(step) and len(axes) > 1 else 0.5 * step
    margin = min(margin, 1e-4 * np.abs(some[-1]))
    at = np.logical_or.reduce([signed(axis) >= some[-1] - margin for axis in axes])
    below = some[some < some[-1] - margin][-TOP:]
    if len(below) < TOP:
        return np.zeros(len(fresh), bool)
    chance = TOP * (margin + 0.5 * step) / (some[-1] - below[0]) if np.isfinite(step) else 0.0
    runs = np.diff(runs_of(at[fresh]))
    # the top of one smooth turn may fill a coarse step for some samples
    number = runs.sum() if chance < CERTAIN else np.maximum(runs - SUMMIT, 0).sum() + len(runs)
    return at if number >= max(2, CROWDED * chance) else np.zeros(len(fresh), bool)


def _largest(signed: Callable, axis: np.ndarray, fresh: np.ndarray) -> np.ndarray:
    """Return the largest values of ``signed(axis[fresh])``, block by block."""
    largest = np.zeros(0)
    least = -np.inf
    for start in range(0, len(axis), SAMPLES_AT_ONCE):
        stop = start + SAMPLES_AT_ONCE
        values = signed(axis[start:stop])
        largest = np.append(largest, values[(values > least) & fresh[start:stop]])
        if len(largest) > MAX_RANGE_READINGS:
            largest = np.partition(largest, -MAX_RANGE_READINGS)[-MAX_RANGE_READINGS:]
            least = largest[0]
    return largest


def known_turn_data(
    time: np.ndarray,
    imu: ImuSamples,
    turn: KnownTurn,
    *,
    poses: Poses,
    temperature_c: np.ndarray | None = None,
) -> TurnData:
    """
    Return the data of a `KnownTurn`; `KNOWN_TURN_SD` applies along and, for the axis, across it.
    """
    axis = np.asarray(turn.axis, float) / np.linalg.norm(turn.axis)
    along = np.outer(axis, axis)
    cov = KNOWN_TURN_SD**2 * along + (turn.angle * KNOWN_TURN_SD) ** 2 * (np.eye(3) - along)
    piece = slice(turn.start, turn.stop)
    density = np.mean(poses.noise['gyroscope'].white_variance) * poses.period
    noise_variance = density * (time[piece][-1] - time[piece][0])
    return TurnData(
        time[piece],
        imu.rate_s[piece],
        imu.force_s[piece],
        noise_variance=noise_variance,
        rotation=turn.angle * axis,
        rotation_cov=cov,
        temperature_c=None if temperature_c is None else temperature_c[piece],
    )


def sample_times(imu: ImuSamples) -> np.ndarray:
    """
    Return the times of samples since the first one, s, shape (n,).

    Of the clock fitted to the stamps, or the stamps.

    An even clock is a straight line through the stamps over the count of the samples, in pieces of
    `LINE` seconds. It is used unless the readings interpolate better from their neighbours at the
    stamps, as with a driver that polls the sensor at uneven times.
    """
    stamps = rising(1e-9 * (imu.stamp_ns - imu.stamp_ns[0]))
    even = stamps.copy()
    step = np.diff(stamps)
    period = float(np.median(step))
    edges = np.flatnonzero(step / period > MOST_LOST + MAX_REGULAR_STEP) + 1
    del step  # a long recording is large
    for start, stop in zip([0, *edges], [*edges, len(stamps)]):
        if stop - start >= 2 * LAG:
            even[start:stop] = _clock_times(stamps[start:stop], period)
    return (
        even
        if np.all(np.diff(even) > 0)
        and _roughness(even, imu.rate_s) <= UNDECIDED * _roughness(stamps, imu.rate_s)
        else stamps
    )


def _clock_times(stamps: np.ndarray, period: float) -> np.ndarray:
    """
    Return the times of the clock of one stretch, or its stamps where samples were lost unnoticed.
    """
    step = np.diff(stamps) / period
    numbers = [np.arange(float(len(stamps)))]
    lost = (step > MAX_REGULAR_STEP) & (np.abs(step - np.rint(step)) <= WHOLE_STEP_SHARE)
    if lost.any():  # long steps of a rebuilt clock need not be lost samples
        numbers.insert(0, np.concatenate([[0.0], np.cumsum(np.where(lost, np.rint(step), 1.0))]))
    lines = (
        _clock_line(number, stamps, max(1, int(period * len(stamps) / LINE))) for number in numbers
    )
    line = min(lines, key=lambda line: np.sum((stamps - line) ** 2))
    part = np.arange(len(stamps) // LAG)
    size, longer = divmod(len(stamps), len(part))
    late = np.add.reduceat(stamps - line, part * size + np.minimum(part, longer)) / (
        size + (part < longer)
    )
    return line if np.abs(late).max() < 0.6 * period else stamps


def _clock_line(number: np.ndarray, time: np.ndarray, pieces: int) -> np.ndarray:
    line = np.polynomial.Polynomial.fit(number, time, 1)(number)
    middles = [part.mean() for part in np.array_split(number, pieces)]
    late = [part.mean() for part in np.array_split(time - line, pieces)]
    return line + np.interp(number, middles, late)


def _roughness(time: np.ndarray, rate: np.ndarray) -> float:
    """
    Return the sum of squared errors of linear interpolation.

    The interpolation is between the two neighbours of each reading.
    """
    total = 0.0
    for start in range(0, len(time) - 2, SAMPLES_AT_ONCE):
        stop = start + SAMPLES_AT_ONCE + 2
        some = time[start:stop]
        own = rate[start:stop].T
        share = (some[1:-1] - some[:-2]) / (some[2:] - some[:-2])
        total += float(np.sum((own[:, 1:-1] - (1 - share) * own[:, :-2] - share * own[:, 2:]) ** 2))
    return total


def rising(time: np.ndarray) -> np.ndarray:
    """Spread repeated stamps over the following step: their order is known, their times are not."""
    if np.all(np.diff(time) > 0):
        return time
    kept = np.concatenate([[True], np.diff(time) > 0])
    return np.interp(np.arange(len(time)), np.flatnonzero(kept), time[kept]) + 1e-9 * np.arange(
        len(time)
    )


def full_scale_factor(state: State, poses: Poses, turns: Sequence[TurnData]) -> float:
    """
    Return the factor between measured and true rates (`preprocessing.full_scale`).

    It is 1 if the rotated gravity matches its observed direction.

    Only turns with gravity as reference count; the bias of each is the mean of the rates at rest
    before and after it.

    Parameters
    ----------
    state : State
        Directions of gravity from the norms.
    poses : Poses
    turns : sequence of TurnData

    """
    some = [turn for turn in turns if turn.rotation is None][:MOST_TURNS]
    if len(some) < LEAST_TURNS:
        return 1.0

    def missed(factor: float) -> float:
        return float(
            np.median(
                [missed_angle(state, poses, turn, matrix=factor * np.eye(3)) for turn in some]
            )
        )

    return believed_factor(missed)


def missed_angle(state: State, poses: Poses, turn: TurnData, *, matrix: np.ndarray) -> float:
    """
    Return the angle between rotated and observed gravity after a turn, rad.

    The gyroscope reads `matrix` times the rate.
    """
    bias = 0.5 * (poses.rate[turn.first] + poses.rate[turn.last])
    mat_ji = total_rotation(turn.time, (turn.rate - bias) @ np.linalg.inv(matrix).T)
    return float(np.arccos(np.clip(mat_ji @ state.up[turn.first] @ state.up[turn.last], -1.0, 1.0)))
