"""
Model error in standard deviations.

Residuals that differ between parts of the recording, and parameters that drift.

The gradient of the cost is a sum over blocks of consecutive windows; at the estimate it is zero.
Sums weighted with slow cosines of the block number, times the covariance, are shifts of the
estimate between parts of the recording. Their covariance under noise is known; where the shifts
exceed it significantly, the covariance grows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.distributions import chi2_sf, f_sf
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.sensor_noise import dof_factor
from imu_calibration.estimation.solution import DRIFT, MODEL_ERROR

MIN_SCATTER_BLOCKS = 8
"""Fewest blocks for an estimate of the scatter."""
MOST_WAVES = 12
"""Number of cosines; faster ones add no information to the scatter within windows."""
SLOW_WAVES = 3
"""Cosines that show a drift."""
CHANCE = 0.01
"""False positive rate per sensor, for a drift and for model error."""
COMMON_ERROR_FACTOR = 1.5
"""
Factor on the excess variance of a group over noise: model error that is equal in every block causes
no scatter between blocks.
"""
LEAST_SHARE_OF_DATA = 1e-6
"""Share of a parameter's variance that must come from the recording."""


@dataclass(frozen=True, eq=False)
class ModelError:
    """Allowances that are added to the covariance."""

    factor: np.ndarray
    """Factor on the standard deviations from noise, at least 1, shape (n_params,)."""
    drift_variance: np.ndarray
    """Variance to add for parameters that drift, shape (n_params,)."""
    scatter_variance: np.ndarray
    """Variance to add for a bias that depends on the attitude, shape (n_params,)."""

    def terms(self, covariance: np.ndarray) -> dict[str, np.ndarray]:
        """Return the terms to add to the covariance from noise and fixed parameters."""
        scaled = covariance * (np.outer(self.factor, self.factor) - 1.0)
        return {
            MODEL_ERROR: scaled + np.diag(self.scatter_variance),
            DRIFT: np.diag(self.drift_variance),
        }


def errors_of_waves(waves: 'CosineScores', model: SensorModel) -> tuple[ModelError, set[str]]:
    """
    Return (ModelError, sensors with significant scatter) from shifts of the parameters.

    Parameters
    ----------
    waves : CosineScores
        Shifts along slow cosines over the recording.
    model : SensorModel
        The parameters of one of its effects are a group.

    """
    size = len(model.param_names)
    scattering = set()
    factor = np.ones(size)
    drift_variance = np.zeros(size)
    for sensor in {effect.sensor for effect in model.effects}:
        groups = []
        for effect in model.effects:
            group = waves.group(model.slices[effect.key])
            if effect.sensor == sensor and len(group):
                groups.append(group)
        if not groups:
            continue
        # One test of all groups of a sensor; if it is significant, each group has its own variance.
        drifts = [waves.drift(group) for group in groups]
        if _fisher([chance for chance, _ in drifts]) < CHANCE:
            for group, (_, variance) in zip(groups, drifts, strict=True):
                drift_variance[waves.places[group]] = variance
        scatters = [waves.scatter(group) for group in groups]
        if _fisher([chance for chance, _ in scatters]) < CHANCE:
            scattering.add(sensor)
            for group, (_, ratio) in zip(groups, scatters, strict=True):
                factor[waves.places[group]] = np.sqrt(ratio)
    return ModelError(factor, drift_variance, np.zeros(size)), scattering


def _fisher(p_values: Sequence[float]) -> float:
    """Return the p-value of several independent ones together (Fisher)."""
    return float(chi2_sf(-2 * np.log(np.maximum(p_values, 1e-300)).sum(), 2 * len(p_values)))


def waves_of_blocks(
    information: np.ndarray,
    gradient: np.ndarray,
    prior_root: np.ndarray,
    *,
    free: np.ndarray,
    shared: np.ndarray | None = None,
) -> 'CosineScores':
    """
    Return the shifts of the free parameters along slow cosines of the block number.

    With the information N_b and the gradient g_b of block b, the covariance C = (sum N_b + R'R)^-1
    and the weights w_kb of cosine k::

        shift_k = C sum_b w_kb g_b
        cov(shift_k) = C (sum_b w_kb^2 N_b - M_k C M_k) C,   M_k = sum_b w_kb N_b

    Fitted nuisances reduce the middle term by ``L_k' L_k``, ``L_k = sum_b w_kb shared_b``.

    Parameters
    ----------
    information : array, shape (n_blocks, n_params, n_params)
    gradient : array, shape (n_blocks, n_params)
    prior_root : array, shape (m, n_params)
        Square root R of the information of the prior.
    free : array of bool, shape (n_params,)
        Parameters that were estimated.
    shared : array, shape (n_blocks, n_nuisances, n_params), optional
        Products of an orthonormal basis of the nuisances with the design, of each block.

    """
    information = information[:, free][:, :, free]
    gradient = gradient[:, free]
    covariance = inverse_normal(
        information.sum(axis=0) + prior_root[:, free].T @ prior_root[:, free]
    )
    # Weights of the blocks in each cosine, the slowest first.
    n_blocks = len(information)
    number = np.arange(1, min(MOST_WAVES, n_blocks - 1) + 1)
    weights = np.sqrt(2) * np.cos(np.pi * number[:, None] * (np.arange(n_blocks) + 0.5) / n_blocks)
    mixed = np.einsum('kc,cij->kij', weights, information)
    squared = np.einsum('kc,cij->kij', weights**2, information)
    expected = squared - mixed @ covariance @ mixed
    if shared is not None:
        nuisance_products = np.einsum('kc,cdi->kdi', weights, shared[:, :, free])  # L_k
        expected -= nuisance_products.transpose(0, 2, 1) @ nuisance_products
    expected = covariance @ expected @ covariance
    return CosineScores(np.flatnonzero(free), weights @ gradient @ covariance, expected, covariance)


