"""
Estimate from rows of any reference.

Gauss-Newton, scatter beyond the noise, fixed parameters, covariance.

A reference linearises its equations at a state and moves the state by a step. States are
dataclasses with `values`, the parameters; their other fields are nuisances (directions, drifts),
which are estimated and eliminated.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.linalg

from imu_calibration.estimation.estimate import estimate
from imu_calibration.estimation.gauss_newton import gauss_newton
from imu_calibration.estimation.held_parameters import undetermined_parameters
from imu_calibration.estimation.rows import Rows, flat
from imu_calibration.estimation.scaled_solve import triangular_of_band
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


class RowReference(Protocol):
    """What an estimate needs of a reference."""

    nominal: np.ndarray
    """Values of the parameters before any data, shape (n,)."""
    priors: np.ndarray
    """Their standard deviations, shape (n,)."""
    fixed: np.ndarray
    """True where a convention fixes a parameter, shape (n,)."""

    def linearise(self, state: Any) -> Rows:
        """Return the rows of one axis at a state, with their components."""

    def moved(self, state: Any, step: np.ndarray) -> Any:
        """Return the state after a step (nuisances, then parameters)."""


@dataclass(frozen=True, eq=False)
class RowEstimate:
    """Joint estimate of parameters, nuisances and scatter from rows."""

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
    always_held: np.ndarray | None = None,
) -> RowEstimate:
    """
    Estimate parameters, nuisances and the scatter of the components from the rows of a reference.

    Parameters
    ----------
    reference : RowReference
    state
        Where the first step begins.
    fallback : array, shape (n_components,)
        Variances of the components where the data are too few to estimate them.
    always_held : array of bool, shape (n,), optional
        Parameters to hold at their prior even if the data determine them; default none.

    """
    if always_held is None:
        always_held = np.zeros(len(reference.fixed), bool)
    problem = _RowProblem(reference, fallback, always_held & ~reference.fixed)
    joint = estimate(problem, _Iterated(state, _known_scatter(fallback)))
    last = joint.state
    return RowEstimate(
        state=last.state,
        terms=joint.terms,
        held=joint.held,
        free=joint.free,
        scatter=last.scatter,
        factor=joint.rows.design,
        steps=last.n_steps,
    )


@dataclass(frozen=True, eq=False)
class _Iterated:
    """State and scatter after some Gauss-Newton steps."""

    state: Any
    """Parameters and nuisances."""
    scatter: GroupVariances
    """Scatter of the components beyond the noise."""
    n_steps: int = 0
    """Number of steps."""


def _known_scatter(variance: np.ndarray) -> GroupVariances:
    """Return variances of the components that are not estimated."""
    return GroupVariances(variance, np.full(len(variance), np.inf), variance.copy())


@dataclass(frozen=True, eq=False)
class _RowProblem:
    """Estimate from the rows of a reference (`EstimateProblem`)."""

    reference: RowReference
    """Linearises its equations at a state."""
    fallback: np.ndarray
    """Variances of the components where the data are too few, shape (n_components,)."""
    always_held: np.ndarray
    """True where a parameter is held even if the data determine it, shape (n,)."""

    @property
    def adjustable(self) -> np.ndarray:
        """False where a convention fixes a parameter, shape (n,)."""
        return ~self.reference.fixed

    @property
    def prior_sd(self) -> np.ndarray:
        """Standard deviations of the parameters before any data, shape (n,)."""
        return self.reference.priors

    def fitted(self, state: _Iterated) -> _Iterated:
        """Return the values of least cost with the priors, and the scatter of the components."""
        return self._solved(state, self.always_held, self.prior_sd)

    def _solved(self, state: _Iterated, held: np.ndarray, prior_sd: np.ndarray) -> _Iterated:
        """
        Return values and scatter after Gauss-Newton steps, the held parameters (mask) unchanged.

        `prior_sd`: standard deviations of the priors that count in this fit, shape (n,).
        """
        squares = _RowSquares(self.reference, self.adjustable & ~held, prior_sd, self.fallback)
        return gauss_newton(squares, state, n_steps=MAX_NEWTON_STEPS)

    def undetermined(self, state: _Iterated) -> np.ndarray:
        """Return a mask of the parameters that the data alone do not determine."""
        flat_prior = np.diag(1 / (FLAT_PRIOR_FACTOR * self.prior_sd))
        rows = np.vstack([self.weighted(state).design, flat_prior])
        return undetermined_parameters(
            rows, self.prior_sd, free=self.adjustable, held=self.always_held
        )

    def holding(self, state: _Iterated, held: np.ndarray) -> _Iterated:
        """Return the values from the data almost without priors, the held ones nominal."""
        values = np.where(held, self.reference.nominal, state.state.values)
        variance = np.maximum(state.scatter.variance, LEAST_START_VARIANCE * self.fallback)
        start = _Iterated(replace(state.state, values=values), _known_scatter(variance))
        last = self._solved(start, held, FLAT_PRIOR_FACTOR * self.prior_sd)
        return replace(last, n_steps=state.n_steps + last.n_steps)

    def weighted(self, state: _Iterated) -> '_ScatteredRows':
        """Return the rows at a state."""
        return _ScatteredRows(self.reference.linearise(state.state), state.scatter)

    def not_believed(
        self, state: _Iterated, free: np.ndarray, sd: np.ndarray
    ) -> Mapping[int, float]:
        """Return no parameter: the scatter of few rows contains their misfit."""
        return {}


@dataclass(frozen=True, eq=False)
class _RowStep:
    """A step, and the scatter with which the rows were weighted."""

    change: np.ndarray
    """Change of the nuisances, then of all parameters, shape (d + n,)."""
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
    """Linearises its equations at a state."""
    free: np.ndarray
    """True for the parameters that are estimated, shape (n,)."""
    priors: np.ndarray
    """Standard deviations of the parameters before any data, shape (n,)."""
    fallback: np.ndarray
    """Variances of the components where the data are too few, shape (n_components,)."""

    def step(self, at: _Iterated) -> _RowStep:
        """Return the Gauss-Newton step from a state, with the scatter estimated at that state."""
        free = self.free
        # Rows of the reference, of nuisances and free parameters, and rows of the priors.
        distance = self.reference.nominal - at.state.values
        rows = self.reference.linearise(at.state).of_parameters(free)
        rows = rows.with_prior(distance[free], np.diag(1 / self.priors[free]))

        # The residuals of the first steps contain errors of linearisation, which are no scatter.
        scatter = at.scatter
        before = scatter.variance
        if at.n_steps >= FIRST_STEPS:
            scatter = estimate_group_variances(rows, start=before, fallback=self.fallback)

        # Weighted least squares: R x = q, from the triangular factor of [design | residual]; |q|
        # is the length of the step.
        white = flat(rows.with_scatter(scatter.variance).white())
        factor = triangular_of_band(white)[:-1]
        right = factor[:, -1]
        change = np.zeros(rows.n_nuisances + len(free))
        moving = np.append(np.ones(rows.n_nuisances, bool), free)
        change[moving] = scipy.linalg.solve_triangular(factor[:, :-1], right)

        # A change of a variance by 1 % changes weights and steps little; so does a small variance.
        negligible = 1e-4 * np.min(self.fallback)
        settled = np.allclose(scatter.variance, before, rtol=0.01, atol=negligible)
        return _RowStep(change, float(np.linalg.norm(right)), scatter, settled)

    def moved(self, at: _Iterated, step: _RowStep) -> _Iterated:
        """Return the state after a step."""
        state = self.reference.moved(at.state, step.change)
        return _Iterated(state, step.scatter, at.n_steps + 1)

    def is_last(self, at: _Iterated, step: _RowStep) -> bool:
        """Return whether parameters and scatter have converged."""
        is_small = step.is_settled and step.length < SMALL_STEP_LENGTH
        return at.n_steps > FIRST_STEPS + 1 and is_small


@dataclass(frozen=True, eq=False)
class _ScatteredRows:
    """Rows with the scatter of their components (`WeightedRows`)."""

    rows: Rows
    """Rows of the reference, with the variance of the known noise."""
    scatter: GroupVariances
    """Scatter of the components beyond the noise."""

    @cached_property
    def design(self) -> np.ndarray:
        """
        Triangular factor of the parameters with the nuisances eliminated, shape (n, n).

        The rows are weighted with the upper variances of the components.
        """
        n_nuisances = self.rows.n_nuisances
        factor = triangular_of_band(flat(self.rows.with_scatter(self.scatter.upper).white()))
        return factor[n_nuisances:-1, n_nuisances:-1]

    def scatter_term(self, covariance: np.ndarray) -> np.ndarray:
        """
        Return the part ``G (V - N) G'`` of the covariance of the free parameters, shape (n, n).

        It is due to the scatter of the components, with the changes G of the parameters by errors
        of the rows, the variance V of the rows and their noise N.
        """
        free = np.diag(covariance) > 0
        added = self.rows.with_scatter(self.scatter.upper).variance - self.rows.variance
        gain = gain_of_rows(self.rows, self.scatter, free) * np.sqrt(added.ravel())
        term = np.zeros_like(covariance)
        term[np.ix_(free, free)] = gain @ gain.T
        return term


def gain_of_rows(rows: Rows, scatter: GroupVariances, free: np.ndarray) -> np.ndarray:
    """
    Return the changes of the free parameters by errors of the rows, shape (n_free, m).

    ``(A' V^-1 A)^-1 A' V^-1`` without the rows of the nuisances, A being the columns of nuisances
    and free parameters, V the inflated variances.
    """
    weighted = rows.of_parameters(free).with_scatter(scatter.upper)
    design = flat(weighted.white())[:, :-1]
    solved = scipy.linalg.cho_solve((triangular_of_band(design), False), design.T)
    return solved[rows.n_nuisances :] / np.sqrt(weighted.variance.ravel())
