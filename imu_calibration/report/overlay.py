"""Interactive figures of a simulation against the measurement, as data for the charts of a page."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from imu_calibration.calibration.diagnosis.traces import Traces
from imu_calibration.core.units import STANDARD_GRAVITY, for_people
from imu_calibration.effects.base import AXES, SENSORS, UNITS

MOST_POINTS = 1200
"""Points of a chart against a variable."""
HISTOGRAM_BINS = 40
WHEN = ('before', 'after')


def variables(traces: Traces, joint_names: Sequence[str]) -> dict[str, tuple[str, np.ndarray]]:
    """Return label -> (kind, values) of the variables of residual plots, in people's units."""
    found = {'time, s': ('time', traces.time)}
    if traces.temperature_c is not None:
        found['temperature, °C'] = ('temperature', traces.temperature_c)
    for k, axis in enumerate(AXES):
        found[f'specific force {axis}, g'] = ('force', traces.force_s[:, k] / STANDARD_GRAVITY)
        found[f'rate {axis}, deg/s'] = ('rate', np.rad2deg(traces.rate_s[:, k]))
    found['speed, deg/s'] = ('speed', np.rad2deg(np.linalg.norm(traces.rate_s, axis=1)))
    for name, angle in zip(joint_names, traces.position.T):   # by hand no joint is known
        found[f'angle of {name}, deg'] = ('angle', np.rad2deg(np.angle(np.exp(1j * angle))))
    return found


def overlay_section(traces: Traces, joint_names: Sequence[str], causes: Mapping[str, str]) -> list[dict[str, Any]]:
    """
    Return for each sensor its name, table of bands and charts: signals, differences, residuals, spectra and histograms by axis.

    Parameters
    ----------
    traces : Traces
    joint_names : sequence of str
    causes : mapping
        Sensor -> label of the variable that is shown first, as in `variables`.

    """
    against = {label: values for label, (_, values) in variables(traces, joint_names).items()}
    return [_sensor(traces, sensor, against, causes.get(sensor, 'time, s')) for sensor in SENSORS]


def _sensor(traces, sensor, against, first):
    factor, unit = for_people(UNITS[sensor])
    rows: list[dict[str, Any]] = []

    def row(title: str, chart: Callable[[int], dict[str, Any]], **more: Any) -> None:
        rows.append({'title': title, 'charts': [json.dumps(chart(axis)) for axis in range(3)], 'variables': '', 'labels': (), **more})
    if segments := traces.segments.get(sensor):
        row(f'Measured and simulated on the segment with the largest difference, {unit}',
            lambda k: _chart(f'{sensor} {AXES[k]}', 'time, s', segments[k].time,
                             {name: signal * factor for name, signal in segments[k].signals.items()}))
        row(f'Measured minus simulated on that segment, {unit}',
            lambda k: _chart(f'{sensor} {AXES[k]}', 'time, s', segments[k].time, {
                when: (segments[k].signals['measured'] - segments[k].signals[f'simulated {when}']) * factor for when in WHEN}))
    some = slice(None, None, -(-len(traces.time) // MOST_POINTS))
    residuals = [{when: getattr(traces, when)[sensor][some, k] * factor for when in WHEN} for k in range(3)]
    row(f'Residual, {unit}, against', lambda k: _chart(f'{sensor} {AXES[k]}', first, against[first][some], residuals[k], kind='points'),
        variables=json.dumps({label: _plain(values[some]) for label, values in against.items()}), first=first, labels=list(against))
    if sensor in traces.distances:
        frequency, density, noise = traces.distances[sensor].density()
        row(f'Spectrum of the residual, {unit}/√Hz, with the noise at rest',
            lambda k: _chart(f'{sensor} {AXES[k]}', 'frequency, Hz', frequency, {
                **{when: density[w, :, k] * factor for w, when in enumerate(WHEN)}, 'noise': noise[:, k] * factor}, kind='log'))
    row(f'Histogram of the residual, {unit}', lambda k: _histogram(f'{sensor} {AXES[k]}', unit, {
        when: getattr(traces, when)[sensor][:, k] * factor for when in WHEN}))
    bands = [(name, rms.T * factor, float(np.sqrt(np.mean(noise**2))) * factor)
             for name, rms, noise in (traces.distances[sensor].bands() if sensor in traces.distances else ())]
    return {'sensor': sensor, 'unit': unit, 'bands': bands, 'rows': rows}


def histogram(residuals: Mapping[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return (middles of the bins, name -> counts) of residuals, shape (n,) each; the bins contain 99.9 % of each."""
    limit = max(float(np.quantile(np.abs(own), 0.999)) for own in residuals.values()) or 1.0
    edges = np.linspace(-limit, limit, HISTOGRAM_BINS + 1)
    return edges[:-1] + edges[1] / 2 - edges[0] / 2, {name: np.histogram(own, edges)[0] for name, own in residuals.items()}


def _histogram(title, unit, residuals):
    middles, counts = histogram(residuals)
    return _chart(title, f'residual, {unit}', middles, counts, kind='steps')


def _chart(title, x, values, series, kind='line'):
    if kind == 'log':
        series = {name: np.where(own > 0, own, np.nan) for name, own in series.items()}
    return {'title': title, 'x': x, 'kind': kind, 'names': list(series),
            'data': [_plain(values), *(_plain(own) for own in series.values())]}


def _plain(values):
    return [float(f'{value:.5g}') if np.isfinite(value) else None for value in values]
