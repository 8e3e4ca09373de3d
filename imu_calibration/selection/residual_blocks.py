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
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.scaled_solve import solve_normal
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
"""
Variance of second differences of unit white noise, and their number for each degree of freedom of a
mean of their squares.
"""
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
        variance, time = blocks.variance[select], blocks.time[select]
        self.scale = np.sqrt(np.median(variance / variance.mean(axis=1, keepdims=True), axis=0))
        covariance = np.diag(variance.mean(axis=1))
        # Intermediate arrays of a part, not of the matrix.
        for rows in np.array_split(np.arange(len(time)), COVARIANCE_PARTS):
            apart = np.abs(time[rows, None] - time[None, :])
            for process in blocks.processes:
                covariance[rows] += process.sd**2 * np.exp(-apart / process.time)
        self._factor, self._select = (
            cholesky(covariance.T, lower=True, overwrite_a=True, check_finite=False),
            select,
        )

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
    length = max(
        MIN_BLOCK_SECONDS,
        sum(w.time[-1] - w.time[0] for w in windows if len(w.motion) > 1) / MAX_RESIDUAL_BLOCKS,
    )
    which = _some(windows, length)
    windows = [windows[k] for k in which]
    starts_of, rows_of, per_block = zip(*(_cut(window, length) for window in windows))
    motion = JointMotion.concatenate(
        window.motion.select(rows) for window, rows in zip(windows, rows_of)
    )
    warm = [
        w.temperature_c[rows] if len(rows) > 1 else w.temperature_c.mean(keepdims=True)
        for w, rows in zip(windows, rows_of)
        if w.temperature_c is not None
    ]
    temperature = np.concatenate(warm) if len(warm) == len(windows) else None
    place = np.repeat(np.arange(len(windows)), [len(starts) for starts in starts_of])
    edges = np.concatenate(
        [
            starts + first
            for starts, first in zip(starts_of, np.cumsum([0, *map(len, windows[:-1])]))
        ]
    )
    count = np.diff(edges, append=sum(map(len, windows))).astype(float)
    common = {
        'starts': np.cumsum([0, *np.concatenate(per_block)[:-1]]),
        'time': block_means(np.concatenate([window.time for window in windows]), edges),
        'window': which[place],
        'locked': problem.locked[which[place]],
    }
    references = References(problem.recording.model, table, motion, temperature_c=temperature)
    columns_of = _block_means(problem, table, motion, temperature, common['starts'])
    left = residuals(windows, table, problem.recording.model, values=problem.recording.values)
    inner = _inner(windows)
    number = np.add.reduceat(inner, edges)
    rough = {
        sensor: _roughness(residual, inner, edges, number=number, least=LEAST_NOISE[sensor])
        for sensor, residual in left.items()
    }
    slope = {sensor: _slope(residual, windows, edges, sensor) for sensor, residual in left.items()}
    freedom = number / PER_FREEDOM
    jitter = stamp_jitter(list(rough.values()), list(slope.values()), freedom)
    louder = {sensor: jitter_ratio(rough[sensor], slope[sensor], jitter.sd) for sensor in left}
    kinds = problem.recording.kind[common['window']]
    of_kind = {str(kind): kinds == kind for kind in np.unique(kinds) if kind != 'static'}
    jitter = replace(
        jitter,
        ratio={
            sensor: {kind: float(louder[sensor][own].mean()) for kind, own in of_kind.items()}
            for sensor in left
        },
    )
    found = {}
    for sensor, residual in left.items():
        floor = explained.floor.noise[sensor]
        busier = _busier(
            windows, sensor, floor, problem.recording.kind[which], ~problem.locked[which]
        )
        variance = floor.low_variance * busier[place] / count[:, None]
        # An estimated bias process would absorb a step or a warm-up; regimes are searched with the
        # least bias processes.
        processes = natural_processes(floor, problem.recording.period)
        rows = np.concatenate([columns_of[sensor], block_means(residual, edges)], axis=1)
        design = tuple(rows @ join for join in problem.space.join[sensor])
        found[sensor] = RestBlocks(
            sensor,
            references.at(sensor),
            **common,
            design=design,
            index=tuple(problem.space.index[sensor]),
            variance=variance,
            processes=processes,
            freedom=freedom,
            rough=rough[sensor] / louder[sensor],
            jitter=jitter,
        )
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
    inner, ends = np.ones(sum(map(len, windows))), np.cumsum([len(window) for window in windows])
    inner[ends - 1] = inner[np.append(0, ends[:-1])] = 0.0
    return inner


