"""
The noise figures of an IMU, and the parameters of filters from them.

Filters get a white noise and a random walk, or Gauss-Markov processes for the slow part.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from imu_calibration.allan.processes import (
    FLICKER,
    QUANTISATION,
    RANDOM_WALK,
    WHITE,
    NoiseProcess,
    allan_variance,
    gauss_markov,
)
from imu_calibration.allan.terms import GAUSS_MARKOV, PROCESSES, TIME_KEY, AxisNoise
from imu_calibration.allan.trends import AxisTrend
from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.sensor_noise import BiasProcess

HORIZON = 100.0
"""
Averaging time at which the random walk for a filter has the Allan variance of all slow processes,
s.
"""
MIN_WALK_REST = 3.0 * HORIZON
"""
Least rest for the export of a random walk, s: it contains two differences of means over the
horizon.
"""
SLOW_PROCESSES = (FLICKER.name, RANDOM_WALK.name, GAUSS_MARKOV)


@dataclass(frozen=True, eq=False)
class AxisFigures(AxisNoise):
    """The noise of one axis of a recording."""

    trends: tuple[AxisTrend, ...] = ()
    """Trends that were subtracted before the noise was estimated."""
    record_for: dict[str, float | None] = field(default_factory=dict)
    """
    Name of a figure that is not determined -> rest that would determine it, s; None: more than two
    days.
    """
    sample_sd: float = 0.0
    """Measured standard deviation of single samples."""
    deviation: tuple[float, ...] = ()
    """Allan deviations at the averaging times of the document."""

    def processes(self) -> list[tuple[NoiseProcess, float]]:
        """Return the processes of the model with their coefficients (squares of the figures)."""
        processes = []
        for name in (QUANTISATION.name, WHITE.name, *self.form):
            term = self.terms.get(name)
            if term is None or term.value is None:
                continue
            if name == GAUSS_MARKOV:
                # A time without a value (in a document only): the shortest that is possible.
                time = self.terms[TIME_KEY]
                process = gauss_markov(time.value or time.interval[0])
            else:
                process = PROCESSES[name]
            processes.append((process, term.value**2))
        return processes

    @property
    def white(self) -> float:
        """
        The density of the white noise; where its interval contains zero, its upper end.

        Without an upper end, the density of white noise with the variance of the samples: a finite
        bound for filters and weights.
        """
        term = self.terms[WHITE.name]
        if term.value is not None and term.interval[0] > 0:
            return term.value
        if np.isfinite(term.interval[1]):
            return term.interval[1]
        return self.sample_sd * float(np.sqrt(self.shortest))

    def walk(self, horizon: float = HORIZON) -> tuple[float, str]:
        """
        Return (density of the random walk that replaces the slow part, `Densities.basis`).

        The walk has the total Allan variance of the slow processes at the horizon, s; without a
        slow part in the curve, it is the largest walk that the curve allows.
        """
        names = []
        variance = 0.0
        for process, coefficient in self.processes():
            if process.name in SLOW_PROCESSES:
                names.append(process.name)
                variance += coefficient * float(allan_variance(process, np.array([horizon]))[0])
        if not names:
            return self.terms[RANDOM_WALK.name].interval[1], 'bound'
        # K^2 tau / 3 is the Allan variance of a random walk of density K.
        density = float(np.sqrt(3.0 * variance / horizon))
        return density, 'walk' if names == [RANDOM_WALK.name] else 'equivalent'


@dataclass(frozen=True, eq=False)
class NoiseFigures:
    """The noise of an IMU."""

    accelerometer: tuple[AxisFigures, ...]
    """x, y, z; empty where the sensor was absent or could not be used."""
    gyroscope: tuple[AxisFigures, ...]
    """x, y, z; empty where the sensor was absent or could not be used."""
    rate: float
    """Sampling rate of the recording, Hz."""
    frame_id: str = ''
    """Frame of the messages."""
    recording: dict = field(default_factory=dict)
    """Seconds at rest, parts, excluded parts."""
    tau: tuple[float, ...] = ()
    """Averaging times of the Allan deviations, s."""
    provenance: dict = field(default_factory=dict)
    """Software version, recording, options."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors with figures."""
        return tuple(sensor for sensor in SENSORS if self.sensor(sensor))

    def require_both_sensors(self, remedy: str) -> None:
        """Raise an InputError with the remedy where a sensor has no figures."""
        for sensor in SENSORS:
            if sensor not in self.sensors:
                raise InputError(
                    'the noise document must have figures of both sensors, it has none of the'
                    f' {sensor}; {remedy}',
                    key='noise',
                    code='absent',
                )

    def sensor(self, name: str) -> tuple[AxisFigures, ...]:
        """Return the axes of 'accelerometer' or 'gyroscope'."""
        return {'accelerometer': self.accelerometer, 'gyroscope': self.gyroscope}[name]

    def densities(self, sensor: str, horizon: float = HORIZON) -> 'Densities':
        """
        Return the two noise parameters of most filters for a sensor.

        Each is that of its worst axis; axes without a finite walk do not count if another has one.
        """
        walks = [axis.walk(horizon) for axis in self.sensor(sensor)]
        finite = [(walk, basis) for walk, basis in walks if np.isfinite(walk)]
        walk, basis = max(finite or walks)
        return Densities(float(max(axis.white for axis in self.sensor(sensor))), float(walk), basis)


