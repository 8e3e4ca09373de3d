"""The residual of one sensor in short blocks, with the columns of all candidate effects: data for regimes and formulas."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import References
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.session_noise import LEAST_NOISE
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window, chunks
from imu_calibration.selection.explained_share import ExplainedWindows
from imu_calibration.selection.linearised_problem import LinearisedProblem
from imu_calibration.selection.noise_beside_effects import natural_processes
from imu_calibration.selection.questions import TEMPERATURE_SPAN
from imu_calibration.selection.reduced_recording import columns_with_bank
from imu_calibration.selection.saturation import measured
from imu_calibration.selection.stamp_jitter import StampJitter, jitter_ratio, stamp_jitter
from imu_calibration.simulation.replay import predict_windows

MIN_BLOCK_SECONDS = 0.25
"""Least length of a block of a moving window, s; at rest a window is one block."""
MAX_RESIDUAL_BLOCKS = 1200
"""Blocks of one recording, about: their full covariance is factored."""
COVARIANCE_PARTS = 16
"""Parts of the rows of that covariance, which are computed one after the other."""
AT_A_TIME = 256
"""Blocks whose columns are in memory at once."""
WHITE_BENDS, PER_FREEDOM = 6.0, 35 / 18
"""Variance of second differences of unit white noise, and their number for each degree of freedom of a mean of their squares."""
WITHIN = 5
"""Rows at which the columns of a block are evaluated."""


@dataclass(frozen=True, eq=False)
class RestBlocks:
    """Means over blocks of one sensor's residual and of the columns of all candidate effects."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    ref: Reference
    """True motion at the rows within the blocks, in order of blocks."""
    starts: np.ndarray
    """First row of each block, shape (b,)."""
    time: np.ndarray
    """Middle of each block, s, shape (b,)."""
    window: np.ndarray
    """Number of the window of each block, shape (b,)."""
    locked: np.ndarray
    """Mask of blocks in locked windows, shape (b,)."""
    design: tuple
    """Per axis ``[columns of the parameters that act on it | residual]``, shape (b, q_a + 1)."""
    index: tuple
    """Per axis the parameters of the space that these columns belong to."""
    variance: np.ndarray
    """Variance of a block's residual by the white noise, shape (b, 3)."""
    processes: tuple
    """How every bias moves (BiasProcess)."""
    rough: np.ndarray
    """
    Variance of the residual within a block by second differences, which suppress causes that vary with the motion, without errors of the
    stamps, shape (b, 3).
    """
    freedom: np.ndarray
    """Its degrees of freedom, shape (b,)."""
    jitter: StampJitter
    """Errors of the stamps, the same for both sensors."""

    @property
    def warms(self) -> bool:
        """Whether the temperature is known and changes by as much as a thermal effect needs to show."""
        return self.ref.temperature_c is not None and bool(np.ptp(self.ref.temperature_c) >= TEMPERATURE_SPAN)

    def means(self, rows: np.ndarray) -> np.ndarray:
        """Return means over the blocks of something known at the rows, shape (b, ...)."""
        return block_means(rows, self.starts)

    @cached_property
    def white(self) -> list['BlockWhitener']:
        """Whiteners of the blocks outside locked windows and of those inside; large, therefore shared by the fits of all choices."""
        return [BlockWhitener(self, ~self.locked), BlockWhitener(self, self.locked)]


class BlockWhitener:
    """Makes rows of the blocks `select` (mask) independent, of unit variance: white noise of each block and a bias that moves."""

    def __init__(self, blocks: RestBlocks, select: np.ndarray):
        variance, time = blocks.variance[select], blocks.time[select]
        self.scale = np.sqrt(np.median(variance / variance.mean(axis=1, keepdims=True), axis=0))
        covariance = np.diag(variance.mean(axis=1))
        for rows in np.array_split(np.arange(len(time)), COVARIANCE_PARTS):   # intermediate arrays of a part, not of the matrix
            apart = np.abs(time[rows, None] - time[None, :])
            for process in blocks.processes:
                covariance[rows] += process.sd**2 * np.exp(-apart / process.time)
        self._factor, self._select = cholesky(covariance.T, lower=True, overwrite_a=True, check_finite=False), select

    def __call__(self, rows: np.ndarray, axis: int | None = None) -> np.ndarray:
        """Return whitened rows of an axis, shape of the selection; of all axes, still to be divided by ``scale[axis]``, without `axis`."""
        white = solve_triangular(self._factor, rows[self._select], lower=True, check_finite=False)
        return white if axis is None else white / self.scale[axis]


