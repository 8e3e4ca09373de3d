"""
Parameters in units of their tolerances, and goals of a plan as a number.

Every tolerance met, or causes separated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import numpy as np
import scipy.linalg
from scipy.special import ndtri

from imu_calibration.core.distributions import chi2_isf
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import all_arms, coefficient_jacobian
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import fixed_parameters, make_prior
from imu_calibration.selection.search import FAMILY_WISE, TIE

KNOWN_SHARE = 1e-4
"""A parameter counts as known if its sd is below this share of its tolerance."""


class Coordinates:
    """
    A model at a point: ``values = point + units * (basis @ z)`` with z free of the gauge.

    The gauge are directions of the parameters that no data determine.

    Parameters
    ----------
    model : SensorModel
    tolerances : ndarray, shape (n_params,)
        Largest standard deviation that will do, SI.
    values : ndarray, optional
        Values at which the model is linearised; the prior mean for unknown parameters.

    """

    def __init__(
        self, model: SensorModel, tolerances: np.ndarray, values: np.ndarray | None = None
    ):
        start = model.start() if values is None else np.asarray(values, float)
        self.values = np.where(np.isfinite(start), start, 0.0)
        """The point, SI, shape (n_params,)."""
        self.model = model.at(self.values)
        self.tolerances = np.asarray(tolerances, float)
        # At a fixed point the derivative of a lag needs no columns for each arm: a third of the
        # columns of an arm with seven joints.
        self.folded = replace(self.model, folded_arms=all_arms(self.model, self.values))
        prior = make_prior(model)
        self.prior_sd = prior.sd
        """SI, shape (n_params,)."""
        self.wanted = model.requested & ~fixed_parameters(model)
        """Whether each parameter must meet its tolerance, shape (n_params,)."""
        self.units = np.where(self.wanted, self.tolerances, prior.sd)
        """Units of the parameters, SI, shape (n_params,)."""
        self.basis = _basis(prior.gauge * self.units)
        """Orthonormal columns, shape (n_params, n)."""
        # The basis obeys the gauge already: the sds here are those without it.
        _, sd_without_gauge = model.prior()
        whitened_basis = self.basis / (sd_without_gauge / self.units)[:, None]
        self.prior_information = whitened_basis.T @ whitened_basis
        """Of z, ``basis' diag(units / sd)^2 basis``, shape (n, n)."""

    def excess(self, covariance: np.ndarray) -> np.ndarray:
        """
        Return the standard deviations of the p requested parameters in tolerances, (..., p).

        `covariance`: of z, shape (..., n, n).
        """
        rows = self.requested_rows
        variance = np.einsum('pn,...nm,pm->...p', rows, covariance, rows, optimize=True)
        return np.sqrt(np.maximum(variance, 1e-300))

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.basis.shape[1]

    @cached_property
    def requested_rows(self) -> np.ndarray:
        """Rows that map z to the requested parameters, in tolerances, shape (k, n)."""
        return self.basis[self.wanted]

    @cached_property
    def slopes(self) -> dict[str, np.ndarray]:
        """Sensor -> derivative of the coefficients of the columns by z, shape (n_columns, 3, n)."""
        slopes = {}
        for sensor in SENSORS:
            by_parameters = coefficient_jacobian(self.folded, sensor, self.values) * self.units
            slopes[sensor] = np.einsum('cap,pq->caq', by_parameters, self.basis)
        return slopes

    @property
    def names(self) -> list[str]:
        """Names of the requested parameters."""
        return np.array(self.model.param_names)[self.wanted].tolist()

    def sd(self, covariance: np.ndarray) -> np.ndarray:
        """Return standard deviations of all parameters, SI, from the covariance of z."""
        variance = np.einsum('pi,ij,pj->p', self.basis, covariance, self.basis)
        return self.units * np.sqrt(np.clip(variance, 0, None))

    def information_from(self, names: Mapping[str, int], covariance: np.ndarray) -> np.ndarray:
        """
        Return the information about z that a calibration adds to the prior, shape (n, n).

        It is ``basis' C^-1 basis - prior_information``, with C the covariance in units; negative
        eigenvalues of the difference are set to zero.

        Parameters
        ----------
        names : mapping
            Parameter name -> row of the covariance.
        covariance : ndarray
            Of all its parameters, SI; parameters that this model lacks are averaged over.

        """
        # Shared parameters: their indices in this model, and in the covariance.
        shared = np.array(
            [k for k, name in enumerate(self.model.param_names) if name in names], int
        )
        if not len(shared):
            return np.zeros((self.size, self.size))
        source = np.array([names[self.model.param_names[k]] for k in shared])
        units = self.units[shared]
        scaled = covariance[np.ix_(source, source)] / np.outer(units, units)
        # basis' C^-1 basis by the eigenvectors of C. A direction below KNOWN_SHARE counts as known;
        # those that the gauge fixes have variance 0, and no component in the basis.
        variances, directions = scipy.linalg.eigh((scaled + scaled.T) / 2)
        least_variance = max(1e-13 * variances.max(), KNOWN_SHARE**2)
        sd = np.sqrt(np.maximum(variances, least_variance))
        rows = (directions.T @ self.basis[shared]) / sd[:, None]

        # Without the prior, and without negative eigenvalues.
        added = rows.T @ rows - self.prior_information
        eigenvalues, eigenvectors = scipy.linalg.eigh((added + added.T) / 2)
        return (eigenvectors * np.maximum(eigenvalues, 0.0)) @ eigenvectors.T


