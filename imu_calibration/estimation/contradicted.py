"""Outlying windows: their mean is inconsistent with the other windows of their kind, as after a knock during an assumed rest."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.distributions import chance_of_fall
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.weighted_system import WeightedSystem

P_VALUE = 1e-3
"""False positive rate per sensor and kind for a recording without outliers."""
SHARE = 0.15
"""Largest share of each kind that is excluded; a more frequent deviation is a property of the recording."""
LEAST_SPARE = 9.0
"""Residual degrees of freedom of the other windows of the kind that the test requires."""
CANDIDATES = 8
"""Windows of each kind under test per round, in order of their residual."""
LEAST_SEEN = 0.05
"""A window whose error keeps less than this share in the residuals is not tested."""


def contradicted(system: WeightedSystem, values: np.ndarray, noises: dict[str, NoiseModel]) -> dict[str, frozenset]:
    """
    Return sensor -> keys of the outlying windows by kind, without the ones that the noise model excludes already.

    Mean-shift F test, one kind of window per round (the one with the least probable outlier), because with a bias process one outlier makes
    its neighbours look inconsistent.

    A separate offset for one window must improve the fit of the other windows significantly (F test with Bonferroni correction). The noise
    may be overestimated because of that window; the factor is common to all windows and cancels in the ratio.

    Parameters
    ----------
    system : WeightedSystem
    values : ndarray, shape (n_params,)
        The estimate.
    noises : dict
        Sensor -> NoiseModel of the estimate.

    """
    found, kinds = {}, np.array(system.kinds)
    for sensor in SENSORS:
        fit, out = _Fit.of(system, sensor, values, noises[sensor]), np.array([key in noises[sensor].left_out for key in system.keys])
        worst = min((_of_kind(kinds == kind, out, fit) for kind in sorted(set(system.kinds))), key=lambda of_kind: of_kind[0])
        found[sensor] = frozenset(system.keys[at] for at in worst[1])
    return found


def _of_kind(own: np.ndarray, out: np.ndarray, fit: '_Fit') -> tuple[float, list[int]]:
    """Return (the smallest p-value, the numbers of the outliers among the windows `own`), without the windows `out`."""
    count, kept = int(own.sum()), np.flatnonzero(own & ~out)
    allowed = max(1, int(SHARE * count)) - (count - len(kept))
    worst = kept[np.argsort(-(fit.rest[kept]**2).sum(axis=1), kind='stable')][:CANDIDATES] if allowed > 0 else []
    found = sorted((fit.p_value(at, kept) * len(kept), at) for at in worst)[:allowed]
    return found[0][0] if found else 1.0, [at for chance, at in found if chance < P_VALUE]


@dataclass(frozen=True, eq=False)
class _Fit:
    """Whitened means of one sensor with the normal matrix of centred rows and prior."""

    rest: np.ndarray
    """Whitened residuals, shape (n_windows, 3)."""
    design: np.ndarray
    """Whitened columns, shape (n_windows, 3, q)."""
    covariance: np.ndarray
    """Of the parameters, shape (q, q)."""
    whiten: Callable
    """Function that whitens columns, shape (n_windows, 3, k)."""

    @classmethod
    def of(cls, system: WeightedSystem, sensor: str, values: np.ndarray, noise: NoiseModel) -> '_Fit':
        rows, normal = system.linearised(sensor, values, noise)
        white = system.whitened(rows, noise)
        design, q = white[:, :, :-1], white.shape[2] - 1
        return cls(white[:, :, -1], design, inverse_normal(normal[:q, :q] + np.einsum('kap,kaq->pq', design, design)),
                   lambda columns: system.whitened(columns, noise))

    def p_value(self, at: int, own: np.ndarray) -> float:
        """Return the p-value of the improvement of the windows `own` by a separate offset for window `at`."""
        one = np.zeros(self.rest.shape + (1,))
        one[at] = 1.0
        one = self.whiten(one)[:, :, 0]
        along = np.einsum('kap,ka->ap', self.design, one)
        seen = (one**2).sum(axis=0) - np.einsum('ap,pq,aq->a', along, self.covariance, along)
        if np.any(seen < LEAST_SEEN * (one**2).sum(axis=0)):
            return 1.0
        size = (one * self.rest).sum(axis=0) / seen
        better = self.rest - (one - np.einsum('kap,pq,aq->ka', self.design, self.covariance, along)) * size
        leverage = np.einsum('kap,pq,kaq->ka', self.design[own], self.covariance, self.design[own]).sum()
        spare = 3 * len(own) - leverage - 3
        if spare < LEAST_SPARE:
            return 1.0
        total, others = ((part[own]**2).sum() for part in (self.rest, better))
        return chance_of_fall(total - others, 3, rest=others, spare=spare)
