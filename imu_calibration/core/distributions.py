"""
Probabilities of an equal or larger value by chance.

Upper tails of the distributions of significance tests.

The same numbers as ``scipy.stats``, by special functions only; the import of scipy.stats is slower
than that of all remaining modules together, and every command and node would wait for it.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import bdtrc, chdtrc, chdtri, fdtrc, ndtr


def chi2_sf(x: ArrayLike, dof: ArrayLike) -> np.ndarray:
    """
    Return the probability that chi-square of `dof` degrees of freedom lies above `x`.

    One below zero, nan without degrees of freedom.
    """
    return np.where(np.asarray(dof) > 0, chdtrc(dof, np.maximum(x, 0.0)), np.nan)[()]


def chi2_isf(chance: ArrayLike, dof: ArrayLike) -> np.ndarray:
    """
    Return the value that chi-square exceeds with probability `chance`.

    Chi-square has `dof` degrees of freedom, and the probability is between zero and one.
    """
    return chdtri(dof, chance)


def f_sf(x: ArrayLike, dof: ArrayLike, dof_below: ArrayLike) -> np.ndarray:
    """
    Return the probability that F lies above `x`.

    With the degrees of freedom above and below the line; one below zero.
    """
    return fdtrc(dof, dof_below, np.maximum(x, 0.0))


def binom_sf(x: ArrayLike, trials: ArrayLike, chance: float) -> np.ndarray:
    """
    Return the probability of more than `x` successes in `trials` (int) of probability `chance`.

    One below zero.
    """
    return bdtrc(x, trials, chance)


def norm_sf(x: ArrayLike) -> np.ndarray:
    """Return the probability that a standard Gaussian number lies above `x`."""
    return ndtr(-np.asarray(x))


def chance_of_fall(fall: float, added: int, *, rest: float, spare: float) -> float:
    """
    Return the p-value of the fall of a sum of squares by added parameters (F test).

    ``F = (fall / added) / (rest / spare)`` has `added` and `spare` degrees of freedom.

    Parameters
    ----------
    fall : float
        Fall of the sum of squares; a negative value counts as zero.
    added : int
        Parameters that were added.
    rest : float
        Residual sum of squares.
    spare : float
        Its degrees of freedom.

    """
    return float(f_sf(fall / added / max(rest / spare, 1e-12), added, spare))