def _basis(gauge: np.ndarray) -> np.ndarray:
    """
    Return orthonormal directions b of the parameters with ``gauge @ b = 0``, (n_params, n).

    `gauge`: shape (n_rows, n_params). A parameter without an element in it is a coordinate by
    itself; these coordinates are the first ones.
    """
    in_gauge = np.any(gauge != 0, axis=0)
    null_space = np.zeros((0, 0))
    if in_gauge.any():
        null_space = scipy.linalg.null_space(gauge[:, in_gauge] / np.abs(gauge).max())
    free = np.flatnonzero(~in_gauge)
    # First a column for each free parameter, then the directions of the parameters in the gauge.
    basis = np.zeros((len(in_gauge), len(free) + null_space.shape[1]))
    basis[free, np.arange(len(free))] = 1.0
    basis[np.ix_(in_gauge, len(free) + np.arange(null_space.shape[1]))] = null_space
    return basis


SEPARATION_PROBABILITY = 0.95
"""Probability with which causes are to be separated."""


class WithinTolerances:
    """
    Every requested parameter within its tolerance.

    ``sum_i w_i max(0, ln(sd_i / tolerance_i))``, all weights 1 unless given.
    """

    words = ''
    """Causes that are to be separated, as text: none."""

    def __init__(self, coordinates: Coordinates, weights: np.ndarray | float = 1.0):
        self.coordinates = coordinates
        self.weights = weights

    def distance(self, covariance: np.ndarray, margin: float = 1.0) -> np.ndarray:
        """
        Return the distance to the goal for covariances of z, (k, n, n); 0 where it is reached.

        It is the weighted sum of the logarithms of the excess; `margin` is a factor on the sd.
        """
        log_excess = np.log(margin * self.coordinates.excess(covariance))
        return (self.weights * np.maximum(log_excess, 0.0)).sum(axis=1)

    def missing(self, covariance: np.ndarray) -> tuple[str, ...]:
        """Return the parameters outside their tolerance, for one covariance of z, (n, n)."""
        excess = self.coordinates.excess(covariance)
        names = zip(self.coordinates.names, excess, strict=True)
        return tuple(name for name, ratio in names if ratio > 1.0 + 1e-6)


@dataclass(frozen=True, eq=False)
class CollinearEffect:
    """One effect of a class that is collinear in a recording."""

    key: tuple[str, str]
    """(sensor, effect name)."""
    places: np.ndarray
    """Its coordinates."""
    size: np.ndarray
    """Its assumed size, in those coordinates."""