@dataclass(frozen=True, eq=False)
class CosineScores:
    """Shifts of the m free parameters along k slow cosines over a recording."""

    places: np.ndarray
    """Numbers of the free parameters among all, shape (m,)."""
    shifts: np.ndarray
    """Shift along each cosine, the slowest first, shape (k, m)."""
    expected: np.ndarray
    """Covariance of each shift under noise, shape (k, m, m)."""
    covariance: np.ndarray
    """Covariance of the estimate under noise, shape (m, m)."""

    @property
    def walk(self) -> np.ndarray:
        """
        Variance of each cosine of a random walk with unit variance after the recording, shape (k,).
        """
        return 1 / (np.pi * np.arange(1, len(self.shifts) + 1)) ** 2

    def group(self, part: slice) -> np.ndarray:
        """
        Return the indices, among the free parameters, of those of one effect.

        The effect has the parameters `part` of the model. Parameters of which the recording
        contains almost no information are omitted.
        """
        least = LEAST_SHARE_OF_DATA * np.diag(self.covariance)
        informed = np.all(np.einsum('kii->ki', self.expected) > least, axis=0)
        return np.flatnonzero((self.places >= part.start) & (self.places < part.stop) & informed)

    def drift(self, group: np.ndarray) -> tuple[float, np.ndarray]:
        """
        Return (p-value of a slow change, variance to add for it) of n parameters, shape (n,).

        The parameters are independent random walks of one common variance; a parameter with a
        significant walk has a larger variance. The means of two recordings of equal length differ
        by two thirds of the variance that the walk reaches in one recording, a third from each.
        """
        p_value, common = self._walk_test(group)
        variances = []
        for parameter in group:
            p_value_alone, variance = self._walk_test(np.array([parameter]))
            significant = p_value_alone < CHANCE / len(group)
            variances.append(max(common, variance) if significant else common)
        return p_value, np.array(variances)

    def _walk_test(self, group: np.ndarray) -> tuple[float, float]:
        """
        Return (p-value, variance to add) by the score test of the variance v of a random walk.

        The shift m_k along the slow cosine k has the covariance ``S_k + v w_k I``, with S_k from
        noise and w_k of the unit walk::

            score = sum w_k |S_k^-1 m_k|^2
            E(score) = mean + v spread,   mean = sum w_k tr(S_k^-1),   spread = sum w_k^2 tr(S_k^-2)

        Fast variation that is not white, such as the ripple of a motor, is part of the noise and
        makes the slow cosines smaller than expected: where the faster ones scatter less than
        expected, they are the reference of the test (F instead of chi-square).
        """
        inverse = self._inverse(group)
        walk = self.walk[:SLOW_WAVES]
        shifts = self.shifts[:, group]
        # Squares of the faster cosines in units of their noise, each expected to be the number of
        # parameters.
        fast = np.einsum('ki,kij,kj->k', shifts, inverse, shifts)[SLOW_WAVES:]
        fast_dof = fast.size * len(group)

        # The score of the slow cosines, and its expectation.
        inverse = inverse[:SLOW_WAVES]
        shifts = shifts[:SLOW_WAVES]
        score = walk @ (np.einsum('kij,kj->ki', inverse, shifts) ** 2).sum(axis=1)
        mean = walk @ np.einsum('kii->k', inverse)
        spread = walk**2 @ np.einsum('kij,kij->k', inverse, inverse)
        # The variance of the score under noise is 2 spread: score / mean dof is like chi-square.
        dof = mean**2 / spread
        if fast.sum() < fast_dof:
            mean = mean * fast.sum() / fast_dof
            p_value = f_sf(score / mean, dof, fast_dof)
        else:
            p_value = chi2_sf(score / mean * dof, dof)
        # A third of the variance of the walk, see `drift`.
        return float(p_value), max(score - mean, 0.0) / spread / 3 * float(dof_factor(dof))

    def scatter(self, group: np.ndarray) -> tuple[float, np.ndarray]:
        """
        Return (p-value of the scatter, factor on the variance of each parameter) of n parameters.

        The factor follows from the mean of two variance ratios, that of the parameter and that of
        the group: ``sum_k m_k' S_k^-1 m_k / (k n)`` with the shifts m and their covariance S.
        """
        shifts = self.shifts[:, group]
        inverse = self._inverse(group)
        ratio = np.einsum('ki,kij,kj->k', shifts, inverse, shifts).sum() / shifts.size
        single = (shifts**2 / np.einsum('kii->ki', self.expected)[:, group]).mean(axis=0)
        p_value = float(chi2_sf(ratio * shifts.size, shifts.size))
        excess = np.maximum(0.5 * (single + ratio) - 1.0, 0.0)
        return p_value, 1.0 + COMMON_ERROR_FACTOR * excess

    def _inverse(self, group: np.ndarray) -> np.ndarray:
        """Return the inverse of the covariance of each shift of n parameters, shape (k, n, n)."""
        expected = self.expected[:, group][:, :, group]
        return inverse_normal(expected)
