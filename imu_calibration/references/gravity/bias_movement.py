"""Drift of biases within the recording, estimated from the poses together with all parameters."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from imu_calibration.estimation.scaled_solve import orthonormal_basis
from imu_calibration.preprocessing.recording_evidence import WARNING, CheckFinding
from imu_calibration.references.gravity.equations import Poses
from imu_calibration.references.gravity.hand_parameters import HandModel

DRIFT_P_VALUE = 1e-3
"""A drift is significant below this p-value."""
MIN_DRIFT_FREEDOM = 6
"""Least number of poses beyond the columns."""


@dataclass(frozen=True, eq=False)
class BiasMovement:
    """The smooth course of one sensor's bias over the poses."""

    course: np.ndarray
    """Departure of the bias from its mean in each pose, shape (k, 3), m/s^2 or rad/s."""
    growth: np.ndarray
    """
    Factor by which the sds of the sensor's bias and matrix grow when the drift is estimated too,
    shape (n,).
    """

    @property
    def size(self) -> np.ndarray:
        """Largest minus smallest departure on each axis, shape (3,)."""
        return np.ptp(self.course, axis=0)


def bias_movements(model: HandModel, values: np.ndarray, poses: Poses) -> dict[str, BiasMovement]:
    """
    Return sensor -> `BiasMovement` of the biases that drift significantly.

    The drift is a parabola in time, tested against the scatter from pose to pose (F test).
    """
    if not np.ptp(poses.time) > 0:
        return {}
    time = (poses.time - poses.time.mean()) / np.ptp(poses.time)
    movements = {}

    # Accelerometer: lengths of gravity, with the columns of bias and matrix.
    norm_residual, columns = model.norm_rows(values, poses.force, **poses.conditions)
    base = columns[:, model.base_index('accelerometer')]
    of_accelerometer = _movement_of_norms(time, norm_residual, base)
    if of_accelerometer is not None:
        movements['accelerometer'] = of_accelerometer

    # Gyroscope: rates at rest without the effects of the model.
    at_rest = np.zeros_like(poses.force)
    true_force, _ = model.compensate(values, poses.force, at_rest, **poses.conditions)
    rate_residual, _ = model.rate_rows(values, true_force, poses.rate, **poses.conditions)
    of_gyroscope = _movement_of_rates(time, rate_residual)
    if of_gyroscope is not None:
        movements['gyroscope'] = of_gyroscope
    return movements


def _powers(time: np.ndarray, freedom: int) -> np.ndarray:
    """
    Return time and, with enough degrees of freedom, its square, less their means, (k, 1 or 2).
    """
    powers = time[:, None]
    if freedom >= 2 * MIN_DRIFT_FREEDOM:
        powers = np.column_stack([time, time**2])
    return powers - powers.mean(axis=0)


def _movement_of_norms(
    time: np.ndarray, residual: np.ndarray, linear_columns: np.ndarray
) -> BiasMovement | None:
    """
    Return the drift of the accelerometer's bias, or None where it is not significant.

    Only its component along gravity is observable in a pose: a column of the drift is that of the
    bias times a power of time.

    Parameters
    ----------
    time : array, shape (k,)
        Times of the poses, in units of the time from the first to the last.
    residual : array, shape (k,)
        ``|true force| - gravity``, m/s^2.
    linear_columns : array, shape (k, n_linear)
        Columns of bias (first three) and matrix.

    """
    n_linear = linear_columns.shape[1]
    powers = _powers(time, len(time) - n_linear - 3)
    drift_columns = [power[:, None] * linear_columns[:, 0:3] for power in powers.T]
    columns = np.hstack([linear_columns, *drift_columns])

    # F test of the drift, on the columns that are independent.
    basis_before = orthonormal_basis(linear_columns)
    basis_after = orthonormal_basis(columns)
    spare = len(time) - basis_after.shape[1]
    square_before = np.sum((residual - basis_before @ (basis_before.T @ residual)) ** 2)
    square_after = np.sum((residual - basis_after @ (basis_after.T @ residual)) ** 2)
    n_added = basis_after.shape[1] - basis_before.shape[1]
    if spare < MIN_DRIFT_FREEDOM:
        return None
    if not _is_significant(square_before, square_after, n_added, spare):
        return None

    # Growth of the sds of bias and matrix when the drift is estimated too.
    drift = np.linalg.lstsq(columns, residual, rcond=1e-9)[0][n_linear:].reshape(-1, 3)
    variance_before = np.diag(np.linalg.pinv(linear_columns.T @ linear_columns))
    variance_after = np.diag(np.linalg.pinv(columns.T @ columns))[:n_linear]
    growth = variance_after / np.maximum(variance_before, 1e-300)
    return BiasMovement(powers @ drift, np.sqrt(np.maximum(growth, 1.0)))


