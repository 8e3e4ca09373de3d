"""Implausible values: comparison of a calibration with the grades of instruments in the catalogue."""

import numpy as np

from imu_calibration.core.constants import DEG, STANDARD_GRAVITY
from imu_calibration.core.units import significant
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import Role

LOOK_FOR = {'reference': 'the literature values of tables: check the description of the table, the mount, the stamps'}

ONE = 3.0
"""Standard deviations by which one coefficient of an effect must differ from its prior for the effect to be added."""


def one_significant(distance: np.ndarray, sd: np.ndarray) -> bool:
    """Return whether one of several coefficients differs from its prior by more than ONE standard deviations."""
    return bool(np.any(np.abs(distance) > ONE * sd))


DIAGONAL = (0.5, 2.0)
"""Scale factors that an instrument in SI units can have: data sheets promise a few per cent."""
OFF_DIAGONAL = 0.5
"""Largest off-diagonal element: axes 30 degrees from orthogonal; the mount is part of the table description."""
LARGEST_BIAS = {'accelerometer': 16 * STANDARD_GRAVITY, 'gyroscope': 4000 * DEG}
"""The largest full scales of such sensors, m/s^2 and rad/s."""


def beyond_instruments(calibration: Calibration, sensor: str) -> str:
    """Return which value of a sensor's matrix or bias belongs to no instrument, with the limit; '' where none does."""
    matrix, bias = (np.asarray(calibration.of(sensor, role)) for role in (Role.LINEAR, Role.OFFSET))
    diagonal, off = np.diag(matrix), np.abs(matrix - np.diag(np.diag(matrix))).max()
    for value in (diagonal.min(), diagonal.max()):
        if not DIAGONAL[0] <= value <= DIAGONAL[1]:
            return f'a scale factor must be {DIAGONAL[0]:g} to {DIAGONAL[1]:g}, it is {significant(value)}'
    if off > OFF_DIAGONAL:
        return f'off-diagonal elements must be at most {OFF_DIAGONAL:g}, the largest is {significant(off)}'
    if np.abs(bias).max() > LARGEST_BIAS[sensor]:
        return f'a bias must be within full scale ({significant(LARGEST_BIAS[sensor])} SI), it is {significant(np.abs(bias).max())}'
    return ''


def beyond_known(share: float, section: str) -> str:
    """Return the message for an effect that explains a share of the excess variance with a size that no known instrument has."""
    return (f'explains {100 * share:.0f} % of the residual, but its size exceeds '
            f'{LOOK_FOR.get(section, "the literature values of such sensors: check saturation, the mount, the scale")}')


def implausible(calibration: Calibration, sensor: str | None = None) -> list[str]:
    """Return one line for each parameter group, of one sensor or of all, that is outside the range of all grades of instruments."""
    lines = []
    for effect in calibration.model.effects:
        if sensor not in (None, effect.sensor):
            continue
        amplitudes = effect.amplitudes(calibration.values[calibration.model.slices[effect.key]])
        if effect.surpasses(amplitudes):
            grade, largest, source = effect.plausible[-1]
            size = max(map(abs, amplitudes))
            lines.append(f'{effect.sensor} {effect.name} reaches {size:.3g} {effect.unit_of(0)}, '
                         f'more than ten times the known values of {grade} instruments ({largest:.3g}; {source}): check units and axes')
    return lines
