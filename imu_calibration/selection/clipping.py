"""Removal of windows corrupted by clipped output before the search; limits are estimated without the locked windows."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window
from imu_calibration.selection.evidence import LEAST_WINDOWS, locked_windows
from imu_calibration.selection.saturation import (
    Saturation,
    find_saturation,
    may_be_clipped,
    measured,
    noise_at_rest,
    predictions,
    simple_fit,
    without_clipped,
)


def windows_at(windows: Sequence[Window], rows: np.ndarray) -> list[Window]:
    """Return the windows of the rows that are true."""
    return [window for window, taken in zip(windows, rows) if taken]


def without_clipping(windows: list[Window], table: Table, model: SensorModel) -> tuple[list[Window], np.ndarray, list[Saturation]]:
    """
    Return (windows without samples corrupted by a limit, mask of the locked ones, limits estimated from all other windows).

    One fast swing may be all that reaches a limit: a window in which outputs pile up is not locked, where they do so at a limit.
    """
    locked, piled = locked_windows(np.array([window.kind for window in windows])), _piled(windows)
    limits, noise_sd, values = _limits(windows_at(windows, piled | ~locked), table, model)
    if not limits:
        return windows, locked, []
    locked &= ~piled
    levels, kept = {limit.sensor: limit.level for limit in limits}, []
    for rows in (~locked, locked):
        part = windows_at(windows, rows)
        kept.append(without_clipped(part, predictions(part, table, model, values=values), levels, noise_sd=noise_sd))
    entries = [(window.time[0], number, window) for number, part in enumerate(kept) for window in part]
    in_order = sorted(entries, key=lambda entry: entry[:2])
    return [window for *_, window in in_order], np.array([number == 1 for _, number, _ in in_order]), limits


def _piled(windows):
    """Return which windows hold the largest output of a sensor, where several samples share it."""
    found = np.zeros(len(windows), bool)
    for sensor in SENSORS:
        if may_be_clipped(windows, sensor):
            largest = np.array([np.abs(measured(window, sensor)).max() for window in windows])
            found |= largest >= largest.max() * (1 - 1e-12)
    return found


def _limits(windows, table, model):
    """Return (limits found, standard deviation of single samples by sensor, parameters of a simple fit without corrupted samples)."""
    nothing = [], {}, None
    suspects = [sensor for sensor in SENSORS if may_be_clipped(windows, sensor)]
    if not suspects:
        return nothing
    limits = {sensor: float(max(np.abs(measured(w, sensor)).max() for w in windows)) for sensor in suspects}
    noise_sd = {sensor: noise_at_rest(windows, sensor) for sensor in SENSORS}
    kept = windows
    for _ in range(2):
        predicted = predictions(windows, table, model, values=simple_fit(kept, table, model))
        kept = without_clipped(windows, predicted, limits, noise_sd=noise_sd)
        if len(kept) < LEAST_WINDOWS:
            return nothing   # output that is always at or near its limit does not determine it
    values = simple_fit(kept, table, model)
    predicted = predictions(windows, table, model, values=values)
    found = [limit for limit in (find_saturation(windows, predicted, noise_sd[sensor], sensor=sensor) for sensor in suspects) if limit]
    return found, noise_sd, values
