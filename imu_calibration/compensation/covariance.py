"""Uncertainty of corrected samples from noise and parameters, to first order."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.compensation.angular_acceleration import CausalDerivative
from imu_calibration.compensation.compensate import FittedErrors, Transfer, invertible_values
from imu_calibration.compensation.kernel import make_kernel
from imu_calibration.compensation.rate_slope import SlopeError
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import coefficients_at_point, columns_at_point
from imu_calibration.kinematics.rotations import Reference

DIFFERENCE_STEPS = np.array([1e-3] * 3 + [1e-4] * 3 + [1e-2] * 3)
"""
Steps of the central differences in force, rate and derivative of the rate: small against the
curvature, large against rounding.
"""


MAX_KNOWN_COVARIANCE = 1e30
"""Covariances from this value on contain no information; below it no arithmetic overflows."""


def is_known(covariance: np.ndarray) -> bool:
    """
    Return whether a covariance from a message is usable.

    Neither NaN nor huge, variances not negative, not all zero.
    """
    return bool(
        np.all(np.abs(covariance) < MAX_KNOWN_COVARIANCE)
        and np.any(covariance)
        and np.all(np.diag(covariance) >= 0)
    )


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """
    Derivatives of corrected force and rate by their inputs at one sample, with covariances.

    The derivative of the rate is formed from the same readings as the rate, so their noise is
    correlated: the newest reading enters both.
    """

    gain: np.ndarray
    """
    d(force, rate) / d(measured force, measured rate, derivative of the measured rate), shape (6,
    9).
    """
    parameters: np.ndarray
    """Covariance of (force, rate) from the calibration's parameters, shape (6, 6)."""
    newest: float
    """Weight of the newest reading in the derivative, 1/s."""
    earlier: float
    """Sum of the squared weights of the earlier readings, 1/s^2."""
    slope_error: SlopeError
    """Error of the derivative in the present motion."""

    def with_slope_error(self, slope_error: SlopeError) -> 'Sensitivity':
        """
        Return the same with another derivative of the rate: its weights and its error.

        Without weights they are those of the full window, which the sensitivity has already.
        """
        weights = slope_error.weights
        if weights is None:
            return replace(self, slope_error=slope_error)
        newest = float(weights[0])
        earlier = float(weights[1:] @ weights[1:])
        return replace(self, newest=newest, earlier=earlier, slope_error=slope_error)

    def covariances(
        self, force_cov: np.ndarray, rate_cov: np.ndarray, with_parameters: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the covariances of corrected (force, rate), each shape (3, 3).

        ``A N_f A' + (B + w C) N_w (B + w C)' + v C N_w C' + C E C'`` with A, B, C the gains by
        force, rate and derivative, w the newest weight, v the earlier ones, and E the covariance of
        the derivative's error (its delay); plus the parameters' share.
        """
        error_cov = self.slope_error.covariance(rate_cov)
        results = []
        for k in (0, 3):  # force, rate
            by_force = self.gain[k : k + 3, 0:3]
            by_rate = self.gain[k : k + 3, 3:6]
            by_derivative = self.gain[k : k + 3, 6:9]
            by_newest = by_rate + self.newest * by_derivative
            total = by_force @ force_cov @ by_force.T + by_newest @ rate_cov @ by_newest.T
            total = total + by_derivative @ (self.earlier * rate_cov + error_cov) @ by_derivative.T
            if with_parameters:
                total = total + self.parameters[k : k + 3, k : k + 3]
            results.append(total)
        return results[0], results[1]


class Uncertainty:
    """
    Makes the `Sensitivity` at any sample.

    Parameters
    ----------
    calibration : Calibration
    transfer : compensation.Transfer, optional
    kernel : callable, optional
        That of `make_kernel` for both, if the caller has it.

    """

    def __init__(
        self,
        calibration: FittedErrors,
        transfer: Transfer | None = None,
        kernel: Callable | None = None,
    ):
        self._calibration = calibration
        self._model, self._values = invertible_values(calibration)
        self._kernel = kernel or make_kernel(calibration, transfer)
        """Correction of a sample to the target point and frame."""
        self._sensor_kernel = self._kernel if transfer is None else make_kernel(calibration)
        """Correction of a sample in the frame of the sensor."""
        self._inverse_rate = np.linalg.inv(calibration.of('gyroscope', Role.LINEAR))

        parameters = np.arange(len(calibration.values))
        slices = calibration.model.slices
        inverted = np.concatenate(
            [parameters[slices[effect.key]] for effect in self._model.effects]
        )
        self._covariance = calibration.covariance[np.ix_(inverted, inverted)]
        """Covariance of the parameters that the correction uses."""
        self._slopes = []
        """d(coefficients) / d(parameters) of each sensor, shape (n_params, n_columns, 3)."""
        for sensor in SENSORS:
            slopes = []
            for step in 1e-30j * np.eye(len(self._values)):  # complex steps
                moved = coefficients_at_point(self._model, sensor, self._values + step)
                slopes.append(moved.imag / 1e-30)
            self._slopes.append(np.stack(slopes))
        self.use(None)

    def use(self, derivative: CausalDerivative | None, period: float | None = None) -> None:
        """
        Use the weights of a CausalDerivative, or none, and the noise of samples `period` apart.

        The period is in s; None: that of the calibration.
        """
        noise = []
        for sensor in SENSORS:
            sample_sd, _ = self._calibration.noise(sensor, period)
            noise.append(np.diag(sample_sd**2))
        self.noise = tuple(noise)
        """Covariances of a sample of (force, rate) by the calibration, each shape (3, 3)."""
        weights = np.zeros(1) if derivative is None else derivative.weights
        self._newest = float(weights[0])
        """As in `Sensitivity`, 1/s."""
        self._earlier = float((weights[1:] ** 2).sum())
        """As in `Sensitivity`, 1/s^2."""

    def at(
        self,
        force: tuple[float, float, float] | np.ndarray = (0.0, 0.0, 9.8),
        rate: tuple[float, float, float] | np.ndarray = (0.0, 0.0, 0.0),
        derivative: tuple[float, float, float] | np.ndarray = (0.0, 0.0, 0.0),
        *,
        warming: float = 0.0,
        branch: float = 0.0,
        vibration: tuple[float, ...] = (0.0, 0.0, 0.0),
        slope_error: SlopeError | None = None,
    ) -> Sensitivity:
        """
        Return the Sensitivity at a measured sample.

        Parameters
        ----------
        force, rate, derivative : sequence of 3 floats
            Measured specific force, rate, and derivative of the rate.
        warming : float
            Temperature above the calibration's reference temperature, K.
        branch : float
            Thermal branch (`kinematics.signal_history`).
        vibration : tuple of 3 floats
            How much it vibrates (`kinematics.signal_history`), (m/s^2)^2.
        slope_error : rate_slope.SlopeError, optional
            Error of the derivative; None: noise only.

        """
        sample = np.concatenate([force, rate, derivative])
        conditions = (warming, branch, *vibration)
        slopes = [self._slope(sample, step, conditions) for step in np.diag(DIFFERENCE_STEPS)]
        gain = np.stack(slopes, axis=1)

        # d(corrected) / d(parameters) is that of the measured sample, up to its sign, which a
        # covariance does not show.
        true = np.array(self._sensor_kernel(*sample.tolist(), *conditions))
        alpha = self._inverse_rate @ sample[6:]
        jacobian = gain[:, :6] @ self._parameter_slopes(true, alpha, conditions)
        sensitivity = Sensitivity(
            gain=gain,
            parameters=jacobian @ self._covariance @ jacobian.T,
            newest=self._newest,
            earlier=self._earlier,
            slope_error=SlopeError(),
        )
        return sensitivity.with_slope_error(slope_error or SlopeError())

    def _slope(
        self, sample: np.ndarray, step: np.ndarray, conditions: tuple[float, ...]
    ) -> np.ndarray:
        """
        Return the central difference of the corrected (force, rate) by one input, shape (6,).

        Sample and step are in (force, rate, derivative), shape (9,); the step has one element that
        is not zero. `conditions` are warming (K), thermal branch and three of vibration.
        """
        above = self._kernel(*(sample + step).tolist(), *conditions)
        below = self._kernel(*(sample - step).tolist(), *conditions)
        return (np.array(above) - below) / (2 * step.sum())

    def _parameter_slopes(
        self, true: np.ndarray, alpha: np.ndarray, conditions: tuple[float, ...]
    ) -> np.ndarray:
        """
        Return d(measured force, rate) / d(parameters), shape (6, n_params).

        At the true force and rate, shape (6,), with the angular acceleration, shape (3,).
        `conditions` as in `_slope`.
        """
        warming, branch, *vibration = conditions
        ref = Reference(
            time=np.zeros(1),
            mat_sn=np.eye(3)[None],
            force_s=true[None, :3],
            rate_s=true[None, 3:],
            alpha_s=alpha[None],
            gravity=0.0,
            temperature_c=np.full(1, self._model.temperature_ref_c + warming),
            branch=np.full(1, branch),
            shaking=np.array([vibration]),
        )
        sensor_slopes = []
        for sensor, slopes in zip(SENSORS, self._slopes):
            columns = columns_at_point(self._model, sensor, ref)[0]
            sensor_slopes.append(np.einsum('c,pci->ip', columns, slopes))
        return np.concatenate(sensor_slopes)