def _movement_of_rates(time: np.ndarray, rates: np.ndarray) -> BiasMovement | None:
    """
    Return the drift of the gyroscope's bias, or None where it is not significant.

    `time` as for `_movement_of_norms`; `rates`: residual rates at rest, rad/s, shape (k, 3).
    """
    powers = _powers(time, len(time))
    spare = 3 * (len(time) - 1 - powers.shape[1])
    if spare < 3 * MIN_DRIFT_FREEDOM:
        return None
    rates = rates - rates.mean(axis=0)
    course = powers @ np.linalg.lstsq(powers, rates, rcond=None)[0]
    variance = np.mean((rates - course) ** 2, axis=0) + 1e-300
    square_before = np.sum(rates**2 / variance)
    square_after = np.sum((rates - course) ** 2 / variance)
    if not _is_significant(square_before, square_after, 3 * powers.shape[1], spare):
        return None
    # Drift and matrix are estimated from different data, rests and turns: no sd grows.
    return BiasMovement(course, np.ones(12))


def _is_significant(square_before: float, square_after: float, n_added: int, spare: int) -> bool:
    """
    Return whether the decrease of a sum of squares by `n_added` columns is significant (F test).

    `spare`: degrees of freedom of the residual with these columns.
    """
    ratio = (square_before - square_after) / max(n_added, 1) / max(square_after / spare, 1e-300)
    return bool(n_added > 0 and fdtrc(n_added, spare, max(ratio, 0.0)) < DRIFT_P_VALUE)


def with_movement(
    covariance: np.ndarray, model: HandModel, movements: Mapping[str, BiasMovement]
) -> np.ndarray:
    """
    Return the covariance (n, n) of the parameters when the biases drift.

    The sds of a drifting sensor grow (`BiasMovement.growth`). Half the size of the drift is added
    to the covariance of the bias as an sd, so that the bias at any time of the recording is within
    one sd of the reported mean.
    """
    grown = covariance.copy()
    for sensor, movement in movements.items():
        index = model.base_index(sensor)
        factor = np.ones(model.size)
        factor[index] = movement.growth
        grown *= np.outer(factor, factor)
        grown[index[:3], index[:3]] += (movement.size / 2) ** 2
    return grown


def notes(moved: Mapping[str, float], duration: float) -> tuple[CheckFinding, ...]:
    """Return the notes for the user: sensor -> distance moved in SI, over `duration` s."""
    span = f'{duration / 60:.0f} minutes' if duration >= 90 else f'{duration:.0f} s'
    sizes = {'accelerometer': (1e3 / STANDARD_GRAVITY, 'mg'), 'gyroscope': (1 / DEG, 'deg/s')}
    return tuple(
        CheckFinding(
            'bias_drift',
            WARNING,
            f'{sensor} bias moved by {size * sizes[sensor][0]:.2g} {sizes[sensor][1]} in {span}, '
            'which is in its sd; let the sensor warm up before recording, '
            'or record imu/temperature and request a thermal bias',
        )
        for sensor, size in moved.items()
    )
