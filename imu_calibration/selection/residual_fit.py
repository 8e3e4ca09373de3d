"""Residual of a choice of columns in blocks: fitted to the selection windows, evaluated on the locked ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import AXES
from imu_calibration.estimation.scaled_solve import solve_normal
from imu_calibration.selection.residual_blocks import RestBlocks

AMPLITUDE_PRIOR_SD = 1e6
"""Prior sd of amplitudes; unit: the amplitude that equals one standard deviation of noise in all blocks."""
SHARE_RESAMPLES = 500
LEAST_OF_AXIS = 0.1
"""Share of the strongest axis' squares from which another axis has an excess too."""
ABOVE_NOISE = 3.0
"""Least excess of this axis over noise, standard deviations."""


def largest_axes(squares: np.ndarray, least: float = LEAST_OF_AXIS) -> tuple[str, ...]:
    """Return the axes whose squares, shape (3,), exceed the share `least` of the largest, the largest first."""
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

    def __init__(self, blocks: RestBlocks, used: Sequence[int], *, prior_sd: np.ndarray, prior_mean: np.ndarray):
        self.blocks, self.used, self._prior = blocks, frozenset(used), (prior_sd, prior_mean)
        self._design = [[white(part, axis) for axis, part in enumerate(blocks.design)] for white in blocks.white]
        self._at = [np.flatnonzero(np.isin(index, list(used))) for index in blocks.index]

    def fit(self, columns: np.ndarray | None = None, *, more: Sequence[int] = (), half: int | None = None) -> BlockFit:
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
            at = np.union1d(self._at[axis], np.flatnonzero(np.isin(self.blocks.index[axis], list(more)))).astype(int)
            values, covariance, left = self._solved(axis, at, columns, half)
            misfit = max(float(left @ left) / max(len(left) - len(values), 1), 1.0)
            amplitudes[:, axis], sds[:, axis] = values[len(at):], np.sqrt(misfit * np.diag(covariance)[len(at):])
            locked = self._rows(1, axis, at, columns)
            rests.append(locked[:, -1] - locked[:, :-1] @ values)
        return BlockFit(amplitudes, sds, np.stack(rests, axis=1), self.blocks.window[self.blocks.locked])

    def axes(self) -> tuple[str, ...]:
        """Return the axes with an excess in the selection windows, in order of unweighted squares, the largest first."""
        excess = self._excess()
        noise = ABOVE_NOISE * np.sqrt(2.0 * (~self.blocks.locked).sum())
        squares = excess * np.median(self.blocks.variance[~self.blocks.locked], axis=0)
        return tuple(axis for axis in largest_axes(squares) if excess[AXES.index(axis)] > min(noise, 0.99 * excess.max()))

    @property
    def sigma(self) -> float:
        """Excess of the residual over noise in the selection windows, all axes, standard deviations."""
        return float(self._excess().sum() / np.sqrt(6.0 * (~self.blocks.locked).sum()))

    def _excess(self):
        """Return the sums of squares above the expectation from noise in the selection windows, shape (3,)."""
        excess = np.zeros(3)
        for axis in range(3):
            left = self._solved(axis, self._at[axis])[2]
            excess[axis] = max(float(left @ left) - len(left), 0.0)
        return excess

    def _solved(self, axis, at, columns=None, half=None):
        """Return (values, covariance, residual) of a fit to the selection windows: of the parameters `at`, then of columns."""
        rows = self._rows(0, axis, at, columns)
        if half is not None:
            time = self.blocks.time[~self.blocks.locked]
            rows = rows[(time > np.median(time)) == half]
        scale = np.sqrt(np.maximum((rows[:, len(at):-1]**2).sum(axis=0), 1e-60))
        own = self.blocks.index[axis][at]
        sd, mean = np.append(self._prior[0][own], AMPLITUDE_PRIOR_SD / scale), np.append(self._prior[1][own], np.zeros_like(scale))
        values, covariance = solve_normal(rows.T @ rows, np.arange(len(sd)), sd, prior_mean=mean)
        return values, covariance, rows[:, -1] - rows[:, :-1] @ values

    def _rows(self, part, axis, at, columns):
        design = self._design[part][axis]
        further = [] if columns is None else [self.blocks.white[part](columns[:, :, axis], axis)]
        return np.concatenate([design[:, at], *further, design[:, -1:]], axis=1)


def share_removed(before: BlockFit, after: BlockFit) -> float:
    """Return the share of the locked blocks' excess that a fit removes."""
    return 1.0 - max(after.excess, 0.0) / before.excess if before.excess > 0 else 0.0


def share_interval(before: BlockFit, after: BlockFit, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % interval of `share_removed`, by resampling locked windows."""
    windows = np.unique(before.window)
    sums = np.array([[(fit.rest[before.window == w]**2 - 1.0).sum() for w in windows] for fit in (before, after)])
    drawn = sums[:, rng.integers(len(windows), size=(SHARE_RESAMPLES, len(windows)))].sum(axis=2)
    shares = 1.0 - np.maximum(drawn[1], 0.0) / np.maximum(drawn[0], 1e-300)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(low), float(high)
