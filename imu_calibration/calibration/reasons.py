"""Statements about a calibration: decisions, warnings and notes, with the next step."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from imu_calibration.calibration.document import Calibration
from imu_calibration.effects.base import SENSORS
from imu_calibration.errors import with_hint


class StatementKind(StrEnum):
    """Kind of a statement."""

    DECISION = 'decision'
    """The decision on a sensor."""
    PARAMETERS = 'parameters'
    """How many parameters are within their tolerance, or which are not."""
    WARNING = 'warning'
    """A finding that the user should follow up."""
    NOTE = 'note'
    """A remark."""


DECISION, PARAMETERS, WARNING, NOTE = StatementKind
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
    """One statement about the calibration."""

    word: StatementKind
    """Its kind."""
    what: str
    """The statement."""
    next: str
    """The next step; empty when no action is needed."""
    key: str | None = None
    """The input needed for it, a key of `errors.KEYS`."""
    sensors: tuple[str, ...] = SENSORS
    """Sensors with parameters that it concerns."""

    def advice(self, hints: dict[str, str] | None = None) -> str:
        """Return the next step with the local name of its key (`errors.with_hint`); empty for none."""
        return with_hint(self.next, self.key, hints or {}) if self.next else ''


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
