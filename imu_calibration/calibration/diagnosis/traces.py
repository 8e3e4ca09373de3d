"""
Measurement against the simulation of two models.

Residuals over short blocks, segments, residual power and dead reckoning.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.sensor_noise import SensorNoise
from imu_calibration.preprocessing.window import Window
from imu_calibration.selection.gain import MEASURES, OF_MODEL, Gain, gain_of

PER_DECADE = 6
"""Frequency bands of the spectrum per decade."""
LOWEST_DECADE, HIGHEST_DECADE = -2, 5
"""Decades of the lowest and highest edge, Hz."""
BAND_EDGES = 10.0 ** np.linspace(
    LOWEST_DECADE, HIGHEST_DECADE, (HIGHEST_DECADE - LOWEST_DECADE) * PER_DECADE + 1
)


class BandResidual(NamedTuple):
    """Residual of one sensor in a frequency band, m/s^2 or rad/s."""

    name: str
    rms: np.ndarray
    """
    Beyond noise, before and after: ``sqrt(max(mean square of the residual - mean square of the
    noise, 0))``, shape (2, 3).
    """
    noise: np.ndarray
    """Rms of the noise, shape (3,)."""


class Spectrum(NamedTuple):
    """Amplitude densities of one sensor, per sqrt(Hz)."""

    frequency: np.ndarray
    """Middles of the bands, Hz, shape (k,)."""
    residual: np.ndarray
    """Density of the residual before and after, shape (2, k, 3)."""
    noise: np.ndarray
    """Density of the noise, shape (k, 3)."""


@dataclass(frozen=True, eq=False)
class Distance:
    """Residual power of one sensor before and after an extension."""

    edges: np.ndarray
    """Edges of the frequency bands, Hz, shape (m + 1,)."""
    power: np.ndarray
    """
    Mean square of the residual within windows by model (before, after) and band, shape (2, m, 3).
    """
    noise: np.ndarray
    """
    Mean square of the noise in each band, from the spectrum of the windows at rest, shape (m, 3).
    """
    means: np.ndarray
    """Mean square of the window means of the residual before and after, shape (2, 3)."""
    means_noise: np.ndarray
    """Mean square of the noise of window means, shape (3,)."""
    gains: dict[str, Gain]
    """Measure of a held-out gain -> the same gain on all windows, all axes and noise included."""

    def bands(self) -> list[BandResidual]:
        """
        Return the residual of the window means, and of each decade.

        Decades end at the last edge below the Nyquist frequency.
        """
        bands = [_band_residual('window means', self.means, self.means_noise)]
        decade = np.floor(np.log10(self.edges[:-1]) + 1e-9).astype(int)
        for exponent in np.unique(decade):
            in_decade = decade == exponent
            in_decade[-1] = False  # the Nyquist frequency is within the last band
            if self.power[0, in_decade].any():
                highest = self.edges[1:][in_decade].max()
                power = self.power[:, in_decade].sum(axis=1)
                noise = self.noise[in_decade].sum(axis=0)
                name = f'{10.0**exponent:g} to {highest:.3g} Hz'
                bands.append(_band_residual(name, power, noise))
        return bands

    def density(self) -> Spectrum:
        """
        Return the amplitude densities of residual and noise.

        Bands without data and the last one, within which the Nyquist frequency is, are omitted.
        """
        is_used = self.power[0].any(axis=1)
        is_used[-1] = False
        width = np.diff(self.edges)[is_used, None]
        return Spectrum(
            frequency=np.sqrt(self.edges[:-1] * self.edges[1:])[is_used],
            residual=np.sqrt(self.power[:, is_used] / width),
            noise=np.sqrt(self.noise[is_used] / width),
        )

    def to_mapping(self) -> dict:
        """
        Return plain data: rms beyond noise before and after, rms of the noise, by band, and gains.
        """
        bands = []
        for name, (before, after), noise in self.bands():
            bands.append(
                {
                    'band': name,
                    'before': before.tolist(),
                    'after': after.tolist(),
                    'noise': noise.tolist(),
                }
            )
        reduction = {}
        for measure, gain in self.gains.items():
            reduction[measure] = {'value': gain.reduction, 'ci95': list(gain.ci95)}
        return {'bands': bands, 'reduction': reduction}


def _band_residual(name: str, power: np.ndarray, noise: np.ndarray) -> BandResidual:
    """Return the residual of a band from mean squares of residual, (2, 3), and noise, (3,)."""
    return BandResidual(name, np.sqrt(np.maximum(power - noise, 0.0)), np.sqrt(noise))


class _WindowSquares(NamedTuple):
    """Squares of the residual of one sensor in one window, before and after."""

    n_samples: int
    at_rest: bool
    within: np.ndarray
    """Sum of squares without the mean, shape (2,)."""
    mean: np.ndarray
    """Square of the mean, shape (2,)."""


class DistanceSums:
    """Accumulates the residual power of windows; memory does not grow with the recording."""

    def __init__(self) -> None:
        count = len(BAND_EDGES) - 1
        # Sums over windows of squares within windows by model (before, after) and band.
        self._power = {sensor: np.zeros((2, count, 3)) for sensor in SENSORS}
        # The same of windows at rest, after.
        self._rest_power = {sensor: np.zeros((count, 3)) for sensor in SENSORS}
        # Sums over windows of squared means, before and after.
        self._means = {sensor: np.zeros((2, 3)) for sensor in SENSORS}
        # Sums of the noise variance of window means.
        self._noise = {sensor: np.zeros(3) for sensor in SENSORS}
        self._windows: dict[str, list[_WindowSquares]] = {sensor: [] for sensor in SENSORS}
        # Degrees of freedom by band, of all windows and of windows at rest.
        self._freedom = np.zeros((2, count))
        self._n_samples = 0
        self._n_windows = 0

    def add(
        self,
        window: Window,
        residuals: Sequence[Mapping[str, np.ndarray]],
        noise: Mapping[str, SensorNoise],
    ) -> None:
        """
        Add a window with its residuals before and after, and the noise of each sensor.

        Both residuals are sensor -> measured minus predicted, shape (n, 3).
        """
        n = len(window)
        at_rest = window.kind == 'static'
        if n < 4 or not window.period:  # too short for a spectrum
            return

        # Parseval: sum of (x - mean)^2 = sum of |X_k|^2 freedom_k / n over the frequencies above
        # zero, with two degrees of freedom each, and one at the Nyquist frequency.
        n_bands = len(BAND_EDGES) - 1
        frequency = np.fft.rfftfreq(n, window.period)[1:]
        band = np.clip(np.searchsorted(BAND_EDGES, frequency, side='right') - 1, 0, n_bands - 1)
        freedom = np.full(len(frequency), 2.0)
        if n % 2 == 0:
            freedom[-1] = 1.0
        self._freedom[: 2 if at_rest else 1] += np.bincount(band, freedom, n_bands)
        self._n_samples += n
        self._n_windows += 1

        # Squares of the residual in each band and of its mean, before and after.
        for sensor, sensor_noise in noise.items():
            self._noise[sensor] += sensor_noise.low_variance / n
            of_window = _WindowSquares(n, at_rest, within=np.zeros(2), mean=np.zeros(2))
            for k, residual_of in enumerate(residuals):  # before, after
                residual = residual_of[sensor]
                mean = residual.mean(axis=0)
                squares = np.abs(np.fft.rfft(residual, axis=0)[1:]) ** 2 * freedom[:, None] / n
                power = np.stack(
                    [np.bincount(band, column, n_bands) for column in squares.T], axis=1
                )
                self._power[sensor][k] += power
                self._means[sensor][k] += mean**2
                of_window.within[k] = power.sum()
                of_window.mean[k] = mean @ mean
                if at_rest and k == len(residuals) - 1:
                    self._rest_power[sensor] += power
            self._windows[sensor].append(of_window)

    def distances(self) -> dict[str, Distance]:
        """Return sensor -> Distance of the windows up to now."""
        # Up to the upper edge of the highest band with data.
        n_edges = int(np.max(np.flatnonzero(self._freedom[0]), initial=0)) + 2
        distances = {}
        for sensor, windows in self._windows.items():
            if windows:
                distances[sensor] = self._distance(sensor, n_edges)
        return distances

    def _distance(self, sensor: str, n_edges: int) -> Distance:
        """Return the Distance of one sensor in the bands between the first edges."""
        n_bands = n_edges - 1
        # Noise of a band: its power per degree of freedom at rest, in the nearest band with data.
        noise = np.zeros((n_bands, 3))
        bands_at_rest = np.flatnonzero(self._freedom[1])
        if len(bands_at_rest):
            density = (
                self._rest_power[sensor][bands_at_rest] / self._freedom[1][bands_at_rest, None]
            )
            nearest = np.abs(np.arange(n_bands)[:, None] - bands_at_rest).argmin(axis=1)
            noise = density[nearest] * self._freedom[0][:n_bands, None]
        return Distance(
            edges=BAND_EDGES[:n_edges],
            power=self._power[sensor][:, :n_bands] / self._n_samples,
            noise=noise / self._n_samples,
            means=self._means[sensor] / self._n_windows,
            means_noise=self._noise[sensor] / self._n_windows,
            gains=self.gains(sensor),
        )

    def gains(self, sensor: str, of: str = OF_MODEL) -> dict[str, Gain]:
        """
        Return measure -> Gain of the windows up to now, in the order of `MEASURES`.

        `of`: kind of the residuals that were added, `OF_MODEL` or `APPLIED` of `selection.gain`.
        """
        windows = self._windows[sensor]
        n = np.array([window.n_samples for window in windows], float)
        at_rest = np.array([window.at_rest for window in windows], bool)
        # Before and after, of each window, shape (2, n_windows).
        within = np.array([window.within for window in windows]).reshape(-1, 2).T
        mean = np.array([window.mean for window in windows]).reshape(-1, 2).T
        # In the order of `MEASURES`: sums of squares, and the numbers of values in them, all axes.
        squares = (within + n * mean, mean, within, mean[:, at_rest])
        numbers = (3 * n, np.full(len(n), 3.0), 3 * (n - 1), np.full(at_rest.sum(), 3.0))
        gains = {}
        for measure, (before, after), number in zip(MEASURES, squares, numbers, strict=True):
            pair = [(before, number), (after, number)]
            gains[measure] = gain_of(sensor, measure, pair, of=of)
        return gains


@dataclass(frozen=True, eq=False)
class OverlaySegment:
    """Measured and simulated signal of one axis."""

    time: np.ndarray
    """Seconds since the first sample, shape (n,)."""
    signals: dict[str, np.ndarray]
    """
    'measured', 'simulated before', 'simulated after': m/s^2 or rad/s, shape (n,); samples, or means
    of equal numbers of them.
    """

    def difference(self, simulated: str) -> np.ndarray:
        """Return measured minus simulated, shape (n,), of a name in `signals`."""
        return self.signals['measured'] - self.signals[simulated]


@dataclass(frozen=True, eq=False)
class ResidualBlocks:
    """Residuals averaged over short blocks, before and after, with the variables of their plots."""

    time: np.ndarray
    """Middle of each block, s, shape (n,)."""
    kind: np.ndarray
    """Kind of its window, shape (n,)."""
    position: np.ndarray
    """Joint angles, rad, shape (n, n_joints)."""
    force_s: np.ndarray
    """Reference specific force, m/s^2, shape (n, 3)."""
    rate_s: np.ndarray
    """Reference rate, rad/s, shape (n, 3)."""
    temperature_c: np.ndarray | None
    """Temperature, shape (n,), or None."""
    before: dict
    """Sensor -> measured minus predicted by the baseline, shape (n, 3)."""
    after: dict
    """Sensor -> measured minus predicted by the extended model, shape (n, 3)."""
    samples: np.ndarray
    """Samples in each block, shape (n,)."""


@dataclass(frozen=True, eq=False)
class Traces(ResidualBlocks):
    """The residuals of a recording with what follows from them for people."""

    dead_reckoning: dict | None
    """
    {'seconds', 'position_before', 'position_after', 'velocity_before', 'velocity_after',
    'stretches'}: medians, m and m/s, or None with one sensor, or when no stretch of the recording
    is long enough.
    """
    segments: dict[str, list[OverlaySegment]] = field(default_factory=dict)
    """Sensor -> for each axis the segment with the largest residual before."""
    distances: dict[str, Distance] = field(default_factory=dict)
    """Sensor -> residual power by band; empty by hand."""
