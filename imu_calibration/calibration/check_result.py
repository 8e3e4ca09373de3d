"""Result of the check of a calibration on another recording: the same for every reference."""

from dataclasses import dataclass, field

from imu_calibration.core.exit_codes import exit_code_of
from imu_calibration.core.settings import CHANGE
from imu_calibration.document.change import RegimeChange
from imu_calibration.document.decision import (
    HELPS,
    SensorDecision,
    decide,
    most_cautious,
    reason_of,
    worse_regimes,
)
from imu_calibration.document.outcome import DecisionLimit
from imu_calibration.document.proof_entry import Proof

TOO_FEW_WINDOWS = 'fewer than three windows of rest or motion were found; record for longer'
"""Why there is no proof on a table."""
OWN_RECORDING = 'it was calibrated from this recording: the result can differ on new recordings'
"""Note on a check with the recording of the calibration."""


@dataclass(frozen=True, eq=False)
class CheckResult:
    """The errors of a calibration on a recording."""

    proof: Proof
    """Sensor -> error before and after by regime (see `proof.prove`); {}: not determined."""
    findings: tuple = ()
    """Findings of the checks of the recording."""
    why: str = TOO_FEW_WINDOWS
    """Why there is no proof, where there is none."""
    notes: tuple[str, ...] = ()
    """Notes on the result."""
    limits: dict[str, DecisionLimit] = field(default_factory=dict)
    """Sensor -> best decision that this recording can give (`outcome.decision_limits`)."""
    changes: tuple[RegimeChange, ...] = ()
    """Error now against the held-out error in the file of the calibration, by regime."""
    change_limit: float = CHANGE
    """Factor of the error from which a significant change counts."""
    dropped: str = ''
    """Why dropped samples make the result incomplete; '' where they do not."""
    sensors: tuple[str, ...] = ()
    """Sensors of the calibration: each without an entry in the proof is unproven."""

    @property
    def judged(self) -> tuple[str, ...]:
        """The sensors on which there is a decision."""
        return tuple(dict.fromkeys((*self.proof, *self.sensors)))

    @property
    def changed(self) -> tuple[RegimeChange, ...]:
        """The changes that are significantly larger than the limit."""
        return tuple(change for change in self.changes if change.exceeds(self.change_limit))

    @property
    def helps(self) -> bool:
        """Whether the decision on each sensor is `helps`."""
        return bool(self.proof) and len(self.helped) == len(self.judged)

    @property
    def exit_code(self) -> int:
        """0 where each sensor `helps`, no error changed and few samples were dropped, else 3."""
        return exit_code_of(self.reasons)

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        if not self.proof:
            return self.lines
        lines = [self._line(sensor) for sensor in self.judged if sensor not in self.helped]
        changed_sensors = {change.sensor for change in self.changed}
        for sensor, line in self._change_lines().items():
            if sensor in changed_sensors:
                lines.append(line)
        if self.dropped:
            lines.append(self.dropped)
        return lines

    def _change_lines(self) -> dict[str, str]:
        """Return sensor -> how its error compares with that on the day of the calibration."""
        lines = {}
        for sensor in dict.fromkeys(change.sensor for change in self.changes):
            exceeding = [change for change in self.changed if change.sensor == sensor]
            if exceeding:
                parts = ', '.join(f'{change.regime}: {change.text}' for change in exceeding)
                lines[sensor] = f'{sensor}: the error has changed since the calibration, {parts}'
                continue
            of_sensor = [change for change in self.changes if change.sensor == sensor]
            largest = max(of_sensor, key=lambda change: change.factor)
            lines[sensor] = (
                f'{sensor}: the error is as on the day of the calibration, at most'
                f' {largest.text} in {largest.regime}'
            )
        return lines

    def decision(self, sensor: str) -> SensorDecision:
        """Return the decision on a sensor: that of its errors, at best its limit."""
        decisions = [decide(self.proof.get(sensor))]
        if sensor in self.limits:
            decisions.append(self.limits[sensor].decision)
        return most_cautious(decisions)

    def _line(self, sensor: str) -> str:
        """Return the decision on a sensor with its reason: that of its limit, or of its errors."""
        decision = self.decision(sensor)
        why = reason_of(self.proof.get(sensor))
        limit = self.limits.get(sensor)
        if limit is not None and limit.decision is decision:
            why = limit.why
        return f'{sensor} {decision}: {why}'

    @property
    def helped(self) -> Proof:
        """Sensor -> entry of the proof, of the sensors that the calibration helps."""
        helped = {}
        for sensor, entry in self.proof.items():
            if self.decision(sensor) is HELPS:
                helped[sensor] = entry
        return helped

    @property
    def lines(self) -> list[str]:
        """The decision on each sensor with its reason, then the regimes with a larger error."""
        if not self.proof:
            return [f'unproven: {self.why}']
        worse = []
        for sensor, entry in self.proof.items():
            worse += [f'{sensor}: {line}' for line in worse_regimes(entry)]
        return [
            *(self._line(sensor) for sensor in self.judged),
            *worse,
            *self._change_lines().values(),
        ]

    def __str__(self) -> str:
        if self.helps:
            first_line = 'the calibration helps'
        elif self.helped:
            first_line = f'it helps the {", ".join(self.helped)} only'
        else:
            first_line = 'it helps no sensor'
        further_lines = [*self.lines, *self.notes]
        if self.dropped:
            further_lines.append(self.dropped)
        return '\n'.join([first_line, *(f'  {line}' for line in further_lines)])

    __repr__ = __str__
