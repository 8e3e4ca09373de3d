"""
How well a choice of parameters predicts windows that it was not fitted to.

Small problems on normal matrices.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from imu_calibration.core.distributions import chi2_sf, f_sf
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.scaled_solve import (
    inverse_normal,
    quadratic,
    solve_normal,
    solve_scaled,
)
from imu_calibration.estimation.solution import CONVENTION_SHARE
from imu_calibration.selection.parameter_space import (
    ParameterSpace,
    normal_matrix,
    white_means,
    within_of_axis,
)
from imu_calibration.selection.reduced_recording import Recent

ParameterFit = tuple[np.ndarray, np.ndarray]
"""Values of parameters and their covariance, shape (n,) and (n, n)."""
MIN_FOLD_WINDOWS = 8
"""Least number of windows for held-out folds."""
MOST_FITS = 128
"""
Fits kept with covariances or predictions: a search tries thousands of choices, and asks for the
last again.
"""
EVIDENCE_FOLDS = 6
"""Parts that are held out in turn."""
LEAST_SCATTER = 20
"""Least excess of windows over parameters for a test with their scatter."""
LOCKED_EVERY = 4
"""
One of this many windows of each kind is locked: excluded from estimation, selection and rejection.
"""


def locked_windows(kind: np.ndarray) -> np.ndarray:
    """
    Return the mask of the windows that are used only for the gain.

    Every fourth of each kind, spread through the session.
    """
    return _turn_of(kind, LOCKED_EVERY) == LOCKED_EVERY - 2


def folds_of(kind: np.ndarray) -> np.ndarray:
    """Return the fold of each window; windows of each kind are dealt out in turn."""
    return _turn_of(kind, EVIDENCE_FOLDS)


def _turn_of(kind: np.ndarray, modulus: int) -> np.ndarray:
    turn = np.zeros(len(kind), int)
    for offset, name in enumerate(np.unique(kind)):
        turn[kind == name] = (np.arange((kind == name).sum()) + offset) % modulus
    return turn


class Evidence:
    """
    Evidence for choices of parameters, each a sequence of indices.

    From rows of known noise in folds.

    Losses are minus twice log likelihoods, up to a constant.

    Parameters
    ----------
    total : array, shape (q + 1, q + 1)
        Normal matrix ``[design | residual]' V^-1 [design | residual]`` of all rows.
    without : array, shape (n_folds, q + 1, q + 1)
        The same of all rows but those of each fold.
    prior_sd, prior_mean : array, shape (q,)
        Prior of the parameters.

    """

    def __init__(
        self,
        total: np.ndarray,
        without: np.ndarray,
        *,
        prior_sd: np.ndarray,
        prior_mean: np.ndarray,
    ):
        self.total = total
        self.without = without
        self._prior_sd = prior_sd
        self._prior_mean = prior_mean
        self._fits: dict[tuple, tuple] = Recent(MOST_FITS)
        self._losses: dict[tuple, float] = {}
        self._predictions: dict[tuple, np.ndarray] = Recent(MOST_FITS)

    def equations(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (matrix, right side) of the normal equations of all parameters on all rows.

        With the prior.
        """
        known = 1 / self._prior_sd**2
        matrix = self.total[:-1, :-1] + np.diag(known)
        right = self.total[:-1, -1] + known * self._prior_mean
        return matrix, right

    def fit(self, used: Sequence[int], number: int | None = None) -> ParameterFit:
        """
        Return (values, covariance) of the parameters `used`.

        They are fitted to all folds or to all but fold `number`.
        """
        ordered = tuple(sorted(used))
        if (ordered, number) not in self._fits:
            normal = self.total if number is None else self.without[number]
            self._fits[ordered, number] = solve_normal(
                normal, np.array(ordered), self._prior_sd, prior_mean=self._prior_mean
            )
        values, covariance = self._fits[ordered, number]
        if ordered == tuple(used):
            return values, covariance
        places = np.searchsorted(ordered, used)
        return values[places], covariance[np.ix_(places, places)]

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
            known = 1 / self._prior_sd[at] ** 2
            places = np.append(at, -1)
            normal = self.without[:, places[:, None], places]
            matrix = normal[:, :-1, :-1] + np.diag(known)
            values = solve_scaled(matrix, normal[:, :-1, -1] + known * self._prior_mean[at])
            # A residual is the last column less the prediction.
            self._predictions[used] = np.column_stack([-values, np.ones(len(values))])
        return self._predictions[used]


