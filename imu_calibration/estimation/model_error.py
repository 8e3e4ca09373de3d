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
    Return (ModelError, sensors with significant scatter).

    Both are from the shifts between parts of a recording.

    Parameters
    ----------
    waves : CosineScores
    model : SensorModel
        Its parameters; a group are those of one effect.

    """
    size = len(model.param_names)
    misfits = set()
    factor = np.ones(size)
    more = np.zeros(size)
    for sensor in {effect.sensor for effect in model.effects}:
        # Groups are the parameters of one effect that the recording informs about.
        groups = []
        for effect in model.effects:
            group = waves.group(model.slices[effect.key])
            if effect.sensor == sensor and len(group):
                groups.append(group)
        if not groups:
            continue
        # The tests of the groups together decide; then each has its own variance.
        drifts = [waves.drift(group) for group in groups]
        if _fisher([chance for chance, _ in drifts]) < CHANCE:
            for group, (_, variance) in zip(groups, drifts, strict=True):
                more[waves.places[group]] = variance
        scatters = [waves.scatter(group) for group in groups]
        if _fisher([chance for chance, _ in scatters]) < CHANCE:
            misfits.add(sensor)
            for group, (_, ratio) in zip(groups, scatters, strict=True):
                factor[waves.places[group]] = np.sqrt(ratio)
    return ModelError(factor, more, np.zeros(size)), misfits


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
    Return the shifts along slow cosines of parts with their own information and gradient.

    `shared`: products of their fitted nuisances with the design, shape (k, n_nuisances, n_params).
    """
    information = information[:, free][:, :, free]
    gradient = gradient[:, free]
    covariance = inverse_normal(
        information.sum(axis=0) + prior_root[:, free].T @ prior_root[:, free]
    )
    # Weights of the blocks in each cosine, the slowest first.
    count = len(information)
    number = np.arange(1, min(MOST_WAVES, count - 1) + 1)
    weights = np.sqrt(2) * np.cos(np.pi * number[:, None] * (np.arange(count) + 0.5) / count)
    mixed = np.einsum('kc,cij->kij', weights, information)
    squared = np.einsum('kc,cij->kij', weights**2, information)
    expected = squared - mixed @ covariance @ mixed
    if shared is not None:
        along = np.einsum('kc,cdi->kdi', weights, shared[:, :, free])
        expected -= along.transpose(0, 2, 1) @ along
    expected = covariance @ expected @ covariance
    return CosineScores(
        np.flatnonzero(free), weights @ gradient @ covariance, expected, covariance=covariance
    )


class CosineScores:
    """
    Shifts of the parameters along slow cosines over a recording, with their covariance under noise.

    Parameters
    ----------
    places : array of int, shape (m,)
        Parameters that were estimated.
    moved : array, shape (k, m)
        Shift along each cosine.
    expected : array, shape (k, m, m)
        Its covariance under noise.
    covariance : array, shape (m, m)
        Of the estimate, under noise.

    """

    def __init__(
        self, places: np.ndarray, moved: np.ndarray, expected: np.ndarray, *, covariance: np.ndarray
    ):
        self.places = places
        self.moved = moved
        self.expected = expected
        self.walk = 1 / (np.pi * np.arange(1, len(moved) + 1)) ** 2
        """
        Variance of each cosine of a random walk that has unit variance after the whole recording.
        """
        self._seen = np.all(
            np.einsum('kii->ki', expected) > LEAST_SHARE_OF_DATA * np.diag(covariance), axis=0
        )

    def group(self, part: slice) -> np.ndarray:
        """
        Return the indices of one effect with information from the recording.

        The indices are among the free parameters.
        """
        return np.flatnonzero((self.places >= part.start) & (self.places < part.stop) & self._seen)

    def drift(self, group: np.ndarray) -> tuple[float, np.ndarray]:
        """
        Return (p-value of a slow change, variance to add for it) of parameters.

        The parameters are independent random walks, and the variance has shape (n,).

        One common variance, or a larger one for a parameter with a significant walk. The means of
        two recordings of equal length differ by two thirds of the variance that the walk reaches in
        one recording, a third from each.
        """
        p_value, common = self._walked(group)
        variances = []
        for parameter in group:
            chance, own = self._walked(np.array([parameter]))
            significant = chance < CHANCE / len(group)
            variances.append(max(common, own) if significant else common)
        return p_value, np.array(variances)

    def _walked(self, group: np.ndarray) -> tuple[float, float]:
        """
        Return (p-value, variance to add) by the score test of the variance of a walk.

        Fast variation that is not white, such as the ripple of a motor, is part of the noise and
        makes the slow cosines smaller than expected: where the faster ones scatter less than
        expected, they are the reference of the test (F instead of chi-square).
        """
        inverse = self._inverse(group)
        walk = self.walk[:SLOW_WAVES]
        moved = self.moved[:, group]
        fast = np.einsum('ki,kij,kj->k', moved, inverse, moved)[SLOW_WAVES:]
        fast_dof = fast.size * len(group)
        inverse = inverse[:SLOW_WAVES]
        moved = moved[:SLOW_WAVES]
        score = walk @ (np.einsum('kij,kj->ki', inverse, moved) ** 2).sum(axis=1)
        mean = walk @ np.einsum('kii->k', inverse)
        spread = walk**2 @ np.einsum('kij,kij->k', inverse, inverse)
        dof = mean**2 / spread
        if fast.sum() < fast_dof:
            mean = mean * fast.sum() / fast_dof
            p_value = f_sf(score / mean, dof, fast_dof)
        else:
            p_value = chi2_sf(score / mean * dof, dof)
        return float(p_value), max(score - mean, 0.0) / spread / 3 * float(dof_factor(dof))

    def scatter(self, group: np.ndarray) -> tuple[float, np.ndarray]:
        """Return (p-value of the scatter, factor on the variance of each parameter) of a group."""
        moved = self.moved[:, group]
        ratio = np.einsum('ki,kij,kj->k', moved, self._inverse(group), moved).sum() / moved.size
        single = (moved**2 / np.einsum('kii->ki', self.expected)[:, group]).mean(axis=0)
        p_value = float(chi2_sf(ratio * moved.size, moved.size))
        excess = np.maximum(0.5 * (single + ratio) - 1.0, 0.0)
        return p_value, 1.0 + COMMON_ERROR_FACTOR * excess

    def _inverse(self, group: np.ndarray) -> np.ndarray:
        """Return the inverse of the expected covariance of a group, shape (k, n, n)."""
        expected = self.expected[:, group][:, :, group]
        return np.array([inverse_normal(of_wave) for of_wave in expected])
