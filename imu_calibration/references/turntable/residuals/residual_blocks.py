"""
The residual of one sensor and the columns of all candidate effects, as means over short blocks.

Fits of columns to these means choose on some windows, and predict the locked (held-out) windows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular, svd

from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.effects.forward_equations import References
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.scaled_solve import solve_normal
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window, chunks, sensors_of
from imu_calibration.references.turntable.estimation.session_noise import LEAST_NOISE
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.residuals.jitter_of_blocks import (
    jitter_ratio,
    stamp_jitter,
)
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.references.turntable.selection.noise_beside_effects import natural_processes
from imu_calibration.references.turntable.selection.reduced_recording import columns_with_bank
from imu_calibration.references.turntable.window_statistics import measured
from imu_calibration.selection.questions import TEMPERATURE_SPAN
from imu_calibration.selection.regime_variables import block_means
from imu_calibration.selection.stamp_jitter import StampJitter
from imu_calibration.selection.unexplained import largest_axes
from imu_calibration.simulation.replay import predict_windows

MIN_BLOCK_SECONDS = 0.25
"""Least length of a block of a moving window, s; at rest a window is one block."""
MAX_RESIDUAL_BLOCKS = 1200
"""Approximate number of blocks of one recording, because their full covariance is factored."""
COVARIANCE_PARTS = 16
"""Parts of the rows of that covariance, which are computed one after the other."""
AT_A_TIME = 256
"""Blocks whose columns are in memory at once."""
VARIANCE_OF_DIFFERENCES = 6.0
"""Variance of the second differences ``y_(k-1) - 2 y_k + y_(k+1)`` of unit white noise."""
DIFFERENCES_PER_FREEDOM = 35 / 18
"""Second differences for each degree of freedom of the mean of their squares: they overlap."""
SHORT_WINDOW = 8
"""Samples up to which the white noise of a window is unknown."""
WITHIN = 5
"""Rows at which the columns of a block are evaluated."""


@dataclass(frozen=True, eq=False)
class BlockMeans:
    """
    Means over b blocks of one sensor's residual and of the columns of all candidate effects.

    A block is a part of a moving window, or a whole window at rest.
    """

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
    design: tuple[np.ndarray, ...]
    """Per axis ``[columns of the parameters that act on it | residual]``, shape (b, q_a + 1)."""
    index: tuple[np.ndarray, ...]
    """Per axis the numbers of these parameters in the `ParameterSpace`, shape (q_a,)."""
    variance: np.ndarray
    """Variance of the mean of each block by the white noise, shape (b, 3)."""
    processes: tuple[BiasProcess, ...]
    """Bias processes, the same for all axes."""
    rough: np.ndarray
    """
    Variance of the samples within each block by second differences, which suppress causes that vary
    with the motion, without errors of the stamps, shape (b, 3).
    """
    freedom: np.ndarray
    """Degrees of freedom of `rough`, shape (b,)."""
    jitter: StampJitter
    """Errors of the stamps, the same for both sensors."""

    @property
    def warms(self) -> bool:
        """Whether the temperature is known and changes enough for a thermal effect to show."""
        return self.ref.temperature_c is not None and bool(
            np.ptp(self.ref.temperature_c) >= TEMPERATURE_SPAN
        )

    def means(self, rows: np.ndarray) -> np.ndarray:
        """Return the means over the blocks of values at the rows of `ref`, shape (b, ...)."""
        return block_means(rows, self.starts)

    @cached_property
    def white(self) -> list['BlockWhitener']:
        """
        Whiteners of the blocks outside locked windows, and of the locked blocks.

        Each holds a factor of shape (b, b), therefore the fits of all choices share them.
        """
        return [BlockWhitener(self, ~self.locked), BlockWhitener(self, self.locked)]


class BlockWhitener:
    """
    Whitening of the blocks `select` (mask) by the factor L of their covariance ``C = L L'``.

    One covariance serves the three axes, whose white noise differs by the factors `scale`. With the
    means v_i of the variances of a block over the axes, and the bias processes (sd, T)::

        C_ij = v_i (i = j) + sum over processes of sd^2 exp(-|t_i - t_j| / T)
    """

    def __init__(self, blocks: BlockMeans, select: np.ndarray):
        variance = blocks.variance[select]
        time = blocks.time[select]
        mean_variance = variance.mean(axis=1, keepdims=True)
        self.scale = np.sqrt(np.median(variance / mean_variance, axis=0))
        covariance = np.diag(mean_variance[:, 0])
        # By parts of the rows: the intermediate arrays are then smaller than the matrix.
        for rows in np.array_split(np.arange(len(time)), COVARIANCE_PARTS):
            apart = np.abs(time[rows, None] - time[None, :])
            for process in blocks.processes:
                covariance[rows] += process.sd**2 * np.exp(-apart / process.time)
        self._select = select
        self._factor = cholesky(covariance.T, lower=True, overwrite_a=True, check_finite=False)

    def whiten(self, rows: np.ndarray) -> np.ndarray:
        """
        Return ``L^-1 rows`` of the selected blocks, shape (n_selected, k).

        The errors are independent; on an axis they have the standard deviation ``scale[axis]``.
        """
        return solve_triangular(self._factor, rows[self._select], lower=True, check_finite=False)

    def whiten_axis(self, rows: np.ndarray, axis: int) -> np.ndarray:
        """Return rows of one axis with independent errors of unit variance, (n_selected, k)."""
        return self.whiten(rows) / self.scale[axis]


@dataclass(frozen=True, eq=False)
class WhitenedAxis:
    """Whitening of the blocks of one axis (`ColumnWhitening`)."""

    whitener: BlockWhitener
    axis: int

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Return columns over the blocks with independent errors of unit variance."""
        return self.whitener.whiten_axis(columns, self.axis)


