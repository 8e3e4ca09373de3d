"""Small problems on the reduced recording: how well a choice of parameters predicts windows that it was not fitted to."""

from functools import cached_property

import numpy as np
from scipy.stats import chi2

from imu_calibration.diagnosis.noise import KINDS, normal_matrix, white_means
from imu_calibration.effects.base import SENSORS

FOLDS = 6
"""Parts that are held out in turn."""
LOCKED_EVERY = 4
"""Every so many windows of each kind take no part in choosing."""


def locked_windows(kind):
    """Return a mask of the windows that take no part in choosing: every fourth of each kind, spread through the session."""
    return _turn_of(kind, LOCKED_EVERY) == LOCKED_EVERY - 2


def folds_of(kind, locked):
    """Return the fold of each window, -1 where locked; windows of each kind are dealt out in turn."""
    fold = np.full(len(kind), -1)
    fold[~locked] = _turn_of(kind[~locked], FOLDS)
    return fold


def _turn_of(kind, modulus):
    turn = np.zeros(len(kind), int)
    for offset, name in enumerate(np.unique(kind)):
        turn[kind == name] = (np.arange((kind == name).sum()) + offset) % modulus
    return turn


class Evidence:
    """
    Normal matrices of the folds of a recording, and what follows from them.

    A choice of parameters is an index array into the space of the diagnosis. Losses are minus twice log likelihoods, up to a constant.
    """

    def __init__(self, space, noise, fold):
        self.space, self.noise, self.fold = space, noise, fold
        self.parts = np.array([normal_matrix(space, noise, fold == number) for number in range(fold.max() + 1)])
        self.total = self.parts.sum(axis=0)
        self._fits = {}

    def fit(self, used, number=None):
        """Return (values, inverse information) of the parameters `used` on all chosen windows, or on all but fold `number`."""
        key = (tuple(used), number)
        if key not in self._fits:
            normal = self.total if number is None else self.total - self.parts[number]
            self._fits[key] = self._solve(normal, np.asarray(used))
        return self._fits[key]

    def _solve(self, normal, used):
        sd, shift = self.space.prior_sd[used], self.space.prior_mean[used]
        information = normal[np.ix_(used, used)].copy()
        information.flat[::len(used) + 1] += 1 / sd**2
        scale = 1 / np.sqrt(np.diag(information))
        scaled = information * np.outer(scale, scale)
        scaled.flat[::len(used) + 1] += 1e-12
        inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
        return inverse @ (normal[used, -1] + shift / sd**2), inverse

    def loss(self, used):
        """Return the loss of the best fit on all chosen windows."""
        return quadratic(self.total, np.asarray(used), self.fit(used)[0])

    def heldout_losses(self, used):
        """Return the loss of each fold under the fit to the other folds, shape (n_folds,)."""
        index = np.asarray(used)
        return np.array([quadratic(part, index, self.fit(used, number)[0]) for number, part in enumerate(self.parts)])

    def heldout(self, used):
        """Return the loss on held-out windows, all folds."""
        return float(self.heldout_losses(used).sum())

    def p_value(self, smaller, larger):
        """Return the p-value of `larger` against `smaller` (chi-square of the fall of the loss)."""
        fall = self.loss(smaller) - self.loss(larger)
        return float(chi2.sf(max(fall, 0.0), len(larger) - len(smaller)))

    def window_losses(self, used):
        """
        Return the loss of each window under fits that did not see its fold: two dicts sensor -> (k,), NaN where locked.

        The first is the loss of the windows' means, the second that within the windows.
        """
        index = np.asarray(used)
        reduced = np.zeros((len(self.parts), self.space.size + 1))
        reduced[:, -1] = 1.0
        for number in range(len(self.parts)):
            reduced[number, index] = -self.fit(used, number)[0]
        rows = self.fold >= 0
        found = {sensor: self._losses(sensor, reduced[np.maximum(self.fold, 0)]) for sensor in SENSORS}
        return tuple({sensor: np.where(rows, found[sensor][part], np.nan) for sensor in SENSORS} for part in range(2))

    def _losses(self, sensor, reduced):
        kind = self.space.lifted.kind
        means, within = np.zeros(len(kind)), np.zeros(len(kind))
        for axis in range(3):
            weights = reduced[:, np.r_[self.space.index[sensor][axis], self.space.size]]
            means += np.einsum('ki,ki->k', self._white[sensor][axis], weights)**2
            inside = np.einsum('kij,ki,kj->k', self.space.within[sensor][axis], weights, weights, optimize=True)
            for name in KINDS:
                rows = kind == name
                within[rows] += inside[rows] / self.noise[sensor].row_variance(name)[axis]
        return means, within

    @cached_property
    def _white(self):
        return {sensor: white_means(self.space, self.noise, sensor) for sensor in SENSORS}


def quadratic(normal, used, values):
    """Return the loss of `values` of the parameters `used` under a normal matrix."""
    used = np.asarray(used)
    inner = normal[np.ix_(used, used)]
    return float(normal[-1, -1] - 2 * values @ normal[used, -1] + values @ inner @ values)
