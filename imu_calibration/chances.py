"""
Probabilities that chance alone is as large: upper tails of the distributions that tests of significance ask.

The same numbers as from ``scipy.stats``, of which the special functions are all that is needed here; its import takes longer than that of
everything else together, and every command and every node would wait for it.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, fdtrc, ndtr, ndtri


def chi2_sf(x: ArrayLike, dof: ArrayLike) -> np.ndarray:
    """Return the probability that chi-square of `dof` degrees of freedom lies above `x`; one below zero, nan without degrees of freedom."""
    return np.where(np.asarray(dof) > 0, chdtrc(dof, np.maximum(x, 0.0)), np.nan)[()]


def chi2_isf(chance: ArrayLike, dof: ArrayLike) -> np.ndarray:
    """Return what chi-square of `dof` degrees of freedom exceeds by a `chance` between zero and one."""
    return chdtri(dof, chance)


def f_sf(x: ArrayLike, dof: ArrayLike, dof_below: ArrayLike) -> np.ndarray:
    """Return the probability that F lies above `x`, with the degrees of freedom above and below the line; one below zero."""
    return fdtrc(dof, dof_below, np.maximum(x, 0.0))


def norm_sf(x: ArrayLike) -> np.ndarray:
    """Return the probability that a standard Gaussian number lies above `x`."""
    return ndtr(-np.asarray(x))


def norm_ppf(chance: ArrayLike) -> np.ndarray:
    """Return what a standard Gaussian number stays below by a `chance`."""
    return ndtri(chance)
