"""Residual variance of the slow and fast parts of moving windows; separate weights where the fast part fits worse."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.estimation.noise_model import MovingFactors, NoiseModel

MIN_VARIANCE_RATIO = 2.0
"""The parts have separate weights above this ratio of their residual variances, fast over slow; below it all samples count alike."""
CAUTIOUS_SDS = 2.0
"""The residual variance of the slow part is raised by this many of its standard deviations, in comparison and use."""
DESIGN_EIGENVALUE_SHARE = 1e-6
"""Directions of a scaled design with less than this share of the largest eigenvalue do not count."""
RESIDUAL_EIGENVALUE_SHARE = 1e-9
"""The same for the least residual."""
WEIGHTLESS = 1e6
"""Factor on a variance that makes the weight negligible."""


@dataclass(frozen=True, eq=False)
class BandMisfit:
    """Residual variance per row of the centred rows of one kind of window; equal in all parts for white noise."""

    overall: np.ndarray
    """Of all rows, shape (3,)."""
    slow: np.ndarray
    """Of the means of short pieces, times the root of their length, shape (3,); zero when there are none."""
    fast: np.ndarray
    """Of the other rows, shape (3,)."""
    apart: np.ndarray
    """Whether slow and fast part have separate weights, shape (3,)."""

    def factors(self, noise: NoiseModel) -> MovingFactors:
        """Return the excess variance of moving windows with this residual over the noise at rest."""
        white, unit = noise.white_variance, noise.low_variance
        samples, pieces = np.where(self.apart, self.fast, self.overall), np.where(self.apart, 0.0, self.slow)
        every = np.maximum.reduce([samples / white, pieces / unit, np.ones(3)])
        return MovingFactors(every, np.where(self.apart, np.minimum(np.maximum(self.slow / unit, 1.0), every), every))

    def without_fast(self) -> 'BandMisfit':
        """Return the same with a variance of the fast part so large that its weight is zero."""
        return replace(self, fast=np.where(self.apart, WEIGHTLESS * self.fast, self.fast))

    @property
    def noise(self) -> np.ndarray:
        """Return the variance that replaces the one of white noise in the absence of rest, shape (3,)."""
        return np.where(self.apart, self.slow, self.overall)


def band_misfit(total: np.ndarray, dof_total: float, slow: np.ndarray, *, dof_slow: float) -> BandMisfit:
    """
    Return the `BandMisfit` of centred rows.

    A reference with errors at high frequency (ripple beyond the band of the joint states, an unmodelled low-pass) raises the residual of
    the fast part. Where the slow part fits worse, its residual variance applies to all rows, because the residual is correlated in time.

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
    cautious = of_slow * (1 + CAUTIOUS_SDS * np.sqrt(2 / dof_slow))
    apart = of_fast > MIN_VARIANCE_RATIO * cautious
    return BandMisfit(overall, np.where(apart, cautious, of_slow), of_fast, apart)


def own_misfit(rows: np.ndarray) -> np.ndarray:
    """Return the residuals of the least-squares fit of each axis to rows ``[columns | output]``, shape (k, 3)."""
    columns, output = rows[:, :-3], rows[:, -3:]
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    return output - columns @ np.linalg.lstsq(columns, output, rcond=1e-10)[0] if len(rows) else output


def misfit_along(products: np.ndarray) -> tuple[float, int]:
    """
    Return the sum of squares of residuals projected on the columns of designs, and the number of dimensions.

    For residual e and design A: ``e' A (A'A)^+ A' e`` and the rank of A, summed over designs. Their ratio is the variance of e when e is
    white noise. It grows with the number of samples when the best-fit parameters differ from the given ones.

    Parameters
    ----------
    products : array, shape (k, q + 1, q + 1)
        Products of ``[design | residual]``.

    """
    gram, gradient = products[:, :-1, :-1], products[:, :-1, -1]
    scale = _scales(np.einsum('kii->ki', gram))
    eigenvalues, vectors = np.linalg.eigh(gram * scale[:, :, None] * scale[:, None, :])
    along = np.einsum('kij,ki->kj', vectors, gradient * scale)
    strong = eigenvalues > DESIGN_EIGENVALUE_SHARE * eigenvalues[:, -1:]
    return float((along**2 * strong / np.where(strong, eigenvalues, 1.0)).sum()), int(strong.sum())


def least_misfit(products: np.ndarray) -> tuple[float, int]:
    """Return the residual sum of squares of the best fit from products of ``[design | output]``, shape (q + 1, q + 1), and the rank."""
    scale = np.append(_scales(np.diag(products)[:-1]), 1 / np.sqrt(max(products[-1, -1], 1e-300)))
    scaled = products * np.outer(scale, scale)
    eigenvalues, vectors = np.linalg.eigh(scaled[:-1, :-1])
    seen = eigenvalues > RESIDUAL_EIGENVALUE_SHARE * max(eigenvalues[-1], 1e-300)
    along = (vectors.T @ scaled[:-1, -1])[seen]
    return max(scaled[-1, -1] - (along**2 / eigenvalues[seen]).sum(), 0.0) / scale[-1]**2, int(seen.sum())


def _scales(squares):
    """Return the scales that give columns unit length; 0 for a column that is zero or negative through rounding."""
    return np.where(squares > 0, 1 / np.sqrt(np.where(squares > 0, squares, 1.0)), 0.0)
