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
        self.model = model.at(self.values)
        self.tolerances = np.asarray(tolerances, float)
        # At a fixed point the derivative of a lag needs no columns for each arm: a third of the
        # columns of an arm with seven joints.
        self.folded = replace(self.model, folded_arms=all_arms(self.model, self.values))
        prior = make_prior(model)
        self.prior_sd = prior.sd
        self.wanted = model.requested & ~fixed_parameters(model)
        self.units = np.where(self.wanted, self.tolerances, prior.sd)
        self.basis = _basis(prior.gauge * self.units)
        own = self.basis / (model.prior()[1] / self.units)[:, None]
        self.prior_information = own.T @ own
        """Of z, shape (n, n)."""

    def excess(self, covariance: np.ndarray) -> np.ndarray:
        """
        Return the standard deviations of the requested parameters, in tolerances, shape (p,).

        Leading axes are kept.
        """
        variance = np.einsum('pn,...nm,pm->...p', self.asked, covariance, self.asked, optimize=True)
        return np.sqrt(np.maximum(variance, 1e-300))

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.basis.shape[1]

    @cached_property
    def asked(self) -> np.ndarray:
        """Rows that map z to the requested parameters, in tolerances, shape (k, n)."""
        return self.basis[self.wanted]

    @cached_property
    def slopes(self) -> dict[str, np.ndarray]:
        """Sensor -> derivative of the coefficients of the columns by z, shape (n_columns, 3, n)."""
        found = {}
        for sensor in SENSORS:
            found[sensor] = np.einsum(
                'cap,pq->caq',
                coefficient_jacobian(self.folded, sensor, self.values) * self.units,
                self.basis,
            )
        return found

    @property
    def names(self) -> list[str]:
        """Names of the requested parameters."""
        return np.array(self.model.param_names)[self.wanted].tolist()

    def sd(self, covariance: np.ndarray) -> np.ndarray:
        """Return standard deviations of all parameters, SI, from the covariance of z."""
        return self.units * np.sqrt(
            np.clip(np.einsum('pi,ij,pj->p', self.basis, covariance, self.basis), 0, None)
        )

    def information_from(self, names: Mapping[str, int], covariance: np.ndarray) -> np.ndarray:
        """
        Return the information about z that a calibration holds beyond the prior, shape (n, n).

        Parameters
        ----------
        names : mapping
            Parameter name -> row of the covariance.
        covariance : ndarray
            Of all its parameters, SI; parameters that this model lacks are averaged over.

        """
        shared = [
            (k, names[name]) for k, name in enumerate(self.model.param_names) if name in names
        ]
        if not shared:
            return np.zeros((self.size,) * 2)
        own, theirs = (np.array(part) for part in zip(*shared, strict=True))
        scaled = covariance[np.ix_(theirs, theirs)] / np.outer(self.units[own], self.units[own])
        basis = self.basis[own]
        values, vectors = scipy.linalg.eigh((scaled + scaled.T) / 2)
        # Directions that the gauge fixes have no variance and no component in the basis;
        # KNOWN_SHARE is as good as certain.
        rows = (vectors.T @ basis) / np.sqrt(
            np.maximum(values, max(1e-13 * values.max(), KNOWN_SHARE**2))
        )[:, None]
        known = rows.T @ rows - self.prior_information
        weights, directions = scipy.linalg.eigh((known + known.T) / 2)
        return (directions * np.maximum(weights, 0.0)) @ directions.T


def _basis(gauge):
    """
    Return orthonormal directions that a gauge leaves free.

    Unaffected parameters are separate coordinates.
    """
    concerned = np.any(gauge != 0, axis=0)
    inner = (
        scipy.linalg.null_space(gauge[:, concerned] / np.abs(gauge).max())
        if concerned.any()
        else np.zeros((0, 0))
    )
    free = np.flatnonzero(~concerned)
    basis = np.zeros((len(concerned), len(free) + inner.shape[1]))
    basis[free, np.arange(len(free))] = 1.0
    basis[np.ix_(concerned, len(free) + np.arange(inner.shape[1]))] = inner
    return basis


SEPARATION_PROBABILITY = 0.95
"""Probability with which causes are to be separated."""


