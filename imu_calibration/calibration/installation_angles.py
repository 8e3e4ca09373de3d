"""
Scale factors and the nine installation angles that a sensor matrix contains.

They are in the units of the papers as well.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from imu_calibration.core.readings import RawReadings
from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import Role


@dataclass(frozen=True, eq=False)
class Derived:
    """
    Parameters of the three sensing elements, derived from the matrix of one sensor.

    Row i of the matrix is ``scale_i * unit vector along element i`` (Zhang 2017, eq. 5-9, with the
    rows of the cosines normalised).
    """

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    scale: np.ndarray
    """Scale factor of each element, shape (3,)."""
    scale_sd: np.ndarray
    """Its standard deviation, shape (3,)."""
    angles: np.ndarray
    """Angle between element i and sensor axis j, rad, shape (3, 3)."""
    angles_sd: np.ndarray
    """Its standard deviation, rad, shape (3, 3)."""
    between: np.ndarray
    """Angles between the elements xy, yz, xz, rad, shape (3,)."""
    between_sd: np.ndarray
    """Their standard deviations, rad, shape (3,)."""
    bias: np.ndarray
    """Reading at zero input, SI, shape (3,)."""
    bias_sd: np.ndarray
    """Its standard deviation, shape (3,)."""


AXIS_PAIRS = ((0, 1), (1, 2), (0, 2))


def derive(calibration: Calibration, sensor: str) -> Derived:
    """
    Return the `Derived` of one sensor, standard deviations to first order from the full covariance.

    Parameters
    ----------
    calibration : Calibration
    sensor : str
        'accelerometer' or 'gyroscope'.

    """
    # Row i of the matrix is scale_i axis_i, with a unit vector axis_i.
    scale, axes = split(calibration.of(sensor, Role.LINEAR))
    linear = calibration.model.part(sensor, Role.LINEAR)
    covariance = calibration.covariance[linear, linear]

    # d scale_i / d row_i = axis_i,   d axis_i / d row_i = (1 - axis_i axis_i') / scale_i.
    tangent = (np.eye(3) - axes[:, :, None] * axes[:, None, :]) / scale[:, None, None]
    scale_sd = np.zeros(3)
    angles_sd = np.zeros((3, 3))
    for i, axis in enumerate(axes):
        row_cov = covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        axis_cov = tangent[i] @ row_cov @ tangent[i]
        scale_sd[i] = np.sqrt(axis @ row_cov @ axis)
        for j in range(3):
            angles_sd[i, j] = _angle_sd(axis, j, axis_cov)

    between = np.zeros(3)
    between_sd = np.zeros(3)
    for k, (i, j) in enumerate(AXIS_PAIRS):
        between[k] = _angle(axes[i], axes[j])
        between_sd[k] = _between_sd(axes, tangent, covariance, i, j)
    return Derived(
        sensor=sensor,
        scale=scale,
        scale_sd=scale_sd,
        angles=angles_of(axes),
        angles_sd=angles_sd,
        between=between,
        between_sd=between_sd,
        bias=calibration.of(sensor, Role.OFFSET),
        bias_sd=calibration.sd[calibration.model.part(sensor, Role.OFFSET)],
    )


def split(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (scale factors, unit vectors along the elements) of a sensor matrix.

    Shapes (3,) and (3, 3).
    """
    scale = np.linalg.norm(matrix, axis=1)
    return scale, matrix / scale[:, None]


def angles_of(axes: np.ndarray) -> np.ndarray:
    """
    Return the angle between each unit vector and each coordinate axis, rad.

    Exact for small angles too, shape (n, 3).
    """
    axes = np.asarray(axes, float)
    across = np.stack([np.hypot(axes[:, j - 2], axes[:, j - 1]) for j in range(3)], axis=1)
    return np.arctan2(across, axes)


def _angle(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle between two vectors, exact also near 0 and pi."""
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))


def _angle_sd(axis: np.ndarray, j: int, axis_cov: np.ndarray) -> float:
    """
    Return the sd of the angle to coordinate axis j.

    Near zero, where the angle has no slope, that of one component of the tilt.
    """
    # angle = atan2(s, a_j) with the sine s, the length of the part of the axis across j:
    # d angle / d a_k = a_j a_k / s,   d angle / d a_j = -s
    others = [k for k in range(3) if k != j]
    sine = np.linalg.norm(axis[others])
    tilt_variance = np.trace(axis_cov[np.ix_(others, others)])
    if sine**2 <= tilt_variance:
        # The trace is the sum of the variances of two components.
        return float(np.sqrt(tilt_variance / 2))
    slope = axis[j] * axis / sine
    slope[j] = -sine
    return float(np.sqrt(slope @ axis_cov @ slope))


def _between_sd(
    axes: np.ndarray, tangent: np.ndarray, covariance: np.ndarray, i: int, j: int
) -> float:
    """
    Return the sd of the angle between the axes i and j, cos(angle) = axis_i . axis_j.

    ``d angle = -(axis_j . d axis_i + axis_i . d axis_j) / sin(angle)``.
    """
    slope = np.zeros(9)
    slope[3 * i : 3 * i + 3] = axes[j] @ tangent[i]
    slope[3 * j : 3 * j + 3] = axes[i] @ tangent[j]
    sine = max(np.linalg.norm(np.cross(axes[i], axes[j])), 1e-9)
    return float(np.sqrt(slope @ covariance @ slope) / sine)


class PaperValues(NamedTuple):
    """Three values of a sensor in the unit of the source papers."""

    quantity: str
    unit: str
    values: np.ndarray
    """Shape (3,)."""
    sds: np.ndarray
    """Standard deviations of the values, shape (3,)."""


def in_paper_units(
    derived: Derived, nominal: RawReadings | Mapping | None = None
) -> tuple[PaperValues, ...]:
    """
    Return scale factors and biases in the units of the source papers.

    Accelerometers: V/g and V for a recording in volts (`nominal` given), else g/g and mg.
    Gyroscopes: V/(deg/s) and V, else the plain ratio and deg/s.

    Parameters
    ----------
    derived : Derived
    nominal : RawReadings, optional
        The conversion with which the recording was read; None: the recording is in SI units.

    """
    accelerometer = derived.sensor == 'accelerometer'
    size = STANDARD_GRAVITY if accelerometer else DEG
    name = 'g' if accelerometer else '(deg/s)'

    # A recording in SI units: the scale factor is a ratio.
    if nominal is None:
        bias_factor, unit = (1e3 / STANDARD_GRAVITY, 'mg') if accelerometer else (1 / DEG, 'deg/s')
        return (
            PaperValues('scale factor', f'{name}/{name}', derived.scale, derived.scale_sd),
            PaperValues('bias', unit, derived.bias * bias_factor, derived.bias_sd * bias_factor),
        )

    # A recording in volts, SI = (volts - offset) / per_si: the nominal conversion is undone.
    nominal = nominal if isinstance(nominal, RawReadings) else RawReadings.of_scales(**nominal)
    stated = nominal.accelerometer if accelerometer else nominal.gyroscope
    offset = np.asarray(stated.offset)
    per_si = np.asarray(stated.scale)
    return (
        PaperValues(
            'scale factor',
            f'V/{name}',
            derived.scale * per_si * size,
            derived.scale_sd * abs(per_si) * size,
        ),
        PaperValues('bias', 'V', offset + derived.bias * per_si, derived.bias_sd * abs(per_si)),
    )