class WindowEvidence(Evidence):
    """
    Evidence of the windows of a reduced recording with known noise.

    Parameters
    ----------
    space : ParameterSpace
    noise : dict
        Sensor -> NoiseModel.
    fold : array, shape (k,)
        Fold of each window.
    scatter : dict, optional
        Sensor -> factor of the scatter within (and of the mean) of each window over its kind, at
        least 1, shape (k, 3).

    """

    def __init__(
        self,
        space: ParameterSpace,
        noise: dict[str, NoiseModel],
        fold: np.ndarray,
        *,
        scatter: dict[str, np.ndarray] | None = None,
    ):
        self.space = space
        self.noise = noise
        self.fold = fold
        self._white = {}
        """Sensor -> white mean rows of each axis."""
        self._of_axis: dict[str, list[np.ndarray]] = {}
        """Sensor -> of each axis the products of means and within windows, (2, n_folds, n, n)."""
        for sensor in space.sensors:
            own_scatter = None if scatter is None else scatter.get(sensor)
            self._white[sensor] = white_means(space, noise, sensor, scatter=own_scatter)
            self._of_axis[sensor] = []
            for axis, rows in enumerate(self._white[sensor]):
                of_means = [rows[own].T @ rows[own] for own in self._folds]
                within = self._within(space, sensor, axis)
                self._of_axis[sensor].append(np.array([of_means, within]))
        parts = np.sum([self._of_sensor(sensor) for sensor in space.sensors], axis=0)
        total = np.sum(parts, axis=0)
        super().__init__(total, total - parts, prior_sd=space.prior_sd, prior_mean=space.prior_mean)

    @property
    def _folds(self) -> list[np.ndarray]:
        """Mask of the windows of each fold."""
        return [self.fold == number for number in range(self.fold.max() + 1)]

    def _within(self, space: ParameterSpace, sensor: str, axis: int) -> list[np.ndarray]:
        """Return the normal matrix of an axis from within the windows, of each fold."""
        found = []
        for own in self._folds:
            found.append(within_of_axis(space, self.noise[sensor], sensor, axis=axis, select=own))
        return found

    def _of_sensor(self, sensor: str) -> np.ndarray:
        """Return the normal matrices of one sensor, of each fold."""
        found = np.zeros((self.fold.max() + 1, self.space.size + 1, self.space.size + 1))
        for axis, parts in enumerate(self._of_axis[sensor]):
            at = self.space.places(sensor, axis)
            found[:, at[:, None], at] += parts.sum(axis=0)
        return found

    def fits_of_halves(
        self, used: Sequence[int]
    ) -> tuple[ParameterFit, ParameterFit, ParameterFit]:
        """Return the fits of parameters to both halves of the windows, and to all of them."""
        first, second = (
            solve_normal(normal, np.array(used), self._prior_sd, prior_mean=self._prior_mean)
            for normal in self._halves
        )
        return first, second, self.fit(used)

    @cached_property
    def _halves(self) -> list[np.ndarray]:
        """Normal matrices of the first and second half of the windows."""
        early = np.arange(len(self.fold)) < len(self.fold) // 2
        return [normal_matrix(self.space, self.noise, half) for half in (early, ~early)]

    def known_from(self, sensor: str, used: Sequence[int]) -> np.ndarray:
        """Return the covariance of the parameters `used` from one sensor and the prior."""
        at = np.ix_(used, used)
        information = self._of_sensor(sensor).sum(axis=0)[at]
        return inverse_normal(information + np.diag(1 / self._prior_sd[list(used)] ** 2))

    def heldout_parts(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return the loss of `heldout` by sensor.

        Of the windows' means and within the windows, of each axis, shape (2, 3).
        """
        left = self.left_by_others(used)
        found = {}
        for sensor, axes in self._of_axis.items():
            losses = []
            for axis, parts in enumerate(axes):
                losses.append(_squares(parts, left[:, self.space.places(sensor, axis)]))
            found[sensor] = np.stack(losses, axis=1)
        return found

    def unpredicted(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return the same loss.

        The means are in units of their prediction error by the fit to the other folds: their number
        is expected.

        A slow bias process is correlated over folds: without this, the loss of a fold includes the
        uncertainty of the fit to the other folds. The effect of a drift within windows, which does
        not determine it, is predicted too.
        """
        own = np.array(sorted(used))
        left = self.left_by_others(used)
        found = self.heldout_parts(used)
        # Information N of the other folds, with the prior.
        others = self.without[:, own[:, None], own] + np.diag(1 / self._prior_sd[own] ** 2)
        for sensor, axes in self._of_axis.items():
            for axis, (means, _) in enumerate(axes):
                places = self.space.places(sensor, axis)
                _, at, of = np.intersect1d(own, places, return_indices=True)

                # e' (1 + A N^-1 A')^-1 e = e'e - g' (N + A'A)^-1 g with the slopes g = A'e.
                slopes = np.zeros(others.shape[:2])
                slopes[:, at] = np.einsum('fij,fj->fi', means[:, of], left[:, places])
                known = others.copy()
                known[:, at[:, None], at] += means[:, of[:, None], of]
                found[sensor][0, axis] -= (slopes * solve_scaled(known, slopes)).sum()

                whole = self._within_whole[sensor][axis]
                found[sensor][1, axis] = _squares(whole, left[:, places])[0]
        return found

    @cached_property
    def _within_whole(self) -> dict[str, list[np.ndarray]]:
        """
        Sensor -> part within the windows of each fold.

        For each axis, including effects that are smooth in time.
        """
        whole = replace(self.space, join_within=self.space.join)
        found = {}
        for sensor in self.space.sensors:
            found[sensor] = [np.array([self._within(whole, sensor, axis)]) for axis in range(3)]
        return found

    def p_value_by_scatter(self, used: Sequence[int], parameters: Sequence[int]) -> float:
        """
        Return the p-value of some of the parameters `used`.

        From their scatter over windows (Hotelling's T^2); 0 with few windows.

        With the slopes ``g_k = A_k' V_k^-1 e_k`` of the windows at the fit and its covariance C,
        the estimates have the covariance ``C sum(g_k g_k') C`` for any noise. The model has white
        noise within windows, equal in all of a kind; a bias process within them, and encoders where
        two joints turn fast, violate both (White 1980, Econometrica 48).
        """
        # Slopes g_k of the windows, shape (n_windows, q + 1).
        values, covariance = self.fit(used)
        reduced = self.space.reduced(used, values)
        kind = self.space.recording.kind
        slopes = np.zeros((len(self.fold), self.space.size + 1))
        for sensor in self.space.sensors:
            of_kind = {name: self.noise[sensor].row_variance(name) for name in np.unique(kind)}
            variance = np.array([of_kind[name] for name in kind])
            for axis, means in enumerate(self._white[sensor]):
                at = self.space.places(sensor, axis)
                within = self.space.slopes_within(sensor, axis, reduced[at])
                within = within / variance[:, axis : axis + 1]
                slopes[:, at] += means * (means @ reduced[at])[:, None] + within

        # Shifts of the estimates by each window, in sds, and their scatter.
        places = [list(used).index(k) for k in parameters]
        sd = np.sqrt(np.diag(covariance)[places])
        moved = slopes[:, list(used)] @ (covariance[:, places] / sd)
        sizes, directions = np.linalg.eigh(moved.T @ moved)
        # Without unobservable directions: compliances in no pose, arms that cancel.
        observable = sizes > CONVENTION_SHARE * sizes[-1]
        n_windows, n_own = len(moved), int(observable.sum())
        if n_windows - n_own < LEAST_SCATTER:
            return 0.0

        # T^2 = z' S^-1 z, an F statistic with n_own and n_windows - n_own degrees of freedom.
        along = (directions.T @ (values[places] / sd))[observable]
        t_squared = (along**2 / sizes[observable]).sum()
        ratio = (n_windows - n_own) / (n_own * (n_windows - 1)) * t_squared
        return float(f_sf(ratio, n_own, n_windows - n_own))


def _squares(parts: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """
    Return residual sums of squares from normal matrices of folds.

    Shape (p, f, n, n), and residual vectors (f, n), shape (p,).
    """
    return ((parts @ rows[:, :, None])[..., 0] * rows).sum(axis=(1, 2))


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
