"""View of a calibration and of a compensation without the sphere, as JSON with a schema for each topic: in a file, and live."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_calibration.effects.base import SENSORS

if TYPE_CHECKING:   # a compensator without a view must not wait for the imports of a calibration
    from imu_calibration.calibration.document import Calibration
    from imu_calibration.calibration.result import CalibrationResult
    from imu_calibration.compensation.health import HealthState
    from imu_calibration.compensation.stop_watch import CorrectedStretch
    from imu_calibration.segmentation.window import Window

PARAMETERS, RESIDUAL, SPECTRUM, SPHERE = '/imu/parameters', '/imu/residual/windows', '/imu/residual/spectrum', '/imu/coverage'
READINGS, HEALTH = '/imu/readings', '/imu/health'
BAND = 1.959964
"""Standard deviations on each side of a value that hold 95 %."""
SHOWN_RATE = 50.0
"""Readings that are shown per second; more than a screen has points."""
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
    READINGS: {'title': 'imu_calibration.Readings', **_object(
        measured=SENSOR_AXES, corrected=SENSOR_AXES, low=SENSOR_AXES, high=SENSOR_AXES)},
    HEALTH: {'title': 'imu_calibration.Health', **_object(outcome=TEXT, message=TEXT, values=_list(name=TEXT, value=TEXT))},
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


def readings(stretch: CorrectedStretch, sd: tuple[np.ndarray, np.ndarray]) -> Iterator[tuple[int, dict[str, Any]]]:
    """
    Yield (stamp in ns, measured and corrected readings with their band) of some samples of a stretch.

    Parameters
    ----------
    stretch : CorrectedStretch
    sd : pair of ndarray
        Standard deviations of corrected (rate, force), each shape (3,).

    """
    since, corrected, measured = stretch.samples[:, 0], stretch.samples[:, 1:7].copy(), stretch.samples[:, 7:]
    corrected[:, :3] -= stretch.offset
    half = BAND * np.concatenate(sd)
    rate = (len(since) - 1) / max(1e-9 * (since[-1] - since[0]), 1e-9)
    for k in range(0, len(since), max(round(rate / SHOWN_RATE), 1)):
        rows = {'measured': measured[k], 'corrected': corrected[k], 'low': corrected[k] - half, 'high': corrected[k] + half}
        yield stretch.first_ns + int(since[k]), {
            name: {'gyroscope': _axes(row[:3]), 'accelerometer': _axes(row[3:])} for name, row in rows.items()}


def health(state: HealthState) -> dict[str, Any]:
    """Return the result of the last stop."""
    return {'outcome': str(state.word), 'message': state.message,
            'values': [{'name': name, 'value': str(value)} for name, value in state.values.items()]}


def _by_sensor(vectors, k):
    return {sensor: _axes(vectors[sensor][k]) for sensor in SENSORS}


def _axes(vector):
    """Return the components by axis; unknown ones are omitted, because JSON has no NaN."""
    return {axis: float(part) for axis, part in zip('xyz', vector, strict=True) if np.isfinite(part)}
