"""
Noise of known coefficients, by its physics.

Steps of a converter, white noise, flicker, a walk, a process that forgets, and grades made of them.
"""

from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count
from unittest.mock import patch

import numpy as np
from scipy.fft import irfft, next_fast_len
from scipy.signal import lfilter

from imu_calibration.allan import identify
from imu_calibration.allan.curve import AllanSums
from imu_calibration.simulation.sensor_noise import GRADES

RATE = 100.0
"""Hz, of the records of the grades."""


def white(n, period, density, rng):
    """White noise of a density (unit per root hertz)."""
    return density / np.sqrt(period) * rng.standard_normal(n)


def random_walk(n, period, density, rng):
    """
    Means over the periods of a random walk.

    Its steps over t seconds scatter by density times the root of t.
    """
    ends = np.cumsum(rng.standard_normal(n + 1))
    bridges = rng.standard_normal(n) / np.sqrt(12.0)
    return density * np.sqrt(period) * (0.5 * (ends[1:] + ends[:-1]) + bridges)


def gauss_markov(n, period, sd, time, rng):
    """A stationary process with the correlation exp(-t / time)."""
    decay = np.exp(-period / time)
    drive = sd * rng.standard_normal(n)
    drive[1:] *= np.sqrt(-np.expm1(-2 * period / time))
    return lfilter([1.0], [1.0, -decay], drive)


def flicker(n, period, instability, rng):
    """
    Means over the periods of noise with the density instability^2 / (2 pi f).

    The density is two-sided, down to an eighth of the extent of the record.
    """
    length = next_fast_len(8 * n)
    size = _folded_flicker(length, period)
    drive = (rng.standard_normal(len(size)) + 1j * rng.standard_normal(len(size))) * size
    return irfft(drive * instability * np.sqrt(length / period), length)[:n]


@lru_cache(maxsize=2)
def _folded_flicker(length, period):
    """
    Return the root of half the density of such means for unit instability.

    With what folds back from higher frequencies; none at zero.
    """
    frequency = np.arange(length // 2 + 1) / (length * period)
    frequency[0] = frequency[1]
    folded = np.zeros(len(frequency))
    for alias in range(-6, 7):
        seen = np.abs(frequency + alias / period)
        folded += np.sinc(seen * period) ** 2 / (2 * np.pi * seen)
    folded[0] = 0.0
    return np.sqrt(0.5 * folded)


def quantisation(n, period, coefficient, rng):
    """Rates from an angle that is read with independent errors."""
    return np.diff(coefficient * rng.standard_normal(n + 1)) / period


@contextmanager
def identifying(*axes):
    """
    Identify these axes of a recording only: 0, and those whose noise is not that of the one before.

    Counted are the axes with a curve. The others get the figures of the one before, which are not
    compared again, and keep their curves and faults of readings.
    """
    calls, identify_axis, known = count(), identify.identify_axis, []

    def identified(moments):
        if next(calls) in axes:
            known.append(identify_axis(moments))
        return known[-1]

    with patch.object(identify, 'identify_axis', identified):
        yield


@dataclass(frozen=True)
class AxisTruth:
    """
    Figures of one axis: name of the process -> figure.

    'gauss_markov' and 'correlation_time' together.
    """

    figures: dict = field(default_factory=dict)

    @property
    def form(self):
        """The slow part, in the order of the package."""
        return tuple(
            name
            for name in ('bias_instability', 'random_walk', 'gauss_markov')
            if name in self.figures
        )

    def draw(self, n, period, rng):
        """Return a record of n samples."""
        f = self.figures
        values = white(n, period, f['white_noise'], rng)
        if 'bias_instability' in f:
            values += flicker(n, period, f['bias_instability'], rng)
        if 'random_walk' in f:
            values += random_walk(n, period, f['random_walk'], rng)
        if 'gauss_markov' in f:
            values += gauss_markov(n, period, f['gauss_markov'], f['correlation_time'], rng)
        if 'quantisation' in f:
            values += quantisation(n, period, f['quantisation'], rng)
        return values


def overlapping_allan_variance(values, factors):
    """Return the overlapping Allan variance of samples in memory, shape (n_scales, n_columns)."""
    sums = AllanSums(factors, values.shape[1])
    sums.push(values)
    sums.end_stretch()
    return sums.variance()


FORMS = (
    ('random_walk',),
    ('bias_instability',),
    ('gauss_markov',),
    ('bias_instability', 'random_walk'),
)


def draw_truth(grade, sensor, form, rng):
    """
    Return the figures of an axis.

    The grade's densities and instability within a factor of two, in one of `FORMS`.
    """
    noise = GRADES[grade].noise
    density, instability = (
        (noise.accel_density, noise.accel_instability)
        if sensor == 'accelerometer'
        else (noise.gyro_density, noise.gyro_instability)
    )
    density, instability = (value * 2.0 ** rng.uniform(-1, 1) for value in (density, instability))
    figures = {'white_noise': density}
    if 'bias_instability' in form:
        figures['bias_instability'] = instability
    # Crosses the flicker, or the white noise of as much, after some hundred seconds.
    if 'random_walk' in form:
        figures['random_walk'] = instability / np.sqrt(100.0 * 2.0 ** rng.uniform(-1, 2))
    if 'gauss_markov' in form:
        figures |= {
            'gauss_markov': instability,
            'correlation_time': 100.0 * 2.0 ** rng.uniform(-1.5, 1.5),
        }
    if rng.random() < 0.2:
        figures['quantisation'] = density * np.sqrt(1.0 / RATE) * 2.0 ** rng.uniform(-1, 1)
    return AxisTruth(figures)
