"""Outliers among the means of windows of the same kind."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.distributions import chance_of_fall
from imu_calibration.estimation.outliers import Outliers, find_outliers
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.references.turntable.estimation.weighted_system import WeightedSystem
from imu_calibration.references.turntable.noise_model import NoiseModel

MAX_WINDOW_OUTLIERS = 0.15
"""
Largest share of each kind that is excluded; a more frequent deviation is a property of the
recording.
"""
MIN_WINDOW_FREEDOM = 9.0
"""Residual degrees of freedom of the other windows of the kind that the test requires."""
OUTLIER_CANDIDATES = 8
"""Windows of each kind under test per round, in order of their residual."""
LEAST_VISIBLE = 0.05
"""Least share of the error of a window in the residuals, from which the window is tested."""
WindowKey = tuple[int, float]
"""Recording, and middle of the window in s."""


def outlier_windows(
    system: WeightedSystem, values: np.ndarray, noises: dict[str, NoiseModel]
) -> dict[str, frozenset[WindowKey]]:
    """
    Return sensor -> keys of the outlying windows, except windows that the noise excludes already.

    Mean-shift F test: a separate offset for one window must improve the fit of the windows of its
    kind significantly (with Bonferroni correction). The noise may be overestimated because of that
    window; the factor is common to all windows and cancels in the ratio. A call returns outliers of
    one kind of window, the one with the least probable outlier, because with a bias process one
    outlier makes its neighbours inconsistent.

    Parameters
    ----------
    system : WeightedSystem
    values : ndarray, shape (n_params,)
        The estimate.
    noises : dict
        Sensor -> NoiseModel of the estimate.

    """
    outliers_of = {}
    for sensor in system.sensors:
        fit = _MeanFit.of(system, sensor, values, noises[sensor])
        excluded = np.array([key in noises[sensor].left_out for key in system.keys])
        kinds = np.unique(system.kind)
        of_kinds = [_outliers_of_kind(system.kind == kind, excluded, fit) for kind in kinds]
        least_probable = min(of_kinds, key=lambda outliers: outliers.least_p_value)
        outliers_of[sensor] = frozenset(system.keys[window] for window in least_probable.numbers)
    return outliers_of


def _outliers_of_kind(of_kind: np.ndarray, excluded: np.ndarray, fit: '_MeanFit') -> Outliers:
    """Return the outliers among the windows of a kind (mask) that are not `excluded` (mask)."""
    n_windows = int(of_kind.sum())
    included = np.flatnonzero(of_kind & ~excluded)
    n_excluded = n_windows - len(included)
    n_allowed = max(1, int(MAX_WINDOW_OUTLIERS * n_windows)) - n_excluded
    if n_allowed <= 0:
        return Outliers(least_p_value=1.0, numbers=())

    # The windows with the largest residuals are tested.
    squares = (fit.residual[included] ** 2).sum(axis=1)
    tested = included[np.argsort(-squares, kind='stable')][:OUTLIER_CANDIDATES]
    p_values = {int(window): fit.p_value(window, included) for window in tested}
    return find_outliers(p_values, n_tests=len(included), most=n_allowed)


@dataclass(frozen=True, eq=False)
class _MeanFit:
    """Whitened means of one sensor with the covariance of the parameters."""

    residual: np.ndarray
    """Whitened residuals, shape (n_windows, 3)."""
    design: np.ndarray
    """Whitened columns, shape (n_windows, 3, q)."""
    covariance: np.ndarray
    """Of the parameters, from the means, the centred rows and the prior, shape (q, q)."""
    whitening: Whitening
    """Whitening of the means."""

    @classmethod
    def of(
        cls, system: WeightedSystem, sensor: str, values: np.ndarray, noise: NoiseModel
    ) -> '_MeanFit':
        """Return the means of a sensor, linearised at the values."""
        rows = system.linearised(sensor, values, noise)
        whitening = rows.whitening()
        white = whitening(rows.equations)
        design = white[:, :, :-1]
        normal = rows.products[:-1, :-1] + np.einsum('kap,kaq->pq', design, design)
        return cls(white[:, :, -1], design, inverse_normal(normal), whitening)

    def p_value(self, window: int, of_kind: np.ndarray) -> float:
        """
        Return the p-value of a separate offset b of the mean of one window.

        With the whitened column h of the offset, the design A and the covariance C of the
        parameters, of each axis::

            s = h' h - h' A C A' h            part of h that the parameters do not imitate
            b = h' r / s
            r -> r - (h - A C A' h) b

        The test concerns the residuals of the windows with the numbers `of_kind`.
        """
        # h, A' h and s of each axis. An offset that the parameters imitate is not tested.
        column = np.zeros(self.residual.shape + (1,))
        column[window] = 1.0
        column = self.whitening(column)[:, :, 0]
        gradient = np.einsum('kap,ka->ap', self.design, column)
        squares = (column**2).sum(axis=0)
        visible = squares - np.einsum('ap,pq,aq->a', gradient, self.covariance, gradient)
        if np.any(visible < LEAST_VISIBLE * squares):
            return 1.0

        # b, and the residual with it.
        offset = (column * self.residual).sum(axis=0) / visible
        imitated = np.einsum('kap,pq,aq->ka', self.design, self.covariance, gradient)
        improved = self.residual - (column - imitated) * offset

        # F test of three offsets with the residual degrees of freedom of these windows.
        design = self.design[of_kind]
        leverage = np.einsum('kap,pq,kaq->ka', design, self.covariance, design).sum()
        dof = 3 * len(of_kind) - leverage - 3
        if dof < MIN_WINDOW_FREEDOM:
            return 1.0
        without_offset = (self.residual[of_kind] ** 2).sum()
        with_offset = (improved[of_kind] ** 2).sum()
        return chance_of_fall(without_offset - with_offset, 3, rest=with_offset, spare=dof)
