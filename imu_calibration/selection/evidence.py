"""
Likelihood of choices of parameters, on all rows and on rows that they are not fitted to.

Small problems on normal matrices.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
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


@dataclass(frozen=True, eq=False)
class FitsOfHalves:
    """Fits of the same parameters to parts of the rows."""

    first: ParameterFit
    """To the first half."""
    second: ParameterFit
    """To the second half."""
    both: ParameterFit
    """To all rows."""


def squares_of_folds(normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """
    Return ``sum_f w_f' N_pf w_f``, the residual sums of squares over f folds, shape (p,).

    Parameters
    ----------
    normals : array, shape (p, f, n, n)
        Normal matrix N of each of p parts of the rows and each fold.
    weights : array, shape (f, n)
        Weights w of the residuals of each fold (`weights_of`).

    """
    return ((normals @ weights[:, :, None])[..., 0] * weights).sum(axis=(1, 2))


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


@dataclass(eq=False)
class Evidence:
    """
    Evidence for choices of parameters, each a sequence of indices, from rows in folds.

    Losses are minus twice log likelihoods, up to a constant; here those of known noise.
    """

    blocks: Sequence[Rows]
    """Explicit rows."""
    folds: Sequence[np.ndarray]
    """Fold of each row of each block, each shape (m,)."""
    _: KW_ONLY
    total: np.ndarray
    """
    Normal matrix ``[design | residual]' V^-1 [design | residual]`` of all rows, shape
    (q + 1, q + 1).
    """
    without: np.ndarray
    """The same of all rows but those of each fold, shape (n_folds, q + 1, q + 1)."""
    prior_sd: np.ndarray
    """Prior standard deviations of the parameters, shape (q,)."""
    prior_mean: np.ndarray
    """Prior values of the parameters, shape (q,)."""
    _fits: dict[tuple, ParameterFit] = field(
        default_factory=lambda: Recent(MOST_FITS), init=False, repr=False
    )
    """Sorted choice -> its fit to all rows."""
    _losses: dict[tuple, float] = field(default_factory=dict, init=False, repr=False)
    """Sorted choice, after 'held out' or not -> its loss."""
    _heldout_fits: dict[tuple, np.ndarray] = field(
        default_factory=lambda: Recent(MOST_FITS), init=False, repr=False
    )
    """Sorted choice -> `_heldout_weights`."""

    def equations(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (matrix (q, q), right side (q,)) of the normal equations of all parameters.

        They contain all rows and the prior.
        """
        prior_information = 1 / self.prior_sd**2
        matrix = self.total[:-1, :-1] + np.diag(prior_information)
        right = self.total[:-1, -1] + prior_information * self.prior_mean
        return matrix, right

    def fit(self, used: Sequence[int]) -> ParameterFit:
        """Return (values, covariance) of the parameters `used`, in that order, from all rows."""
        ordered = tuple(sorted(used))
        if ordered not in self._fits:
            self._fits[ordered] = self._fitted(self.total, ordered)
        values, covariance = self._fits[ordered]
        if ordered == tuple(used):
            return values, covariance
        places = np.searchsorted(ordered, used)
        return values[places], covariance[np.ix_(places, places)]

    def _fitted(self, normal: np.ndarray, used: Sequence[int]) -> ParameterFit:
        """Return (values, covariance) of the parameters `used` by a normal matrix and the prior."""
        return solve_normal(normal, np.array(used), self.prior_sd, prior_mean=self.prior_mean)

    def loss(self, used: Sequence[int]) -> float:
        """Return the loss of the best fit to all rows."""
        ordered = tuple(sorted(used))
        if ordered not in self._losses:
            self._losses[ordered] = self._loss(ordered)
        return self._losses[ordered]

    def heldout(self, used: Sequence[int]) -> float:
        """Return the loss of each fold under the fit to the other folds, summed."""
        ordered = tuple(sorted(used))
        key = ('held out', *ordered)
        if key not in self._losses:
            self._losses[key] = self._heldout(ordered)
        return self._losses[key]

    def heldout_parts(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return sensor -> loss on held-out data, shape (2, 3).

        Rows are the means of the windows, and the samples about them; columns are the axes.
        """
        raise NotImplementedError(f'{type(self).__name__} has no effect that acts on both sensors')

    def p_value(self, smaller: Sequence[int], larger: Sequence[int]) -> float:
        """Return the p-value of `larger` against `smaller` (chi-square of the fall of the loss)."""
        fall = max(self.loss(smaller) - self.loss(larger), 0.0)
        return float(chi2_sf(fall, len(larger) - len(smaller)))

    def fits_of_halves(self, used: Sequence[int]) -> FitsOfHalves:
        """Return the fits of parameters to the first and second half of the rows, and to both."""
        raise NotImplementedError

    def heldout_residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """Return the residuals of each block, every row under the fit without its fold."""
        weights = self.heldout_weights(used)
        return [block.residuals_at(weights[fold]) for block, fold in zip(self.blocks, self.folds)]

    def heldout_weights(self, used: Sequence[int]) -> np.ndarray:
        """
        Return the weights of the residuals of each fold (`weights_of`), shape (n_folds, q + 1).

        The parameters `used` have the values of the fit to all other folds, all others are zero.
        """
        weights = np.zeros((len(self.without), len(self.total)))
        weights[:, np.append(sorted(used), -1)] = self._heldout_weights(tuple(sorted(used)))
        return weights

    def _loss(self, used: Sequence[int]) -> float:
        """Return the loss of the best fit of a sorted choice to all rows."""
        return quadratic(self.total, used, self.fit(used)[0])

    def _heldout(self, used: tuple[int, ...]) -> float:
        """Return the loss of each fold of a sorted choice under the fit to the others, summed."""
        places = np.append(used, -1)
        of_folds = self.total[np.ix_(places, places)] - self.without[:, places[:, None], places]
        return float(squares_of_folds(of_folds[None], self._heldout_weights(used))[0])

    def _heldout_weights(self, used: tuple[int, ...]) -> np.ndarray:
        """Return `heldout_weights` of the n sorted parameters `used` alone, (n_folds, n + 1)."""
        if used not in self._heldout_fits:
            parameters = np.array(used)
            information = 1 / self.prior_sd[parameters] ** 2
            places = np.append(parameters, -1)
            normal = self.without[:, places[:, None], places]
            matrix = normal[:, :-1, :-1] + np.diag(information)
            right = normal[:, :-1, -1] + information * self.prior_mean[parameters]
            values = solve_scaled(matrix, right)
            self._heldout_fits[used] = np.column_stack([-values, np.ones(len(values))])
        return self._heldout_fits[used]


DISAGREE = 1e-4
"""Significance level of the test that the halves differ."""
MAX_HALVES_LOSS = 1 / 16
"""
Share of an effect's chi-square, above which the loss with one value for both halves is a
disagreement.

For halves of equal precision: values that differ by half of the joint estimate.
"""


def agree(fits: FitsOfHalves, at: Sequence[int]) -> bool:
    """
    Return whether the estimates of some parameters from two halves agree within their precision.

    With the estimates x and their covariances C of the halves 1, 2 and of both::

        chi2_difference = (x_1 - x_2)' (C_1 + C_2)^-1 (x_1 - x_2)
        chi2_effect = x' C^-1 x

    They disagree when the difference is significant and exceeds `MAX_HALVES_LOSS` of the chi-square
    of the effect. A half that determines an effect badly loses little, for any value: before any
    rotation, an arm may be estimated at a metre.

    Parameters
    ----------
    fits : FitsOfHalves
    at : sequence of int
        Indices of the parameters under test among the fitted ones.

    """
    at = list(at)
    first, first_cov = fits.first
    second, second_cov = fits.second
    difference = (first - second)[at]
    covariance = (first_cov + second_cov)[np.ix_(at, at)]
    chi2_difference = float(difference @ np.linalg.solve(covariance, difference))

    joint, joint_cov = fits.both
    value = joint[at]
    chi2_effect = float(value @ np.linalg.solve(joint_cov[np.ix_(at, at)], value))

    is_insignificant = chi2_sf(chi2_difference, len(at)) > DISAGREE
    return bool(is_insignificant or chi2_difference < MAX_HALVES_LOSS * chi2_effect)