def _slope(
    residual: np.ndarray, windows: Sequence[Window], edges: np.ndarray, sensor: str
) -> np.ndarray:
    """
    Return the mean square of the rate of change of the predicted output in blocks.

    The blocks begin at the samples `edges`, and the shape is (b, 3).
    """
    ends, squares = np.cumsum([0, *map(len, windows)]), np.zeros_like(residual)
    for window, first in zip(windows, ends):
        if len(window) > 2:
            part = slice(first, first + len(window))
            squares[part] = (
                np.gradient(measured(window, sensor) - residual[part], window.time, axis=0) ** 2
            )
    return block_means(squares, edges)


def _some(windows: Sequence[Window], length: float) -> np.ndarray:
    """
    Return the numbers of the windows in use: all, or a random part of a long recording, in order.
    """
    blocks = sum(
        1 if len(w.motion) == 1 else max(1, round((w.time[-1] - w.time[0]) / length))
        for w in windows
    )
    if blocks <= 2 * MAX_RESIDUAL_BLOCKS:
        return np.arange(len(windows))
    return np.sort(
        np.random.default_rng(0).permutation(len(windows))[
            : len(windows) * 2 * MAX_RESIDUAL_BLOCKS // blocks
        ]
    )


def _busier(
    windows: Sequence[Window], sensor: str, floor: NoiseModel, kinds: np.ndarray, judged: np.ndarray
) -> np.ndarray:
    """
    Return by how much each window's white noise exceeds that at rest, shape (k, 3).

    By kind, from second differences of the windows `judged` (mask), which suppress causes that vary
    with the motion; at most the misfit of the kind.
    """
    place = SENSORS.index(sensor)
    found = np.ones((len(windows), 3))
    own = np.array(
        [
            window.noise_sd[place] ** 2 if len(window) > 8 else np.full(3, np.nan)
            for window in windows
        ]
    )
    still = (
        np.nanmedian(own[judged & (kinds == 'static')], axis=0)
        if np.any(judged & (kinds == 'static'))
        else floor.white_variance
    )
    still = np.maximum(still, LEAST_NOISE[sensor] ** 2)
    for kind in np.unique(kinds[kinds != 'static']):
        most = np.maximum(floor.row_variance(kind) / floor.low_variance, 1.0)
        found[kinds == kind] = np.clip(
            np.nanmedian(own[judged & (kinds == kind)], axis=0) / still, 1.0, most
        )
    return found


def residuals(
    windows: Sequence[Window], table: Table, model: SensorModel, *, values: np.ndarray
) -> dict[str, np.ndarray]:
    """
    Return sensor -> residual of every sample of all windows at some values, shape (n, 3).

    Rows within blocks would be too coarse.
    """
    # Columns need much memory.
    predicted = [predict_windows(group, table, model, values=values) for group in chunks(windows)]
    return {
        sensor: (
            np.concatenate([measured(window, sensor) for window in windows])
            - np.concatenate([part[sensor] for part in predicted])
        )
        for sensor in SENSORS
    }


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
    recording, found, edges = (
        problem.recording,
        {sensor: [] for sensor in SENSORS},
        np.append(starts, len(motion)),
    )
    for first in range(0, len(starts), AT_A_TIME):
        own = edges[first : first + AT_A_TIME + 1]
        rows = slice(own[0], own[-1])
        warmth = None if temperature is None else temperature[rows]
        references = References(recording.model, table, motion.select(rows), temperature_c=warmth)
        for sensor in SENSORS:
            found[sensor].append(
                block_means(
                    columns_with_bank(references, sensor, recording.bank), own[:-1] - own[0]
                )
            )
    return {sensor: np.concatenate(parts) for sensor, parts in found.items()}


