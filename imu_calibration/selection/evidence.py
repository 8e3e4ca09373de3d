"""
How well a choice of parameters predicts windows that it was not fitted to.

Small problems on normal matrices.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from imu_calibration.core.distributions import chi2_sf
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.scaled_solve import (
    quadratic,
    solve_normal,
    solve_scaled,
)

ParameterFit = tuple[np.ndarray, np.ndarray]
"""Values of parameters and their covariance, shape (n,) and (n, n)."""
MOST_FITS = 128
"""
Fits kept with covariances or predictions: a search tries thousands of choices, and asks for the
last again.
"""


def _squares(parts: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """
    Return residual sums of squares from normal matrices of folds.

    Shape (p, f, n, n), and residual vectors (f, n), shape (p,).
    """
    return ((parts @ rows[:, :, None])[..., 0] * rows).sum(axis=(1, 2))


class Recent(dict):
    """
    The last results by key; beyond `most` the oldest is dropped and computed again on demand.

    Parameters
    ----------
    most : int
        Results kept at most.

    """

    def __init__(self, most: int):
        super().__init__()
        self._most = most

    def __setitem__(self, key: Any, value: Any) -> None:
        """Keep a result."""
        super().__setitem__(key, value)
        if len(self) > self._most:
            del self[next(iter(self))]


class Evidence:
    """
    Evidence for choices of parameters, each a sequence of indices, from rows in folds.

    Losses are minus twice log likelihoods, up to a constant; here those of known noise.

    Parameters
    ----------
    blocks : sequence of Rows
        Explicit rows.
    folds : sequence of array, each shape (m,)
        Fold of each row of each block.
    total : array, shape (q + 1, q + 1)
        Normal matrix ``[design | residual]' V^-1 [design | residual]`` of all rows.
    without : array, shape (n_folds, q + 1, q + 1)
        The same of all rows but those of each fold.
    prior_sd, prior_mean : array, shape (q,)
        Prior of the parameters.

    """

    def __init__(
        self,
        blocks: Sequence[Rows],
        folds: Sequence[np.ndarray],
        *,
        total: np.ndarray,
        without: np.ndarray,
        prior_sd: np.ndarray,
        prior_mean: np.ndarray,
    ):
        self.blocks = blocks
        self.folds = folds
        self.total = total
        self.without = without
        self.prior_sd = prior_sd
        self.prior_mean = prior_mean
        self._fits: dict[tuple, tuple] = Recent(MOST_FITS)
        self._losses: dict[tuple, float] = {}
        self._predictions: dict[tuple, np.ndarray] = Recent(MOST_FITS)

    def equations(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (matrix, right side) of the normal equations of all parameters on all rows.

        With the prior.
        """
        known = 1 / self.prior_sd**2
        matrix = self.total[:-1, :-1] + np.diag(known)
        right = self.total[:-1, -1] + known * self.prior_mean
        return matrix, right

    def fit(self, used: Sequence[int]) -> ParameterFit:
        """Return (values, covariance) of the parameters `used`, fitted to all folds."""
        ordered = tuple(sorted(used))
        if ordered not in self._fits:
            self._fits[ordered] = self._fitted(self.total, ordered)
        values, covariance = self._fits[ordered]
        if ordered == tuple(used):
            return values, covariance
        places = np.searchsorted(ordered, used)
        return values[places], covariance[np.ix_(places, places)]

    def _fitted(self, normal: np.ndarray, used: Sequence[int]) -> ParameterFit:
        """Return the same from the normal matrix of some rows."""
        return solve_normal(normal, np.array(used), self.prior_sd, prior_mean=self.prior_mean)

    def loss(self, used: Sequence[int]) -> float:
        """Return the loss of the best fit to all rows."""
        ordered = tuple(sorted(used))
        if ordered not in self._losses:
            self._losses[ordered] = self._loss(ordered)
        return self._losses[ordered]

    def heldout(self, used: Sequence[int]) -> float:
        """Return the loss of each fold under the fit to the other folds, summed."""
        key = ('held out', *sorted(used))
        if key not in self._losses:
            self._losses[key] = self._heldout(tuple(sorted(used)))
        return self._losses[key]

    def heldout_parts(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return the loss on held-out data by sensor.

        Of the windows' means and within the windows, of each axis, shape (2, 3).
        """
        raise NotImplementedError(f'{type(self).__name__} has no effect that acts on both sensors')

    def p_value(self, smaller: Sequence[int], larger: Sequence[int]) -> float:
        """Return the p-value of `larger` against `smaller` (chi-square of the fall of the loss)."""
        fall = max(self.loss(smaller) - self.loss(larger), 0.0)
        return float(chi2_sf(fall, len(larger) - len(smaller)))

    def fits_of_halves(
        self, used: Sequence[int]
    ) -> tuple[ParameterFit, ParameterFit, ParameterFit]:
        """Return the fits of parameters to the first and second half of the rows, and to both."""
        raise NotImplementedError

    def heldout_residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """
        Return the residual of every row under the fit without its fold.

        Shape (m, n_axes) per block.
        """
        left = self.left_by_others(used)
        found = []
        for block, fold in zip(self.blocks, self.folds):
            found.append(block.residuals_at(left[fold]))
        return found

    def left_by_others(self, used: Sequence[int]) -> np.ndarray:
        """
        Return the vectors that map rows of all parameters to residuals, per fold.

        The residuals are of the fit to all other folds, and the shape is (n_folds, q + 1).
        """
        left = np.zeros((len(self.without), len(self.total)))
        left[:, np.append(sorted(used), -1)] = self._left_by_others(tuple(sorted(used)))
        return left

    def _loss(self, used: Sequence[int]) -> float:
        return quadratic(self.total, used, self.fit(used)[0])

    def _heldout(self, used: tuple[int, ...]) -> float:
        places = np.append(used, -1)
        folds = self.total[np.ix_(places, places)] - self.without[:, places[:, None], places]
        return float(_squares(folds[None], self._left_by_others(used))[0])

    def _left_by_others(self, used: tuple[int, ...]) -> np.ndarray:
        """
        Return for each fold the map from rows of `used`, sorted, to residuals.

        The residuals are of the fit to all other folds, and the shape is (n_folds, n + 1).
        """
        if used not in self._predictions:
            at = np.array(used)
            known = 1 / self.prior_sd[at] ** 2
            places = np.append(at, -1)
            normal = self.without[:, places[:, None], places]
            matrix = normal[:, :-1, :-1] + np.diag(known)
            values = solve_scaled(matrix, normal[:, :-1, -1] + known * self.prior_mean[at])
            # A residual is the last column less the prediction.
            self._predictions[used] = np.column_stack([-values, np.ones(len(values))])
        return self._predictions[used]


DISAGREE = 1e-4
"""Significance level of the test that the halves differ."""
MAX_HALVES_LOSS = 1 / 16
"""
Share of an effect's chi-square that is lost with one value for both halves, above which they
disagree.

For halves of equal precision: values that differ by half of the joint estimate.
"""


def agree(halves: Sequence[ParameterFit], whole: ParameterFit, at: Sequence[int]) -> bool:
    """
    Return whether the estimates of some parameters from two halves agree within their precision.

    They disagree when the difference is significant and one value for both loses more than
    `MAX_HALVES_LOSS` of the chi-square. A half that hardly determines an effect loses little, for
    any value: before any rotation, an arm may be estimated at a metre.

    Parameters
    ----------
    halves, whole
        (values, covariance) of the same parameters, fitted to each half and to both.
    at : sequence of int
        Indices of the parameters under test.

    """
    at = list(at)
    difference = (halves[0][0] - halves[1][0])[at]
    apart = float(
        difference @ np.linalg.solve((halves[0][1] + halves[1][1])[np.ix_(at, at)], difference)
    )
    value = whole[0][at]
    explained = float(value @ np.linalg.solve(whole[1][np.ix_(at, at)], value))
    return bool(chi2_sf(apart, len(at)) > DISAGREE or apart < MAX_HALVES_LOSS * explained)