@dataclass(frozen=True)
class Densities:
    """White noise and random walk in continuous time."""

    white: float
    """Per root hertz."""
    walk: float
    """Per second and root hertz."""
    basis: str
    """
    'walk' (a walk was found), 'equivalent' (it replaces other slow noise) or 'bound' (no slow
    noise: upper limit).
    """

    def sample_sd(self, rate: float) -> float:
        """Return the standard deviation of the white noise of a sample at a rate (Hz)."""
        return self.white * float(np.sqrt(rate))

    def step_sd(self, rate: float) -> float:
        """
        Return the standard deviation of the change of the bias between samples at a rate (Hz).
        """
        return self.walk / float(np.sqrt(rate))


PROCESS_TIME_RATIO = 4.0
"""Ratio of neighbouring correlation times: the density ripples by a hundredth."""
PROCESS_TIMES = PROCESS_TIME_RATIO ** np.arange(1, 8)
"""Times, s, from the length of windows to four times that of sessions of an hour."""


def bias_processes(figures: NoiseFigures) -> dict[str, tuple[BiasProcess, ...]]:
    """
    Return sensor -> its bias processes, from the mean of the axes' variances.

    Empty for a sensor without slow noise. Upper limits of processes that were not found do not
    count.
    """
    return {sensor: _processes(figures.sensor(sensor)) for sensor in figures.sensors}


def _processes(axes: Sequence[AxisFigures]) -> tuple[BiasProcess, ...]:
    """
    Return the bias processes with the mean variances of the axes.

    Flicker noise has the two-sided power density B^2 / (2 pi f). It is a sum of exponential
    correlations with the variance B^2 ln(ratio) / pi, one for each time of a geometric series with
    this ratio. A random walk is the correlation of the longest time T, with the variance K^2 T / 2.
    """
    flicker = 0.0
    walk = 0.0
    correlated: dict[float, float] = {}  # correlation time -> variance
    for axis in axes:
        for process, coefficient in axis.processes():
            if process.name == FLICKER.name:
                flicker += coefficient
            elif process.name == RANDOM_WALK.name:
                walk += coefficient
            elif process.name == GAUSS_MARKOV:
                correlated[process.time] = correlated.get(process.time, 0.0) + coefficient
    share = 1.0 / len(axes)
    flicker *= share
    walk *= share

    # Correlation time -> variance.
    variances = {time: flicker * np.log(PROCESS_TIME_RATIO) / np.pi for time in PROCESS_TIMES}
    variances[PROCESS_TIMES[-1]] += walk * PROCESS_TIMES[-1] / 2.0
    for time, variance in correlated.items():
        variances[time] = variances.get(time, 0.0) + share * variance
    return tuple(
        BiasProcess(float(np.sqrt(variance)), float(time))
        for time, variance in sorted(variances.items())
        if variance > 0
    )
