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

from imu_calibration.estimation.noise_search import GroupVariances, estimate_group_variances
from imu_calibration.estimation.scaled_solve import (
    covariance_with_held,
    inverse_gram,
    triangular_of_band,
)
from imu_calibration.estimation.solution import BIAS_PROCESS, HELD_PRIORS, SAMPLE_NOISE

MAX_NEWTON_STEPS = 15
"""Largest number of Gauss-Newton steps; four to six are usual."""
FLAT_PRIOR_FACTOR = 1e4
"""
Factor on the prior sds for an estimate from the data: large enough to remove the priors, small
enough for rounding.
"""


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
    asked, priors = ~reference.fixed, reference.priors
    held = np.zeros(len(priors), bool) if withheld is None else withheld & asked
    state, scatter, steps = _iterate(
        reference, state, asked & ~held, priors, variance=fallback, fallback=fallback
    )
    held = _choose_held(_factor(reference.linearise(state), scatter), priors, asked, held=held)
    free = asked & ~held
    state = replace(state, values=np.where(held, reference.nominal, state.values))
    start = np.maximum(scatter.variance, 0.01 * fallback)
    state, scatter, more = _iterate(
        reference, state, free, FLAT_PRIOR_FACTOR * priors, variance=start, fallback=fallback
    )
    rows = reference.linearise(state)
    factor = _factor(rows, scatter)
    own, of_held = covariance_with_held(factor, free, held, prior_sd=priors)
    scattered = _of_scatter(rows, scatter, free)
    terms = {SAMPLE_NOISE: own - scattered, BIAS_PROCESS: scattered, HELD_PRIORS: of_held}
    return RowEstimate(state, terms, held, free, scatter, factor, steps + more)


def _choose_held(factor, priors, asked, *, held):
    """
    Return which of the parameters `asked` (mask) have next to no information from the data.

    Shape (n,).

    One at a time, given the parameters fixed so far, the one with the largest sd in units of its
    prior, while that exceeds one half. `held` (mask): fixed before.
    """
    held = held.copy()
    while np.any(free := asked & ~held):
        ratio = np.zeros(len(priors))
        # the sds in units of the priors, nearly unlimited without information from the data
        ratio[free] = np.sqrt(
            np.diag(
                inverse_gram(
                    np.vstack(
                        [factor[:, free] * priors[free], np.eye(free.sum()) / FLAT_PRIOR_FACTOR]
                    )
                )
            )
        )
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 0.5:
            break
        held[worst] = True
    return held


def _iterate(reference, state, free, priors, *, variance, fallback):
    """Repeat steps and scatter estimates until both converge."""
    scatter = GroupVariances(
        np.array(variance, float), np.full(len(fallback), np.inf), np.array(variance, float)
    )
    for number in range(1, MAX_NEWTON_STEPS + 1):
        rows = reference.linearise(state)
        n_nuisances, n_free = rows.nuisance.shape[1], int(free.sum())
        design = np.vstack(
            [
                np.hstack([rows.nuisance, rows.main[:, free]]),
                np.eye(n_nuisances + n_free)[n_nuisances:],
            ]
        )
        residual = np.concatenate([rows.residual, (reference.nominal - state.values)[free]])
        noise = np.concatenate([rows.noise, priors[free] ** 2])
        group = np.concatenate([rows.component, np.full(n_free, -1)])
        before = scatter.variance
        if (
            number > 2
        ):  # after the first steps there are errors of linearisation that are not scatter
            scatter = estimate_group_variances(
                design, residual, noise, group=group, start=scatter.variance, fallback=fallback
            )
        root = np.sqrt(scatter.total(noise, group))
        factor = triangular_of_band(np.column_stack([design, residual]) / root[:, None])[:-1]
        reduced = scipy.linalg.solve_triangular(factor[:, :-1], factor[:, -1])
        step = np.zeros(n_nuisances + len(free))
        step[np.append(np.ones(n_nuisances, bool), free)] = reduced
        state = reference.moved(state, step)
        settled = np.allclose(scatter.variance, before, rtol=0.01, atol=1e-4 * np.min(fallback))
        if (
            number > 3 and settled and np.linalg.norm(factor[:, -1]) < 1e-3
        ):  # in units of the joint sd
            break
    return state, scatter, number


def _factor(rows, scatter):
    """
    Return the triangular factor of the parameters with the nuisances eliminated.

    The factor is at inflated variances.
    """
    root, width = (
        np.sqrt(scatter.total(rows.noise, rows.component, inflated=True)),
        rows.nuisance.shape[1],
    )
    return triangular_of_band(np.hstack([rows.nuisance, rows.main]) / root[:, None])[width:, width:]


def _of_scatter(rows, scatter, free):
    """
    Return the part of the covariance that is due to the scatter of the components beyond the noise.

    Shape (n, n).
    """
    variance = scatter.total(rows.noise, rows.component, inflated=True)
    design = np.hstack([rows.nuisance, rows.main[:, free]]) / np.sqrt(variance)[:, None]
    factor = triangular_of_band(design)
    gain = scipy.linalg.cho_solve((factor, False), design.T)[rows.nuisance.shape[1] :] * np.sqrt(
        1 - rows.noise / variance
    )
    found = np.zeros((len(free),) * 2)
    found[np.ix_(free, free)] = gain @ gain.T
    return found
