"""Accumulated windows as rows of least squares, with the columns of a model and the prior."""

from collections.abc import Iterator

import numpy as np
import scipy.linalg

from imu_calibration.effects.forward_equations import coefficient_jacobian, coefficients
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.held_parameters import Factors
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.scaled_solve import triangular
from imu_calibration.references.turntable.accumulator import Accumulator, WindowBlock
from imu_calibration.references.turntable.estimation.window_means import WindowMeans
from imu_calibration.references.turntable.noise_model import NoiseModel


class WeightedSystem(WindowMeans):
    """
    Accumulated windows as rows ``[columns | output]``, for any parameters and noise.

    A sensor has mean rows, one for each window, and centred rows: the deviations of the samples of
    moving windows from their means, reduced to one triangular factor for each kind of window. With
    the coefficients B(values) of a sensor, the residual is ``output - columns @ B``.

    Parameters
    ----------
    accumulator : Accumulator
    model : SensorModel
        Its columns are those of the rows.

    """

    def __init__(self, accumulator: Accumulator, model: SensorModel):
        self.model = model
        self.prior = make_prior(model)
        self.accumulator = accumulator
        self.windows = accumulator.rows
        self.means = {}
        """Sensor -> mean rows, shape (n_windows, p + 3)."""
        self.within: dict[str, dict[str, np.ndarray]] = {}
        """Sensor -> kind -> factor of the centred rows."""
        for sensor in self.sensors:
            self.means[sensor] = np.array([window.sensors[sensor].mean for window in self.windows])
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
            whitening = self.mean_rows(design, noises[sensor]).whitening()
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
        means_of_axes = [means[:, self.columns_and_output(sensor, axis)] for axis in range(3)]
        return self.mean_rows(np.stack(means_of_axes, axis=1), noise).white()

    def columns_and_output(self, sensor: str, axis: int) -> list[int]:
        """Return the places of all columns and of the output of one axis in rows of a sensor."""
        p = self.means[sensor].shape[1] - 3
        return [*range(p), p + axis]

    def factors(self, sensor: str, noise: NoiseModel) -> list[np.ndarray]:
        """
        Return for each axis the triangular factor of all whitened rows ``[columns | output]``.

        Each has the shape (p + 1, p + 1) or less, and the sums of squares of all rows.
        """
        white = self.whitened_means(sensor, noise)
        centred = list(self.weighed_rows(sensor, noise))
        factors = []
        for axis in range(3):
            places = self.columns_and_output(sensor, axis)
            parts = [white[:, axis]]
            parts += [rows[:, places] * weight[axis] for rows, weight in centred]
            factors.append(triangular(np.concatenate(parts)))
        return factors

    def weighed_rows(
        self, sensor: str, noise: NoiseModel, block: WindowBlock | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """
        Yield (centred rows ``[columns | output]``, weight of each axis, shape (3,)).

        For each kind of window all rows, then the rows of their slow part with the weight that they
        have in addition, if any. The rows are those of one block, by default of all windows.
        """
        source: Accumulator | WindowBlock = block or self.accumulator
        for kind in self.within[sensor]:
            if (sensor, kind) in source.within:
                yield source.within[sensor, kind], 1 / np.sqrt(noise.row_variance(kind))
            extra = noise.slow_weight(kind)
            if extra.any() and (sensor, kind) in source.slow:
                yield source.slow[sensor, kind], extra

    def linearise(self, values: np.ndarray, factors: Factors) -> Rows:
        """
        Return the rows ``[design | residual]`` of all sensors and axes, linearised at the values.

        `factors` are the triangular factors of the weighted rows (`factors`).
        """
        parts = []
        for sensor in self.sensors:
            coefficient = coefficients(self.model, sensor, values)
            slope = coefficient_jacobian(self.model, sensor, values)
            for axis, factor in enumerate(factors[sensor]):
                residual = factor[:, -1] - factor[:, :-1] @ coefficient[:, axis]
                parts.append(np.column_stack([factor[:, :-1] @ slope[:, axis], residual]))
        equations = np.concatenate(parts)[:, None]
        return Rows(equations=equations, variance=np.ones(equations.shape[:2]))

    def residual(self, values: np.ndarray, factors: Factors) -> np.ndarray:
        """Return the residual of `linearise` without the derivatives, shape (m,)."""
        parts = []
        for sensor in self.sensors:
            coefficient = coefficients(self.model, sensor, values)
            for axis, factor in enumerate(factors[sensor]):
                parts.append(factor[:, -1] - factor[:, :-1] @ coefficient[:, axis])
        return np.concatenate(parts)

    def linearised(self, sensor: str, values: np.ndarray, noise: NoiseModel) -> Rows:
        """
        Return the mean rows ``[design | residual]`` of one sensor at the values.

        Their `products` are those of the weighted centred rows and of the prior. The columns are
        coordinates of the parameters that act on the sensor, without the directions that the gauge
        fixes: their weight would dominate the products.
        """
        # Coordinates: an orthonormal basis of the directions that the gauge leaves free.
        slope = coefficient_jacobian(self.model, sensor, values)
        acting = np.flatnonzero(np.any(slope != 0, axis=(0, 1)))
        gauge = self.prior.gauge[:, acting]
        basis = np.eye(len(acting))
        if gauge.any():
            basis = scipy.linalg.null_space(gauge)
        slope = slope[:, :, acting] @ basis

        # Mean rows.
        means = self.means[sensor]
        design = np.einsum('kp,paq->kaq', means[:, :-3], slope)
        rows = np.concatenate([design, self.misfit(sensor, means, values)[:, :, None]], axis=2)

        # Rows of the prior of these parameters.
        root = self.prior.root_without_gauge
        root = root[np.any(root[:, acting] != 0, axis=1)]
        offset = root @ (self.prior.mean - values)
        parts = [np.concatenate([root[:, acting] @ basis, offset[:, None]], axis=1)]

        # Weighted centred rows of the three axes.
        for factor, weight in self.weighed_rows(sensor, noise):
            misfit = self.misfit(sensor, factor, values)
            for axis in range(3):
                columns = factor[:, :-3] @ slope[:, axis]
                centred = np.concatenate([columns, misfit[:, axis : axis + 1]], axis=1)
                parts.append(centred * weight[axis])
        stacked = np.concatenate(parts)
        return self.mean_rows(rows, noise, stacked.T @ stacked)
