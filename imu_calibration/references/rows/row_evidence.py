"""
Evidence from few rows of any reference: poses and turns by hand, blocks of a pose topic.

Rows are few, so that this evidence differs from that of windows. The variances of the rows are
estimated from the same rows: a loss is ``n log(mean square)``, and a test an F test. The rows
without a fold are whitened again, since they are correlated with it by the bias. And for halves the
noise is estimated again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.estimation.noise_likelihood import NoiseLikelihood, NoiseShape
from imu_calibration.estimation.rows import Rows, flat, normal_of_rows, weights_of
from imu_calibration.estimation.scaled_solve import orthonormal_basis
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.selection.evidence import Evidence, FitsOfHalves

GROUP_FOLDS = 12
"""Number of folds of the groups; with up to `ONE_BY_ONE` groups each group is a fold."""
ONE_BY_ONE = 24
SCATTER_RATIOS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Candidate scatter of rows beyond the noise of their samples, in units of that noise."""
BIASES = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Candidate bias processes, in units of offset and noise together."""
BIAS_TIMES = (100.0, 300.0)
"""Candidate correlation times of a bias process, s."""
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
    blocks : sequence of Rows
        With all parameters, by their known variances.
    prior_sd : array, shape (q,)
        Of the parameters; wide for the baseline, which is linearised at its own solution.
    smooth : dict
        Sensor -> parameters of each effect that is smooth in time, included when the noise is
        estimated.
    baseline : sequence of int
        Parameters of the model under diagnosis.

    """

    def __init__(
        self,
        blocks: Sequence[Rows],
        prior_sd: np.ndarray,
        smooth: Mapping[str, Sequence[tuple[int, ...]]],
        *,
        baseline: Sequence[int],
    ):
        # Noise of each block. Smooth effects are included: it is not estimated from what they
        # explain.
        self._weighted = []
        """The blocks with the variance and the bias process that are estimated for each."""
        for block in blocks:
            of_smooth = chain.from_iterable(smooth.get(block.sensor, ()))
            self._weighted.append(_with_noise(block, [*baseline, *of_smooth]))
        # Folds of whole groups: consecutive groups are in different folds.
        self.groups = np.unique(np.concatenate([block.group for block in blocks]))
        """Numbers of the groups of rows, shape (n_groups,)."""
        n_folds = len(self.groups) if len(self.groups) <= ONE_BY_ONE else GROUP_FOLDS
        folds = [np.searchsorted(self.groups, block.group) % n_folds for block in blocks]

        # White rows, and the results that are computed once.
        self._white = [flat(block.white()) for block in self._weighted]
        """Independent rows of unit variance ``[columns | residual]`` of each block."""
        self._is_in_block = [np.any(white != 0, axis=0) for white in self._white]
        """Whether each column of a block has an element that is not zero, shape (q + 1,)."""
        self._sums: dict[tuple[int, tuple[int, ...]], float] = {}
        """(Number of a block, choice) -> its sum of squares: one choice meets many larger ones."""
        self._bases: dict[tuple[int, ...], np.ndarray] = {}
        """Choice -> orthonormal basis of its white columns."""

        # Normal matrices of all rows, and of the rows without each fold, which are whitened again.
        total = np.sum([white.T @ white for white in self._white], axis=0)
        without = []
        for number in range(n_folds):
            kept = [block.select(fold != number) for block, fold in zip(self._weighted, folds)]
            without.append(normal_of_rows(kept, len(prior_sd)))
        super().__init__(
            blocks,
            folds,
            total=total,
            without=np.array(without),
            prior_sd=prior_sd,
            prior_mean=np.zeros(len(prior_sd)),
        )

    def fits_of_halves(self, used: Sequence[int]) -> FitsOfHalves:
        """Return the fits of parameters to both halves of the groups of rows, and to all."""
        first, second = np.array_split(self.groups, 2)
        no_groups = self.groups[:0]
        fits = []
        for left_out in (second, first, no_groups):
            # The noise is estimated with the effects in the model, as part of the baseline.
            blocks = without_groups(self.blocks, left_out)
            fits.append(RowEvidence(blocks, self.prior_sd, smooth={}, baseline=used).fit(used))
        return FitsOfHalves(*fits)

    def weights(self, used: Sequence[int]) -> np.ndarray:
        """Return the weights of `Rows.residuals_at` at the fit to all rows, shape (q + 1,)."""
        return weights_of(used, self.fit(used)[0], len(self.prior_sd))

    def residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """Return the residuals of each block under the fit to all rows, shape (m, n_axes)."""
        weights = self.weights(used)
        return [block.residuals_at(weights) for block in self.blocks]

    def against_noise(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return sensor -> squares of the held-out residuals summed over a block, (n_blocks, 1).

        The residuals are in units of the known noise with the usual drift of a bias.
        """
        squares: dict[str, list[list[float]]] = {}
        for block, residual in zip(self.blocks, self.heldout_residuals(used)):
            squares.setdefault(block.sensor, []).append([np.sum(residual**2 / block.floor)])
        return {sensor: np.array(of_blocks) for sensor, of_blocks in squares.items()}

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """Sensor -> number of residuals of each block, shape (n_blocks,)."""
        numbers: dict[str, list[int]] = {}
        for block in self.blocks:
            numbers.setdefault(block.sensor, []).append(block.variance.size)
        return {sensor: np.array(of_blocks) for sensor, of_blocks in numbers.items()}

    def _heldout(self, used: Sequence[int]) -> float:
        """Return ``sum n log(mean(residual^2 / variance))`` of the held-out rows of all blocks."""
        loss = 0.0
        for residual, block in zip(self.heldout_residuals(used), self._weighted):
            of_processes = sum(process.sd**2 for process in block.processes)
            squares = residual**2 / (block.variance + of_processes)
            loss += squares.size * np.log(squares.mean())
        return float(loss)

    def _loss(self, used: Sequence[int]) -> float:
        """Return ``sum n log(mean(white residual^2))`` of all blocks at the fit to all rows."""
        loss = 0.0
        for white in self._white:
            loss += len(white) * np.log(np.mean(self._white_residual(white, used) ** 2))
        return float(loss)

    def _white_residual(self, white: np.ndarray, used: Sequence[int]) -> np.ndarray:
        """Return the residual of white rows at the fit to all rows, shape (m,)."""
        return white[:, -1] - white[:, list(used)] @ self.fit(used)[0]

    def _white_squares(self, number: int, used: Sequence[int]) -> float:
        """Return the sum of squares of the white residual of a block at the fit to all rows."""
        key = (number, tuple(used))
        if key not in self._sums:
            self._sums[key] = np.sum(self._white_residual(self._white[number], used) ** 2)
        return self._sums[key]

    def p_value(self, smaller: Sequence[int], larger: Sequence[int]) -> float:
        """
        Return the p-value of `larger` against `smaller` (F test).

        On the blocks with the added columns, with the sums of squares S, the rank r of the added
        columns and n rows of which p columns of `larger` are not zero::

            F = (S_smaller - S_larger) / r / (S_larger / (n - p))

        """
        added = [k for k in larger if k not in set(smaller)]
        squares_of_smaller = 0.0
        squares_of_larger = 0.0
        n_rows = 0
        in_use = np.zeros(len(larger), bool)
        for number, is_in_block in enumerate(self._is_in_block):
            if np.any(is_in_block[added]):
                squares_of_smaller += self._white_squares(number, smaller)
                squares_of_larger += self._white_squares(number, larger)
                n_rows += len(self._white[number])
                in_use |= is_in_block[list(larger)]
        rank = max(self.rank(added, smaller), 1)
        dof = n_rows - int(in_use.sum())
        if dof < FEWEST_SPARE_ROWS or squares_of_larger <= 0:
            return 1.0
        fall = max(squares_of_smaller - squares_of_larger, 0.0)
        return float(f_sf(fall / rank / (squares_of_larger / dof), rank, dof))

    def rank(self, added: Sequence[int], smaller: Sequence[int]) -> int:
        """
        Return the number of combinations of the added columns that `smaller` does not imitate.

        With the orthonormal bases N of the added columns and K of `smaller`, the singular values of
        ``N - K K'N`` are the sines of the angles between the two spaces.
        """
        basis_of_smaller = self._basis_of(tuple(smaller))
        added_columns = np.concatenate(self._white)[:, list(added)]
        basis_of_added = orthonormal_basis(added_columns, MIN_COLUMN_DIFFERENCE)
        if not basis_of_added.shape[1]:
            return 0
        imitated = basis_of_smaller @ (basis_of_smaller.T @ basis_of_added)
        sines = np.linalg.svd(basis_of_added - imitated, compute_uv=False)
        return int(np.sum(sines > MIN_COLUMN_SINE))

    def _basis_of(self, used: tuple[int, ...]) -> np.ndarray:
        """Return an orthonormal basis of the white columns of a choice, shape (rows, rank)."""
        if used not in self._bases:
            white = np.concatenate(self._white)
            self._bases[used] = orthonormal_basis(white[:, list(used)], DEPENDENT)
        return self._bases[used]


def without_groups(blocks: Sequence[Rows], groups: np.ndarray) -> list[Rows]:
    """Return the blocks without some groups of rows; a block of few rows is omitted."""
    kept = [block.select(~np.isin(block.group, groups)) for block in blocks]
    return [block for block in kept if block.variance.size > FEWEST_SPARE_ROWS]


def _with_noise(block: Rows, used: Sequence[int]) -> Rows:
    """
    Return the rows with their likeliest noise, with the parameters `used` fitted.

    The noise is the known one, an independent scatter of the rows, and, where the bias drifts, a
    bias process. Their sizes are the likeliest ones of a grid.
    """
    n_rows, n_axes, _ = block.equations.shape
    basis = orthonormal_basis(flat(block.equations)[:, used], DEPENDENT)
    columns = basis.reshape(n_rows, n_axes, -1)
    of_choice = np.concatenate([columns, block.equations[:, :, -1:]], axis=2)
    likelihood = NoiseLikelihood(replace(block, equations=of_choice))

    # (ratio of the bias process to offset and noise, its correlation time)
    biases = [(0.0, BIAS_TIMES[0])]
    if block.drift is not None:
        for ratio in BIASES[1:]:
            biases += [(ratio, time) for time in BIAS_TIMES]
    shapes = []
    for offset in SCATTER_RATIOS:
        for ratio, time in biases:
            shapes.append(NoiseShape(offset, ratio * max(offset, 1.0), time))
    likeliest = min(shapes, key=likelihood.loss)

    unit = likelihood.typical
    processes: tuple[BiasProcess, ...] = ()
    if likeliest.bias:
        processes = (BiasProcess(likeliest.bias * unit, likeliest.time),)
    variance = block.variance + (likeliest.offset * unit) ** 2
    return replace(block, variance=variance, processes=processes)
