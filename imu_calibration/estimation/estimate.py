"""
Estimate from the rows of any reference, in four steps.

What differs is how a reference finds its values. On a table all rows are one triangular factor,
and the noise is estimated between the solutions. For few rows it is estimated in each step,
together with nuisances that belong to single rows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from imu_calibration.estimation.gauss_newton import StateT
from imu_calibration.estimation.scaled_solve import covariance_with_held
from imu_calibration.estimation.solution import BIAS_PROCESS, HELD_PRIORS, SAMPLE_NOISE


class WeightedRows(Protocol):
    """Rows at an estimate, weighted by their noise."""

    @property
    def design(self) -> np.ndarray:
        """
        Columns of the parameters, shape (m, n).

        The nuisances are eliminated; rows of the prior are included where the prior counts.
        """

    def scatter_term(self, covariance: np.ndarray) -> np.ndarray:
        """
        Return the part of the covariance of the free parameters by bias processes and offsets.

        The other part is by noise of the samples. Argument and result have the shape (n, n), and
        zeros for parameters that are not free.
        """


RowsT = TypeVar('RowsT', bound=WeightedRows, covariant=True)


class EstimateProblem(Protocol[StateT, RowsT]):
    """What an estimate needs of a reference; a state has parameters, noise and nuisances."""

    @property
    def prior_sd(self) -> np.ndarray:
        """Standard deviations of the parameters before any data, shape (n,)."""

    @property
    def adjustable(self) -> np.ndarray:
        """False where a convention fixes a parameter, shape (n,)."""

    def fitted(self, state: StateT) -> StateT:
        """Return the values of least cost with the priors, and the noise, estimated alternately."""

    def undetermined(self, state: StateT) -> np.ndarray:
        """Return a mask of the adjustable parameters that the data do not determine."""

    def holding(self, state: StateT, held: np.ndarray) -> StateT:
        """Return the values of least cost with the held parameters (mask) at their prior."""

    def weighted(self, state: StateT) -> RowsT:
        """Return the rows at a state."""

    def not_believed(self, state: StateT, free: np.ndarray, sd: np.ndarray) -> Mapping[int, float]:
        """
        Return number -> value of the free parameters (mask) that misfit alone can cause.

        `sd`: standard deviations of the parameters, shape (n,).
        """


@dataclass(frozen=True, eq=False)
class JointEstimate(Generic[StateT, RowsT]):
    """Joint estimate of parameters."""

    state: StateT
    """Parameters, noise and nuisances."""
    rows: RowsT
    """The rows at this state."""
    terms: dict[str, np.ndarray]
    """Covariance of the parameters as named terms, each of shape (n, n)."""
    held: np.ndarray
    """True where a parameter is fixed at its prior, shape (n,)."""
    free: np.ndarray
    """True where a parameter was estimated, shape (n,)."""
    not_believed: dict[int, float]
    """Number -> value of the parameters that were held because misfit alone can cause the value."""


def estimate(
    problem: EstimateProblem[StateT, RowsT], state: StateT
) -> JointEstimate[StateT, RowsT]:
    """
    Return the estimate of all parameters that the data determine.

    Parameters
    ----------
    problem : EstimateProblem
    state
        Where the first step begins.

    """
    # 1. Values and noise, alternately.
    state = problem.fitted(state)
    # 2. The parameters that the data do not determine.
    held = problem.undetermined(state)

    # 3. Values with the held parameters at their prior. Values that misfit alone can cause are held
    #    too, until none is left.
    not_believed: dict[int, float] = {}
    while True:
        free = problem.adjustable & ~held
        state = problem.holding(state, held)
        rows = problem.weighted(state)
        of_free, of_held = covariance_with_held(rows.design, free, held, prior_sd=problem.prior_sd)
        misfit = problem.not_believed(state, free, np.sqrt(np.diag(of_free + of_held)))
        if not misfit:
            break
        not_believed.update(misfit)
        held = held.copy()
        held[list(misfit)] = True

    # 4. The covariance as a sum of named terms.
    of_bias = rows.scatter_term(of_free)
    terms = {SAMPLE_NOISE: of_free - of_bias, BIAS_PROCESS: of_bias, HELD_PRIORS: of_held}
    return JointEstimate(
        state=state, rows=rows, terms=terms, held=held, free=free, not_believed=not_believed
    )
