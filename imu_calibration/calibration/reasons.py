"""What speaks for or against a calibration, one thing at a time, and the words for it."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from imu_calibration.calibration.document import Calibration
from imu_calibration.effects.base import SENSORS


class Judgement(StrEnum):
    """What a reason, or all of them together, say of a calibration."""

    GOOD = 'good'
    """Use it."""
    WEAK = 'weak'
    """Usable, with gaps."""
    BAD = 'bad'
    """Do not use it as it is."""
    NOTE = 'note'
    """A reason that leaves the verdict alone."""


GOOD, WEAK, BAD, NOTE = Judgement
MISFIT = 10.0
"""Moving windows that scatter by more than this factor in variance beyond the noise at rest do not fit the model."""
LOOSE = 2.0
"""From this factor on the misfit is worth a note."""
SHOWN_NAMES = 6
"""Names listed one by one; of more, the groups are named."""
HAND_AXES = 'accelerometer_lower_triangular'
"""The axes of a calibration by hand."""


@dataclass(frozen=True)
class Reason:
    """One thing that speaks for or against the calibration."""

    word: Judgement
    """What it says."""
    what: str
    """What was seen."""
    next: str
    """What to do about it; empty when nothing has to be done."""
    key: str | None = None
    """What has to be given for it, a key of `errors.KEYS`."""
    sensors: tuple[str, ...] = SENSORS
    """Whose parameters it concerns."""


def misfit_ratios(calibration: Calibration, sensor: str) -> dict[str, float]:
    """Return kind of window -> variance of what is left of the sensor there, over that of its noise."""
    chi2 = calibration.statistics.get(sensor, {}).get('chi2_per_dof') or {}
    return {kind: ratio for kind, ratio in chi2.items() if kind != 'means'}


def quiet(calibration: Calibration) -> str:
    """
    Return what residuals in motion are compared with.

    Without a rest only their own slow part is there, and lags show in the fast one.
    """
    return 'the noise at rest' if rested(calibration) else 'their slow part (a lag or a late clock leaves that)'


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
