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

NOISE_PIECES = 8
"""Pieces of an interval at rest whose means show noise that is not white."""
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

    The mean rate is less the rate at which the attitude creeps (`_creep`).

    Parameters
    ----------
    imu : ImuSamples
    ranges : sequence of (start, stop)
        Intervals at rest.
    temperature_c : array, shape (n,), optional
        Temperature of the samples.

    """
    forces = [imu.force_s[start:stop] for start, stop in ranges]
    rates = [imu.rate_s[start:stop] for start, stop in ranges]
    force_rounding = rounding_variance(imu.force_s)
    rate_rounding = rounding_variance(imu.rate_s)
    force_noise = _pooled_noise(forces, force_rounding)
    rate_noise = _pooled_noise(rates, rate_rounding)
    mean_rate = np.array([rate.mean(0) for rate in rates])

    start, stop = np.array(ranges).T
    time = 1e-9 * (0.5 * (imu.stamp_ns[start] + imu.stamp_ns[stop - 1]) - imu.stamp_ns[0])
    duration = 1e-9 * (imu.stamp_ns[stop - 1] - imu.stamp_ns[start])
    creep = _creep(forces, duration, force_noise)
    mean_temperature_c = None
    if temperature_c is not None:
        mean_temperature_c = np.array([temperature_c[a:b].mean() for a, b in ranges])
    return Poses(
        force=np.array([force.mean(0) for force in forces]),
        rate=mean_rate - creep,
        force_sem=_sd_of_means(forces, force_noise, force_rounding),
        rate_sem=_sd_of_means(rates, rate_noise, rate_rounding),
        start=start,
        stop=stop,
        time=time,
        temperature_c=mean_temperature_c,
        noise={'accelerometer': force_noise, 'gyroscope': rate_noise},
        half_turn=0.5 * duration[:, None] * creep,
        sway=sway_at_rest(forces, rates, duration),
        period=float(np.median(np.diff(imu.stamp_ns))) * 1e-9,
        hidden=_hidden_rates(imu.rate_s, rates, mean_rate),
    )


def _sd_of_means(
    parts: Sequence[np.ndarray], noise: SensorNoise, rounding: np.ndarray
) -> np.ndarray:
    """
    Return the sd of the mean of each of k intervals, shape (k, 3).

    Where readings scatter by less than half a step, they do not average rounding: the variance of
    the mean is then at least that of rounding, shape (3,).
    """
    count = np.array([len(part) for part in parts])
    variance = noise.low_variance / count[:, None]
    scatter = np.array([part.var(axis=0) for part in parts])
    at_least_rounding = np.maximum(variance, rounding)
    return np.sqrt(np.where(scatter < DITHER * rounding, at_least_rounding, variance))


def _hidden_rates(
    rate_s: np.ndarray, parts: Sequence[np.ndarray], means: np.ndarray
) -> HiddenRates:
    """
    Return the `HiddenRates` of k poses from their readings `parts` and the means of these, (k, 3).

    A mean of readings with the variance v and the step h has a rounding error of the variance
    ``h^2 / 12 exp(-4 pi^2 v / h^2)``: noise of half a step averages it. The bias, and with it the
    error, is the same in all poses.
    """
    # Step of the readings of each axis; 0 where they have none. A dead band that hides the bias
    # gives zero in all poses.
    step = smallest_step(rate_s)
    step = np.where(np.isfinite(step), step, 0.0)
    bands = np.where(np.any(means != 0.0, axis=0), 0.0, dead_bands(rate_s, step))

    # The root of h^2 / 12 exp(-4 pi^2 v / h^2), with v / h^2 of the poses.
    scatter = np.mean([part.var(axis=0) for part in parts], axis=0)
    # Between two steps the readings scatter by up to half a step without any noise: the noise is
    # that of the calmest axis.
    in_steps = np.min(scatter[step > 0.0] / step[step > 0.0] ** 2, initial=np.inf)
    rounding_sd = step / np.sqrt(12.0) * np.exp(-2.0 * np.pi**2 * in_steps)
    return HiddenRates(tuple(bands.tolist()), tuple(rounding_sd.tolist()), tuple(step.tolist()))


def _creep(forces: Sequence[np.ndarray], duration: np.ndarray, noise: SensorNoise) -> np.ndarray:
    """
    Return the rates across gravity at which the attitude creeps in each pose, rad/s, shape (k, 3).

    The slope of the force f in a pose is ``df/dt = -rate x f``, so that the rate across gravity is
    ``df/dt x f / |f|^2``. Zero where the slopes of all poses together are no more than noise.

    Parameters
    ----------
    forces : sequence of array, shape (n, 3)
        Readings of the accelerometer in each pose, m/s^2.
    duration : array, shape (k,)
        Duration of each pose, s.
    noise : SensorNoise
        Noise of the accelerometer.

    """
    rates = np.zeros((len(forces), 3))
    # Squares of the slopes across gravity over their variances, two for each pose.
    squares = 0.0
    for pose, (force, seconds) in enumerate(zip(forces, duration)):
        time = np.linspace(-0.5, 0.5, len(force)) * seconds
        slope = time @ force / (time @ time)
        mean_force = force.mean(axis=0)
        rates[pose] = np.cross(slope, mean_force) / (mean_force @ mean_force)
        slope_across = np.cross(mean_force, rates[pose])
        squares += slope_across @ slope_across * (time @ time) / np.mean(noise.low_variance)
    return rates if squares > CREEPS * 2 * len(forces) else np.zeros_like(rates)


def noise_statistics(poses: Poses) -> dict[str, float | list[float]]:
    """Return noise and tilt within the intervals as plain numbers, by name."""
    statistics: dict[str, float | list[float]] = {}
    for sensor, name in zip(SENSORS, ('force', 'rate')):
        noise = poses.noise[sensor]
        statistics[f'{name}_noise_sd'] = noise.white_sd.tolist()
        statistics[f'{name}_noise_colour'] = np.sqrt(noise.inflation).tolist()
    statistics['period'] = poses.period
    statistics['sway'] = poses.sway
    return statistics


def _pooled_noise(parts: Sequence[np.ndarray], rounding: np.ndarray) -> SensorNoise:
    """
    Return the SensorNoise of one sensor from its readings in the intervals.

    The variance of single readings is the median of those of the intervals, at least that of
    rounding, shape (3,). The noise need not be white: the inflation is the variance of the means of
    n samples times n over the variance of single readings, from `NOISE_PIECES` pieces of each
    interval, if it exceeds 1 by two standard deviations.
    """
    # Readings without any scatter get a weight that is finite.
    floor = 1e-9 * max(1e-3, max(np.max(np.abs(part)) for part in parts))
    median_variance = np.median([part.var(0, ddof=1) for part in parts], axis=0)
    sd = np.sqrt(np.maximum(median_variance, rounding)) + floor
    ratios = []
    for part in parts:
        n_samples = len(part) // NOISE_PIECES
        if n_samples >= 4:
            pieces = part[: n_samples * NOISE_PIECES].reshape(NOISE_PIECES, n_samples, 3)
            means = pieces.mean(1)
            # Differences of neighbours: a slow drift belongs to the scatter between poses, not
            # here. They have twice the variance of the means.
            ratios.append(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0) * n_samples / sd**2)
    if not ratios:
        return SensorNoise(sd**2, np.ones(3))
    ratio = np.mean(ratios, axis=0)
    # The mean of n squared differences of neighbours has the relative variance 3 / n.
    margin = 2 * np.sqrt(3 / (len(ratios) * (NOISE_PIECES - 1)))
    return SensorNoise(sd**2, np.where(ratio > 1 + margin, ratio, 1.0))


def distinct_attitudes(force: np.ndarray) -> int:
    """
    Return the number of directions of the mean readings (k, 3) more than `ATTITUDES_APART` apart.
    """
    distinct = []
    for direction in unit_rows(force):
        angles = [np.arccos(np.clip(direction @ other, -1, 1)) for other in distinct]
        if all(angle > ATTITUDES_APART for angle in angles):
            distinct.append(direction)
    return len(distinct)


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

    `time` has the times of the samples, s, shape (n,); `temperature_c` their temperatures.
    """
    turns = []
    dropped = {}
    rate = imu.rate_s
    max_gap = max(MAX_TURN_GAP, 5 * poses.period)
    clipped = at_range_end(rate)
    # Power density of the noise of rates, (rad/s)^2/Hz: its integral has the variance density * T.
    density = np.mean(poses.noise['gyroscope'].low_variance) * poses.period
    for first in range(len(poses) - 1):
        # From the last sample of one pose to the first sample of the next one.
        piece = slice(poses.stop[first] - 1, poses.start[first + 1] + 1)
        reason = _unusable(time[piece], clipped[piece], max_gap)
        if reason:
            dropped[reason] = dropped.get(reason, 0) + 1
            continue
        # Integrated white noise, and rounding at the slow ends of the turn.
        noise_variance = density * (time[piece][-1] - time[piece][0])
        noise_variance += _slow_rounding_variance(time[piece], rate[piece], poses.hidden)
        turns.append(
            TurnData(
                time=time[piece],
                rate=rate[piece],
                force=imu.force_s[piece],
                first=first,
                last=first + 1,
                noise_variance=noise_variance,
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
    is_slow = np.abs(rate[:-1]) <= hidden.step
    slow_seconds = np.diff(time) @ is_slow
    return float(np.mean(np.square(hidden.rounding_sd * slow_seconds)))


def _unusable(time: np.ndarray, clipped: np.ndarray, max_gap: float) -> str:
    """Return the reason why a turn cannot be integrated; '' if it can."""
    if time[-1] - time[0] > TURN_LONGEST:
        return 'too long'
    if np.max(np.diff(time)) > max_gap:
        return 'gap'
    return 'clipped' if clipped.any() else ''


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
    is_new = np.ones(len(rate), bool)  # a reading published twice is one reading
    is_new[1:] = np.logical_or.reduce([axis[1:] != axis[:-1] for axis in rate.T])
    # One range for both sides of all axes, or a range for each side of each axis.
    at_end = _at_end(np.abs, rate.T, is_new)
    for axis in rate.T:
        at_end |= _at_end(np.positive, axis[None], is_new)
        at_end |= _at_end(np.negative, axis[None], is_new)
    return at_end


def _at_end(signed: Callable, axes: np.ndarray, is_new: np.ndarray) -> np.ndarray:
    """
    Return the samples at the largest value of ``signed(axes)`` if it ends the range, shape (n,).

    It ends the range if more readings are at it than expected by chance from the density of the
    `TOP` readings below it.

    Parameters
    ----------
    signed : callable
        Absolute value, identity or negative.
    axes : array, shape (m, n)
        Readings of m axes.
    is_new : array of bool, shape (n,)
        False for repeated readings.

    """
    # 1. The largest readings of all axes, and the step of the converter: their smallest difference.
    largest = np.concatenate([_largest(signed, axis, is_new) for axis in axes])
    largest = np.sort(largest)[-MAX_RANGE_READINGS:]
    extreme = largest[-1]
    step = np.diff(largest)
    step = step[step > 1e-9 * np.abs(extreme)].min(initial=np.inf)

    # 2. Samples at the extreme: to half a step below it, where no other reading is. Of several axes
    #    the next reading too, because in two's complement one end is larger by a step. At most 1e-4
    #    of the extreme, also where the readings have no step or a coarse one.
    margin = 1.5 * step if np.isfinite(step) and len(axes) > 1 else 0.5 * step
    margin = min(margin, 1e-4 * np.abs(extreme))
    at_extreme = np.logical_or.reduce([signed(axis) >= extreme - margin for axis in axes])
    below = largest[largest < extreme - margin][-TOP:]
    if len(below) < TOP:
        return np.zeros(len(is_new), bool)

    # 3. Readings expected there by chance: the density of the readings below, over the margin.
    n_by_chance = 0.0
    if np.isfinite(step):
        n_by_chance = TOP * (margin + 0.5 * step) / (extreme - below[0])

    # 4. Readings that are there, in runs of consecutive samples.
    run_lengths = np.diff(runs_of(at_extreme[is_new]))
    if n_by_chance < CERTAIN:
        n_readings = run_lengths.sum()
    else:
        # The top of one smooth turn may fill a coarse step for some samples: they count once.
        n_readings = np.maximum(run_lengths - SUMMIT, 0).sum() + len(run_lengths)
    if n_readings < max(2, CROWDED * n_by_chance):
        return np.zeros(len(is_new), bool)
    return at_extreme


def _largest(signed: Callable, axis: np.ndarray, is_new: np.ndarray) -> np.ndarray:
    """
    Return the largest `MAX_RANGE_READINGS` values of ``signed(axis[is_new])``, or some more.

    They are computed in blocks, which need less memory.
    """
    largest = np.zeros(0)
    least = -np.inf
    for start in range(0, len(axis), SAMPLES_AT_ONCE):
        stop = start + SAMPLES_AT_ONCE
        values = signed(axis[start:stop])
        largest = np.append(largest, values[(values > least) & is_new[start:stop]])
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
    Return the data of a `KnownTurn`.

    Along the axis the sd of the rotation is that of the angle, `KNOWN_TURN_SD`; across it, the same
    error of the axis times the angle.
    """
    axis = np.asarray(turn.axis, float) / np.linalg.norm(turn.axis)
    projector = np.outer(axis, axis)
    cov = KNOWN_TURN_SD**2 * projector + (turn.angle * KNOWN_TURN_SD) ** 2 * (np.eye(3) - projector)
    piece = slice(turn.start, turn.stop)
    density = np.mean(poses.noise['gyroscope'].white_variance) * poses.period
    noise_variance = density * (time[piece][-1] - time[piece][0])
    return TurnData(
        time=time[piece],
        rate=imu.rate_s[piece],
        force=imu.force_s[piece],
        noise_variance=noise_variance,
        rotation=turn.angle * axis,
        rotation_cov=cov,
        temperature_c=None if temperature_c is None else temperature_c[piece],
    )


def sample_times(imu: ImuSamples) -> np.ndarray:
    """
    Return the times of samples since the first one, s, shape (n,).

    They are those of an even clock, a straight line through the stamps over the count of the
    samples, in pieces of `LINE` seconds. They are the stamps if the readings interpolate better
    from their neighbours at the stamps, as with a driver that polls the sensor at uneven times.
    """
    stamps = rising(1e-9 * (imu.stamp_ns - imu.stamp_ns[0]))
    even = stamps.copy()
    step = np.diff(stamps)
    period = float(np.median(step))
    # A longer step is a pause: the clock of each stretch between pauses is fitted separately.
    edges = np.flatnonzero(step / period > MOST_LOST + MAX_REGULAR_STEP) + 1
    del step  # a long recording is large
    for start, stop in zip([0, *edges], [*edges, len(stamps)]):
        if stop - start >= 2 * LAG:
            even[start:stop] = _clock_times(stamps[start:stop], period)
    if not np.all(np.diff(even) > 0):
        return stamps
    if _roughness(even, imu.rate_s) <= UNDECIDED * _roughness(stamps, imu.rate_s):
        return even
    return stamps


def _clock_times(stamps: np.ndarray, period: float) -> np.ndarray:
    """
    Return the times of the even clock of one stretch, s, shape (n,).

    They are the stamps if the mean stamps of pieces depart from the clock by 0.6 periods or more:
    samples were lost unnoticed.
    """
    # Numbers of the samples: counted, or with lost samples in steps of several periods. The better
    # line is used, because long steps of a rebuilt clock need not be lost samples.
    counted = np.arange(float(len(stamps)))
    step = np.diff(stamps) / period
    lost = (step > MAX_REGULAR_STEP) & (np.abs(step - np.rint(step)) <= WHOLE_STEP_SHARE)
    numbers = [counted]
    if lost.any():
        n_periods = np.where(lost, np.rint(step), 1.0)
        numbers = [np.concatenate([[0.0], np.cumsum(n_periods)]), counted]
    n_lines = max(1, int(period * len(stamps) / LINE))
    lines = [_clock_line(number, stamps, n_lines) for number in numbers]
    line = min(lines, key=lambda line: np.sum((stamps - line) ** 2))

    # Mean departure of pieces of about LAG samples. The first `longer` pieces have size + 1
    # samples, all others `size`: piece k begins at k size + min(k, longer).
    piece = np.arange(len(stamps) // LAG)
    size, longer = divmod(len(stamps), len(piece))
    sums = np.add.reduceat(stamps - line, piece * size + np.minimum(piece, longer))
    departure = sums / (size + (piece < longer))
    return line if np.abs(departure).max() < 0.6 * period else stamps


def _clock_line(number: np.ndarray, time: np.ndarray, pieces: int) -> np.ndarray:
    """
    Return the times of a clock at the sample numbers, s, shape (n,).

    It is a straight line through the stamps `time`, with the mean departures of the pieces from it,
    interpolated between their middles.
    """
    line = np.polynomial.Polynomial.fit(number, time, 1)(number)
    middles = [part.mean() for part in np.array_split(number, pieces)]
    departures = [part.mean() for part in np.array_split(time - line, pieces)]
    return line + np.interp(number, middles, departures)


def _roughness(time: np.ndarray, rate: np.ndarray) -> float:
    """
    Return the sum of squared errors of rates (n, 3) interpolated between their two neighbours.
    """
    total = 0.0
    for start in range(0, len(time) - 2, SAMPLES_AT_ONCE):
        stop = start + SAMPLES_AT_ONCE + 2
        t = time[start:stop]
        w = rate[start:stop].T
        share = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
        errors = w[:, 1:-1] - (1 - share) * w[:, :-2] - share * w[:, 2:]
        total += float(np.sum(errors**2))
    return total


def rising(time: np.ndarray) -> np.ndarray:
    """
    Return stamps in which repeated ones are spread over the following step.

    The order of samples with equal stamps is known, their times are not.
    """
    if np.all(np.diff(time) > 0):
        return time
    number = np.arange(len(time))
    is_later = np.concatenate([[True], np.diff(time) > 0])
    even = np.interp(number, np.flatnonzero(is_later), time[is_later])
    # Equal stamps at the end have no following step: each sample is a nanosecond later.
    return even + 1e-9 * number


def full_scale_factor(state: State, poses: Poses, turns: Sequence[TurnData]) -> float:
    """
    Return the factor between measured and true rates (`preprocessing.full_scale`).

    It is the one with which rotated gravity matches its observed direction after the turns, 1 with
    few turns. Turns of known angle are not used.

    Parameters
    ----------
    state : State
        With the directions of gravity in the poses (`first_state`).
    poses : Poses
    turns : sequence of TurnData

    """
    used_turns = [turn for turn in turns if turn.rotation is None][:MOST_TURNS]
    if len(used_turns) < LEAST_TURNS:
        return 1.0

    def median_error(factor: float) -> float:
        """Return the median angle error of the turns with a factor, rad."""
        matrix = factor * np.eye(3)
        angles = [missed_angle(state, poses, turn, matrix=matrix) for turn in used_turns]
        return float(np.median(angles))

    return believed_factor(median_error)


def missed_angle(state: State, poses: Poses, turn: TurnData, *, matrix: np.ndarray) -> float:
    """
    Return the angle between rotated and observed gravity after a turn, rad.

    The gyroscope reads ``bias + matrix @ rate``, with the mean bias of the poses before and after
    the turn.
    """
    bias = 0.5 * (poses.rate[turn.first] + poses.rate[turn.last])
    mat_ji = total_rotation(turn.time, (turn.rate - bias) @ np.linalg.inv(matrix).T)
    cosine = mat_ji @ state.up[turn.first] @ state.up[turn.last]
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
