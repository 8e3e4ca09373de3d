"""Poses from samples: means over the intervals held still, and their standard errors."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.core.samples import ImuSamples, rounding_variance
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.references.gravity.equations import Poses

CREEPS = 3.0
"""Mean square of the slopes of forces across gravity, relative to its expectation from noise, above which poses creep."""

ATTITUDES_APART = 0.2
"""Attitudes closer than this count as one pose, rad."""
DITHER = 3.0
"""Variance of readings over that of rounding below which rounding is not averaged: half a step; 1 % of a step remains above."""


def average_poses(imu: ImuSamples, ranges: Sequence[tuple[int, int]], temperature_c: np.ndarray | None = None) -> Poses:
    """
    Return the means over the intervals, with their sd from the noise within the intervals.

    `temperature_c` is that of the samples, shape (n,), when it was recorded.

    The noise need not be white: the scatter of means of pieces of half a second or more determines the factor over white noise.
    """
    parts = {'accelerometer': [imu.force_s[a:b] for a, b in ranges], 'gyroscope': [imu.rate_s[a:b] for a, b in ranges]}
    rounding = {'accelerometer': rounding_variance(imu.force_s), 'gyroscope': rounding_variance(imu.rate_s)}
    noise = {sensor: _pooled_noise(part, rounding[sensor]) for sensor, part in parts.items()}
    count, kinds = np.array([b - a for a, b in ranges]), ['static'] * len(ranges)
    means = [np.array([part.mean(0) for part in parts[sensor]]) for sensor in SENSORS]
    sems = [np.sqrt(_with_rounding(noise[sensor].mean_variance(kinds, count), parts[sensor], rounding[sensor])) for sensor in SENSORS]
    start, stop = np.array(ranges).T
    time = 1e-9 * (0.5 * (imu.stamp_ns[start] + imu.stamp_ns[stop - 1]) - imu.stamp_ns[0])
    length = 1e-9 * (imu.stamp_ns[stop - 1] - imu.stamp_ns[start])
    creep = _creep(parts['accelerometer'], length, noise['accelerometer'])
    warm = None if temperature_c is None else np.array([temperature_c[a:b].mean() for a, b in ranges])
    return Poses(means[0], means[1] - creep, sems[0], sems[1], start=start, stop=stop, time=time, temperature_c=warm, noise=noise,
                 half_turn=0.5 * length[:, None] * creep, period=float(np.median(np.diff(imu.stamp_ns))) * 1e-9)


def _with_rounding(variance, parts, rounding):
    """Return the variance of the means, at least that of rounding where readings scatter by less than half a step and do not average it."""
    within = np.array([part.var(axis=0) for part in parts])
    return np.where(within < DITHER * rounding, np.maximum(variance, rounding), variance)


def _creep(forces, length, noise):
    """
    Return the rates at which the attitude creeps in each pose, as observable from gravity, rad/s, shape (k, 3).

    ``d force / dt = -rate x force``: the part across gravity. Zero where the slopes of all poses together are no more than noise.
    """
    rates, excess = np.zeros((len(forces), 3)), 0.0
    for pose, (force, seconds) in enumerate(zip(forces, length)):
        since = np.linspace(-0.5, 0.5, len(force)) * seconds
        slope, up = since @ force / (since @ since), force.mean(axis=0)
        rates[pose] = np.cross(slope, up) / (up @ up)
        across = np.cross(up, rates[pose])
        excess += across @ across * (since @ since) / np.mean(noise.low_variance)
    return rates if excess > CREEPS * 2 * len(forces) else np.zeros_like(rates)


def noise_statistics(poses: Poses) -> dict:
    """Return the noise within the intervals as plain numbers."""
    found = {}
    for sensor, name in zip(SENSORS, ('force', 'rate')):
        noise = poses.noise[sensor]
        found |= {f'{name}_noise_sd': noise.white_sd.tolist(), f'{name}_noise_colour': np.sqrt(noise.inflation).tolist()}
    return found | {'period': poses.period}


def _pooled_noise(parts, rounding, pieces=8):
    """Return the NoiseModel of samples, from the median of the intervals and how much means of pieces scatter more than white noise."""
    floor = 1e-9 * max(1e-3, max(np.max(np.abs(p)) for p in parts))
    within = np.sqrt(np.maximum(np.median([p.var(0, ddof=1) for p in parts], axis=0), rounding)) + floor
    ratios = []
    for part in parts:
        length = len(part) // pieces
        if length >= 4:
            means = part[:length * pieces].reshape(pieces, length, 3).mean(1)
            # differences of neighbours: a slow drift belongs to the scatter between poses, not here
            ratios.append(0.5 * np.mean(np.diff(means, axis=0)**2, axis=0) * length / within**2)
    if not ratios:
        return NoiseModel(within**2, np.ones(3))
    ratio, margin = np.mean(ratios, axis=0), 2 * np.sqrt(3 / (len(ratios) * (pieces - 1)))
    return NoiseModel(within**2, np.where(ratio > 1 + margin, ratio, 1.0))


def distinct_attitudes(force: np.ndarray) -> int:
    """Return how many of the mean readings (k, 3) point in directions more than `ATTITUDES_APART` from each other."""
    kept = []
    for direction in unit_rows(force):
        if all(np.arccos(np.clip(direction @ other, -1, 1)) > ATTITUDES_APART for other in kept):
            kept.append(direction)
    return len(kept)
