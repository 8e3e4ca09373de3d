"""Words and figures that the statements about a calibration share."""

from collections.abc import Sequence

from imu_calibration.document.calibration import Calibration

MISFIT = 10.0
"""Moving windows that scatter by more than this factor in variance beyond the noise at rest do not fit the model."""
LOOSE = 2.0
"""From this factor on the misfit is worth a note."""
SHOWN_NAMES = 6
"""Names listed one by one; of more, the groups are named."""
HAND_AXES = 'accelerometer_lower_triangular'
"""The axes of a calibration by hand."""




def misfit_ratios(calibration: Calibration, sensor: str) -> dict[str, float]:
    """Return kind of window -> ratio of the residual variance of the sensor to its noise variance."""
    chi2 = calibration.statistics.get(sensor, {}).get('chi2_per_dof') or {}
    return {kind: ratio for kind, ratio in chi2.items() if kind != 'means'}


def quiet(calibration: Calibration) -> str:
    """
    Return the name of the reference that residuals in motion are compared with.

    Without a rest it is their slow part; lags are visible in the fast part.
    """
    return 'the noise at rest' if rested(calibration) else 'their slow part (as after a lag or a late clock)'


def rested(calibration: Calibration) -> bool:
    """Return whether a recording on a table has rests, from which the noise is known."""
    windows = calibration.statistics.get('windows')
    return windows is None or bool(windows.get('static'))


def listed(names: Sequence[str]) -> str:
    """Return names in a sentence; of many, the groups with their numbers."""
    if len(names) <= SHOWN_NAMES:
        return ', '.join(names)
    groups = {}
    for name in names:
        groups.setdefault(name.rpartition('.')[0], []).append(name.rpartition('.')[2])
    return ', '.join(f'{group} ({len(members)}: {", ".join(members)})' for group, members in groups.items())
