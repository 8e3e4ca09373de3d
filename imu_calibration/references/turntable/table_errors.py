"""Delay of the clocks and zeros of the encoders, fitted where a residual is not noise."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.calibrate import conclude
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.document.verdict import incomplete_windows
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.solution import Status
from imu_calibration.preprocessing.recording_evidence import WARNING, CheckFinding
from imu_calibration.references.turntable.table_calibration import TableRecordings
from imu_calibration.references.turntable.window_observations import TableResult

SIGNIFICANT = 5.0
"""An error of table or clock is reported from this many standard deviations on."""


@dataclass(frozen=True, eq=False)
class TableErrors:
    """A calibration on a table with the errors of clocks and zeros that its recording shows."""

    result: TableResult
    """The calibration; with these errors in its model where they are significant."""
    findings: tuple[CheckFinding, ...]
    """The errors with their values, or a residual that is not noise."""


def calibrate_with_table_errors(
    recordings: TableRecordings, options: CalibrationOptions
) -> TableErrors:
    """
    Return the calibration without a search for effects, but for a delay and zeros of encoders.

    Both are common, and each makes many parameters weak that more motions do not improve. They are
    added where the residual of the requested model is not noise, and kept if significant.

    Parameters
    ----------
    recordings : TableRecordings
    options : CalibrationOptions
        Of the requested model.

    """
    result = conclude(recordings.solved(options), options)
    if options.as_asked or not _unlike_noise(result):
        return TableErrors(result, findings=())
    # The ones that the table has: the zero of the first joint is part of the attitude of the base.
    added = []
    for key, effect in result.model.catalogue.effects(recordings.table.joint_names).items():
        if effect.set_up_fault is not None:
            added.append(key)
    extended_options = replace(options, added=(*options.added, *added))
    extended = conclude(recordings.solved(extended_options), extended_options)
    findings = _table_error_findings(extended)
    if findings:
        result = extended
    if _unlike_noise(result):
        findings.append(
            CheckFinding(
                'residual',
                WARNING,
                'the residual must be noise, parts of the recording differ by more: a cause is not'
                ' in the model, and more motions do not help; diagnose the recording',
            )
        )
    return TableErrors(result, tuple(findings))


def _unlike_noise(result: TableResult) -> bool:
    """Return whether moving windows scatter clearly more than the noise at rest."""
    statistics = result.calibration.statistics
    return any(incomplete_windows(statistics, sensor) for sensor in SENSORS)


def _table_error_findings(result: TableResult) -> list[CheckFinding]:
    """Return a finding for a significant delay and for each zero that is significantly off."""
    calibration = result.calibration
    significant = np.abs(calibration.values) > SIGNIFICANT * calibration.sd
    findings = []
    for effect in calibration.model.effects:
        if effect.set_up_fault is None:
            continue
        first = calibration.model.slices[effect.key].start
        for index, component in enumerate(effect.components, first):
            if not significant[index] or calibration.status[index] is Status.HELD:
                continue
            value = float(calibration.values[index])
            sd = float(calibration.sd[index])
            text = effect.set_up_fault(component, value, sd)
            findings.append(CheckFinding(effect.name, WARNING, text))
    return findings