def rest_blocks(windows: Sequence[Window], table: Table, problem: LinearisedProblem, *,
                explained: ExplainedWindows) -> dict[str, RestBlocks]:
    """
    Return sensor -> RestBlocks of the windows of the reduced recording.

    Parameters
    ----------
    windows : sequence of Window
        Windows of the fit, in order.
    table : Table
    problem : LinearisedProblem
        The linearisation of the columns.
    explained : ExplainedWindows
        Expected loss from noise.

    """
    length = max(MIN_BLOCK_SECONDS, sum(w.time[-1] - w.time[0] for w in windows if len(w.motion) > 1) / MAX_RESIDUAL_BLOCKS)
    which = _some(windows, length)
    windows = [windows[k] for k in which]
    starts_of, rows_of, per_block = zip(*(_cut(window, length) for window in windows))
    motion = JointMotion.concatenate(window.motion.select(rows) for window, rows in zip(windows, rows_of))
    warm = [w.temperature_c[rows] if len(rows) > 1 else w.temperature_c.mean(keepdims=True) for w, rows in zip(windows, rows_of)
            if w.temperature_c is not None]
    temperature = np.concatenate(warm) if len(warm) == len(windows) else None
    place = np.repeat(np.arange(len(windows)), [len(starts) for starts in starts_of])
    edges = np.concatenate([starts + first for starts, first in zip(starts_of, np.cumsum([0, *map(len, windows[:-1])]))])
    count = np.diff(edges, append=sum(map(len, windows))).astype(float)
    common = {'starts': np.cumsum([0, *np.concatenate(per_block)[:-1]]),
              'time': block_means(np.concatenate([window.time for window in windows]), edges),
              'window': which[place], 'locked': problem.locked[which[place]]}
    references = References(problem.recording.model, table, motion, temperature_c=temperature)
    columns_of = _block_means(problem, table, motion, temperature, common['starts'])
    left = residuals(windows, table, problem.recording.model, values=problem.recording.values)
    inner = _inner(windows)
    number = np.add.reduceat(inner, edges)
    rough = {sensor: _roughness(residual, inner, edges, number=number, least=LEAST_NOISE[sensor]) for sensor, residual in left.items()}
    slope = {sensor: _slope(residual, windows, edges, sensor) for sensor, residual in left.items()}
    freedom = number / PER_FREEDOM
    jitter = stamp_jitter(list(rough.values()), list(slope.values()), freedom)
    louder = {sensor: jitter_ratio(rough[sensor], slope[sensor], jitter.sd) for sensor in left}
    kinds = problem.recording.kind[common['window']]
    of_kind = {str(kind): kinds == kind for kind in np.unique(kinds) if kind != 'static'}
    jitter = replace(jitter, ratio={sensor: {kind: float(louder[sensor][own].mean()) for kind, own in of_kind.items()} for sensor in left})
    found = {}
    for sensor, residual in left.items():
        floor = explained.floor.noise[sensor]
        busier = _busier(windows, sensor, floor, problem.recording.kind[which], ~problem.locked[which])
        variance = floor.low_variance * busier[place] / count[:, None]
        # An estimated bias process would absorb a step or a warm-up; regimes are searched with the least bias processes.
        processes = natural_processes(floor, problem.recording.period)
        rows = np.concatenate([columns_of[sensor], block_means(residual, edges)], axis=1)
        design = tuple(rows @ join for join in problem.space.join[sensor])
        found[sensor] = RestBlocks(sensor, references.at(sensor), **common, design=design, index=tuple(problem.space.index[sensor]),
                                   variance=variance, processes=processes, freedom=freedom,
                                   rough=rough[sensor] / louder[sensor], jitter=jitter)
    return found


def _roughness(residual, inner, edges, *, number, least):
    """Return the variance by the `number` of second differences in blocks that begin at the samples `edges`, at least rounding, (b, 3)."""
    bends = np.diff(residual, 2, axis=0, prepend=residual[:1], append=residual[-1:])
    squares = np.add.reduceat(inner[:, None] * bends**2, edges, axis=0) / WHITE_BENDS
    return np.maximum(squares / np.maximum(number, 1)[:, None], least**2)


