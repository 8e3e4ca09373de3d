"""
The residual of one sensor in short blocks.

With the columns of all candidate effects, and fits of columns to it.
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
from imu_calibration.references.turntable.selection.explained_windows import ExplainedWindows
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.references.turntable.selection.noise_beside_effects import natural_processes
from imu_calibration.references.turntable.selection.reduced_recording import columns_with_bank
from imu_calibration.references.turntable.selection.saturation import measured
from imu_calibration.selection.questions import TEMPERATURE_SPAN
from imu_calibration.selection.regime_variables import block_means
from imu_calibration.selection.stamp_jitter import StampJitter
from imu_calibration.selection.unexplained import largest_axes
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
"""
Variance of second differences of unit white noise, and their number for each degree of freedom of a
mean of their squares.
"""
SHORT_WINDOW = 8
"""Samples up to which the white noise of a window is unknown."""
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
    Variance of the residual within a block by second differences, which suppress causes that vary
    with the motion, without errors of the stamps, shape (b, 3).
    """
    freedom: np.ndarray
    """Its degrees of freedom, shape (b,)."""
    jitter: StampJitter
    """Errors of the stamps, the same for both sensors."""

    @property
    def warms(self) -> bool:
        """
        Whether the temperature is known and changes by as much as a thermal effect needs to show.
        """
        return self.ref.temperature_c is not None and bool(
            np.ptp(self.ref.temperature_c) >= TEMPERATURE_SPAN
        )

    def means(self, rows: np.ndarray) -> np.ndarray:
        """Return means over the blocks of something known at the rows, shape (b, ...)."""
        return block_means(rows, self.starts)

    @cached_property
    def white(self) -> list['BlockWhitener']:
        """
        Whiteners of the blocks outside locked windows and of those inside.

        Large, therefore shared by the fits of all choices.
        """
        return [BlockWhitener(self, ~self.locked), BlockWhitener(self, self.locked)]


class BlockWhitener:
    """
    Makes rows of the blocks `select` (mask) independent, of unit variance.

    White noise of each block and a bias that moves.
    """

    def __init__(self, blocks: RestBlocks, select: np.ndarray):
        # One covariance for the three axes, whose white noise differs by a factor:
        # C_ij = variance_i (i = j) + sum over the bias processes of sd^2 exp(-|t_i - t_j| / T)
        variance = blocks.variance[select]
        time = blocks.time[select]
        mean_variance = variance.mean(axis=1, keepdims=True)
        self.scale = np.sqrt(np.median(variance / mean_variance, axis=0))
        covariance = np.diag(mean_variance[:, 0])
        # Intermediate arrays of a part, not of the matrix.
        for rows in np.array_split(np.arange(len(time)), COVARIANCE_PARTS):
            apart = np.abs(time[rows, None] - time[None, :])
            for process in blocks.processes:
                covariance[rows] += process.sd**2 * np.exp(-apart / process.time)
        self._select = select
        self._factor = cholesky(covariance.T, lower=True, overwrite_a=True, check_finite=False)

    def __call__(self, rows: np.ndarray, axis: int | None = None) -> np.ndarray:
        """
        Return whitened rows of an axis, shape of the selection.

        Of all axes, still to be divided by ``scale[axis]``, without `axis`.
        """
        white = solve_triangular(self._factor, rows[self._select], lower=True, check_finite=False)
        return white if axis is None else white / self.scale[axis]


