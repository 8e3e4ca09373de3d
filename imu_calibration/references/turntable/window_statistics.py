"""Statistics of one window, in pieces."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.core.samples import rounding_variance
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.core.units import DEG
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import References, columns
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.scaled_solve import triangular
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window, joined_motion

PIECE_TIME = 0.25
"""
Length of a piece for held-out evaluation, s: noise averages out, and a sweep of a table is still
several pieces.
"""
MAX_SLOW_RATE = 30.0 * DEG
"""Mean rate up to which a piece is in slow rotation, rad/s."""
MIN_FAST_RATE = 120.0 * DEG
"""Mean rate above which a piece is in fast rotation, rad/s."""
ACCELERATING = 90.0 * DEG
"""Change of the rate per second from which on a piece counts as accelerating, rad/s^2."""
N_AXES = 3


class Regime(StrEnum):
    """Regime of motion of a piece."""

    REST = 'rest'
    SLOW = 'slow turns'
    MEDIUM = 'turns at 30 to 120 deg/s'
    FAST = 'fast turns'
    ACCELERATING = 'angular acceleration'


def pieces_at_rest(mean: np.ndarray, duration: float) -> dict[str, np.ndarray]:
    """
    Return {regime: rows} of a static window: one row ``[columns | d(true input)/dt | output]``.

    The mean row ``[columns | output]`` with a zero derivative, times the root of the number of
    pieces that the window counts as.
    """
    row = np.concatenate([mean[:-N_AXES], np.zeros(N_AXES), mean[-N_AXES:]])
    return {Regime.REST: np.sqrt(count_pieces(duration)) * row[None]}


def count_pieces(duration: float) -> int:
    """Return the number of pieces in a window with a duration in s, at least one."""
    return max(round(duration / PIECE_TIME), 1)


def moving_pieces(
    rows: np.ndarray, time: np.ndarray, true_input: np.ndarray, *, rate_s: np.ndarray
) -> dict[str, np.ndarray]:
    """
    Return {regime: rows} of a moving window, one row for each piece.

    A row is the mean over its piece of ``[columns | d(true input)/dt | output]``. The mean
    derivative is the difference of the true input at both ends of the piece; it separates
    an unmodelled delay of the sensor from a wrong scale.

    Parameters
    ----------
    rows : array, shape (n, n_columns + 3)
        ``[columns | output]``.
    time : array, shape (n,)
        s.
    true_input, rate_s : array, shape (n, 3)
        True input of the sensor according to the reference, and the rate of the reference, rad/s.

    """
    count = max(int((time[-1] - time[0]) / PIECE_TIME), 1)
    edges = np.round(np.linspace(0, len(rows), count + 1)).astype(int)
    length = np.diff(edges)[:, None]
    means = np.add.reduceat(rows, edges[:-1], axis=0) / length
    pieces = np.concatenate(
        [means[:, :-N_AXES], _slope(true_input, time, edges), means[:, -N_AXES:]], axis=1
    )

    rate = np.linalg.norm(np.add.reduceat(rate_s, edges[:-1], axis=0) / length, axis=1)
    acceleration = np.linalg.norm(_slope(rate_s, time, edges), axis=1)
    regimes = (Regime.SLOW, Regime.MEDIUM, Regime.FAST, Regime.ACCELERATING)
    # Index into `regimes` of each piece: the first condition that holds, otherwise 0.
    number = np.select(
        [acceleration > ACCELERATING, rate > MIN_FAST_RATE, rate > MAX_SLOW_RATE], [3, 2, 1]
    )
    pieces_of: dict[str, np.ndarray] = {}
    for index, regime in enumerate(regimes):
        if np.any(number == index):
            pieces_of[regime] = pieces[number == index]
    return pieces_of


def _slope(values: np.ndarray, time: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """
    Return the mean derivative over each piece, shape (n_pieces, 3).

    The difference of the values at both ends of a piece over the time between them. The value at
    an inner edge is the mean of the samples before and after it, half a period from both.
    """
    period = (time[-1] - time[0]) / max(len(time) - 1, 1)
    inner = edges[1:-1]
    at_edges = np.concatenate([values[:1], 0.5 * (values[inner - 1] + values[inner]), values[-1:]])
    span = np.diff(np.concatenate([[0.0], inner - 0.5, [len(time) - 1.0]])) * period
    return np.diff(at_edges, axis=0) / np.maximum(span, period)[:, None]


SLOW_TIME = 0.25
"""
Length of the pieces whose means separate correlated misfit from white noise, s: longer than sensor
filters, shorter than motions.
"""
BATCHES = 16
"""Equal pieces of a window at rest, the scatter of whose means is the noise at low frequency."""
BATCH_DOF = 2 * (BATCHES - 1) ** 2 / (3 * BATCHES - 4)
"""
Degrees of freedom of the variance from differences of neighbouring means, which are correlated
(von Neumann).
"""


@dataclass(frozen=True, eq=False)
class SensorStatistics:
    """
    The rows ``[columns | output]`` of one sensor in one window, as mean row and centred rows.

    The mean row has a random offset of the window (of its bias) in addition to the averaged noise;
    the centred rows have none. With separate weights, the two are an exact summary for the model
    ``output = columns @ coefficients + window offset + noise``.
    """

    mean: np.ndarray
    """Mean of the rows, shape (n_columns + 3,)."""
    within: np.ndarray
    """
    Triangular factor of the centred rows, shape (k, n_columns + 3); no rows for a static window.
    """
    noise_variance: np.ndarray
    """
    Variance of the output, shape (3,): in static windows about its mean, at least that of rounding;
    in moving windows that of rounding only.
    """
    inflation: np.ndarray
    """
    Variance of the means of equal pieces over that of white noise (`batch_statistics`), shape (3,);
    NaN for a moving window.
    """
    slow: np.ndarray | None = None
    """
    Triangular factor of the means of the centred rows over pieces of SLOW_TIME, times the root of
    their number of samples, for the test of correlated misfit; None for a static window.
    """
    slow_rows: int = 0
    """Number of pieces in `slow`."""


@dataclass(frozen=True, eq=False)
class WindowStatistics:
    """Statistics of one window for both sensors."""

    kind: str
    """'static', 'spin' or 'dynamic'."""
    time: float
    """Middle of the window, s."""
    duration: float
    """Length, s."""
    count: int
    """Number of samples."""
    sensors: dict[str, SensorStatistics]
    """Sensor name -> SensorStatistics."""
    session: int = 0
    """Recording of the window."""
    encoder_step: float = 0.0
    """Largest step of the encoders that is seen in the readings, rad; 0: none."""
    pieces: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    """
    Sensor -> regime -> rows ``[columns | d(true input)/dt | output]`` of short pieces, for
    held-out evaluation; empty without it.
    """


def measured(window: Window, sensor: str) -> np.ndarray:
    """Return the measured output of a sensor in a window, shape (n, 3)."""
    return window.force_s if sensor == 'accelerometer' else window.rate_s


def references_of(windows: Sequence[Window], model: SensorModel, table: Table) -> References:
    """Return the reference motion of both sensors at the samples of all windows, joined."""
    motion, temperature = joined_motion(windows)
    return References(model, table, motion, temperature_c=temperature)


def reduce_windows(
    windows: Sequence[Window],
    model: SensorModel,
    table: Table,
    *,
    column_function: Callable = columns,
) -> list[WindowStatistics]:
    """
    Return the statistics of windows of the first recording, without pieces.

    The columns of all windows are computed in one call.

    Parameters
    ----------
    windows : sequence of Window
        Measured samples with the joints' motion.
    model : SensorModel
        Defines the columns.
    table : Table
        Reference kinematics.
    column_function : callable
        Same signature as `effects.forward_equations.columns`.

    """
    references = references_of(windows, model, table)
    designs = {sensor: column_function(references, sensor) for sensor in SENSORS}
    edges = np.cumsum([0] + [len(window.motion) for window in windows])
    reduced = []
    for window, first, last in zip(windows, edges, edges[1:]):
        of_window = {sensor: design[first:last] for sensor, design in designs.items()}
        reduced.append(_reduced(window, of_window))
    return reduced


def reduce_window(
    window: Window, model: SensorModel, table: Table, *, session: int = 0
) -> WindowStatistics:
    """Return the statistics of one window, with the short pieces for held-out evaluation."""
    references = references_of([window], model, table)
    designs = {sensor: columns(references, sensor) for sensor in SENSORS}
    true_inputs = {}
    for sensor, design in designs.items():
        true_inputs[sensor] = design[:, model.columns_of(sensor, Role.LINEAR)]
    reduced = _reduced(window, designs)
    pieces = {}
    for sensor, statistics in reduced.sensors.items():
        if window.kind == 'static':
            pieces[sensor] = pieces_at_rest(statistics.mean, reduced.duration)
        else:
            pieces[sensor] = moving_pieces(
                np.concatenate([designs[sensor], measured(window, sensor)], axis=1),
                window.time,
                true_inputs[sensor],
                rate_s=true_inputs['gyroscope'],
            )
    return replace(reduced, session=session, pieces=pieces)


def _reduced(window: Window, designs: dict[str, np.ndarray]) -> WindowStatistics:
    """
    Return the statistics of a window of the first recording, without pieces.

    `designs`: sensor -> columns, shape (n, n_columns).
    """
    sensors = {}
    for sensor, design in designs.items():
        if sensor in window.absent:
            continue
        output = measured(window, sensor)
        if window.kind == 'static':
            sensors[sensor] = _reduce_static(design, output)
        else:
            sensors[sensor] = _reduce_moving(design, output, _piece_length(window))
    step = 0.0 if window.joint_step is None else float(np.max(window.joint_step, initial=0.0))
    return WindowStatistics(
        kind=window.kind,
        time=float(window.time.mean()),
        duration=float(window.time[-1] - window.time[0]),
        count=len(window.time),
        sensors=sensors,
        encoder_step=step,
    )


def _reduce_static(design: np.ndarray, output: np.ndarray) -> SensorStatistics:
    """Return the statistics of one sensor at rest: means, and the noise about them."""
    mean = np.concatenate([design.mean(axis=0), output.mean(axis=0)])
    variance, inflation = batch_statistics(output)
    return SensorStatistics(
        mean,
        within=np.zeros((0, len(mean))),
        noise_variance=np.maximum(variance, rounding_variance(output)),
        inflation=inflation,
    )


def _reduce_moving(design: np.ndarray, output: np.ndarray, length: int) -> SensorStatistics:
    """Return the statistics of one sensor in motion: mean row, and factors of the centred rows."""
    rows = np.concatenate([design, output], axis=1)
    mean = rows.mean(axis=0)
    rows -= mean
    slow = slow_part(rows, length)
    return SensorStatistics(
        mean,
        within=triangular(rows),
        noise_variance=rounding_variance(output),
        inflation=np.full(N_AXES, np.nan),
        slow=triangular(slow),
        slow_rows=len(slow),
    )


def _piece_length(window: Window) -> int:
    """Return the number of samples in SLOW_TIME, at least one."""
    span = window.time[-1] - window.time[0]
    if span <= 0:
        return 1
    return max(round(SLOW_TIME * (len(window.time) - 1) / span), 1)


def slow_part(rows: np.ndarray, length: int) -> np.ndarray:
    """
    Return the means of pieces of `length` rows times the root of `length`.

    They have the variance of single rows if the rows are white. Shape (n_pieces, n_columns); no
    rows when a piece is a single row.
    """
    n_pieces = len(rows) // length if length > 1 else 0
    if not n_pieces:
        return rows[:0]
    return rows[: n_pieces * length].reshape(n_pieces, length, -1).sum(axis=1) / np.sqrt(length)


def batch_statistics(output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (variance of each column, inflation of the variance of its means), each shape (m,).

    The means m_k of `BATCHES` pieces of n samples of white noise with variance s² have the variance
    s² / n. The inflation is ``var(m) n / s²``, with var(m) from the differences of neighbouring
    means, which excludes slow drift: ``var(m) = var(m_k - m_(k-1)) / 2``. The low-pass filter of a
    sensor makes it larger than one.
    """
    variance = output.var(axis=0, ddof=1)
    length = len(output) // BATCHES
    if length < 2:
        return variance, np.ones(output.shape[1])
    means = output[: length * BATCHES].reshape(BATCHES, length, -1).mean(axis=1)
    with np.errstate(divide='ignore', invalid='ignore'):
        factor = np.diff(means, axis=0).var(axis=0, ddof=0) / 2 * length / variance
    return variance, np.where(np.isfinite(factor), factor, 1.0)