def _inner(windows):
    """Return 1 for samples with two neighbours in their window, 0 for its ends, shape (n,)."""
    inner, ends = np.ones(sum(map(len, windows))), np.cumsum([len(window) for window in windows])
    inner[ends - 1] = inner[np.append(0, ends[:-1])] = 0.0
    return inner


def _slope(residual, windows, edges, sensor):
    """Return the mean square of the rate of change of the predicted output in blocks that begin at the samples `edges`, shape (b, 3)."""
    ends, squares = np.cumsum([0, *map(len, windows)]), np.zeros_like(residual)
    for window, first in zip(windows, ends):
        if len(window) > 2:
            part = slice(first, first + len(window))
            squares[part] = np.gradient(measured(window, sensor) - residual[part], window.time, axis=0)**2
    return block_means(squares, edges)


def _some(windows, length):
    """Return the numbers of the windows in use: all, or a random part of a long recording, in order."""
    blocks = sum(1 if len(w.motion) == 1 else max(1, round((w.time[-1] - w.time[0]) / length)) for w in windows)
    if blocks <= 2 * MAX_RESIDUAL_BLOCKS:
        return np.arange(len(windows))
    return np.sort(np.random.default_rng(0).permutation(len(windows))[:len(windows) * 2 * MAX_RESIDUAL_BLOCKS // blocks])


def _busier(windows, sensor, floor, kinds, judged):
    """
    Return by how much each window's white noise exceeds that at rest, shape (k, 3).

    By kind, from second differences of the windows `judged` (mask), which suppress causes that vary with the motion; at most
    the misfit of the kind.
    """
    place = SENSORS.index(sensor)
    found = np.ones((len(windows), 3))
    own = np.array([window.noise_sd[place]**2 if len(window) > 8 else np.full(3, np.nan) for window in windows])
    still = np.nanmedian(own[judged & (kinds == 'static')], axis=0) if np.any(judged & (kinds == 'static')) else floor.white_variance
    still = np.maximum(still, LEAST_NOISE[sensor]**2)
    for kind in np.unique(kinds[kinds != 'static']):
        most = np.maximum(floor.row_variance(kind) / floor.low_variance, 1.0)
        found[kinds == kind] = np.clip(np.nanmedian(own[judged & (kinds == kind)], axis=0) / still, 1.0, most)
    return found


def residuals(windows: Sequence[Window], table: Table, model: SensorModel, *, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return sensor -> residual of every sample of all windows at some values, shape (n, 3): rows within blocks would be too coarse."""
    predicted = [predict_windows(group, table, model, values=values) for group in chunks(windows)]   # columns need much memory
    return {sensor: np.concatenate([measured(window, sensor) for window in windows]) - np.concatenate([part[sensor] for part in predicted])
            for sensor in SENSORS}


def _block_means(problem, table, motion, temperature, starts):
    """Return sensor -> means of all columns over the blocks, shape (b, p): some blocks at a time, as their columns need much memory."""
    recording, found, edges = problem.recording, {sensor: [] for sensor in SENSORS}, np.append(starts, len(motion))
    for first in range(0, len(starts), AT_A_TIME):
        own = edges[first:first + AT_A_TIME + 1]
        rows = slice(own[0], own[-1])
        warmth = None if temperature is None else temperature[rows]
        references = References(recording.model, table, motion.select(rows), temperature_c=warmth)
        for sensor in SENSORS:
            found[sensor].append(block_means(columns_with_bank(references, sensor, recording.bank), own[:-1] - own[0]))
    return {sensor: np.concatenate(parts) for sensor, parts in found.items()}


def block_means(rows: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return means over the blocks that begin at `starts`, shape (b, ...)."""
    counts = np.diff(np.append(starts, len(rows)))
    return np.add.reduceat(rows, starts, axis=0) / counts.reshape(-1, *[1] * (rows.ndim - 1))


def _cut(window, length):
    """Return the first sample of each block of a window, the rows of its motion in use, and the number of them in each block."""
    if len(window.motion) == 1:
        return np.array([0]), np.array([0]), np.array([1])
    count = max(1, round((window.time[-1] - window.time[0]) / length))
    edges = np.unique(np.linspace(0, len(window), count + 1).round().astype(int))
    rows = [np.unique((a + (np.arange(WITHIN) + 0.5) / WITHIN * (b - a)).astype(int)) for a, b in zip(edges, edges[1:])]
    return edges[:-1], np.concatenate(rows), np.array([len(part) for part in rows])
