"""
Evidence from few rows of any reference: poses and turns by hand, blocks of a pose topic.

Rows are few, so that variances are estimated too and every group of rows is held out in turn.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.core.samples import AlignedArrays
from imu_calibration.estimation.noise_likelihood import NoiseLikelihood
from imu_calibration.estimation.scaled_solve import orthonormal_basis
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.selection.evidence import Evidence, ParameterFit


@dataclass(frozen=True, eq=False)
class RowBlock(AlignedArrays):
    """
    Rows of one kind, ``residual = columns @ parameters + error``, in the unit of their sensor.
    """

    name: str
    """'poses', 'turns' or another kind."""
    sensor: str
    """'accelerometer' or 'gyroscope'."""
    rows: np.ndarray
    """
    ``[columns | residual]`` at the baseline, shape (m, n_axes, q + 1); different axes have
    independent errors.
    """
    known: np.ndarray
    """Variance by the noise of the samples, shape (m, n_axes)."""
    floor: np.ndarray
    """The same plus the usual bias drift, shape (m, n_axes)."""
    group: np.ndarray
    """
    Group of each row, shape (m,): rows of a group are held out together. By hand the pose, of a
    turn the pose before it.
    """
    time: np.ndarray
    """Seconds since the first sample, shape (m,)."""
    duration: np.ndarray | None = None
    """Of each turn, s, shape (m,): residuals of turns times it are angles; None for poses."""
    wanders: bool = False
    """Whether a bias that moves in time is a part of its scatter."""


@dataclass(frozen=True, eq=False)
class RowSpace:
    """Parameters of a search: those of the baseline, then one run per column set."""

    parts: dict
    """
    Label of each run of columns (effect name, for a warm-up with the number of its time constant)
    -> slice.
    """
    prior_sd: np.ndarray
    """Shape (q,); wide for the baseline, which is linearised at its own solution."""
    size: int
    """Number of parameters."""


GROUP_FOLDS = 12
"""Number of folds of the groups; with up to `ONE_BY_ONE` groups each group is a fold."""
ONE_BY_ONE = 24
SCATTER_RATIOS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Candidate scatter of rows beyond the noise of their samples, in units of that noise."""
BIASES = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Candidate bias processes, in units of offset and noise together."""
BIAS_TIMES = (100.0, 300.0)
"""Its correlation times, s."""
FEWEST_SPARE_ROWS = 3
"""Fewest degrees of freedom of a test."""
DEPENDENT = 1e-9
"""
Singular value of scaled columns, over the largest, up to which one of them depends on the others.
"""
MIN_COLUMN_DIFFERENCE = 0.1
"""Columns that differ by less than this count as collinear."""
MIN_COLUMN_SINE = 0.2
"""Least sine of the angle between a column and the baseline's columns for the column to count."""


