"""A finished calibration with what a report needs beside it, its summary and its exit code."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.gathered import Gathered
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.status import DETERMINED
from imu_calibration.calibration.verdict import judge
from imu_calibration.effects.sensor_model import SensorModel


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibration with what a report needs beside it."""

    calibration: Calibration
    """The document's content."""
    solution: object
    """The Solution, or the HandCalibration of a recording without a table."""
    gathered: Gathered
    """Windows, counts, kept samples."""
    table: object
    """The Table, or None."""
    model: SensorModel
    """The model that was solved."""
    gathered_model: SensorModel
    """The model whose columns were gathered; it may have more effects."""
    tolerances: np.ndarray
    """Tolerance of each parameter."""
    options: CalibrationOptions = CalibrationOptions()
    """What was asked for."""


def summary(result, hints=None):
    """
    Return (verdict, lines): 'good', 'weak' or 'bad' with reasons and next steps, for people (see `verdict`).

    `hints` as for `errors.with_hint`.
    """
    found = judge(result.calibration, result.tolerances)
    return found.word, found.lines(hints)


def exit_code(result):
    """Return 0 when every requested parameter is determined and nothing was lost, else 3."""
    calibration = result.calibration
    lacking = any(status != DETERMINED for status in calibration.requested.values())
    return 3 if lacking or calibration.statistics.get('dropped') or calibration.statistics.get('unusable') else 0
