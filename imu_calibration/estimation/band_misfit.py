"""Slow and fast parts of moving windows: weighed apart where the fast part does not fit, beyond the band of the joints or of the model."""

from dataclasses import dataclass, replace

import numpy as np

APART = 2.0
"""The parts are weighed apart from this ratio of their misfits on, fast over slow; below it all samples count alike."""
SURE = 2.0
"""The misfit of the slow part is taken larger by this many of its standard deviations, when it is compared and used."""
STRONG = 1e-6
"""Directions of a scaled design with less than this share of the largest eigenvalue do not count."""
NO_SAY = 1e6
"""Factor on a variance that takes the weight away."""


@dataclass(frozen=True, eq=False)
class BandMisfit:
    """Variance per row of the centred rows of one kind of window: the same in all parts for white noise."""

    overall: np.ndarray
    """Of all rows, shape (3,)."""
    slow: np.ndarray
    """Of the means of short pieces, times the root of their length, shape (3,); zero when there are none."""
    fast: np.ndarray
    """Of the rest, shape (3,)."""
    apart: np.ndarray
    """Whether slow and fast part are to be weighed apart, shape (3,)."""

    def weights(self, white, inflation):
        """Return the factors on ``white * inflation`` for the variance of all rows and of the slow rows, both shape (3,)."""
        unit = white * inflation
        samples, pieces = np.where(self.apart, self.fast, self.overall), np.where(self.apart, 0.0, self.slow)
        every = np.maximum.reduce([samples / white, pieces / unit, np.ones(3)])
        return every, np.where(self.apart, np.minimum(np.maximum(self.slow / unit, 1.0), every), every)

    def without_fast(self):
        """Return the same with so large a variance of the fast part that it has no say."""
        return replace(self, fast=np.where(self.apart, NO_SAY * self.fast, self.fast))

    @property
    def noise(self):
        """Return the variance to take for that of white noise when there is no rest, shape (3,)."""
        return np.where(self.apart, self.slow, self.overall)


def band_misfit(total, dof_total, slow, dof_slow):
    """
    Return the `BandMisfit` of centred rows.

    A reference that is wrong at high frequency (ripple beyond what joint states show, a low-pass that the model lacks) leaves
    more in the fast part. Where the slow part fits less well, its misfit holds for all rows: it is correlated in time then.

    Parameters
    ----------
    total, slow : array, shape (3,)
        Sums of squares of all rows, and of the slow ones among them.
    dof_total, dof_slow : int
        Degrees of freedom of both.

    """
    overall = total / max(dof_total, 1)
    if dof_slow < 1:
        return BandMisfit(overall, np.zeros(3), overall, np.zeros(3, bool))
    of_slow = slow / dof_slow
    of_fast = np.maximum(total - slow, 0.0) / max(dof_total - dof_slow, 1)
    cautious = of_slow * (1 + SURE * np.sqrt(2 / dof_slow))
    apart = of_fast > APART * cautious
    return BandMisfit(overall, np.where(apart, cautious, of_slow), of_fast, apart)


def own_misfit(rows):
    """Return what the best fit of each axis to rows ``[columns | output]`` alone leaves of the outputs, shape (k, 3)."""
    columns, output = rows[:, :-3], rows[:, -3:]
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    return output - columns @ np.linalg.lstsq(columns, output, rcond=1e-10)[0] if len(rows) else output


def variance_along(every, slow):
    """
    Return the variance of the fast part of a misfit along the columns of a design, per dimension.

    For misfit e and design A of the fast rows: ``e' A (A'A)^+ A' e / rank``. It is the variance of e when e is noise, and more by
    as many times as there are samples when the fast part asks for other parameters than the slow part has given.

    Parameters
    ----------
    every, slow : (design, misfit)
        Of all rows and of the slow ones among them, shapes (k, p) and (k,).

    """
    gram = every[0].T @ every[0] - slow[0].T @ slow[0]
    gradient = every[0].T @ every[1] - slow[0].T @ slow[1]
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    strong = eigenvalues > STRONG * eigenvalues[-1]
    along = (vectors.T @ (gradient / scale))[strong]
    return float((along**2 / eigenvalues[strong]).sum() / max(strong.sum(), 1))


def weighed(noise, misfits):
    """Return the WindowNoise with the variances of kind -> BandMisfit."""
    weights = {kind: misfit.weights(noise.white_variance, noise.inflation) for kind, misfit in misfits.items()}
    return replace(noise, kind_scale={kind: every for kind, (every, _) in weights.items()},
                   slow_scale={kind: slow for kind, (_, slow) in weights.items()})


def extra_weight(fast_variance, slow_variance):
    """
    Return the weight w of slow rows beside all rows weighed as fast ones, ``w^2 = 1/s - 1/f``, shape (3,).

    The sum of squares is then ``fast / f + slow / s``, without a difference of factors.
    """
    return np.sqrt(np.maximum(1 / slow_variance - 1 / fast_variance, 0.0))