@dataclass(frozen=True, eq=False)
class _CutWindows:
    """Windows of a recording, cut into b blocks."""

    windows: list[Window]
    """Windows in use."""
    used: np.ndarray
    """Their numbers among all windows of the fit, shape (k,)."""
    motion: JointMotion
    """Motion at the rows at which columns are evaluated: a few in each block."""
    temperature_c: np.ndarray | None
    """Temperature at these rows; None where a window has none."""
    first_row: np.ndarray
    """First of these rows of each block, shape (b,)."""
    first_sample: np.ndarray
    """First sample of each block among the samples of all windows in use, shape (b,)."""
    place_of_window: np.ndarray
    """Place in `windows` of the window of each block, shape (b,)."""

    @classmethod
    def of(cls, windows: Sequence[Window]) -> '_CutWindows':
        """Return the windows, or a random part of a long recording, cut into blocks."""
        # Blocks so long that moving windows have about `MAX_RESIDUAL_BLOCKS` of them.
        moving_time = sum(w.time[-1] - w.time[0] for w in windows if len(w.motion) > 1)
        length = max(MIN_BLOCK_SECONDS, moving_time / MAX_RESIDUAL_BLOCKS)
        used = _used_windows(windows, length)
        windows_in_use = [windows[k] for k in used]
        cuts = [_cut(window, length) for window in windows_in_use]

        # The rows and samples of all windows, one window after the other.
        motions = []
        first_samples = []
        n_samples = 0
        for window, cut in zip(windows_in_use, cuts):
            motions.append(window.motion.select(cut.rows))
            first_samples.append(n_samples + cut.starts)
            n_samples += len(window)
        rows_per_block = np.concatenate([cut.per_block for cut in cuts])
        return cls(
            windows=windows_in_use,
            used=used,
            motion=JointMotion.concatenate(motions),
            temperature_c=_temperatures(windows_in_use, cuts),
            first_row=np.cumsum([0, *rows_per_block[:-1]]),
            first_sample=np.concatenate(first_samples),
            place_of_window=np.repeat(np.arange(len(cuts)), [len(cut.starts) for cut in cuts]),
        )

    def sample_means(self, samples: np.ndarray) -> np.ndarray:
        """Return the means over the blocks of values of every sample, shape (b, ...)."""
        return block_means(samples, self.first_sample)


