"""Content of a view of a calibration except the sphere, as JSON with a schema for each topic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_calibration.effects.base import SENSORS

if TYPE_CHECKING:
    from imu_calibration.calibration.document import Calibration
    from imu_calibration.calibration.result import CalibrationResult
    from imu_calibration.segmentation.window import Window

PARAMETERS, RESIDUAL, SPECTRUM, SPHERE = '/imu/parameters', '/imu/residual/windows', '/imu/residual/spectrum', '/imu/coverage'
BAND = 1.959964
"""Standard deviations on each side of a value that hold 95 %."""
NUMBER, TEXT = {'type': 'number'}, {'type': 'string'}


def _object(**properties):
    return {'type': 'object', 'properties': properties}


def _list(**properties):
    return {'type': 'array', 'items': _object(**properties)}


AXES = _object(x=NUMBER, y=NUMBER, z=NUMBER)
SENSOR_AXES = _object(accelerometer=AXES, gyroscope=AXES)
SCHEMAS = {
    PARAMETERS: {'title': 'imu_calibration.Parameters', **_object(parameters=_list(
        name=TEXT, value=NUMBER, sd=NUMBER, low=NUMBER, high=NUMBER, unit=TEXT, tolerance=NUMBER, ratio=NUMBER, status=TEXT))},
    RESIDUAL: {'title': 'imu_calibration.Residual', **_object(windows=_list(
        time=NUMBER, motion=TEXT, before=SENSOR_AXES, after=SENSOR_AXES, floor=SENSOR_AXES))},
    SPECTRUM: {'title': 'imu_calibration.Spectrum', **_object(lines=_list(frequency=NUMBER, accelerometer=AXES, gyroscope=AXES))},
}
"""Topic -> JSON schema; SI units, times in s since the first sample."""


def parameters(calibration: Calibration, tolerances: np.ndarray) -> dict[str, Any]:
    """Return every parameter with tolerance and status; without bands where the uncertainty of the values is unknown."""
    units = [effect.unit_of(k) for effect in calibration.model.effects for k in range(effect.size)]
    rows: list[dict[str, Any]] = [{'name': name, 'value': float(value), 'unit': unit, 'tolerance': float(tolerance), 'status': str(status)}
            for name, value, unit, tolerance, status in
            zip(calibration.param_names, calibration.values, units, tolerances, calibration.status, strict=True)]
    for row, sd in zip(rows, map(float, calibration.sd)):
        if calibration.uncertainty_known and np.isfinite(sd):   # JSON has no infinity
            row.update(sd=sd, low=row['value'] - BAND * sd, high=row['value'] + BAND * sd, ratio=sd / row['tolerance'])
    return {'parameters': rows}


def residual(result: CalibrationResult) -> dict[str, Any]:
    """Return the errors of window means before and after, and the expected residual from noise, in the order of time."""
    errors = result.window_errors()
    return {'windows': [{'time': float(errors.time[k]), 'motion': str(errors.kind[k]), **{
        which: _by_sensor(getattr(errors, which), k) for which in ('before', 'after', 'floor')}}
        for k in np.argsort(errors.time, kind='stable')]}


def spectrum(result: CalibrationResult, windows: Sequence[Window]) -> dict[str, Any]:
    """Return the amplitude density of the residuals within windows with motion; no lines where none is long enough."""
    from imu_calibration.calibration.residual_spectrum import residual_spectrum
    frequency, density = residual_spectrum(result, windows)
    return {'lines': [{'frequency': float(f), **_by_sensor(density, k)} for k, f in enumerate(frequency)]}


def _by_sensor(vectors, k):
    return {sensor: _axes(vectors[sensor][k]) for sensor in SENSORS}


def _axes(vector):
    """Return the components by axis; unknown ones are omitted, because JSON has no NaN."""
    return {axis: float(part) for axis, part in zip('xyz', vector, strict=True) if np.isfinite(part)}
