"""Values that no instrument is known to have: what the catalogue knows of grades, held against a calibration."""

import numpy as np

from imu_calibration.calibration.document import Calibration


def implausible(calibration: Calibration) -> list[str]:
    """Return one line for each parameter group that lies outside what is known of any grade of instrument."""
    lines = []
    for effect in calibration.model.effects:
        if not effect.plausible:
            continue
        grade, largest, source = effect.plausible[-1]
        size = np.max(np.abs(effect.amplitudes(calibration.values[calibration.model.slices[effect.key]])))
        if size > 10 * largest:
            lines.append(f'{effect.sensor} {effect.name} reaches {size:.3g} {effect.unit_of(0)}, more than ten times what is known of {grade} instruments '
                         f'({largest:.3g}; {source}): check units and axes')
    return lines