class RowEvidence(Evidence):
    """
    Losses of choices of parameters on all rows and on held-out rows.

    Losses are ``n log(mean square)`` per block: the variance is not known but estimated from the
    same few rows.

    Parameters
    ----------
    blocks : sequence of RowBlock
    space : RowSpace
    smooth : dict
        Sensor -> parameters of each effect that is smooth in time, included when the noise is
        estimated.
    baseline : sequence of int
        Parameters of the model under diagnosis.

    """

    def __init__(
        self,
        blocks: Sequence[RowBlock],
        space: RowSpace,
        smooth: Mapping[str, Sequence[tuple[int, ...]]],
        *,
        baseline: Sequence[int],
    ):
        self.blocks = blocks
        self.space = space
        # Smooth effects are included: the noise is not estimated from what they explain.
        self._noise = []
        for block in blocks:
            acting = chain.from_iterable(smooth.get(block.sensor, ()))
            self._noise.append(_noise(block, [*baseline, *acting]))
        self.groups = np.unique(np.concatenate([block.group for block in blocks]))
        """Numbers of the groups of rows, shape (n_groups,)."""
        n_folds = len(self.groups) if len(self.groups) <= ONE_BY_ONE else GROUP_FOLDS
        self.folds = [np.searchsorted(self.groups, block.group) % n_folds for block in blocks]
        self._white = self._whitened()
        self._acting = [np.any(white != 0, axis=0) for white in self._white]
        """Of each block, the columns that are not zero."""
        self._sums: dict[tuple[int, tuple[int, ...]], float] = {}
        self._bases: dict[tuple[int, ...], np.ndarray] = {}
        total = self._products(self._white)
        without = [self._products(self._whitened(number)) for number in range(n_folds)]
        super().__init__(
            total, np.array(without), prior_sd=space.prior_sd, prior_mean=np.zeros(space.size)
        )

    def fits_of_halves(
        self, used: Sequence[int]
    ) -> tuple[ParameterFit, ParameterFit, ParameterFit]:
        """Return the fits of parameters to both halves of the groups of rows, and to all."""
        first, second = np.array_split(self.groups, 2)
        none = self.groups[:0]
        fits = []
        for out in (second, first, none):
            # The effects are no noise: their parameters are part of the baseline.
            blocks = without_groups(self.blocks, out)
            fits.append(RowEvidence(blocks, self.space, {}, baseline=used).fit(used))
        return fits[0], fits[1], fits[2]

    @staticmethod
    def _products(white: Sequence[np.ndarray]) -> np.ndarray:
        """Return the normal matrix of white rows, shape (q + 1, q + 1)."""
        return np.sum([rows.T @ rows for rows in white], axis=0)

    def _whitened(self, number: int | None = None) -> list[np.ndarray]:
        """
        Return the rows of each block, without fold `number`.

        As independent rows of unit variance, a list of (m, q + 1).
        """
        white = []
        for block, (variance, processes), fold in zip(self.blocks, self._noise, self.folds):
            kept = fold != number
            whitening = Whitening(
                variance[kept], block.time[kept], [np.arange(kept.sum())], processes=processes
            )
            white.append(whitening(block.rows[kept]).reshape(-1, self.space.size + 1))
        return white

    def residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """Return the residual rows of each block under the fit to all rows, shape (m, n_axes)."""
        values = self.fit(used)[0]
        return [
            block.rows[:, :, -1] - block.rows[:, :, list(used)] @ values for block in self.blocks
        ]

    def heldout_residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """
        Return the residual of every row under the fit without its fold.

        Shape (m, n_axes) per block.
        """
        left = self.left_by_others(used)
        return [
            np.einsum('mac,mc->ma', block.rows, left[fold])
            for block, fold in zip(self.blocks, self.folds)
        ]

    def against_noise(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return sensor -> squares of the same in units of noise and usual bias drift, of each block.

        Shape (n_blocks, 1).
        """
        found: dict[str, list[list[float]]] = {}
        for block, residual in zip(self.blocks, self.heldout_residuals(used)):
            found.setdefault(block.sensor, []).append([np.sum(residual**2 / block.floor)])
        return {sensor: np.array(squares) for sensor, squares in found.items()}

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """Sensor -> number of the squares of each block."""
        found: dict[str, list[int]] = {}
        for block in self.blocks:
            found.setdefault(block.sensor, []).append(block.known.size)
        return {sensor: np.array(sizes) for sensor, sizes in found.items()}

    def _heldout(self, used: Sequence[int]) -> float:
        loss = 0.0
        for residual, noise in zip(self.heldout_residuals(used), self._noise):
            variance, processes = noise
            squares = residual**2 / (variance + sum(process.sd**2 for process in processes))
            loss += squares.size * np.log(squares.mean())
        return float(loss)

    def _loss(self, used: Sequence[int]) -> float:
        loss = 0.0
        for white in self._white:
            loss += len(white) * np.log(np.mean(self._left(white, used) ** 2))
        return float(loss)

    def _left(self, white: np.ndarray, used: Sequence[int]) -> np.ndarray:
        return white[:, -1] - white[:, list(used)] @ self.fit(used)[0]

    def _squares_left(self, number: int, used: Sequence[int]) -> float:
        """Return the sum of squares that a choice leaves in a block: it meets many larger ones."""
        key = (number, tuple(used))
        if key not in self._sums:
            self._sums[key] = np.sum(self._left(self._white[number], used) ** 2)
        return self._sums[key]

    def p_value(self, smaller: Sequence[int], larger: Sequence[int]) -> float:
        """
        Return the p-value of `larger` against `smaller`.

        F test on the blocks that contain the new columns.
        """
        added = [k for k in larger if k not in set(smaller)]
        of_smaller = of_larger = 0.0
        n_rows = 0
        in_use = np.zeros(len(larger), bool)
        for number, acting in enumerate(self._acting):
            if np.any(acting[added]):
                of_smaller += self._squares_left(number, smaller)
                of_larger += self._squares_left(number, larger)
                n_rows += len(self._white[number])
                in_use |= acting[list(larger)]
        rank = max(self.rank(added, smaller), 1)
        spare = n_rows - int(in_use.sum())
        if spare < FEWEST_SPARE_ROWS or of_larger <= 0:
            return 1.0
        fall = max(of_smaller - of_larger, 0.0)
        return float(f_sf(fall / rank / (of_larger / spare), rank, spare))

    def rank(self, added: Sequence[int], smaller: Sequence[int]) -> int:
        """
        Return how many combinations of the added columns are not collinear with the smaller choice.
        """
        known = self._basis_of(tuple(smaller))
        new = orthonormal_basis(np.concatenate(self._white)[:, list(added)], MIN_COLUMN_DIFFERENCE)
        if not new.shape[1]:
            return 0
        sines = np.linalg.svd(new - known @ (known.T @ new), compute_uv=False)
        return int(np.sum(sines > MIN_COLUMN_SINE))

    def _basis_of(self, used: tuple[int, ...]) -> np.ndarray:
        """Return a basis of the columns of a choice, which is met with many larger choices."""
        if used not in self._bases:
            white = np.concatenate(self._white)
            self._bases[used] = orthonormal_basis(white[:, list(used)], DEPENDENT)
        return self._bases[used]


def without_groups(blocks: Sequence[RowBlock], groups: np.ndarray) -> list[RowBlock]:
    """Return the blocks without some groups of rows; a block of few rows is omitted."""
    kept = [block.select(~np.isin(block.group, groups)) for block in blocks]
    return [block for block in kept if block.known.size > FEWEST_SPARE_ROWS]


def _noise(block: RowBlock, used: Sequence[int]) -> tuple[np.ndarray, tuple[BiasProcess, ...]]:
    """
    Return (independent variance of each row (m, n_axes), bias processes).

    Scatter between rows, and a bias process where the block wanders.
    """
    count, axes, width = block.rows.shape
    basis = orthonormal_basis(block.rows.reshape(-1, width)[:, used], DEPENDENT)
    rows = np.concatenate([basis.reshape(count, axes, -1), block.rows[:, :, -1:]], axis=2)
    likelihood = NoiseLikelihood(rows, block.known, block.time, sessions=[np.arange(count)])
    biases = [(0.0, BIAS_TIMES[0])]
    if block.wanders:
        for share in BIASES[1:]:
            biases += [(share, time) for time in BIAS_TIMES]
    shapes = []
    for offset in SCATTER_RATIOS:
        shapes += [(offset, share * max(offset, 1.0), time) for share, time in biases]
    offset, bias, time = min(shapes, key=likelihood.loss)
    unit = likelihood.typical
    return block.known + (offset * unit) ** 2, (BiasProcess(bias * unit, time),) if bias else ()
