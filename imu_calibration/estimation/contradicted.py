"""Windows that do not belong to the others of their kind: somebody leaned on the table or shoved the IMU while it was thought to rest."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.f_test import chance_of_fall
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.weighted_system import WeightedSystem

P_VALUE = 1e-3
"""Chance that a recording without such windows loses one, per sensor and kind."""
SHARE = 0.15
"""Of each kind, at most this share is left out: what is more frequent is how the recording is."""
LEAST_SPARE = 9.0
"""Degrees of freedom that the others of the kind must leave to judge by."""
CANDIDATES = 8
"""Windows of each kind that are looked at in one round, those that fit worst."""
LEAST_SEEN = 0.05
"""A window that keeps less than this share of its error after the fit says nothing."""


def contradicted(system: WeightedSystem, values: np.ndarray, noises: dict[str, NoiseModel]) -> dict[str, frozenset]:
    """
    Return sensor -> keys of the windows whose mean the others of its kind contradict, beyond those that the noise leaves out already.

    Of one kind at a time, the one with the least probable of them: a bias that seems to move makes the neighbours of such a window stand
    out, too.

    With an offset of its own for one window the others must fit improbably better (F test, for as many windows as there are). The noise may
    have been estimated with that window: too large by it, it is too large for all, and the ratio stays.

    Parameters
    ----------
    system : WeightedSystem
    values : ndarray, shape (n_params,)
        The estimate.
    noises : dict
        Sensor -> NoiseModel, with which it was made.

    """
    found, kinds = {}, np.array(system.kinds)
    for sensor in SENSORS:
        fit, out = _Fit.of(system, sensor, values, noises[sensor]), np.array([key in noises[sensor].left_out for key in system.keys])
        worst = min((_of_kind(kinds == kind, out, fit) for kind in sorted(set(system.kinds))), key=lambda of_kind: of_kind[0])
        found[sensor] = frozenset(system.keys[at] for at in worst[1])
    return found


def _of_kind(own: np.ndarray, out: np.ndarray, fit: '_Fit') -> tuple[float, list[int]]:
    """Return (the least chance, the numbers of the windows `own` that do not belong to the others), besides those that are `out`."""
    count, kept = int(own.sum()), np.flatnonzero(own & ~out)
    allowed = max(1, int(SHARE * count)) - (count - len(kept))
    worst = kept[np.argsort(-(fit.rest[kept]**2).sum(axis=1), kind='stable')][:CANDIDATES] if allowed > 0 else []
    found = sorted((fit.p_value(at, kept) * len(kept), at) for at in worst)[:allowed]
    return found[0][0] if found else 1.0, [at for chance, at in found if chance < P_VALUE]


@dataclass(frozen=True, eq=False)
class _Fit:
    """Whitened means of one sensor beside everything else that is known of its parameters."""

    rest: np.ndarray
    """Whitened residuals, shape (n_windows, 3)."""
    design: np.ndarray
    """Whitened columns, shape (n_windows, 3, q)."""
    covariance: np.ndarray
    """Of the parameters, shape (q, q)."""
    whiten: Callable
    """What whitens columns, shape (n_windows, 3, k)."""

    @classmethod
    def of(cls, system: WeightedSystem, sensor: str, values: np.ndarray, noise: NoiseModel) -> '_Fit':
        rows, normal = system.linearised(sensor, values, noise)
        white = system.whitened(rows, noise)
        design, q = white[:, :, :-1], white.shape[2] - 1
        return cls(white[:, :, -1], design, inverse_normal(normal[:q, :q] + np.einsum('kap,kaq->pq', design, design)),
                   lambda columns: system.whitened(columns, noise))

    def p_value(self, at: int, own: np.ndarray) -> float:
        """Return the chance that the windows `own` fit so much better with an offset of its own for window `at`."""
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
