"""One window of data, reduced to what least squares needs of it."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.columns import columns, warps_act
from imu_calibration.estimation.linear_least_squares import triangular
from imu_calibration.reference.kinematics import reference_motion

SLOW_TIME = 0.25
"""Length of the pieces whose means tell correlated misfit from white noise, s: longer than sensor filters, shorter than motions."""


@dataclass(frozen=True, eq=False)
class SensorStatistics:
    """
    The rows ``[columns | output]`` of one sensor in one window, split in mean and rest.

    The mean row carries a random offset of the window (bias wander) beside the averaged noise; the centred rows do not.
    Weighted apart, the two are an exact summary for the model ``output = columns @ coefficients + window offset + noise``.
    """

    mean: np.ndarray
    """Mean of the rows, shape (n_columns + 3,)."""
    within: np.ndarray
    """Triangular factor of the centred rows, shape (k, n_columns + 3); no rows for a static window."""
    noise_variance: np.ndarray
    """Variance of the output about its mean (static windows; else NaN), shape (3,)."""
    inflation: np.ndarray
    """Variance of batch means over that of white noise of the same variance, shape (3,); NaN when not static."""
    slow: np.ndarray | None = None
    """Triangular factor of the centred means of SLOW_TIME pieces, times the root of their length; its misfit shows what white noise does not."""
    slow_rows: int = 0
    """Number of those pieces."""


@dataclass(frozen=True, eq=False)
class WindowStatistics:
    """Reduced window for both sensors."""

    kind: str
    """'static', 'spin' or 'dynamic'."""
    time: float
    """Middle of the window, s."""
    duration: float
    """Length, s."""
    count: int
    """Number of samples."""
    sensors: dict
    """Sensor name -> SensorStatistics."""
    session: int = 0
    """Recording that the window comes from."""


def reduce_window(window, model, table, session=0, column_function=columns):
    """
    Reduce one window to its statistics.

    Parameters
    ----------
    window : Window
        Measured samples with the joints' motion.
    model : SensorModel
        Defines the columns.
    table : Table
        Reference kinematics.
    column_function : callable
        Same signature as `sensor_model.columns`.

    """
    static = window.kind == 'static'
    temperature = window.temperature_c
    if static and temperature is not None:
        temperature = np.array([temperature.mean()])
    outputs = {'accelerometer': window.force_s, 'gyroscope': window.rate_s}
    length = piece_length(window)
    # Both sensors feel the same motion unless a lag or a delay acts: then it is worked out once.
    shared = {'ref': reference_motion(table, window.motion, temperature)} if column_function is columns and not warps_act(model) else {}
    designs = {sensor: column_function(model, sensor, table, window.motion, temperature, **shared) for sensor in SENSORS}
    sensors = {s: _reduce_static(designs[s], outputs[s]) if static else _reduce_moving(designs[s], outputs[s], length) for s in SENSORS}
    return WindowStatistics(window.kind, float(window.time.mean()), float(window.time[-1] - window.time[0]), len(window.time), sensors, session)


def _reduce_static(design, output):
    mean = np.concatenate([design.mean(axis=0), output.mean(axis=0)])
    variance, inflation = batch_statistics(output)
    return SensorStatistics(mean, np.zeros((0, len(mean))), variance, inflation)


def _reduce_moving(design, output, length):
    rows = np.concatenate([design, output], axis=1)
    mean = rows.mean(axis=0)
    rows -= mean
    unknown, slow = np.full(3, np.nan), slow_part(rows, length)
    return SensorStatistics(mean, triangular(rows), unknown, unknown, triangular(slow), len(slow))


def piece_length(window):
    """Return the number of samples in SLOW_TIME, at least one; zero for a static window."""
    if window.kind == 'static':
        return 0
    span = window.time[-1] - window.time[0]
    return max(int(round(SLOW_TIME * (len(window.time) - 1) / span)), 1) if span > 0 else 1


def slow_part(rows, length):
    """Return the means of pieces of `length` rows times the root of their length, none when a piece is a single row."""
    pieces = len(rows) // length if length > 1 else 0
    return rows[:pieces * length].reshape(pieces, length, -1).sum(axis=1) / np.sqrt(max(length, 1)) if pieces else rows[:0]


def batch_statistics(output, batches=16):
    """
    Return the variance of each column and the factor by which means of it scatter more than white noise.

    The factor is the variance of the means of `batches` equal pieces, times their length, over the sample variance:
    a sensor's low-pass filter makes it larger than one. Pieces rather than the whole keep slow wander out.
    """
    variance = output.var(axis=0, ddof=1)
    length = len(output) // batches
    if length < 2:
        return variance, np.ones(output.shape[1])
    means = output[:length * batches].reshape(batches, length, -1).mean(axis=1)
    with np.errstate(divide='ignore', invalid='ignore'):
        factor = np.diff(means, axis=0).var(axis=0, ddof=0) / 2 * length / variance
    return variance, np.where(np.isfinite(factor), factor, 1.0)
