"""
Estimate from rows of any reference.

Gauss-Newton, scatter beyond the noise, fixed parameters, covariance.

A reference linearises its equations at a state and moves the state by a step. States are
dataclasses with `values`, the parameters; their other fields are nuisances (directions, drifts),
which are estimated and eliminated.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import scipy.linalg

from imu_calibration.estimation.gauss_newton import gauss_newton
from imu_calibration.estimation.held_parameters import undetermined_parameters
from imu_calibration.estimation.scaled_solve import (
    covariance_with_held,
    triangular_of_band,
)
from imu_calibration.estimation.solution import terms_of_fit
from imu_calibration.references.rows.group_variances import GroupVariances, estimate_group_variances

MAX_NEWTON_STEPS = 15
"""Largest number of Gauss-Newton steps; four to six are usual."""
FLAT_PRIOR_FACTOR = 1e4
"""
Factor on the prior sds for an estimate from the data: large enough to remove the priors, small
enough for rounding.
"""
LEAST_START_VARIANCE = 0.01
"""Least variance of a component in the second iteration, as a share of its fallback."""
FIRST_STEPS = 2
"""Steps with errors of linearisation."""
SMALL_STEP_LENGTH = 1e-3
"""An iteration ends with a step below this length, in joint standard deviations."""


@dataclass(frozen=True, eq=False)
class RowSet:
    """
    Linearised equations ``residual = nuisance @ dn + main @ dp + error``.

    The error has the variance `noise` plus that of `component`.
    """

    residual: np.ndarray
    """Measured minus predicted, shape (m,)."""
    nuisance: np.ndarray
    """Columns of the nuisances, shape (m, d)."""
    main: np.ndarray
    """Columns of the parameters, shape (m, n)."""
    noise: np.ndarray
    """Known variance of each row, shape (m,)."""
    component: np.ndarray
    """Variance component that adds to it, or -1, shape (m,)."""
    group: np.ndarray
    """
    Poses or blocks that the row belongs to, shape (m, 2): a turn belongs to the poses at both its
    ends.
    """

    def variance(self, scatter: GroupVariances, *, inflated: bool = False) -> np.ndarray:
        """Return the variance of each row (`GroupVariances.total`), shape (m,)."""
        return scatter.total(self.noise, self.component, inflated)

    def design(self, free: np.ndarray) -> np.ndarray:
        """Return the columns of nuisances and free parameters, shape (m, d + n_free)."""
        return np.hstack([self.nuisance, self.main[:, free]])


class RowReference(Protocol):
    """What an estimate needs of a reference."""

    nominal: np.ndarray
    """Values of the parameters before any data, shape (n,)."""
    priors: np.ndarray
    """Their standard deviations, shape (n,)."""
    fixed: np.ndarray
    """True where a convention fixes a parameter, shape (n,)."""

    def linearise(self, state: Any) -> RowSet:
        """Return the rows at a state."""

    def moved(self, state: Any, step: np.ndarray) -> Any:
        """Return the state after a step (nuisances, then parameters)."""


@dataclass(frozen=True, eq=False)
class RowEstimate:
    """Joint estimate."""

    state: Any
    """Parameters and nuisances."""
    terms: Mapping[str, np.ndarray]
    """Covariance of the parameters as named terms, each of shape (n, n)."""
    held: np.ndarray
    """True where a parameter is fixed at its prior, shape (n,)."""
    free: np.ndarray
    """True where a parameter was estimated, shape (n,)."""
    scatter: GroupVariances
    """Scatter of the components beyond the noise."""
    factor: np.ndarray
    """Triangular factor of the weighted rows after the nuisances are eliminated, shape (n, n)."""
    steps: int
    """Number of Gauss-Newton steps."""


def estimate_rows(
    reference: RowReference,
    state: Any,
    *,
    fallback: np.ndarray,
    withheld: np.ndarray | None = None,
) -> RowEstimate:
    """
    Estimate all parameters, the scatter of the components and the nuisances.

    The estimates are from the rows of a reference.

    Parameters
    ----------
    reference : RowReference
    state
        Where the first step begins.
    fallback : array, shape (n_components,)
        Variances of the components where the data are too few to estimate them.
    withheld : array of bool, shape (n,), optional
        Parameters to hold at their prior in any case.

    """
    asked = ~reference.fixed
    priors = reference.priors
    held = np.zeros(len(priors), bool)
    if withheld is not None:
        held = withheld & asked

    # With the priors: which parameters do the data determine?
    with_priors = _RowSquares(reference, asked & ~held, priors, fallback)
    first = _iterate(with_priors, state, fallback)
    factor = _factor(reference.linearise(first.state), first.scatter)
    flat_prior = np.diag(1 / (FLAT_PRIOR_FACTOR * priors))
    held = undetermined_parameters(np.vstack([factor, flat_prior]), priors, free=asked, held=held)
    free = asked & ~held

    # From the data alone, with the other parameters at their nominal values.
    state = replace(first.state, values=np.where(held, reference.nominal, first.state.values))
    variance = np.maximum(first.scatter.variance, LEAST_START_VARIANCE * fallback)
    of_data = _RowSquares(reference, free, FLAT_PRIOR_FACTOR * priors, fallback)
    last = _iterate(of_data, state, variance)

    # The covariance as a sum of named terms: C = C_noise + C_scatter + C_held.
    rows = reference.linearise(last.state)
    factor = _factor(rows, last.scatter)
    own, of_held = covariance_with_held(factor, free, held, prior_sd=priors)
    of_scatter = _covariance_of_scatter(rows, last.scatter, free)
    terms = terms_of_fit(own, of_scatter, of_held)
    n_steps = first.n_steps + last.n_steps
    return RowEstimate(last.state, terms, held, free, last.scatter, factor, n_steps)


@dataclass(frozen=True, eq=False)
class _Iterated:
    """State and scatter after some Gauss-Newton steps."""

    state: Any
    """Parameters and nuisances."""
    scatter: GroupVariances
    """Scatter of the components beyond the noise."""
    n_steps: int = 0
    """Number of steps."""


@dataclass(frozen=True, eq=False)
class _RowStep:
    """A step, and the scatter with which the rows were weighted."""

    change: np.ndarray
    """Of the nuisances, then of all parameters."""
    length: float
    """Length in joint standard deviations."""
    scatter: GroupVariances
    """Scatter of the components beyond the noise."""
    is_settled: bool
    """Whether the scatter is that of the step before."""


@dataclass(frozen=True, eq=False)
class _RowSquares:
    """Sum of squares of the rows of a reference and of the priors (`LeastSquares`)."""

    reference: RowReference
    free: np.ndarray
    """True for the parameters that are estimated, shape (n,)."""
    priors: np.ndarray
    """Standard deviations of the parameters before any data, shape (n,)."""
    fallback: np.ndarray
    """Variances of the components where the data are too few, shape (n_components,)."""

    def step(self, at: _Iterated) -> _RowStep:
        """Return the step from a state, with the scatter estimated at it."""
        free, fallback = self.free, self.fallback
        # Rows of the reference, of nuisances and free parameters, and rows of the priors.
        rows = self.reference.linearise(at.state)
        n_nuisances = rows.nuisance.shape[1]
        n_free = int(free.sum())
        columns = rows.design(free)
        design = np.vstack([columns, np.eye(n_nuisances + n_free)[n_nuisances:]])
        distance = (self.reference.nominal - at.state.values)[free]
        residual = np.concatenate([rows.residual, distance])
        noise = np.concatenate([rows.noise, self.priors[free] ** 2])
        group = np.concatenate([rows.component, np.full(n_free, -1)])

        # The residuals of the first steps contain errors of linearisation, which are no scatter.
        scatter = at.scatter
        before = scatter.variance
        if at.n_steps >= FIRST_STEPS:
            scatter = estimate_group_variances(
                design, residual, noise, group=group, start=before, fallback=fallback
            )

        # Weighted least squares: R x = q, from the triangular factor of [design | residual]; |q|
        # is the length of the step.
        sd = np.sqrt(scatter.total(noise, group))
        factor = triangular_of_band(np.column_stack([design, residual]) / sd[:, None])[:-1]
        right = factor[:, -1]
        change = np.zeros(n_nuisances + len(free))
        moving = np.append(np.ones(n_nuisances, bool), free)
        change[moving] = scipy.linalg.solve_triangular(factor[:, :-1], right)
        settled = np.allclose(scatter.variance, before, rtol=0.01, atol=1e-4 * np.min(fallback))
        return _RowStep(change, float(np.linalg.norm(right)), scatter, settled)

    def moved(self, at: _Iterated, step: _RowStep) -> _Iterated:
        """Return the state after a step."""
        state = self.reference.moved(at.state, step.change)
        return _Iterated(state, step.scatter, at.n_steps + 1)

    def is_last(self, at: _Iterated, step: _RowStep) -> bool:
        """Return whether parameters and scatter have converged."""
        is_small = step.is_settled and step.length < SMALL_STEP_LENGTH
        return at.n_steps > FIRST_STEPS + 1 and is_small


def _iterate(squares: _RowSquares, state: Any, variance: np.ndarray) -> _Iterated:
    """Return the state and the scatter of least cost; `variance`: scatter in the first steps."""
    start = np.array(variance, float)
    scatter = GroupVariances(start, np.full(len(start), np.inf), start.copy())
    return gauss_newton(squares, _Iterated(state, scatter), n_steps=MAX_NEWTON_STEPS)


def _factor(rows: RowSet, scatter: GroupVariances) -> np.ndarray:
    """
    Return the triangular factor of the parameters with the nuisances eliminated.

    The factor is at inflated variances.
    """
    sd = np.sqrt(rows.variance(scatter, inflated=True))
    n_nuisances = rows.nuisance.shape[1]
    factor = triangular_of_band(np.hstack([rows.nuisance, rows.main]) / sd[:, None])
    return factor[n_nuisances:, n_nuisances:]


def _covariance_of_scatter(rows: RowSet, scatter: GroupVariances, free: np.ndarray) -> np.ndarray:
    """
    Return the part of the covariance that is due to the scatter of the components beyond the noise.

    With the changes G of the parameters by errors of the rows, the variance V of the rows and
    their noise N::

        covariance = G (V - N) G'

    Returns
    -------
    ndarray, shape (n, n)
        Zero for parameters that are not free.

    """
    variance = rows.variance(scatter, inflated=True)
    gain = gain_of_rows(rows, scatter, free) * np.sqrt(variance - rows.noise)
    found = np.zeros((len(free),) * 2)
    found[np.ix_(free, free)] = gain @ gain.T
    return found


def gain_of_rows(rows: RowSet, scatter: GroupVariances, free: np.ndarray) -> np.ndarray:
    """
    Return the changes of the free parameters by errors of the rows, shape (n_free, m).

    ``(A' V^-1 A)^-1 A' V^-1`` without the rows of the nuisances, A being the columns of nuisances
    and free parameters, V the inflated variances.
    """
    root = np.sqrt(rows.variance(scatter, inflated=True))
    design = rows.design(free) / root[:, None]
    solved = scipy.linalg.cho_solve((triangular_of_band(design), False), design.T)
    return solved[rows.nuisance.shape[1] :] / root