def rest_blocks(
    windows: Sequence[Window],
    table: Table,
    problem: LinearisedProblem,
    *,
    explained: ExplainedWindows,
) -> dict[str, RestBlocks]:
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
    # Blocks of the windows in use: their first samples, and the motion at a few rows of each.
    moving_time = sum(w.time[-1] - w.time[0] for w in windows if len(w.motion) > 1)
    length = max(MIN_BLOCK_SECONDS, moving_time / MAX_RESIDUAL_BLOCKS)
    used = _used_windows(windows, length)
    windows = [windows[k] for k in used]
    cuts = []
    motions = []
    rows_per_block = []
    first_of_block = []
    place_of_block = []
    n_samples = 0
    for place, window in enumerate(windows):
        cut = _cut(window, length)
        cuts.append(cut)
        motions.append(window.motion.select(cut.rows))
        rows_per_block.append(cut.per_block)
        first_of_block.append(n_samples + cut.starts)
        place_of_block.append(np.full(len(cut.starts), place))
        n_samples += len(window)
    motion = JointMotion.concatenate(motions)
    temperature = _temperatures(windows, cuts)
    starts = np.cumsum([0, *np.concatenate(rows_per_block)[:-1]])  # first row of each block
    edges = np.concatenate(first_of_block)
    place_of_window = np.concatenate(place_of_block)
    window_of_block = used[place_of_window]
    n_samples_of_block = np.diff(edges, append=n_samples).astype(float)

    # Columns and residuals.
    references = References(problem.recording.model, table, motion, temperature_c=temperature)
    columns_of = _block_means(problem, table, motion, temperature, starts)
    residual_of = residuals(
        windows, table, problem.recording.model, values=problem.recording.values
    )

    # Variance within the blocks, without that of errors of the stamps.
    inner = _inner(windows)
    number = np.add.reduceat(inner, edges)
    freedom = number / PER_FREEDOM
    rough = {}
    slope = {}
    for sensor, residual in residual_of.items():
        rough[sensor] = _roughness(residual, inner, edges, number=number, least=LEAST_NOISE[sensor])
        slope[sensor] = _slope(residual, windows, edges, sensor)
    jitter = stamp_jitter(list(rough.values()), list(slope.values()), freedom)
    by_jitter = {}
    for sensor in residual_of:
        by_jitter[sensor] = jitter_ratio(rough[sensor], slope[sensor], jitter.sd)
    jitter = replace(jitter, ratio=_by_kind(by_jitter, problem.recording.kind[window_of_block]))

    blocks = {}
    for sensor, residual in residual_of.items():
        floor = explained.floor.noise[sensor]
        noise_factor = _white_noise_factor(
            windows, sensor, floor, problem.recording.kind[used], ~problem.locked[used]
        )
        variance = floor.low_variance * noise_factor[place_of_window]
        rows = np.concatenate([columns_of[sensor], block_means(residual, edges)], axis=1)
        blocks[sensor] = RestBlocks(
            sensor,
            references.at(sensor),
            starts=starts,
            time=block_means(np.concatenate([each.time for each in windows]), edges),
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
    """Return the temperature at the rows of all windows; None where a window has none."""
    found = []
    for window, cut in zip(windows, cuts):
        if window.temperature_c is None:
            return None
        at_rest = len(cut.rows) == 1
        found.append(
            window.temperature_c.mean(keepdims=True) if at_rest else window.temperature_c[cut.rows]
        )
    return np.concatenate(found)


def _by_kind(louder: dict[str, np.ndarray], kinds: np.ndarray) -> dict[str, dict[str, float]]:
    """Return sensor -> kind of moving window -> mean factor of its blocks."""
    found: dict[str, dict[str, float]] = {}
    for sensor, factor in louder.items():
        found[sensor] = {}
        for kind in np.unique(kinds):
            if kind != 'static':
                found[sensor][str(kind)] = float(factor[kinds == kind].mean())
    return found


def _roughness(
    residual: np.ndarray, inner: np.ndarray, edges: np.ndarray, *, number: np.ndarray, least: float
) -> np.ndarray:
    """
    Return the variance by the `number` of second differences in blocks, shape (b, 3).

    The blocks begin at the samples `edges`, and the variance is at least that of rounding.
    """
    bends = np.diff(residual, 2, axis=0, prepend=residual[:1], append=residual[-1:])
    squares = np.add.reduceat(inner[:, None] * bends**2, edges, axis=0) / WHITE_BENDS
    return np.maximum(squares / np.maximum(number, 1)[:, None], least**2)


def _inner(windows: Sequence[Window]) -> np.ndarray:
    """Return 1 for samples with two neighbours in their window, 0 for its ends, shape (n,)."""
    ends = np.cumsum([len(window) for window in windows])
    inner = np.ones(ends[-1])
    inner[ends - 1] = 0.0  # last samples
    inner[np.append(0, ends[:-1])] = 0.0  # first samples
    return inner


def _slope(
    residual: np.ndarray, windows: Sequence[Window], edges: np.ndarray, sensor: str
) -> np.ndarray:
    """
    Return the mean square of the rate of change of the predicted output in blocks.

    The blocks begin at the samples `edges`, and the shape is (b, 3).
    """
    squares = np.zeros_like(residual)
    start = 0
    for window in windows:
        part = slice(start, start + len(window))
        if len(window) > 2:
            predicted = measured(window, sensor) - residual[part]
            squares[part] = np.gradient(predicted, window.time, axis=0) ** 2
        start = part.stop
    return block_means(squares, edges)


def _used_windows(windows: Sequence[Window], length: float) -> np.ndarray:
    """
    Return the numbers of the windows in use: all, or a random part of a long recording, in order.
    """
    n_blocks = 0
    for window in windows:
        n_blocks += 1 if len(window.motion) == 1 else _count_blocks(window, length)
    if n_blocks <= 2 * MAX_RESIDUAL_BLOCKS:
        return np.arange(len(windows))
    n_used = len(windows) * 2 * MAX_RESIDUAL_BLOCKS // n_blocks
    return np.sort(np.random.default_rng(0).permutation(len(windows))[:n_used])


def _count_blocks(window: Window, length: float) -> int:
    """Return into how many blocks a moving window is cut."""
    return max(1, round((window.time[-1] - window.time[0]) / length))


def _white_noise_factor(
    windows: Sequence[Window], sensor: str, floor: NoiseModel, kinds: np.ndarray, judged: np.ndarray
) -> np.ndarray:
    """
    Return by how much each window's white noise exceeds that at rest, shape (k, 3).

    By kind, from second differences of the windows `judged` (mask), which suppress causes that vary
    with the motion; at most the misfit of the kind.
    """
    # Variance of the white noise in each window; unknown in short ones.
    place = SENSORS.index(sensor)
    variance = np.full((len(windows), 3), np.nan)
    for number, window in enumerate(windows):
        if len(window) > SHORT_WINDOW:
            variance[number] = window.noise_sd[place] ** 2

    # That at rest.
    rests = judged & (kinds == 'static')
    at_rest = floor.white_variance
    if rests.any():
        at_rest = np.nanmedian(variance[rests], axis=0)
    at_rest = np.maximum(at_rest, LEAST_NOISE[sensor] ** 2)

    factor = np.ones((len(windows), 3))
    for kind in np.unique(kinds[kinds != 'static']):
        misfit = np.maximum(floor.row_variance(kind) / floor.low_variance, 1.0)
        of_kind = np.nanmedian(variance[judged & (kinds == kind)], axis=0)
        factor[kinds == kind] = np.clip(of_kind / at_rest, 1.0, misfit)
    return factor


def residuals(
    windows: Sequence[Window], table: Table, model: SensorModel, *, values: np.ndarray
) -> dict[str, np.ndarray]:
    """
    Return sensor -> residual of every sample of all windows at some values, shape (n, 3).

    Rows within blocks would be too coarse.
    """
    # Some windows at a time: columns need much memory.
    predicted = [predict_windows(group, table, model, values=values) for group in chunks(windows)]
    residual_of = {}
    for sensor in sensors_of(windows):
        readings = np.concatenate([measured(window, sensor) for window in windows])
        residual_of[sensor] = readings - np.concatenate([part[sensor] for part in predicted])
    return residual_of


def _block_means(
    problem: LinearisedProblem,
    table: Table,
    motion: JointMotion,
    temperature: np.ndarray | None,
    starts: np.ndarray,
) -> dict[str, np.ndarray]:
    """
    Return sensor -> means of all columns over the blocks, shape (b, p).

    Some blocks at a time, as their columns need much memory.
    """
    recording = problem.recording
    edges = np.append(starts, len(motion))
    found: dict[str, list[np.ndarray]] = {sensor: [] for sensor in recording.sensors}
    for first in range(0, len(starts), AT_A_TIME):
        own = edges[first : first + AT_A_TIME + 1]
        rows = slice(own[0], own[-1])
        warmth = None if temperature is None else temperature[rows]
        references = References(recording.model, table, motion.select(rows), temperature_c=warmth)
        for sensor, parts in found.items():
            columns = columns_with_bank(references, sensor, recording.bank)
            parts.append(block_means(columns, own[:-1] - own[0]))
    return {sensor: np.concatenate(parts) for sensor, parts in found.items()}


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
    """Return a window cut into blocks of about this length, s; at rest it is one block."""
    if len(window.motion) == 1:
        return _Cut(np.array([0]), np.array([0]), np.array([1]))
    n_blocks = _count_blocks(window, length)
    edges = np.unique(np.linspace(0, len(window), n_blocks + 1).round().astype(int))
    # Rows in the middles of equal parts of each block; short blocks have fewer.
    middles = (np.arange(WITHIN) + 0.5) / WITHIN
    rows = []
    for start, end in zip(edges, edges[1:]):
        rows.append(np.unique((start + middles * (end - start)).astype(int)))
    return _Cut(edges[:-1], np.concatenate(rows), np.array([len(part) for part in rows]))


AMPLITUDE_PRIOR_SD = 1e6
"""
Prior sd of amplitudes; unit: the amplitude that equals one standard deviation of noise in all
blocks.
"""
IMITATED = 1e-6
"""Least singular value of the scaled columns of the catalogue, relative to the largest one."""
SHARE_RESAMPLES = 500
ABOVE_NOISE = 3.0
"""Least excess of this axis over noise, standard deviations."""


@dataclass(frozen=True, eq=False)
class BlockFit:
    """A model and further columns, fitted to the selection windows."""

    amplitudes: np.ndarray
    """Of the further columns, shape (k, 3)."""
    sd: np.ndarray
    """Their standard deviations, with the misfit in them, shape (k, 3)."""
    rest: np.ndarray
    """Whitened residual of the locked blocks, shape (n_locked, 3)."""
    window: np.ndarray
    """Window of each locked block, shape (n_locked,)."""

    @property
    def excess(self) -> float:
        """Sum of squares of the locked blocks above the expectation from noise."""
        return float((self.rest**2 - 1.0).sum())


class BlockFits:
    """Fits of the blocks of one sensor, whitened once."""

    def __init__(
        self,
        blocks: RestBlocks,
        used: Sequence[int],
        *,
        prior_sd: np.ndarray,
        prior_mean: np.ndarray,
    ):
        self.blocks = blocks
        self.used = frozenset(used)
        self._prior_sd = prior_sd
        self._prior_mean = prior_mean
        # Independent rows [columns | residual]: of the blocks that choose and of the locked ones,
        # each a list over the axes.
        self._design = []
        for whiten in blocks.white:
            self._design.append([whiten(part, axis) for axis, part in enumerate(blocks.design)])
        # Per axis the columns of the parameters in use.
        self._at = [np.flatnonzero(np.isin(index, list(used))) for index in blocks.index]

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
        more : sequence of int
            Parameters of the catalogue that join the model.
        half : 0 or 1, optional
            The half of the choosing windows, by time, that is fitted to.

        """
        count = 0 if columns is None else columns.shape[1]
        amplitudes = np.zeros((count, 3))
        sds = np.zeros((count, 3))
        locked_residuals = []
        for axis in range(3):
            # Fit to the blocks that choose.
            joining = np.flatnonzero(np.isin(self.blocks.index[axis], list(more)))
            at = np.union1d(self._at[axis], joining).astype(int)
            values, covariance, residual = self._solved(axis, at, columns, half)
            n_free = max(len(residual) - len(values), 1)
            misfit = max(float(residual @ residual) / n_free, 1.0)
            amplitudes[:, axis] = values[len(at) :]
            sds[:, axis] = np.sqrt(misfit * np.diag(covariance)[len(at) :])

            # Prediction of the locked blocks.
            locked = self._rows(1, axis, at, columns)
            locked_residuals.append(locked[:, -1] - locked[:, :-1] @ values)
        locked_window = self.blocks.window[self.blocks.locked]
        return BlockFit(amplitudes, sds, np.stack(locked_residuals, axis=1), locked_window)

    def outside_catalogue(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (columns, residual) without all that the columns of the catalogue can imitate.

        Whitened, of the selection windows, the three axes one after the other: shape (3 n, k) and
        (3 n,).

        Parameters
        ----------
        columns : array, shape (b, k, 3)

        """
        outside_columns = []
        outside_residual = []
        for axis in range(3):
            # Orthonormal basis of the catalogue's columns; x - U U^T x is orthogonal to them.
            design = self._design[0][axis]
            catalogue = design[:, :-1]
            residual = design[:, -1]
            norm = np.linalg.norm(catalogue, axis=0)
            scaled = catalogue / np.where(norm > 0, norm, 1)
            basis, singular_values, _ = svd(scaled, full_matrices=False)
            basis = basis[:, singular_values > IMITATED * singular_values.max()]

            rows = self.blocks.white[0](columns[:, :, axis], axis)
            outside_columns.append(rows - basis @ (basis.T @ rows))
            outside_residual.append(residual - basis @ (basis.T @ residual))
        return np.concatenate(outside_columns), np.concatenate(outside_residual)

    def axes(self) -> tuple[str, ...]:
        """
        Return the axes with an excess in the selection windows.

        They are in order of unweighted squares, the largest first.
        """
        choosing = ~self.blocks.locked
        excess = self._excess()
        # The sum of n squares of unit noise has the variance 2 n. The axis with the largest excess
        # is named in any case.
        noise = ABOVE_NOISE * np.sqrt(2.0 * choosing.sum())
        least_excess = min(noise, 0.99 * excess.max())
        squares = excess * np.median(self.blocks.variance[choosing], axis=0)
        named = []
        for axis in largest_axes(squares):
            if excess[AXES.index(axis)] > least_excess:
                named.append(axis)
        return tuple(named)

    @property
    def sigma(self) -> float:
        """
        Excess of the residual over noise in the selection windows, all axes, standard deviations.
        """
        return float(self._excess().sum() / np.sqrt(6.0 * (~self.blocks.locked).sum()))

    def _excess(self) -> np.ndarray:
        """
        Return the sums of squares above the expectation from noise in the selection windows.

        Shape (3,).
        """
        excess = np.zeros(3)
        for axis in range(3):
            _, _, residual = self._solved(axis, self._at[axis])
            excess[axis] = max(float(residual @ residual) - len(residual), 0.0)
        return excess

    def _solved(
        self, axis: int, at: np.ndarray, columns: np.ndarray | None = None, half: int | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Return (values, covariance, residual) of a fit to the selection windows.

        Of the parameters `at`, then of columns.
        """
        rows = self._rows(0, axis, at, columns)
        if half is not None:
            time = self.blocks.time[~self.blocks.locked]
            rows = rows[(time > np.median(time)) == half]
        # Parameters have the priors of the catalogue, amplitudes nearly none.
        parameters = self.blocks.index[axis][at]
        size = np.sqrt(np.maximum((rows[:, len(at) : -1] ** 2).sum(axis=0), 1e-60))
        sd = np.append(self._prior_sd[parameters], AMPLITUDE_PRIOR_SD / size)
        mean = np.append(self._prior_mean[parameters], np.zeros_like(size))
        values, covariance = solve_normal(rows.T @ rows, np.arange(len(sd)), sd, prior_mean=mean)
        return values, covariance, rows[:, -1] - rows[:, :-1] @ values

    def _rows(self, part: int, axis: int, at: np.ndarray, columns: np.ndarray | None) -> np.ndarray:
        """
        Return independent rows ``[columns at | further columns | residual]`` of an axis.

        Of the blocks that choose (`part` 0), or of the locked ones (1).
        """
        design = self._design[part][axis]
        parts = [design[:, at]]
        if columns is not None:
            parts.append(self.blocks.white[part](columns[:, :, axis], axis))
        return np.concatenate([*parts, design[:, -1:]], axis=1)


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
        excess_before.append((before.rest[in_window] ** 2 - 1.0).sum())
        excess_after.append((after.rest[in_window] ** 2 - 1.0).sum())

    excess = np.array([excess_before, excess_after])

    n_windows = excess.shape[1]
    drawn = rng.integers(n_windows, size=(SHARE_RESAMPLES, n_windows))
    before_of_draw, after_of_draw = excess[:, drawn].sum(axis=2)
    shares = 1.0 - np.maximum(after_of_draw, 0.0) / np.maximum(before_of_draw, 1e-300)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(low), float(high)
