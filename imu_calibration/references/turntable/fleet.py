"""
Many units: each is calibrated on its own, then they are compared.

Plain functions, for any scheduler.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.calibration.calibrate import calibrate_by_evidence
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.samples import BlockSource
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.decision import decisions_text
from imu_calibration.document.files import REPORT
from imu_calibration.document.outcome import exit_code, shortcomings
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.solution import HELD
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.table_calibration import TableRecordings


@dataclass(frozen=True)
class Unit:
    """One IMU with its recordings."""

    name: str
    """Name of the unit."""
    sources: tuple[BlockSource, ...]
    """Its recordings; must be picklable for another process."""
    bags: tuple = ()
    """Names of the recordings."""
    provenance: Callable[[], dict[str, Any]] = dict
    """Returns bag hashes and options for the document."""


@dataclass(frozen=True, eq=False)
class UnitResult:
    """Result of one unit; small enough to be sent between processes."""

    name: str
    """Name of the unit."""
    calibration: Calibration | None = None
    """The Calibration, or None when the unit was refused."""
    verdict: str = 'refused'
    """The more cautious decision, or 'refused'."""
    exit_code: int = 1
    """0, 1 or 3, as for a single calibration."""
    error: str = ''
    """Why the unit was refused, one line."""
    key: str | None = None
    """The missing input, a key of `errors.ERROR_KEYS`."""
    files: dict | None = None
    """File name -> text."""
    reasons: tuple[str, ...] = ()
    """Why the exit code is not 0, a line each."""

    @property
    def verdicts(self) -> dict[str, str]:
        """Sensor -> decision, or 'refused'."""
        if self.calibration is None:
            return dict.fromkeys(SENSORS, self.verdict)
        return {**self.calibration.decisions}

    @property
    def verdict_text(self) -> str:
        """The decisions in one phrase, or 'refused'."""
        if self.calibration is None:
            return self.verdict
        return decisions_text(self.calibration.decisions)


@dataclass(frozen=True)
class FleetStep:
    """How units are calibrated; it can be sent to another process or machine."""

    table: Table
    """The table on which every unit was recorded."""
    options: CalibrationOptions = CalibrationOptions()
    """Model and settings of the estimate."""
    report: Callable[[CalibrationResult], str] | None = None
    """Returns report.html; must survive pickling when sent elsewhere."""

    def calibrate(self, unit: Unit) -> UnitResult:
        """Return the UnitResult of a unit; every error of it is part of the result."""
        try:
            return self._calibrated(unit)
        except ImuCalibrationError as error:
            text = ' '.join(str(error).split())
            return UnitResult(unit.name, error=text, key=error.key, reasons=(text,))
        except Exception as error:  # a failed unit does not end the run of the fleet
            text = f'stopped by {type(error).__name__}: {" ".join(str(error).split())}'
            return UnitResult(unit.name, error=text, reasons=(text,))

    def _calibrated(self, unit: Unit) -> UnitResult:
        """Return the result of a unit; raises the errors of its calibration."""
        provenance = unit.provenance()
        recordings = TableRecordings.of(unit.sources, self.table, names=unit.bags or None)
        result = calibrate_by_evidence(recordings, self.options, provenance=provenance)
        texts = {'calibration.yaml': calibration_to_text(result.calibration)}
        report_of = self.report
        if report_of is not None:
            texts[REPORT] = report_of(result)
        return UnitResult(
            unit.name,
            calibration=result.calibration,
            verdict=str(result.verdict.word),
            exit_code=exit_code(result.calibration),
            files=texts,
            reasons=tuple(shortcomings(result.calibration)),
        )


@dataclass(frozen=True)
class Spread:
    """One parameter over the units."""

    name: str
    """Name of the parameter."""
    unit: str
    """Its SI unit."""
    count: int
    """Units in which it is not held at its prior."""
    mean: float
    """Mean of its values."""
    spread: float
    """Standard deviation of its values over the units; NaN for fewer than two."""
    typical_sd: float
    """Root of the mean of its reported variances."""
    lowest: tuple
    """(value, unit's name) of the lowest one."""
    highest: tuple
    """(value, unit's name) of the highest one."""

    @property
    def ratio(self) -> float:
        """How much more the units differ than the calibrations are uncertain."""
        return self.spread / self.typical_sd if self.typical_sd > 0 else float('nan')


def summarise(results: Sequence[UnitResult]) -> list[Spread]:
    """
    Return the Spread of each parameter over the calibrated units: the merge step.

    Raises
    ------
    InputError
        When no unit was calibrated.

    """
    calibrated = [
        (result.name, result.calibration) for result in results if result.calibration is not None
    ]
    if not calibrated:
        first = f'; the first, {results[0].name}: {results[0].error}' if results else ''
        raise InputError(
            f'at least one unit must be calibrated, none of {len(results)} was{first}',
            code='no_unit_calibrated',
        )
    estimates_of: dict[str, list[_Estimate]] = {}  # parameter -> estimates that are not held
    si_units: dict[str, str] = {}  # parameter -> SI unit
    for unit_name, calibration in calibrated:
        for effect in calibration.model.effects:
            for index, name in enumerate(effect.param_names()):
                si_units[name] = effect.unit_of(index)
        for name, value, sd, status in zip(
            calibration.param_names,
            calibration.values,
            calibration.sd,
            calibration.status,
            strict=True,
        ):
            estimates = estimates_of.setdefault(name, [])
            if status != HELD:
                estimates.append(_Estimate(float(value), float(sd), unit_name))
    return [_spread(name, si_units[name], estimates) for name, estimates in estimates_of.items()]


class _Estimate(NamedTuple):
    """A parameter of one unit."""

    value: float
    """SI."""
    sd: float
    """Its reported standard deviation, SI."""
    unit_name: str
    """Name of the unit."""


def _spread(name: str, si_unit: str, estimates: Sequence[_Estimate]) -> Spread:
    """Return the spread of a parameter over the units; NaN without any estimate."""
    if not estimates:
        missing = float('nan')
        return Spread(
            name,
            si_unit,
            count=0,
            mean=missing,
            spread=missing,
            typical_sd=missing,
            lowest=(missing, ''),
            highest=(missing, ''),
        )
    value = np.array([estimate.value for estimate in estimates])
    sd = np.array([estimate.sd for estimate in estimates])
    lowest = estimates[int(np.argmin(value))]
    highest = estimates[int(np.argmax(value))]
    return Spread(
        name,
        si_unit,
        count=len(value),
        mean=float(value.mean()),
        spread=float(value.std(ddof=1)) if len(value) > 1 else float('nan'),
        typical_sd=float(np.sqrt(np.mean(sd**2))),
        lowest=(lowest.value, lowest.unit_name),
        highest=(highest.value, highest.unit_name),
    )
