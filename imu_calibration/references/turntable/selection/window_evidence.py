"""How well a choice of parameters predicts windows that it was not fitted to."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.estimation.rows import flat, weights_of
from imu_calibration.estimation.scaled_solve import inverse_normal, solve_scaled
from imu_calibration.estimation.solution import CONVENTION_SHARE
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.selection.parameter_space import (
    ParameterSpace,
    mean_rows,
    normal_matrix,
    within_of_axis,
)
from imu_calibration.selection.evidence import Evidence, ParameterFit, _squares

MIN_FOLD_WINDOWS = 8
"""Least number of windows for held-out folds."""


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
        self._white: dict[str, list[np.ndarray]] = {}
        """Sensor -> independent means of unit variance of each axis."""
        self._of_axis: dict[str, list[np.ndarray]] = {}
        """Sensor -> of each axis the products of means and within windows, (2, n_folds, n, n)."""
        blocks = []
        for sensor in space.sensors:
            own_scatter = None if scatter is None else scatter.get(sensor)
            means = mean_rows(space, noise, sensor, scatter=own_scatter)
            self._white[sensor] = [flat(rows.white()) for rows in means]
            self._of_axis[sensor] = []
            for axis, white in enumerate(self._white[sensor]):
                of_means = [white[own].T @ white[own] for own in self._folds]
                within = self._within(space, sensor, axis)
                self._of_axis[sensor].append(np.array([of_means, within]))
            blocks += means
        parts = np.sum([self._of_sensor(sensor) for sensor in space.sensors], axis=0)
        total = np.sum(parts, axis=0)
        super().__init__(
            blocks,
            [fold] * len(blocks),
            total=total,
            without=total - parts,
            prior_sd=space.prior_sd,
            prior_mean=space.prior_mean,
        )

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
        first, second = self._halves
        return self._fitted(first, used), self._fitted(second, used), self.fit(used)

    @cached_property
    def _halves(self) -> list[np.ndarray]:
        """Normal matrices of the first and second half of the windows."""
        early = np.arange(len(self.fold)) < len(self.fold) // 2
        return [normal_matrix(self.space, self.noise, half) for half in (early, ~early)]

    def known_from(self, sensor: str, used: Sequence[int]) -> np.ndarray:
        """Return the covariance of the parameters `used` from one sensor and the prior."""
        at = np.ix_(used, used)
        information = self._of_sensor(sensor).sum(axis=0)[at]
        return inverse_normal(information + np.diag(1 / self.prior_sd[list(used)] ** 2))

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
        others = self.without[:, own[:, None], own] + np.diag(1 / self.prior_sd[own] ** 2)
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
        reduced = weights_of(used, values, self.space.size)
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
        n_windows = len(moved)
        n_own = int(observable.sum())
        if n_windows - n_own < LEAST_SCATTER:
            return 0.0

        # T^2 = z' S^-1 z, an F statistic with n_own and n_windows - n_own degrees of freedom.
        along = (directions.T @ (values[places] / sd))[observable]
        t_squared = (along**2 / sizes[observable]).sum()
        ratio = (n_windows - n_own) / (n_own * (n_windows - 1)) * t_squared
        return float(f_sf(ratio, n_own, n_windows - n_own))