class WithinTolerances:
    """
    Every requested parameter within its tolerance.

    ``sum_i w_i max(0, ln(sd_i / tolerance_i))``, all weights 1 unless given.
    """

    words = ''

    def __init__(self, coordinates: Coordinates, weights: np.ndarray | float = 1.0):
        self.coordinates, self.weights = coordinates, weights

    def left(self, covariance: np.ndarray, margin: float = 1.0) -> np.ndarray:
        """Return the weighted sum of the logarithms of the excess."""
        return (
            self.weights * np.maximum(np.log(margin * self.coordinates.excess(covariance)), 0.0)
        ).sum(axis=1)

    def missing(self, covariance: np.ndarray) -> tuple[str, ...]:
        """Return the parameters outside their tolerance."""
        excess = self.coordinates.excess(covariance)
        return tuple(
            name
            for name, ratio in zip(self.coordinates.names, excess, strict=True)
            if ratio > 1.0 + 1e-6
        )


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
    Each cause of a class with its assumed size.

    With another member of the class in the model instead.

    The noncentrality of cause a with cause b is ``lambda = theta_a' [M_aa - M_ar M_rr^-1 M_ra]
    theta_a`` with r the baseline and b (Atkinson and Fedorov 1975); other members of the class are
    omitted. A pair is separated when both noncentralities suffice.

    Parameters
    ----------
    coordinates : Coordinates
        Of the baseline with all causes.
    causes : sequence of CollinearEffect
    questions : int
        Candidate effects of the search.

    """

    def __init__(self, coordinates: Coordinates, causes: Sequence[CollinearEffect], questions: int):
        self.coordinates = coordinates
        self.causes = tuple(causes)
        self.pairs = list(permutations(self.causes, 2))
        self.words = ' and '.join(cause.key[1] for cause in causes)
        self.enough = {cause.key: enough(len(cause.places), questions) for cause in self.causes}
        self.reachable = np.ones(len(self.pairs), bool)
        """
        Pairs that some motion separates: no time is planned for the remaining pairs, which are
        reported.
        """

    def noncentrality(self, covariance: np.ndarray) -> np.ndarray:
        """Return lambda of each pair in units of the sufficient value, shape (k, n_pairs)."""
        found = np.empty((len(covariance), len(self.pairs)))
        prior = self.coordinates.prior_information
        for number, (a, b) in enumerate(self.pairs):
            others = [cause.places for cause in self.causes if cause is not a and cause is not b]
            out = np.concatenate(others) if others else np.zeros(0, int)
            own = covariance[:, a.places[:, None], a.places]
            if len(out):
                cross = covariance[:, a.places[:, None], out]
                own = own - cross @ np.linalg.solve(
                    covariance[:, out[:, None], out], cross.transpose(0, 2, 1)
                )
            information = np.linalg.inv(own) - prior[np.ix_(a.places, a.places)]
            found[:, number] = (
                np.einsum('i,kij,j->k', a.size, information, a.size) / self.enough[a.key]
            )
        return np.maximum(found, 1e-12)

    def left(self, covariance: np.ndarray, margin: float = 1.0) -> np.ndarray:
        """
        Return half the sum of the logarithms of the shortfall of separable pairs.

        The worst is weighted three times.
        """
        lacking = np.maximum(
            -0.5 * np.log(self.noncentrality(covariance)[:, self.reachable] / margin**2), 0.0
        )
        return lacking.sum(axis=1) + 2.0 * lacking.max(axis=1, initial=0.0)

    def leave_out_of_reach(self, covariance: np.ndarray) -> None:
        """
        Drop pairs, in either order, that this covariance, (n, n), does not separate.

        The covariance is a lower bound of all plans.
        """
        enough_left = self.noncentrality(covariance[None])[0] >= 1.0
        apart = set()
        for (a, b), reached in zip(self.pairs, enough_left, strict=True):
            if reached:
                apart.add((a.key, b.key))
        self.reachable = np.array(
            [(a.key, b.key) in apart and (b.key, a.key) in apart for a, b in self.pairs]
        )

    def missing(self, covariance: np.ndarray) -> tuple[str, ...]:
        """Return the pairs that would not be separated."""
        found = self.noncentrality(covariance[None])[0]
        return tuple(
            dict.fromkeys(
                ' and '.join(sorted((a.key[1], b.key[1])))
                for (a, b), value in zip(self.pairs, found, strict=True)
                if value < 1.0
            )
        )


Goal = WithinTolerances | ToldApart
"""Requirement on the covariance of z."""


def enough(size: int, questions: int) -> float:
    """
    Return the noncentrality that identifies and prefers an effect.

    The effect has this number of parameters and is identified and preferred with
    SEPARATION_PROBABILITY.

    Named: its chi-square beyond the search's threshold for so many questions. Preferred: of two
    models of which one is right the logarithm of the likelihood ratio is normal with mean ``lambda
    / 2`` and variance ``lambda``; it must exceed the search's TIE.
    """
    from scipy.stats import ncx2  # here, because its import is slow

    threshold = chi2_isf(FAMILY_WISE / questions, size)
    named = next(
        value
        for value in np.geomspace(1.0, 1e4, 2000)
        if ncx2.sf(threshold, size, value) >= SEPARATION_PROBABILITY
    )
    quantile = ndtri(SEPARATION_PROBABILITY)
    return float(max(named, (quantile + np.sqrt(quantile**2 + 2 * TIE)) ** 2))
