"""
Outcome of a calibration: determined parameters, dropped samples, and the exit code.

Verbs, nodes, exports and reports use these functions, so that they agree.
"""

from dataclasses import dataclass

from imu_calibration.core.exit_codes import dropped_text, exit_code_of
from imu_calibration.document.calibration import Calibration, listed, never_applied
from imu_calibration.document.decision import (
    HELPS,
    UNPROVEN,
    WARNING,
    SensorDecision,
    reason_of,
)
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
    unusable = statistics.get('unusable')
    if unusable:
        dropped['unusable'] = unusable
    # Samples between windows have no fault.
    n_valid = sum((statistics.get('samples_used') or {}).values())
    n_valid += sum((statistics.get('stream') or {}).values())
    return dropped, n_valid


@dataclass(frozen=True)
class DecisionLimit:
    """The best decision that any recording can give on a sensor, where that is not `helps`."""

    decision: SensorDecision
    """The decision."""
    why: str
    """Its reason."""


def decision_limits(
    calibration: Calibration, *, own_recording: bool = True
) -> dict[str, DecisionLimit]:
    """
    Return sensor -> limit of the decision on it.

    On the recording of the calibration (`own_recording`) its decision is the limit: the errors of
    the same readings are no further evidence. On a different one, only values that compensation
    never applies limit the decision.
    """
    limits = {}
    for sensor, decision in calibration.decisions.items():
        if decision is HELPS:
            continue
        refusal = never_applied(calibration, sensor)
        if not own_recording:
            if refusal:
                limits[sensor] = DecisionLimit(UNPROVEN, refusal)
            continue
        why = refusal or calibration.decision_reasons.get(sensor)
        limits[sensor] = DecisionLimit(decision, why or reason_of(calibration.proof.get(sensor)))
    return limits


def shortcomings(calibration: Calibration) -> list[str]:
    """Return the reasons for which the exit code is 3, a line each; empty for 0."""
    lines = []
    for sensor, limit in decision_limits(calibration).items():
        lines.append(f'{sensor} {limit.decision}: {limit.why}')
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


class JudgedResult:
    """Exit code of a result with a calibration, and its reasons."""

    @property
    def calibration(self) -> Calibration:
        """The calibration."""
        raise NotImplementedError

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        return shortcomings(self.calibration)

    @property
    def exit_code(self) -> int:
        """
        0 when each sensor helps and nothing is missing, otherwise 3.

        Nothing is missing when every requested parameter of the sensors is determined and at most
        1 % of the samples were dropped.
        """
        return exit_code(self.calibration)
