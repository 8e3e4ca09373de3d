"""Likelihood of choices of parameters on all windows, and on windows that are held out."""

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
from imu_calibration.selection.evidence import Evidence, FitsOfHalves, squares_of_folds

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
    Return the mask of the windows that are used only for the gain, shape (k,).

    Every fourth of each kind, spread through the session.
    """
    return _dealt_out(kind, LOCKED_EVERY) == LOCKED_EVERY - 2


def folds_of(kind: np.ndarray) -> np.ndarray:
    """Return the fold of each window; windows of each kind are dealt out in turn."""
    return _dealt_out(kind, EVIDENCE_FOLDS)


def _dealt_out(kind: np.ndarray, n_parts: int) -> np.ndarray:
    """
    Return the number of the part that each window is dealt to, shape (k,).

    Windows of one kind are dealt to the parts in turn; each kind begins with another part.
    """
    part = np.zeros(len(kind), int)
    for first, name in enumerate(np.unique(kind)):
        is_kind = kind == name
        part[is_kind] = (np.arange(is_kind.sum()) + first) % n_parts
    return part


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
        self._in_fold = [fold == number for number in range(fold.max() + 1)]
        """Mask of the windows of each fold, shape (k,)."""
        self._white: dict[str, list[np.ndarray]] = {}
        """Sensor -> independent means of unit variance of each axis."""
        self._of_axis: dict[str, list[np.ndarray]] = {}
        """Sensor -> of each axis the products of means and within windows, (2, n_folds, n, n)."""
        blocks = []
        for sensor in space.sensors:
            # Independent means of each axis, shape (k, q_a + 1).
            scatter_of_sensor = None if scatter is None else scatter.get(sensor)
            means = mean_rows(space, noise, sensor, scatter=scatter_of_sensor)
            self._white[sensor] = [flat(rows.white()) for rows in means]
            blocks += means
            # Normal matrices of each axis and fold: of the means, and within windows.
            self._of_axis[sensor] = []
            for axis, white in enumerate(self._white[sensor]):
                of_means = [white[in_fold].T @ white[in_fold] for in_fold in self._in_fold]
                within = self._within(space, sensor, axis)
                self._of_axis[sensor].append(np.array([of_means, within]))

        # Over all parameters: of each fold, of all windows, and of all but each fold.
        of_folds = np.sum([self._of_sensor(sensor) for sensor in space.sensors], axis=0)
        total = np.sum(of_folds, axis=0)
        super().__init__(
            blocks,
            [fold] * len(blocks),
            total=total,
            without=total - of_folds,
            prior_sd=space.prior_sd,
            prior_mean=space.prior_mean,
        )

    @property
    def fold(self) -> np.ndarray:
        """Fold of each window, shape (k,): each block has one row per window."""
        return self.folds[0]

    def _within(self, space: ParameterSpace, sensor: str, axis: int) -> list[np.ndarray]:
        """
        Return the normal matrix of the samples about the means of their windows, for each fold.

        Over the columns of an axis, ``space.places(sensor, axis)``.
        """
        noise = self.noise[sensor]
        return [
            within_of_axis(space, noise, sensor, axis=axis, select=in_fold)
            for in_fold in self._in_fold
        ]

    def _of_sensor(self, sensor: str) -> np.ndarray:
        """Return the normal matrices of a sensor for each fold, (n_folds, q + 1, q + 1)."""
        size = self.space.size + 1
        normals = np.zeros((len(self._in_fold), size, size))
        for axis, parts in enumerate(self._of_axis[sensor]):
            at = self.space.places(sensor, axis)
            normals[:, at[:, None], at] += parts.sum(axis=0)
        return normals

    def fits_of_halves(self, used: Sequence[int]) -> FitsOfHalves:
        """Return the fits of parameters to both halves of the windows, and to all of them."""
        first, second = self._halves
        return FitsOfHalves(self._fitted(first, used), self._fitted(second, used), self.fit(used))

    @cached_property
    def _halves(self) -> list[np.ndarray]:
        """Normal matrices of the first and second half of the windows."""
        n_windows = len(self.fold)
        early = np.arange(n_windows) < n_windows // 2
        return [normal_matrix(self.space, self.noise, half) for half in (early, ~early)]

    def known_from(self, sensor: str, used: Sequence[int]) -> np.ndarray:
        """Return the covariance of the parameters `used` from one sensor and the prior."""
        at = np.ix_(used, used)
        information = self._of_sensor(sensor).sum(axis=0)[at]
        return inverse_normal(information + np.diag(1 / self.prior_sd[list(used)] ** 2))

    def heldout_parts(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return sensor -> the part of the loss `heldout` of each sensor, shape (2, 3).

        Rows are the means of the windows, and the samples about them; columns are the axes.
        """
        weights = self.heldout_weights(used)
        losses = {}
        for sensor, axes in self._of_axis.items():
            of_axes = []
            for axis, parts in enumerate(axes):
                of_columns = weights[:, self.space.places(sensor, axis)]
                of_axes.append(squares_of_folds(parts, of_columns))
            losses[sensor] = np.stack(of_axes, axis=1)
        return losses

    def unpredicted(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return the loss of `heldout_parts`, the means in units of their prediction error.

        With the residuals e of the means of a fold, their columns A and the information N of the
        other folds it is ``e' (I + A N^-1 A')^-1 e``; its expectation is the number of means.

        A slow bias process is correlated over folds: without this, the loss of a fold includes the
        uncertainty of the fit to the other folds. Within windows a drift is predicted too, although
        the samples there do not count for its estimate.
        """
        parameters = np.array(sorted(used))
        weights = self.heldout_weights(used)
        losses = self.heldout_parts(used)
        information = self.without[:, parameters[:, None], parameters]
        information = information + np.diag(1 / self.prior_sd[parameters] ** 2)
        for sensor, axes in self._of_axis.items():
            for axis, (means, _) in enumerate(axes):
                places = self.space.places(sensor, axis)
                # Places of the parameters of this axis: among the fitted ones, and in its rows.
                _, at, column = np.intersect1d(parameters, places, return_indices=True)

                # e' (I + A N^-1 A')^-1 e = e'e - g' (N + A'A)^-1 g with the slopes g = A'e.
                # For each fold f: g = means_f w_f, shape (n_folds, n_fitted), and N + A'A.
                slopes = np.zeros(information.shape[:2])
                slopes[:, at] = np.einsum('fij,fj->fi', means[:, column], weights[:, places])
                with_fold = information.copy()
                with_fold[:, at[:, None], at] += means[:, column[:, None], column]
                losses[sensor][0, axis] -= (slopes * solve_scaled(with_fold, slopes)).sum()

                # Within windows, with the columns of effects that are smooth in time.
                within = self._within_whole[sensor][axis]
                losses[sensor][1, axis] = squares_of_folds(within, weights[:, places])[0]
        return losses

    @cached_property
    def _within_whole(self) -> dict[str, list[np.ndarray]]:
        """
        Sensor -> of each axis the normal matrices within windows, shape (1, n_folds, n, n).

        In contrast to `_of_axis`, effects that are smooth in time have their columns.
        """
        whole = replace(self.space, join_within=self.space.join)
        normals = {}
        for sensor in self.space.sensors:
            normals[sensor] = [np.array([self._within(whole, sensor, axis)]) for axis in range(3)]
        return normals

    def p_value_by_scatter(self, used: Sequence[int], parameters: Sequence[int]) -> float:
        """
        Return the p-value of some of the parameters `used` being zero; 0 with few windows.

        It is that of Hotelling's T^2 with the scatter of the estimates over windows.

        With the slopes ``g_k = A_k' V_k^-1 e_k`` of the windows at the fit and its covariance C,
        the estimates have the covariance ``C sum(g_k g_k') C`` for any noise. The model has white
        noise within windows, equal in all of a kind; a bias process within them, and encoders where
        two joints turn fast, violate both (White 1980, Econometrica 48).
        """
        # Slopes g_k of the windows, shape (n_windows, q + 1).
        values, covariance = self.fit(used)
        weights = weights_of(used, values, self.space.size)
        kind = self.space.recording.kind
        n_windows = len(kind)
        slopes = np.zeros((n_windows, self.space.size + 1))
        for sensor in self.space.sensors:
            of_kind = {name: self.noise[sensor].row_variance(name) for name in np.unique(kind)}
            variance = np.array([of_kind[name] for name in kind])
            for axis, means in enumerate(self._white[sensor]):
                places = self.space.places(sensor, axis)
                of_axis = weights[places]  # times these weights, columns give the residual
                within = self.space.slopes_within(sensor, axis, of_axis)
                within = within / variance[:, axis : axis + 1]
                slopes[:, places] += means * (means @ of_axis)[:, None] + within

        # Shifts of the estimates by each window, in sds, and their scatter.
        places = [list(used).index(k) for k in parameters]
        sd = np.sqrt(np.diag(covariance)[places])
        shifts = slopes[:, list(used)] @ (covariance[:, places] / sd)
        scatter, directions = np.linalg.eigh(shifts.T @ shifts)
        # Without unobservable directions: compliances in no pose, arms that cancel.
        observable = scatter > CONVENTION_SHARE * scatter[-1]
        rank = int(observable.sum())
        dof = n_windows - rank
        if dof < LEAST_SCATTER:
            return 0.0

        # T^2 = z' S^-1 z, an F statistic with rank and n_windows - rank degrees of freedom.
        in_directions = (directions.T @ (values[places] / sd))[observable]
        t_squared = (in_directions**2 / scatter[observable]).sum()
        f_ratio = dof / (rank * (n_windows - 1)) * t_squared
        return float(f_sf(f_ratio, rank, dof))