class ToldApart:
    """
    Each cause of a collinear class is separated from each other one.

    If a is the true cause, with its assumed size theta_a, and the model has b in its place, the
    test of a has the noncentrality ``lambda = theta_a' [M_aa - M_ar M_rr^-1 M_ra] theta_a`` with M
    the information and r the baseline and b (Atkinson and Fedorov 1975); other members of the class
    are omitted. A pair is separated when both noncentralities suffice.

    Parameters
    ----------
    coordinates : Coordinates
        Of the baseline with all causes.
    causes : sequence of CollinearEffect
    n_candidates : int
        Number of effects among which the search finds a cause.

    """

    def __init__(
        self, coordinates: Coordinates, causes: Sequence[CollinearEffect], n_candidates: int
    ):
        self.coordinates = coordinates
        self.causes = tuple(causes)
        self.pairs = list(permutations(self.causes, 2))
        """(true cause, cause in the model), each pair in both orders."""
        self.words = ' and '.join(cause.key[1] for cause in causes)
        """Causes that are to be separated, as text."""
        self.sufficient = {
            cause.key: sufficient_noncentrality(len(cause.places), n_candidates)
            for cause in self.causes
        }
        """Key of the true cause -> noncentrality that suffices."""
        self.reachable = np.ones(len(self.pairs), bool)
        """
        Pairs that some motion separates: no time is planned for the remaining pairs, which are
        reported.
        """

    def noncentrality(self, covariance: np.ndarray) -> np.ndarray:
        """
        Return lambda of each pair in units of the sufficient value, shape (k, n_pairs).

        `covariance`: of z with all causes, shape (k, n, n). To omit the causes o from the model is
        to know that they are zero: ``[M_aa - M_ar M_rr^-1 M_ra]`` is the inverse of the covariance
        of a, given those of o::

            C_aa - C_ao C_oo^-1 C_oa
        """
        ratios = np.empty((len(covariance), len(self.pairs)))
        prior = self.coordinates.prior_information
        for number, (a, b) in enumerate(self.pairs):
            others = [cause.places for cause in self.causes if cause not in (a, b)]
            # Blocks of each covariance: shapes (k, n_a, n_a), (k, n_a, n_o) and (k, n_o, n_o).
            conditional = covariance[:, a.places[:, None], a.places]
            if others:
                o = np.concatenate(others)
                cross = covariance[:, a.places[:, None], o]
                conditional = conditional - cross @ np.linalg.solve(
                    covariance[:, o[:, None], o], cross.transpose(0, 2, 1)
                )
            # Only the information of the motions, without that of the prior.
            information = np.linalg.inv(conditional) - prior[np.ix_(a.places, a.places)]
            noncentrality = np.einsum('i,kij,j->k', a.size, information, a.size)
            ratios[:, number] = noncentrality / self.sufficient[a.key]
        return np.maximum(ratios, 1e-12)

    def distance(self, covariance: np.ndarray, margin: float = 1.0) -> np.ndarray:
        """
        Return the distance to the goal for covariances of z, (k, n, n); 0 where it is reached.

        It is half the sum of the logarithms of (sufficient / present noncentrality) of the
        reachable pairs, with the worst weighted three times; `margin` is a factor on the sd.
        """
        ratios = self.noncentrality(covariance)[:, self.reachable]
        shortfall = np.maximum(-0.5 * np.log(ratios / margin**2), 0.0)
        return shortfall.sum(axis=1) + 2.0 * shortfall.max(axis=1, initial=0.0)

    def leave_out_of_reach(self, covariance: np.ndarray) -> None:
        """
        Drop pairs, in either order, that this covariance, (n, n), does not separate.

        The covariance is a lower bound of all plans.
        """
        separable = set()
        ratios = self.noncentrality(covariance[None])[0]
        for (a, b), ratio in zip(self.pairs, ratios, strict=True):
            if ratio >= 1.0:
                separable.add((a.key, b.key))
        self.reachable = np.array(
            [(a.key, b.key) in separable and (b.key, a.key) in separable for a, b in self.pairs]
        )

    def missing(self, covariance: np.ndarray) -> tuple[str, ...]:
        """Return the pairs that would not be separated, for one covariance of z, (n, n)."""
        missing = []
        ratios = self.noncentrality(covariance[None])[0]
        for (a, b), ratio in zip(self.pairs, ratios, strict=True):
            pair = ' and '.join(sorted((a.key[1], b.key[1])))
            if ratio < 1.0 and pair not in missing:
                missing.append(pair)
        return tuple(missing)


Goal = WithinTolerances | ToldApart
"""Requirement on the covariance of z."""


def sufficient_noncentrality(n_params: int, n_candidates: int) -> float:
    """
    Return the noncentrality with which an effect is found and preferred to another one.

    Both have the probability SEPARATION_PROBABILITY. Found: its chi-square with `n_params`
    parameters exceeds the threshold of a search among `n_candidates` effects. Preferred: of two
    models of which one is right the logarithm of the likelihood ratio is normal with mean ``lambda
    / 2`` and variance ``lambda``; it must exceed the search's TIE.
    """
    from scipy.stats import ncx2  # here, because its import is slow

    threshold = chi2_isf(FAMILY_WISE / n_candidates, n_params)
    # The smallest value of a grid, in steps of half a per cent, that suffices.
    to_be_found = next(
        value
        for value in np.geomspace(1.0, 1e4, 2000)
        if ncx2.sf(threshold, n_params, value) >= SEPARATION_PROBABILITY
    )
    # lambda / 2 - quantile sqrt(lambda) = TIE
    quantile = ndtri(SEPARATION_PROBABILITY)
    to_be_preferred = (quantile + np.sqrt(quantile**2 + 2 * TIE)) ** 2
    return float(max(to_be_found, to_be_preferred))