def residual_blocks(
    windows: Sequence[Window], table: Table, problem: LinearisedProblem
) -> dict[str, BlockMeans]:
    """
    Return sensor -> BlockMeans of the windows of the reduced recording.

    Parameters
    ----------
    windows : sequence of Window
        Windows of the fit, in order.
    table : Table
    problem : LinearisedProblem
        The linearisation of the columns, and the noise of each sensor.

    """
    # 1. Columns at a few rows of each block, residuals of every sample.
    cut = _CutWindows.of(windows)
    window_of_block = cut.used[cut.place_of_window]
    references = References(
        problem.recording.model, table, cut.motion, temperature_c=cut.temperature_c
    )
    columns_of = _mean_columns(problem, table, cut)
    residual_of = residuals(
        cut.windows, table, problem.recording.model, values=problem.recording.values
    )

    # 2. Scatter within the blocks by second differences, and the part of it from the stamps.
    inner = _inner_samples(cut.windows)
    n_differences = np.add.reduceat(inner, cut.first_sample)
    freedom = n_differences / DIFFERENCES_PER_FREEDOM
    rough = {}
    slope = {}
    for sensor, residual in residual_of.items():
        rough[sensor] = _variance_by_differences(
            residual, inner, cut.first_sample, n_differences, least_sd=LEAST_NOISE[sensor]
        )
        slope[sensor] = _mean_square_slope(residual, cut, sensor)
    jitter = stamp_jitter(list(rough.values()), list(slope.values()), freedom)
    by_jitter = {}
    for sensor in residual_of:
        by_jitter[sensor] = jitter_ratio(rough[sensor], slope[sensor], jitter.sd)
    jitter = replace(jitter, ratio=_by_kind(by_jitter, problem.recording.kind[window_of_block]))

    # 3. Means over the blocks, with their variance by the white noise of each kind of window.
    time = np.concatenate([window.time for window in cut.windows])
    n_samples_of_block = np.diff(cut.first_sample, append=len(time)).astype(float)
    blocks = {}
    for sensor, residual in residual_of.items():
        floor = problem.explained.floor.noise[sensor]
        noise_factor = _white_noise_factor(
            cut.windows, sensor, floor, problem.recording.kind[cut.used], ~problem.locked[cut.used]
        )
        variance = floor.low_variance * noise_factor[cut.place_of_window]
        rows = np.concatenate([columns_of[sensor], cut.sample_means(residual)], axis=1)
        blocks[sensor] = BlockMeans(
            sensor,
            references.at(sensor),
            starts=cut.first_row,
            time=cut.sample_means(time),
            window=window_of_block,
            locked=problem.locked[window_of_block],
            design=tuple(rows @ join for join in problem.space.join[sensor]),
            index=tuple(problem.space.index[sensor]),
            variance=variance / n_samples_of_block[:, None],
            # An estimated bias process would absorb a step or a warm-up; regimes are searched with
            # the least bias processes.
            processes=natural_processes(floor, problem.recording.period),
            freedom=freedom,
            rough=rough[sensor] / by_jitter[sensor],
            jitter=jitter,
        )
    return blocks


def _temperatures(windows: Sequence[Window], cuts: Sequence['_Cut']) -> np.ndarray | None:
    """Return the temperature at the rows of all blocks; None where a window has none."""
    temperatures = []
    for window, cut in zip(windows, cuts):
        if window.temperature_c is None:
            return None
        if len(cut.rows) == 1:  # a window at rest
            temperatures.append(window.temperature_c.mean(keepdims=True))
        else:
            temperatures.append(window.temperature_c[cut.rows])
    return np.concatenate(temperatures)


def _by_kind(
    factor_of_blocks: dict[str, np.ndarray], kinds: np.ndarray
) -> dict[str, dict[str, float]]:
    """
    Return sensor -> kind of moving window -> mean over its blocks of a factor, shape (b, 3).

    The blocks belong to windows of the kinds `kinds`, shape (b,).
    """
    means: dict[str, dict[str, float]] = {}
    for sensor, factor in factor_of_blocks.items():
        means[sensor] = {}
        for kind in np.unique(kinds):
            if kind != 'static':
                means[sensor][str(kind)] = float(factor[kinds == kind].mean())
    return means


