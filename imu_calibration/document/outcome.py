"""
Outcome of a calibration: parameters that count, samples left out, and the exit code.

Verbs, nodes, exports and reports use these functions, so that they agree.
"""

from dataclasses import dataclass

from imu_calibration.core.exit_codes import dropped_text, exit_code_of
from imu_calibration.document.calibration import Calibration, listed, never_applied
from imu_calibration.document.decision import HELPS, WARNING, reason_of
from imu_calibration.estimation.solution import DETERMINED

STATED_CHECKS = ('latitude', 'mount')
"""Checks of statements in the table description that the result contradicts: exit code 3."""


@dataclass(frozen=True)
class ParameterCount:
    """Requested parameters of the sensors: how many, and which are not determined."""

    requested: int
    """Requested parameters; those of the reference do not count."""
    lacking: tuple[str, ...]
    """Names of those that are weak or held."""

    @property
    def determined(self) -> int:
        """Requested parameters that are determined."""
        return self.requested - len(self.lacking)

    @property
    def figures(self) -> dict[str, int]:
        """The count as the nodes publish it on /diagnostics."""
        return {'parameters': self.requested, 'not determined': len(self.lacking)}


def parameter_count(calibration: Calibration) -> ParameterCount:
    """Return the count of the requested parameters of the sensors."""
    requested = calibration.requested
    lacking = tuple(name for name, status in requested.items() if status != DETERMINED)
    return ParameterCount(len(requested), lacking)


def missing(calibration: Calibration) -> str:
    """Return which requested parameters are not determined, as text; '' when all are."""
    count = parameter_count(calibration)
    if not count.lacking:
        return ''
    return (
        f'{len(count.lacking)} of {count.requested} parameters not determined'
        f' ({listed(count.lacking)})'
    )


def dropped_of(calibration: Calibration) -> tuple[dict[str, int], int]:
    """Return (reason -> dropped samples, samples without a fault) of a calibration."""
    statistics = calibration.statistics
    dropped = dict(statistics.get('dropped') or {})
    if unusable := statistics.get('unusable'):
        dropped['unusable'] = unusable
    # samples between windows have no fault: they count as kept
    kept = sum((statistics.get('samples_used') or {}).values())
    kept += sum((statistics.get('stream') or {}).values())
    return dropped, kept


def shortcomings(calibration: Calibration) -> list[str]:
    """Return the reasons for which the exit code is 3, a line each; empty for 0."""
    lines = []
    for sensor, word in calibration.decisions.items():
        if word is not HELPS:
            why = never_applied(calibration, sensor) or calibration.decision_reasons.get(sensor)
            lines.append(f'{sensor} {word}: {why or reason_of(calibration.proof.get(sensor))}')
    for sensor, why in (calibration.statistics.get('unusable_sensors') or {}).items():
        lines.append(f'{sensor} not calibrated: {why}')
    for entry in calibration.statistics.get('preflight') or ():
        if entry['check'] in STATED_CHECKS and entry.get('severity', WARNING) == WARNING:
            lines.append(entry['text'])
    for line in (missing(calibration), dropped_text(*dropped_of(calibration))):
        if line:
            lines.append(line)
    return lines


def exit_code(calibration: Calibration) -> int:
    """
    Return 0 when the calibration of every sensor is complete, else 3.

    It is 0 when each sensor helps, every requested parameter of the sensors is determined and at
    most DROPPED_SHARE of the samples were dropped.
    """
    return exit_code_of(shortcomings(calibration))
