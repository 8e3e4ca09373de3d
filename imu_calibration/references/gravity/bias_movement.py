"""Drift of biases within the recording, estimated from the poses together with all parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

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
    """Departure from its mean in each pose, shape (k, 3), m/s^2 or rad/s."""
    growth: np.ndarray
    """
    Factor by which the sds of the sensor's bias and matrix grow when the drift is estimated too,
    shape (n,).
    """

    @property
    def size(self) -> np.ndarray:
        """Largest minus smallest on each axis, shape (3,)."""
        return np.ptp(self.course, axis=0)


def bias_movements(model: HandModel, values: np.ndarray, poses: Poses) -> dict[str, BiasMovement]:
    """
    Return sensor -> `BiasMovement` of the biases that move.

    They move beyond the scatter from pose to pose (F test of a parabola in time).
    """
    if not np.ptp(poses.time) > 0:
        return {}
    time = (poses.time - poses.time.mean()) / np.ptp(poses.time)
    residual, columns = model.norm_rows(values, poses.force, **poses.conditions)
    true = model.compensate(values, poses.force, np.zeros_like(poses.force), **poses.conditions)[0]
    turning = model.rate_rows(values, true, poses.rate, **poses.conditions)[0]
    base = columns[:, model.base_index('accelerometer')]
    found = {
        'accelerometer': _of_norms(time, residual, base),
        'gyroscope': _of_rates(time, turning),
    }
    return {sensor: movement for sensor, movement in found.items() if movement is not None}


def _powers(time: np.ndarray, count: int) -> np.ndarray:
    """Return time and, with enough poses, its square, without their means, shape (k, 1 or 2)."""
    powers = time[:, None]
    if count >= 2 * MIN_DRIFT_FREEDOM:
        powers = np.column_stack([time, time**2])
    return powers - powers.mean(axis=0)


def _of_norms(time: np.ndarray, residual: np.ndarray, base: np.ndarray) -> BiasMovement | None:
    """
    Return the drift of the accelerometer's bias, or None where it is not significant.

    Only its component along gravity is observable in a pose: a column of the drift is that of the
    bias times a power of time.
    """
    n_base = base.shape[1]
    powers = _powers(time, len(time) - n_base - 3)
    both = np.hstack([base, *(power[:, None] * base[:, 0:3] for power in powers.T)])

    # F test of the drift, on the columns that are independent.
    known = orthonormal_basis(base)
    new = orthonormal_basis(both)
    spare = len(time) - new.shape[1]
    square_before = np.sum((residual - known @ (known.T @ residual)) ** 2)
    square_after = np.sum((residual - new @ (new.T @ residual)) ** 2)
    n_added = new.shape[1] - known.shape[1]
    if spare < MIN_DRIFT_FREEDOM or not _shown(square_before, square_after, n_added, spare):
        return None

    # Growth of the sds by the columns that are estimated besides.
    fitted = np.linalg.lstsq(both, residual, rcond=1e-9)[0][n_base:].reshape(-1, 3)
    variance_before = np.diag(np.linalg.pinv(base.T @ base))
    variance_after = np.diag(np.linalg.pinv(both.T @ both))[:n_base]
    growth = variance_after / np.maximum(variance_before, 1e-300)
    return BiasMovement(powers @ fitted, np.sqrt(np.maximum(growth, 1.0)))


def _of_rates(time: np.ndarray, rates: np.ndarray) -> BiasMovement | None:
    """Return the drift of the gyroscope's bias, or None where it is not significant."""
    powers = _powers(time, len(time))
    spare = 3 * (len(time) - 1 - powers.shape[1])
    if spare < 3 * MIN_DRIFT_FREEDOM:
        return None
    rates = rates - rates.mean(axis=0)
    course = powers @ np.linalg.lstsq(powers, rates, rcond=None)[0]
    scale = np.mean((rates - course) ** 2, axis=0) + 1e-300
    square_before = np.sum(rates**2 / scale)
    square_after = np.sum((rates - course) ** 2 / scale)
    if not _shown(square_before, square_after, 3 * powers.shape[1], spare):
        return None
    return BiasMovement(course, np.ones(12))


def _shown(before: float, after: float, added: int, spare: int) -> bool:
    """Return whether the fall of a sum of squares by `added` columns is significant (F test)."""
    ratio = (before - after) / max(added, 1) / max(after / spare, 1e-300)
    return bool(added > 0 and fdtrc(added, spare, max(ratio, 0.0)) < DRIFT_P_VALUE)


def without_movement(poses: Poses, movements: Mapping[str, BiasMovement]) -> Poses:
    """
    Return the poses with the accelerometer's bias at its mean.

    The gyroscope's may differ between poses anyway.
    """
    moved = movements.get('accelerometer')
    return poses if moved is None else replace(poses, force=poses.force - moved.course)


def with_movement(
    covariance: np.ndarray, model: HandModel, movements: Mapping[str, BiasMovement]
) -> np.ndarray:
    """
    Return the covariance with the drift.

    The bias at any time of the recording is within one sd of the reported mean.
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
