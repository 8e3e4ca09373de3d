"""Is a calibration still good? The proof of any calibration on any recording on a table."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from imu_calibration.calibration.collector import GatherStep
from imu_calibration.calibration.decision import HELPS, decide, reason_of, worse_regimes
from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.gathered import join
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.proof import model_for, prove_calibration
from imu_calibration.preflight.joint_checks import check_units
from imu_calibration.reference.table import Table


@dataclass(frozen=True, eq=False)
class CheckResult:
    """The errors of a calibration on a recording."""

    proof: dict
    """Sensor -> error before and after, interval, on how much, by what the IMU does (see `proof.prove`); {}: it cannot be told."""
    findings: tuple = ()
    """What a look at the recording found."""
    why: str = 'fewer than three windows of rest or motion were found; record for longer'
    """Why there is no proof, where there is none."""

    @property
    def helps(self) -> bool:
        """Whether the decision on each sensor is `helps`."""
        return bool(self.proof) and len(self.helped) == len(self.proof)

    @property
    def helped(self) -> dict[str, Any]:
        """The entries of the proof of the sensors that it helps."""
        return {sensor: entry for sensor, entry in self.proof.items() if decide(entry) is HELPS}

    @property
    def lines(self) -> list[str]:
        """The decision on each sensor with its reason, then the regimes with a larger error."""
        if not self.proof:
            return [f'unproven: {self.why}']
        return [*(f'{sensor} {decide(entry)}: {reason_of(entry)}' for sensor, entry in self.proof.items()),
                *(f'{sensor}: {line}' for sensor, entry in self.proof.items() for line in worse_regimes(entry))]


def check_on_table(sources: Sequence[Callable], table: Table, calibration: Calibration, *,
                   options: CalibrationOptions = CalibrationOptions(), names: Sequence[str] = (),
                   progress: Callable | None = None) -> CheckResult:
    """
    Prove a calibration on recordings of its IMU on a table.

    Parameters
    ----------
    sources : sequence of callables
        Each returns an iterator of SampleBlock.
    table : Table
        The reference; it need not be the one on which the calibration was made.
    calibration : Calibration
    options : CalibrationOptions
        How windows are found, and the conversion of volts or counts.
    names : sequence of str
        Names of the recordings for messages.
    progress : callable, optional
        Called with the number of IMU samples read.

    Raises
    ------
    InputError
        When a recording cannot be used, or is of another IMU than the one on the table.

    """
    names = tuple(names or (f'recording {number}' for number in range(1, len(sources) + 1)))
    model = model_for(calibration, table)
    step = GatherStep(table, model, options.windows, options.nominal, names, progress=progress)
    gathered = join(list(map(step, enumerate(sources))), names, lambda part: check_units(part, model, table))
    return CheckResult(prove_calibration(gathered.held_out, model, calibration), gathered.findings)