def _variance_by_differences(
    residual: np.ndarray,
    inner: np.ndarray,
    first_sample: np.ndarray,
    n_differences: np.ndarray,
    *,
    least_sd: float,
) -> np.ndarray:
    """
    Return the variance of the samples of each block by second differences, shape (b, 3).

    With d_k the second difference about sample k, and the n_b inner samples of a block::

        variance = max(sum d_k^2 / (6 n_b), least_sd^2)

    Parameters
    ----------
    residual : ndarray, shape (n, 3)
        Of every sample.
    inner : ndarray, shape (n,)
        1 for samples with a second difference, else 0 (`_inner_samples`).
    first_sample : ndarray, shape (b,)
        First sample of each block.
    n_differences : ndarray, shape (b,)
        Number n_b of inner samples of each block.
    least_sd : float
        Noise of rounding, SI.

    """
    # The two further rows keep the number of samples; `inner` excludes the ends of windows. Then
    # the sum over each block.
    differences = np.diff(residual, 2, axis=0, prepend=residual[:1], append=residual[-1:])
    squares = np.add.reduceat(inner[:, None] * differences**2, first_sample, axis=0)
    squares = squares / VARIANCE_OF_DIFFERENCES
    return np.maximum(squares / np.maximum(n_differences, 1)[:, None], least_sd**2)


def _inner_samples(windows: Sequence[Window]) -> np.ndarray:
    """Return 1 for samples with two neighbours in their window, 0 for its ends, shape (n,)."""
    ends = np.cumsum([len(window) for window in windows])
    inner = np.ones(ends[-1])
    inner[ends - 1] = 0.0  # last samples
    inner[np.append(0, ends[:-1])] = 0.0  # first samples
    return inner


def _mean_square_slope(residual: np.ndarray, cut: _CutWindows, sensor: str) -> np.ndarray:
    """
    Return the mean over each block of ``(dy/dt)^2``, y the predicted output, shape (b, 3).

    Parameters
    ----------
    residual : ndarray, shape (n, 3)
        Measured minus predicted output of every sample.
    cut : _CutWindows
    sensor : str

    """
    squares = np.zeros_like(residual)
    start = 0
    for window in cut.windows:
        part = slice(start, start + len(window))
        if len(window) > 2:
            predicted = measured(window, sensor) - residual[part]
            squares[part] = np.gradient(predicted, window.time, axis=0) ** 2
        start = part.stop
    return cut.sample_means(squares)


def _used_windows(windows: Sequence[Window], length: float) -> np.ndarray:
    """
    Return the numbers of the windows in use: all, or a random part of a long recording, in order.

    `length` is that of a block, s.
    """
    n_blocks = 0
    for window in windows:
        n_blocks += 1 if len(window.motion) == 1 else _count_blocks(window, length)
    # The length allows for `MAX_RESIDUAL_BLOCKS` blocks of moving windows; rests and windows
    # shorter than a block come in addition.
    most = 2 * MAX_RESIDUAL_BLOCKS
    if n_blocks <= most:
        return np.arange(len(windows))
    n_used = len(windows) * most // n_blocks
    return np.sort(np.random.default_rng(0).permutation(len(windows))[:n_used])


def _count_blocks(window: Window, length: float) -> int:
    """Return the number of blocks of about `length` s of a moving window."""
    return max(1, round((window.time[-1] - window.time[0]) / length))


def _white_noise_factor(
    windows: Sequence[Window],
    sensor: str,
    noise: NoiseModel,
    kinds: np.ndarray,
    selected: np.ndarray,
) -> np.ndarray:
    """
    Return the variance of white noise of each window over that at rest, shape (k, 3).

    It is the same for all windows of a kind: the median of the variances by second differences,
    which suppress causes that vary with the motion, of the windows `selected` (mask); at least 1,
    and at most the residual variance of the kind over that at rest.
    """
    # Variance of the white noise in each window; unknown in short ones.
    place = SENSORS.index(sensor)
    variance = np.full((len(windows), 3), np.nan)
    for number, window in enumerate(windows):
        if len(window) > SHORT_WINDOW:
            variance[number] = window.noise_sd[place] ** 2

    # Variance at rest.
    static = selected & (kinds == 'static')
    at_rest = noise.white_variance
    if static.any():
        at_rest = np.nanmedian(variance[static], axis=0)
    at_rest = np.maximum(at_rest, LEAST_NOISE[sensor] ** 2)

    factor = np.ones((len(windows), 3))
    for kind in np.unique(kinds[kinds != 'static']):
        misfit = np.maximum(noise.row_variance(kind) / noise.low_variance, 1.0)
        of_kind = np.nanmedian(variance[selected & (kinds == kind)], axis=0)
        factor[kinds == kind] = np.clip(of_kind / at_rest, 1.0, misfit)
    return factor


