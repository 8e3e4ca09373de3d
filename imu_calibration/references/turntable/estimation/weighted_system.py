"""
The rows of one solve.

Accumulated windows with the columns of a model, weighted by a noise model, and the prior.
"""

from collections.abc import Iterator

import numpy as np
import scipy.linalg

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import coefficient_jacobian, coefficients
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.scaled_solve import triangular
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.references.turntable.estimation.accumulated_rows import (
    AccumulatedRows,
    CentredRows,
)
from imu_calibration.references.turntable.noise_model import NoiseModel, sessions_of

EXCLUDED_MEAN_SD_FACTOR = 1e3
"""Sd factor of an excluded mean over the largest sd of all means."""


class WeightedSystem:
    """
    Accumulated windows as rows ``[columns | output]``.

    With residuals and derivatives for given parameters and noise.

    Parameters
    ----------
    accumulator : AccumulatedRows
    model : SensorModel

    """

    def __init__(self, accumulator: AccumulatedRows, model: SensorModel):
        self.model = model
        self.prior = make_prior(model)
        self.accumulator = accumulator
        rows = accumulator.rows

        self.kinds = [row.kind for row in rows]
        """Kind of each window."""
        self.keys = [(row.session, row.time) for row in rows]
        """(Recording, middle in s) of each window."""
        self.times = np.array([row.time for row in rows], float)
        """Middle of each window, s."""
        self.counts = np.array([row.count for row in rows], float)
        """Number of samples of each window."""
        self.durations = np.array([row.duration for row in rows], float)
        """Length of each window, s."""
        self.sessions = sessions_of(rows)
        """Indices of each recording's windows in order of time."""

        self.sensors = tuple(rows[0].sensors) if rows else SENSORS
        """Sensors with rows: those with readings."""
        self.means = {}
        """Sensor -> mean rows, shape (n_windows, p + 3)."""
        self.within: dict[str, dict[str, np.ndarray]] = {}
        """Sensor -> kind -> factor of the centred rows."""
        for sensor in self.sensors:
            self.means[sensor] = np.array([row.sensors[sensor].mean for row in rows])
            self.within[sensor] = {}
        # In a fixed order, so that sums over kinds do not depend on the order of the windows.
        for (sensor, kind), factor in sorted(accumulator.within.items()):
            if len(factor):
                self.within[sensor][kind] = factor

        # Each window has lost one degree of freedom to its mean.
        self.dof_within = {}
        """Kind -> degrees of freedom of its centred rows."""
        for kind, n_samples in accumulator.samples.items():
            self.dof_within[kind] = max(n_samples - accumulator.windows[kind], 1)

    def misfit(self, sensor: str, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return output minus prediction of rows ``[columns | output]``, shape (k, 3)."""
        return rows[:, -3:] - rows[:, :-3] @ coefficients(self.model, sensor, values)

    def mean_variance(self, noise: NoiseModel, beside_bias: bool = True) -> np.ndarray:
        """
        Return the variance of the window means, very large for excluded windows.

        Shape (n_windows, 3).

        Relative to the bias in the middle of each window, or of the noise within windows and of the
        reference only.
        """
        of_windows = noise.variance_beside_bias if beside_bias else noise.mean_variance
        variance = of_windows(self.kinds, self.counts, self.durations, keys=self.keys)
        if noise.left_out:
            left_out = np.array([key in noise.left_out for key in self.keys])
            largest = variance.max(axis=0) + noise.offset_sd**2 + noise.bias_variance
            variance[left_out] = EXCLUDED_MEAN_SD_FACTOR**2 * largest
        return variance

    def whitened(self, rows: np.ndarray, noise: NoiseModel) -> np.ndarray:
        """Return mean rows, shape (n_windows, 3, q), as independent rows of unit variance."""
        return self._whitening(noise)(rows)

    def _whitening(self, noise: NoiseModel) -> Whitening:
        """Return the whitening of the mean rows, offsets of windows included."""
        variance = self.mean_variance(noise) + noise.offset_sd**2
        return Whitening(
            variance,
            self.times,
            self.sessions,
            processes=noise.bias_processes,
            session_variance=noise.session_variance,
        )

    def bias_information(self, values: np.ndarray, noises: dict[str, NoiseModel]) -> np.ndarray:
        """
        Return ``A' V^-1 B V^-1 A``, shape (n_params, n_params), over the window means.

        A is the design at `values`, V the covariance of the means, and B its part due to offsets of
        windows, bias processes and the bias of each recording. With C the covariance of the
        estimate, ``C (A' V^-1 B V^-1 A) C`` is the part of C due to them.
        """
        total = np.zeros((len(values),) * 2)
        for sensor in self.sensors:
            # W A with W' W = V^-1, so that A' V^-1 A is its product with itself.
            slope = coefficient_jacobian(self.model, sensor, values)
            design = np.einsum('kp,paq->kaq', self.means[sensor][:, :-3], slope)
            whitening = self._whitening(noises[sensor])
            white = whitening(design)
            information = np.einsum('kap,kaq->pq', white, white)

            # B = V - D with the diagonal D of the noise within windows: subtract A' V^-1 D V^-1 A.
            weighed = whitening.adjoint(white)
            within = self.mean_variance(noises[sensor], beside_bias=False)
            of_noise = np.einsum('kap,kaq->pq', weighed, weighed * within[:, :, None])
            total += information - of_noise
        return total

    def whitened_means(self, sensor: str, noise: NoiseModel) -> np.ndarray:
        """
        Return the whitened mean rows ``[columns | output]`` of each axis.

        Shape (n_windows, 3, p + 1).
        """
        means = self.means[sensor]
        of_axes = [means[:, self.columns_and(sensor, axis)] for axis in range(3)]
        return self.whitened(np.stack(of_axes, axis=1), noise)

    def columns_and(self, sensor: str, axis: int) -> list[int]:
        """Return the places of all columns and of the output of one axis in rows of a sensor."""
        p = self.means[sensor].shape[1] - 3
        return [*range(p), p + axis]

    def factors(self, sensor: str, noise: NoiseModel) -> list[np.ndarray]:
        """
        Return for each axis the triangular factor of all whitened rows ``[columns | output]``.
        """
        white = self.whitened_means(sensor, noise)
        centred = list(self.weighed_rows(sensor, noise))
        found = []
        for axis in range(3):
            own = self.columns_and(sensor, axis)
            parts = [white[:, axis]]
            parts += [rows[:, own] * weight[axis] for rows, weight in centred]
            found.append(triangular(np.concatenate(parts)))
        return found

    def weighed_rows(
        self, sensor: str, noise: NoiseModel, part: CentredRows | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """
        Yield (centred rows, weight of each axis (3,)).

        All rows of each kind, and again the slow ones where these have more weight.

        From all windows, or from one block.
        """
        part = part or self.accumulator
        for kind in self.within[sensor]:
            if (sensor, kind) in part.within:
                yield part.within[sensor, kind], 1 / np.sqrt(noise.row_variance(kind))
            extra = noise.slow_weight(kind)
            if extra.any() and (sensor, kind) in part.slow:
                yield part.slow[sensor, kind], extra

    def residuals(self, values: np.ndarray, factors: dict) -> np.ndarray:
        """Return the residual rows of both sensors and all axes, the prior's rows last."""
        parts = []
        for sensor in self.sensors:
            of_axes = coefficients(self.model, sensor, values)
            for axis, factor in enumerate(factors[sensor]):
                parts.append(factor[:, :-1] @ of_axes[:, axis] - factor[:, -1])
        parts.append(self.prior.root @ (values - self.prior.mean))
        return np.concatenate(parts)

    def jacobian(self, values: np.ndarray, factors: dict) -> np.ndarray:
        """Return the derivative of the residual rows without the prior's."""
        parts = []
        for sensor in self.sensors:
            slope = coefficient_jacobian(self.model, sensor, values)
            for axis, factor in enumerate(factors[sensor]):
                parts.append(factor[:, :-1] @ slope[:, axis])
        return np.concatenate(parts)

    def linearised(
        self, sensor: str, values: np.ndarray, noise: NoiseModel
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return mean rows of one sensor, and the normal matrix of centred rows and prior.

        The mean rows are in coordinates of the parameters of the sensor.

        Directions fixed by the gauge are excluded: their weight would dominate the normal matrix.

        Returns
        -------
        tuple
            ``[design | residual]``, shape (n_windows, 3, q + 1), and the normal matrix of centred
            rows and prior, shape (q + 1, q + 1).

        """
        # Coordinates: the parameters of the sensor, without the directions that the gauge fixes.
        slope = coefficient_jacobian(self.model, sensor, values)
        own = np.flatnonzero(np.any(slope != 0, axis=(0, 1)))
        gauge = self.prior.gauge[:, own]
        basis = np.eye(len(own))
        if gauge.any():
            basis = scipy.linalg.null_space(gauge)
        slope = slope[:, :, own] @ basis

        # Mean rows.
        means = self.means[sensor]
        design = np.einsum('kp,paq->kaq', means[:, :-3], slope)
        rows = np.concatenate([design, self.misfit(sensor, means, values)[:, :, None]], axis=2)

        # Rows of the prior, then weighted centred rows of the three axes.
        root = self.prior.root[: -len(gauge) or None, own]
        used = np.flatnonzero(np.any(root != 0, axis=1))
        offset = self.prior.root[used] @ (self.prior.mean - values)
        parts = [np.concatenate([root[used] @ basis, offset[:, None]], axis=1)]
        for factor, weight in self.weighed_rows(sensor, noise):
            misfit = self.misfit(sensor, factor, values)
            for axis in range(3):
                columns = factor[:, :-3] @ slope[:, axis]
                centred = np.concatenate([columns, misfit[:, axis : axis + 1]], axis=1)
                parts.append(centred * weight[axis])
        stacked = np.concatenate(parts)
        return rows, stacked.T @ stacked
