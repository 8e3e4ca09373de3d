"""Search of effects in the windows of each recording on a table."""

from collections.abc import Iterator
from dataclasses import replace

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.effects.sensor_model import BARE, SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.references.turntable.residuals.residual_analysis import (
    ResidualAnalysis,
    inquire,
)
from imu_calibration.references.turntable.selection.window_evidence import MIN_FOLD_WINDOWS
from imu_calibration.references.turntable.session_data import SessionData


def search_windows(
    gathered: SessionData, table: Table, solved: SensorModel, *, options: CalibrationOptions
) -> Iterator[ResidualAnalysis]:
    """
    Yield the search in each recording with enough windows, the largest recording first.

    The unexplained residual of each is evaluated, and its blocks are freed.

    Parameters
    ----------
    gathered : SessionData
        With the windows of each recording.
    table : Table
    solved : SensorModel
        The model of the solution.
    options : CalibrationOptions
        Of the requested model.

    """
    baseline = baseline_model(options, table, solved)
    for windows in windows_to_search(gathered):
        search = inquire(windows, table, baseline, bias_processes=options.bias_processes)
        search.unexplained_rests()
        yield search


def windows_to_search(gathered: SessionData) -> list[list[Window]]:
    """
    Return the windows of each recording that suffice for a search of effects.

    The largest recording is first.
    """
    windows_of_recordings = [kept.windows for kept in gathered.for_search]
    return [windows for windows in windows_of_recordings if len(windows) >= MIN_FOLD_WINDOWS]


def baseline_model(options: CalibrationOptions, table: Table, solved: SensorModel) -> SensorModel:
    """
    Return the baseline model of the search.

    Parameters
    ----------
    options : CalibrationOptions
    table : Table
    solved : SensorModel
        The model of a solution; the same effects are linearised at its point.

    """
    # Effects that were not requested have to be significant.
    baseline_options = replace(
        options,
        accelerometer_model=options.accelerometer_model or BARE,
        reference_model=options.reference_model or 'none',
    )
    model = choose_model(baseline_options, table)
    for effect in solved.effects:
        # An effect that is no candidate would be reported as unexplained if it were removed.
        if effect.key not in model.slices and not model.catalogue.is_candidate(effect):
            model = model.with_effect(*effect.key)
    names = {effect.name for effect in model.effects}
    point = {name: value for name, value in solved.point.items() if name in names}
    return replace(model, point=point, temperature_ref_c=solved.temperature_ref_c)