def residuals(
    windows: Sequence[Window], table: Table, model: SensorModel, *, values: np.ndarray
) -> dict[str, np.ndarray]:
    """
    Return sensor -> measured minus predicted output of every sample, shape (n, 3).

    The windows follow one after the other; `values` are the parameters of the model.
    """
    # Some windows at a time: columns need much memory.
    predicted = [predict_windows(group, table, model, values=values) for group in chunks(windows)]
    residual_of = {}
    for sensor in sensors_of(windows):
        readings = np.concatenate([measured(window, sensor) for window in windows])
        residual_of[sensor] = readings - np.concatenate([part[sensor] for part in predicted])
    return residual_of


def _mean_columns(
    problem: LinearisedProblem, table: Table, cut: _CutWindows
) -> dict[str, np.ndarray]:
    """
    Return sensor -> means of all columns over the blocks, shape (b, p).

    Some blocks at a time, as their columns need much memory.
    """
    recording = problem.recording
    row_edges = np.append(cut.first_row, len(cut.motion))
    groups: dict[str, list[np.ndarray]] = {sensor: [] for sensor in recording.sensors}
    for first in range(0, len(cut.first_row), AT_A_TIME):
        # First row of each of these blocks, and the end of the last one.
        edges = row_edges[first : first + AT_A_TIME + 1]
        rows = slice(edges[0], edges[-1])
        temperature = None if cut.temperature_c is None else cut.temperature_c[rows]
        references = References(
            recording.model, table, cut.motion.select(rows), temperature_c=temperature
        )
        for sensor, means in groups.items():
            columns = columns_with_bank(references, sensor, recording.bank)
            means.append(block_means(columns, edges[:-1] - edges[0]))
    return {sensor: np.concatenate(means) for sensor, means in groups.items()}


@dataclass(frozen=True, eq=False)
class _Cut:
    """A window cut into blocks."""

    starts: np.ndarray
    """First sample of each block, shape (b,)."""
    rows: np.ndarray
    """Rows of the window's motion at which columns are evaluated, in order of blocks."""
    per_block: np.ndarray
    """Number of these rows in each block, shape (b,)."""


def _cut(window: Window, length: float) -> _Cut:
    """Return a window cut into blocks of about `length` s; at rest it is one block."""
    if len(window.motion) == 1:
        return _Cut(np.array([0]), np.array([0]), np.array([1]))
    n_blocks = _count_blocks(window, length)
    edges = np.unique(np.linspace(0, len(window), n_blocks + 1).round().astype(int))
    # Rows in the middles of equal parts of each block; short blocks have fewer.
    middles = (np.arange(WITHIN) + 0.5) / WITHIN
    rows = [
        np.unique((start + middles * (end - start)).astype(int))
        for start, end in zip(edges, edges[1:])
    ]
    return _Cut(edges[:-1], np.concatenate(rows), np.array([len(part) for part in rows]))


AMPLITUDE_PRIOR_SD = 1e6
"""
Prior sd of amplitudes; unit: the amplitude that equals one standard deviation of noise in all
blocks.
"""
IMITATED = 1e-6
"""Least singular value of the scaled columns of the catalogue, relative to the largest one."""
SHARE_RESAMPLES = 500
"""Samples of the bootstrap of a share."""
ABOVE_NOISE = 3.0
"""Least excess over noise of an axis with a significant residual, standard deviations."""


@dataclass(frozen=True, eq=False)
class BlockFit:
    """A model and k further columns, fitted to the selection windows, on locked windows."""

    amplitudes: np.ndarray
    """Amplitudes of the further columns on each axis, shape (k, 3)."""
    sd: np.ndarray
    """Standard deviations of the amplitudes, larger by the misfit, shape (k, 3)."""
    locked_residual: np.ndarray
    """Whitened residual of the locked blocks, by the fit to the others, shape (n_locked, 3)."""
    window: np.ndarray
    """Window of each locked block, shape (n_locked,)."""

    @property
    def excess(self) -> float:
        """Sum of squares of the locked blocks above the expectation from noise."""
        return float((self.locked_residual**2 - 1.0).sum())


SELECTION = 0
"""Place of the blocks outside locked windows in the lists of `BlockFits`."""
LOCKED = 1
"""Place of the locked blocks in these lists."""


