"""Values that no instrument is known to have: what the catalogue knows of grades, held against a calibration."""

import numpy as np

from imu_calibration.calibration.document import Calibration

LOOK_FOR = {'reference': 'such tables are known for: look for a wrong description of the table, a loose mount, wrong stamps'}

ONE = 3.0
"""Standard deviations by which one coefficient of an effect must differ from its prior for the effect to be added."""


def one_significant(distance: np.ndarray, sd: np.ndarray) -> bool:
    """Return whether one of several coefficients differs from its prior by more than ONE standard deviations."""
    return bool(np.any(np.abs(distance) > ONE * sd))


def beyond_known(share: float, section: str) -> str:
    """Return what is said of an effect that explains a share of the rest with a size that is known of no instrument."""
    return (f'explains {100 * share:.0f} % of what the model leaves, but its size is beyond what '
            f'{LOOK_FOR.get(section, "such sensors are known for: look for saturation, a loose mount, a wrong scale")}')


def implausible(calibration: Calibration, sensor: str | None = None) -> list[str]:
    """Return one line for each parameter group, of a sensor or of any, that lies outside what is known of any grade of instrument."""
    lines = []
    for effect in calibration.model.effects:
        if sensor not in (None, effect.sensor):
            continue
        amplitudes = effect.amplitudes(calibration.values[calibration.model.slices[effect.key]])
        if effect.surpasses(amplitudes):
            grade, largest, source = effect.plausible[-1]
            size = max(map(abs, amplitudes))
            lines.append(f'{effect.sensor} {effect.name} reaches {size:.3g} {effect.unit_of(0)}, '
                         f'more than ten times what is known of {grade} instruments ({largest:.3g}; {source}): check units and axes')
    return lines
