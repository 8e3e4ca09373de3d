"""Distance between simulation and measurement: power of the residual beyond noise, by axis and frequency."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.segmentation.window import Window
from imu_calibration.selection.gain import MEASURES, Gain, reduction_interval

PER_DECADE = 6
"""Frequency bands of the spectrum per decade."""
LOWEST, HIGHEST = -2, 5
"""Decades of the lowest and highest edge, Hz."""
EDGES = 10.0**np.linspace(LOWEST, HIGHEST, (HIGHEST - LOWEST) * PER_DECADE + 1)


@dataclass(frozen=True, eq=False)
class Distance:
    """Residual power of one sensor before and after an extension."""

    edges: np.ndarray
    """Edges of the frequency bands, Hz, shape (m + 1,)."""
    power: np.ndarray
    """Mean square of the residual within windows by model (before, after) and band, shape (2, m, 3)."""
    noise: np.ndarray
    """Mean square of the noise in each band, from the spectrum of the windows at rest, shape (m, 3)."""
    means: np.ndarray
    """Mean square of the window means of the residual before and after, shape (2, 3)."""
    means_noise: np.ndarray
    """Mean square of the noise of window means, shape (3,)."""
    gains: dict[str, Gain]
    """Measure of a held-out gain -> the same gain on all windows, all axes and noise included."""

    def bands(self) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """
        Return (band, rms beyond noise (2, 3), rms of the noise (3,)) of the window means and of each decade, m/s^2 or rad/s.

        ``sqrt(max(mean square of measured - simulated - that of the noise, 0))``.
        """
        found = [('window means', self.means, self.means_noise)]
        decade = np.floor(np.log10(self.edges[:-1]) + 1e-9).astype(int)
        for each in np.unique(decade):
            rows = decade == each
            if self.power[0, rows].any():
                found.append((f'{10.0**each:g} to {10.0**(each + 1):g} Hz', self.power[:, rows].sum(axis=1), self.noise[rows].sum(axis=0)))
        return [(name, np.sqrt(np.maximum(power - noise, 0.0)), np.sqrt(noise)) for name, power, noise in found]

    def density(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Return (frequency (k,), amplitude density of the residual (2, k, 3), of the noise (k, 3)), per sqrt(Hz).

        Bands without data and the last one are left out.
        """
        rows = self.power[0].any(axis=1)
        rows[-1] = False   # the Nyquist frequency cuts it
        width = np.diff(self.edges)[rows, None]
        return (np.sqrt(self.edges[:-1] * self.edges[1:])[rows], np.sqrt(self.power[:, rows] / width), np.sqrt(self.noise[rows] / width))

    def to_mapping(self) -> dict:
        """Return plain data: rms beyond noise before and after, and of the noise, by band, in SI units."""
        return {'bands': [{'band': name, 'before': rms[0].tolist(), 'after': rms[1].tolist(), 'noise': noise.tolist()}
                          for name, rms, noise in self.bands()],
                'reduction': {measure: {'value': gain.reduction, 'ci95': list(gain.ci95)} for measure, gain in self.gains.items()}}


class DistanceSums:
    """Accumulates the residual power of windows; memory does not grow with the recording."""

    def __init__(self) -> None:
        count = len(EDGES) - 1
        self._power = {sensor: np.zeros((2, count, 3)) for sensor in SENSORS}
        self._rest = {sensor: np.zeros((count, 3)) for sensor in SENSORS}
        self._means = {sensor: np.zeros((2, 3)) for sensor in SENSORS}
        self._rows: dict[str, list] = {sensor: [] for sensor in SENSORS}
        self._noise = {sensor: np.zeros(3) for sensor in SENSORS}
        self._freedom = np.zeros((2, count))   # of all windows, of windows at rest
        self._samples = self._windows = 0

    def add(self, window: Window, residuals: Sequence[Mapping[str, np.ndarray]], noise: Mapping[str, NoiseModel]) -> None:
        """Add a window with its residuals (before, after: sensor -> (n, 3)) and the noise of each sensor."""
        n, rest = len(window), window.kind == 'static'
        if n < 4 or not window.period:
            return
        line = np.fft.rfftfreq(n, window.period)[1:]
        place = np.clip(np.searchsorted(EDGES, line, side='right') - 1, 0, len(EDGES) - 2)
        freedom = np.full(len(line), 2.0)
        freedom[-1] = 1.0 if n % 2 == 0 else 2.0
        self._freedom[:2 if rest else 1] += np.bincount(place, freedom, len(EDGES) - 1)
        self._samples += n
        self._windows += 1
        for sensor in SENSORS:
            self._noise[sensor] += noise[sensor].low_variance / n
            row = [n, rest]
            for k, own in enumerate(residuals):
                mean = own[sensor].mean(axis=0)
                squares = np.abs(np.fft.rfft(own[sensor], axis=0)[1:])**2 * freedom[:, None] / n
                band = np.stack([np.bincount(place, column, len(EDGES) - 1) for column in squares.T], axis=1)
                self._power[sensor][k] += band
                self._means[sensor][k] += mean**2
                row += [band.sum(), mean @ mean]
                if rest and k == len(residuals) - 1:
                    self._rest[sensor] += band
            self._rows[sensor].append(row)

    def distances(self) -> dict[str, Distance]:
        """Return sensor -> Distance of the windows up to now."""
        edge = int(np.max(np.flatnonzero(self._freedom[0]), initial=0)) + 2
        return {sensor: self._distance(sensor, edge) for sensor in SENSORS}

    def _distance(self, sensor, edge):
        known = np.flatnonzero(self._freedom[1])
        density = self._rest[sensor][known] / self._freedom[1][known, None]
        nearest = np.abs(np.arange(edge - 1)[:, None] - known).argmin(axis=1) if len(known) else []
        noise = density[nearest] * self._freedom[0][:edge - 1, None] if len(known) else np.zeros((edge - 1, 3))
        return Distance(EDGES[:edge], self._power[sensor][:, :edge - 1] / self._samples, noise / self._samples,
                        self._means[sensor] / self._windows, self._noise[sensor] / self._windows, self._gains(sensor))

    def _gains(self, sensor):
        """Return measure -> Gain, in the order of `MEASURES`."""
        n, rest, *squares = np.array(self._rows[sensor]).T
        models, still, found = (squares[:2], squares[2:]), rest > 0, {}
        pairs = ([(within + n * mean, 3 * n) for within, mean in models], [(mean, 0 * n + 3) for _, mean in models],
                 [(within, 3 * (n - 1)) for within, _ in models], [(mean[still], 3 + 0 * mean[still]) for _, mean in models])
        for measure, pair in zip(MEASURES, pairs):
            rms = [float(np.sqrt(total.sum() / max(number.sum(), 1))) for total, number in pair]
            found[measure] = Gain(sensor, measure, *rms, reduction_interval(pair), len(pair[0][0]))
        return found