class BlockFits:
    """
    Fits to the blocks of one sensor with a choice of parameters, whitened once.

    Parameters
    ----------
    blocks : BlockMeans
    used : sequence of int
        Parameters of the model, numbers in the `ParameterSpace`.
    prior_sd, prior_mean : ndarray
        Prior of all parameters of that space.

    """

    def __init__(
        self,
        blocks: BlockMeans,
        used: Sequence[int],
        *,
        prior_sd: np.ndarray,
        prior_mean: np.ndarray,
    ):
        self.blocks = blocks
        self.used = frozenset(used)
        self._prior_sd = prior_sd
        self._prior_mean = prior_mean
        # [SELECTION or LOCKED][axis]: whitened rows [columns | residual].
        self._design = []
        for whitener in blocks.white:
            designs = enumerate(blocks.design)
            self._design.append([whitener.whiten_axis(rows, axis) for axis, rows in designs])
        # Per axis the places of the parameters in use among the columns.
        self._used_places = [np.flatnonzero(np.isin(index, list(used))) for index in blocks.index]

    def fit(
        self,
        columns: np.ndarray | None = None,
        *,
        more: Sequence[int] = (),
        half: int | None = None,
    ) -> BlockFit:
        """
        Return the BlockFit of the model with further columns.

        Parameters
        ----------
        columns : array, shape (b, k, 3), optional
            Further columns over all blocks, one amplitude for each column and axis.
        more : sequence of int
            Parameters of the catalogue that join the model.
        half : 0 or 1, optional
            Fit to the earlier (0) or later (1) half of the selection windows only.

        """
        n_columns = 0 if columns is None else columns.shape[1]
        amplitudes = np.zeros((n_columns, 3))
        sds = np.zeros((n_columns, 3))
        locked_residuals = []
        for axis in range(3):
            joining = np.flatnonzero(np.isin(self.blocks.index[axis], list(more)))
            places = np.union1d(self._used_places[axis], joining).astype(int)
            fit = self._fitted(axis, places, columns, half)

            # The variances grow by the chi-square per degree of freedom.
            n_free = max(len(fit.residual) - len(fit.values), 1)
            misfit = max(float(fit.residual @ fit.residual) / n_free, 1.0)
            amplitudes[:, axis] = fit.values[len(places) :]
            sds[:, axis] = np.sqrt(misfit * np.diag(fit.covariance)[len(places) :])

            # Prediction of the locked blocks.
            locked = self._rows(LOCKED, axis, places, columns)
            locked_residuals.append(locked[:, -1] - locked[:, :-1] @ fit.values)
        locked_window = self.blocks.window[self.blocks.locked]
        return BlockFit(amplitudes, sds, np.stack(locked_residuals, axis=1), locked_window)

    def outside_catalogue(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (columns, residual) less their projection on all columns of the catalogue.

        Both are whitened and of the n blocks of the selection windows, the three axes one after the
        other: shape (3 n, k) and (3 n,).

        Parameters
        ----------
        columns : array, shape (b, k, 3)

        """
        outside_columns = []
        outside_residual = []
        for axis in range(3):
            # Orthonormal basis of the catalogue's columns; x - U U^T x is orthogonal to them.
            design = self._design[SELECTION][axis]
            catalogue = design[:, :-1]
            residual = design[:, -1]
            norm = np.linalg.norm(catalogue, axis=0)
            scaled = catalogue / np.where(norm > 0, norm, 1)
            basis, singular_values, _ = svd(scaled, full_matrices=False)
            basis = basis[:, singular_values > IMITATED * singular_values.max()]

            rows = self.blocks.white[SELECTION].whiten_axis(columns[:, :, axis], axis)
            outside_columns.append(rows - basis @ (basis.T @ rows))
            outside_residual.append(residual - basis @ (basis.T @ residual))
        return np.concatenate(outside_columns), np.concatenate(outside_residual)

    def axes(self) -> tuple[str, ...]:
        """
        Return the axes with a significant excess in the selection windows.

        The axis with the largest excess in SI units squared is first.
        """
        selection = ~self.blocks.locked
        excess = self._excess()
        # The sum of n squares of unit noise has the variance 2 n. The axis with the largest excess
        # is named in any case.
        noise = ABOVE_NOISE * np.sqrt(2.0 * selection.sum())
        least_excess = min(noise, 0.99 * excess.max())
        squares = excess * np.median(self.blocks.variance[selection], axis=0)
        largest_first = largest_axes(squares)
        return tuple(axis for axis in largest_first if excess[AXES.index(axis)] > least_excess)

    @property
    def sigma(self) -> float:
        """Excess of the squares of the selection windows over noise, standard deviations."""
        # The sum of 3 n squares of unit noise has the variance 6 n.
        return float(self._excess().sum() / np.sqrt(6.0 * (~self.blocks.locked).sum()))

    def _excess(self) -> np.ndarray:
        """
        Return the sums of squares above the expectation from noise in the selection windows.

        Shape (3,).
        """
        excess = np.zeros(3)
        for axis in range(3):
            residual = self._fitted(axis, self._used_places[axis]).residual
            excess[axis] = max(float(residual @ residual) - len(residual), 0.0)
        return excess

    def _fitted(
        self,
        axis: int,
        places: np.ndarray,
        columns: np.ndarray | None = None,
        half: int | None = None,
    ) -> '_AxisFit':
        """
        Return the fit of one axis to the selection windows, or to a `half` of them.

        Its values are those of the parameters with the `places` among the columns of the axis, then
        the amplitudes of the further `columns`, shape (b, k, 3).
        """
        rows = self._rows(SELECTION, axis, places, columns)
        if half is not None:
            time = self.blocks.time[~self.blocks.locked]
            rows = rows[(time > np.median(time)) == half]
        # Parameters have the priors of the catalogue, amplitudes nearly none: their columns are the
        # last ones before the residual.
        parameters = self.blocks.index[axis][places]
        size = np.sqrt(np.maximum((rows[:, len(places) : -1] ** 2).sum(axis=0), 1e-60))
        sd = np.append(self._prior_sd[parameters], AMPLITUDE_PRIOR_SD / size)
        mean = np.append(self._prior_mean[parameters], np.zeros_like(size))
        values, covariance = solve_normal(rows.T @ rows, np.arange(len(sd)), sd, prior_mean=mean)
        return _AxisFit(values, covariance, rows[:, -1] - rows[:, :-1] @ values)

    def _rows(
        self, part: int, axis: int, places: np.ndarray, columns: np.ndarray | None
    ) -> np.ndarray:
        """
        Return whitened rows ``[columns of parameters | further columns | residual]`` of an axis.

        The parameters have the `places` among the columns of the axis; the blocks are those of
        `part`, `SELECTION` or `LOCKED`.
        """
        design = self._design[part][axis]
        parts = [design[:, places]]
        if columns is not None:
            parts.append(self.blocks.white[part].whiten_axis(columns[:, :, axis], axis))
        return np.concatenate([*parts, design[:, -1:]], axis=1)


@dataclass(frozen=True, eq=False)
class _AxisFit:
    """Least-squares fit of one axis to whitened rows."""

    values: np.ndarray
    """Parameters, then amplitudes of further columns, shape (n,)."""
    covariance: np.ndarray
    """Covariance of the values, shape (n, n)."""
    residual: np.ndarray
    """Whitened residual of the fitted blocks, shape (n_blocks,)."""


def share_removed(before: BlockFit, after: BlockFit) -> float:
    """Return the share of the locked blocks' excess that a fit removes."""
    if before.excess <= 0:
        return 0.0
    return 1.0 - max(after.excess, 0.0) / before.excess


def share_interval(
    before: BlockFit, after: BlockFit, rng: np.random.Generator
) -> tuple[float, float]:
    """
    Return the 95 % interval of `share_removed`, by the bootstrap over locked windows.

    Each sample draws as many windows as there are, with replacement::

        share = 1 - max(excess after, 0) / excess before

    """
    # Excess of each window: squares of the whitened residual, less 1 each from noise.
    excess_before = []
    excess_after = []
    for window in np.unique(before.window):
        in_window = before.window == window
        excess_before.append((before.locked_residual[in_window] ** 2 - 1.0).sum())
        excess_after.append((after.locked_residual[in_window] ** 2 - 1.0).sum())

    excess = np.array([excess_before, excess_after])

    n_windows = excess.shape[1]
    drawn = rng.integers(n_windows, size=(SHARE_RESAMPLES, n_windows))
    before_of_draw, after_of_draw = excess[:, drawn].sum(axis=2)
    shares = 1.0 - np.maximum(after_of_draw, 0.0) / np.maximum(before_of_draw, 1e-300)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(low), float(high)