def block_means(rows: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return means over the blocks that begin at `starts`, shape (b, ...)."""
    counts = np.diff(np.append(starts, len(rows)))
    return np.add.reduceat(rows, starts, axis=0) / counts.reshape(-1, *[1] * (rows.ndim - 1))


def _cut(window: Window, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return the first sample of each block of a window, its rows, and their number.

    The rows are the ones of the window's motion in use, and the number is that in each block.
    """
    if len(window.motion) == 1:
        return np.array([0]), np.array([0]), np.array([1])
    count = max(1, round((window.time[-1] - window.time[0]) / length))
    edges = np.unique(np.linspace(0, len(window), count + 1).round().astype(int))
    rows = [
        np.unique((a + (np.arange(WITHIN) + 0.5) / WITHIN * (b - a)).astype(int))
        for a, b in zip(edges, edges[1:])
    ]
    return edges[:-1], np.concatenate(rows), np.array([len(part) for part in rows])


AMPLITUDE_PRIOR_SD = 1e6
"""
Prior sd of amplitudes; unit: the amplitude that equals one standard deviation of noise in all
blocks.
"""
IMITATED = 1e-6
"""Least singular value of the scaled columns of the catalogue, relative to the largest one."""
SHARE_RESAMPLES = 500
LEAST_OF_AXIS = 0.1
"""Share of the strongest axis' squares from which another axis has an excess too."""
ABOVE_NOISE = 3.0
"""Least excess of this axis over noise, standard deviations."""


def largest_axes(squares: np.ndarray, least: float = LEAST_OF_AXIS) -> tuple[str, ...]:
    """
    Return the axes whose squares.

    Shape (3,), exceed the share `least` of the largest, the largest first.
    """
    return tuple(AXES[k] for k in np.argsort(-squares) if squares[k] > least * squares.max())


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
        self.blocks, self.used, self._prior = blocks, frozenset(used), (prior_sd, prior_mean)
        self._design = [
            [white(part, axis) for axis, part in enumerate(blocks.design)] for white in blocks.white
        ]
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
        amplitudes, sds, rests = np.zeros((count, 3)), np.zeros((count, 3)), []
        for axis in range(3):
            at = np.union1d(
                self._at[axis], np.flatnonzero(np.isin(self.blocks.index[axis], list(more)))
            ).astype(int)
            values, covariance, left = self._solved(axis, at, columns, half)
            misfit = max(float(left @ left) / max(len(left) - len(values), 1), 1.0)
            amplitudes[:, axis], sds[:, axis] = (
                values[len(at) :],
                np.sqrt(misfit * np.diag(covariance)[len(at) :]),
            )
            locked = self._rows(1, axis, at, columns)
            rests.append(locked[:, -1] - locked[:, :-1] @ values)
        return BlockFit(
            amplitudes, sds, np.stack(rests, axis=1), self.blocks.window[self.blocks.locked]
        )

    def outside_catalogue(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (columns, residual) without all that the columns of the catalogue can imitate.

        Whitened, of the selection windows, the three axes one after the other: shape (3 n, k) and
        (3 n,).

        Parameters
        ----------
        columns : array, shape (b, k, 3)

        """
        left_columns = []
        left_residual = []
        for axis in range(3):
            design = self._design[0][axis]
            scale = np.linalg.norm(design[:, :-1], axis=0)
            basis, sizes = svd(design[:, :-1] / np.where(scale > 0, scale, 1), full_matrices=False)[
                :2
            ]
            basis = basis[:, sizes > IMITATED * sizes.max()]
            rows = self.blocks.white[0](columns[:, :, axis], axis)
            left_columns.append(rows - basis @ (basis.T @ rows))
            left_residual.append(design[:, -1] - basis @ (basis.T @ design[:, -1]))
        return np.concatenate(left_columns), np.concatenate(left_residual)

    def axes(self) -> tuple[str, ...]:
        """
        Return the axes with an excess in the selection windows.

        They are in order of unweighted squares, the largest first.
        """
        excess = self._excess()
        noise = ABOVE_NOISE * np.sqrt(2.0 * (~self.blocks.locked).sum())
        squares = excess * np.median(self.blocks.variance[~self.blocks.locked], axis=0)
        return tuple(
            axis
            for axis in largest_axes(squares)
            if excess[AXES.index(axis)] > min(noise, 0.99 * excess.max())
        )

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
            left = self._solved(axis, self._at[axis])[2]
            excess[axis] = max(float(left @ left) - len(left), 0.0)
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
        scale = np.sqrt(np.maximum((rows[:, len(at) : -1] ** 2).sum(axis=0), 1e-60))
        own = self.blocks.index[axis][at]
        sd, mean = (
            np.append(self._prior[0][own], AMPLITUDE_PRIOR_SD / scale),
            np.append(self._prior[1][own], np.zeros_like(scale)),
        )
        values, covariance = solve_normal(rows.T @ rows, np.arange(len(sd)), sd, prior_mean=mean)
        return values, covariance, rows[:, -1] - rows[:, :-1] @ values

    def _rows(self, part: int, axis: int, at: np.ndarray, columns: np.ndarray | None) -> np.ndarray:
        design = self._design[part][axis]
        further = [] if columns is None else [self.blocks.white[part](columns[:, :, axis], axis)]
        return np.concatenate([design[:, at], *further, design[:, -1:]], axis=1)


def share_removed(before: BlockFit, after: BlockFit) -> float:
    """Return the share of the locked blocks' excess that a fit removes."""
    return 1.0 - max(after.excess, 0.0) / before.excess if before.excess > 0 else 0.0


def share_interval(
    before: BlockFit, after: BlockFit, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % interval of `share_removed`, by resampling locked windows."""
    windows = np.unique(before.window)
    sums = np.array(
        [
            [(fit.rest[before.window == w] ** 2 - 1.0).sum() for w in windows]
            for fit in (before, after)
        ]
    )
    drawn = sums[:, rng.integers(len(windows), size=(SHARE_RESAMPLES, len(windows)))].sum(axis=2)
    shares = 1.0 - np.maximum(drawn[1], 0.0) / np.maximum(drawn[0], 1e-300)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(low), float(high)
