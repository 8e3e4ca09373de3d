"""Calibrations of samples in memory, by the path of the product."""

from dataclasses import replace

from imu_calibration.calibration.calibrate import calibrate_by_evidence
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.references.gravity.gravity_reference import GravityReference
from imu_calibration.references.turntable.table_reference import TableReference


def calibrated_on_table(sources, table, options=CalibrationOptions(), *, provenance=None):
    """Return the result for recordings on a table with the requested model: without a search."""
    as_asked = replace(options, as_asked=True)
    recordings = TableReference(table).gather(sources, as_asked)
    return calibrate_by_evidence(recordings, as_asked, provenance=provenance)


def calibrated_by_hand(sources, options=CalibrationOptions(), *, provenance=None):
    """Return the result for a recording by hand."""
    recording = GravityReference().gather(sources, options)
    return calibrate_by_evidence(recording, options, provenance=provenance)
