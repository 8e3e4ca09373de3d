"""Is a calibration still good? The proof of any calibration on any recording on a table."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.calibration.collector import GatherStep
from imu_calibration.calibration.proof import prove_readings, reference_model, reference_values
from imu_calibration.compensation.compensate import invertible
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.core.samples import TemperatureSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import HELPS, decide, reason_of, worse_regimes
from imu_calibration.estimation.window_statistics import reduce_window
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.joint_checks import check_units
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.references.turntable.gathered import join, naming
from imu_calibration.references.turntable.held_out import HeldOut


@dataclass(frozen=True, eq=False)
class CheckResult:
    """The errors of a calibration on a recording."""

    proof: dict
    """Sensor -> error before and after, interval and amount of data, by regime (see `proof.prove`); {}: not determined."""
    findings: tuple = ()
    """Findings of the checks of the recording."""
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
    Return the errors of a calibration on recordings of its IMU on a table, of the readings that compensation writes.

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
    model, before, after, parts = reference_model(calibration, table), HeldOut(), HeldOut(), []
    step = GatherStep(table, model, options.windows, options.nominal, names, progress=progress)
    for session, source in enumerate(sources):
        windows: list[Window] = []
        parts.append(naming(names, session)(step.read, _with_corrected(source, calibration, options), session,
                                            Preflight(table.gravity_value), windows=windows))
        for raw, corrected in map(_both, (window for window in windows if window.kind != 'unused')):
            for held_out, window in ((before, raw), (after, corrected)):
                if len(window) > 1:
                    held_out.add(reduce_window(window, model, table, session=session, with_pieces=True))
    gathered = join(parts, names, lambda part: check_units(part, model, table))
    return CheckResult(prove_readings(before, after, model, reference=reference_values(model, calibration)), gathered.findings)


def _with_corrected(source, calibration, options):
    """Yield the blocks of a recording with corrected readings in addition to the raw ones, as compensation writes them into a bag."""
    temperature = None
    if invertible(calibration.model).needs_temperature:
        known = [block.temperature for block in source() if block.temperature is not None]
        temperature = TemperatureSamples.concatenate(known) if known else None
    stream = CompensationStream(calibration, temperature=temperature)
    for block in source():
        if block.imu is not None and len(block.imu):
            found = stream.correct(options.nominal.apply(block.imu) if options.nominal else block.imu)
            block = replace(block, imu=replace(block.imu, corrected=np.hstack([found.force, found.rate])))
        yield block


def _both(window):
    """Return a window with raw readings and the same with corrected ones, both without samples that cannot be corrected."""
    known = np.isfinite(window.corrected).all(axis=1)
    if not known.all():
        motion = window.motion.select(known) if len(window.motion) == len(window) else window.motion
        parts = {name: getattr(window, name)[known] for name in ('stamp_ns', 'time', 'force_s', 'rate_s', 'corrected')}
        window = replace(window, motion=motion, **parts,
                         temperature_c=None if window.temperature_c is None else window.temperature_c[known])
    return window, replace(window, force_s=window.corrected[:, :3], rate_s=window.corrected[:, 3:])
