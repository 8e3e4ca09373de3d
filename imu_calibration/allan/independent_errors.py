"""Upper bound of the noise that errors in a small share of the readings add."""

from functools import lru_cache

import numpy as np
from scipy.special import ndtr

from imu_calibration.allan.torn_reads import NO_EXCESS, Excess

LARGEST_SHARE = 0.1
"""Share of the readings with an error, at most: more of them are noise."""
HISTOGRAM_EDGES = np.linspace(0.0, 6.5, 131)
"""Edges of the histogram, in standard deviations of the readings; outliers are excluded before."""
NOISE_SDS = np.r_[np.arange(0.5, 0.9, 0.01), np.arange(0.9, 1.02, 0.0025)]
"""Standard deviations of the noise that are tried, in those of the readings."""
SIZES = np.arange(0.5, 6.25, 0.5)
"""Sizes of errors of either sign, in standard deviations of the noise."""
WIDE = np.array([1.5, 2.0, 3.0, 4.0, 6.0])
"""Standard deviations of readings with a normal error, in those of the noise."""
NEWTON_STEPS = 12
"""Iterations of the share, whose likelihood is concave."""
BOUND = 2.7
"""Twice the loss of log likelihood at the bound, which 5 % of the errors exceed."""
LEAST_PROBABILITY = 1e-12
"""Of a bin, so that one impossible reading does not decide."""


def excess_of_errors(deviation: np.ndarray, readings_per_mean: int) -> Excess:
    """
    Return by how much errors of at most a tenth of the readings may raise their noise.

    Model of a reading: noise, and with probability p <= 0.1 an error that is independent of it::

        density = (1 - p) N(0, sd^2) + p h(sd),  h: one size and either sign, uniform or normal

    Small errors change the fourth cumulant only, so that sd, p and the size are not separately
    known. The smallest sd whose likelihood, maximised over p and h, is near the best one
    is therefore a bound. With ``p k^2`` for errors of k sd::

        ratio^2 = 1 + p k^2

    Parameters
    ----------
    deviation : ndarray, shape (n,)
        Readings less the mean of their block.
    readings_per_mean : int
        Readings m of a block. Errors move its mean too, and with it the readings without an error:
        their variance is ``sd^2 (m - 2 + ratio^2) / m``, that of all ``sd^2 ratio^2 (m - 1) / m``.

    Returns
    -------
    Excess
        The bound of the ratio, and the significance of errors at all.

    """
    all_sd = float(np.sqrt(np.mean(deviation**2)))
    if not all_sd:
        return NO_EXCESS
    counts = np.histogram(np.abs(deviation) / all_sd, HISTOGRAM_EDGES)[0].astype(float)
    with_errors, without = _log_likelihoods(counts)
    best = float(with_errors.max())

    # The smallest sd that is nearly as likely as the best one, in sds of the readings.
    smallest_noise = float(NOISE_SDS[np.argmax(2.0 * (best - with_errors) <= BOUND)])
    observed = 1.0 / smallest_noise**2
    # observed = ratio^2 (m - 1) / (m - 2 + ratio^2), of deviations from the mean of a block.
    square = (readings_per_mean - 2) * observed / (readings_per_mean - 1 - observed)
    significance = np.sqrt(max(2.0 * (best - float(without.max())), 0.0))
    return Excess(float(np.sqrt(max(square, 1.0))), float(significance))


def _log_likelihoods(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the log likelihood of each `NOISE_SDS`, (with the likeliest errors, without errors).

    `counts` are the numbers of readings in the bins of the histogram. For each sd and each kind of
    error, Newton's method finds the share p of errors that maximises the sum of ``log((1 - p) f + p
    h)``, with the probabilities f of a bin without an error and h with one.
    """
    occupied = counts > 0
    counts = counts[occupied]
    no_error, changes = (probabilities[..., occupied] for probabilities in _densities())
    share = np.full(changes.shape[:2], 0.5 * LARGEST_SHARE)  # shape (n_noise, n_kinds)
    for _ in range(NEWTON_STEPS):
        # First derivative (h - f) / density of the logarithm; the second is minus its square.
        slope = changes / (no_error[:, None] + share[..., None] * changes)
        share = np.clip(share + slope @ counts / (slope**2 @ counts), 0.0, LARGEST_SHARE)
    density = no_error[:, None] + share[..., None] * changes
    return (np.log(density) @ counts).max(axis=1), np.log(no_error) @ counts


@lru_cache
def _densities() -> tuple[np.ndarray, np.ndarray]:
    """
    Return (probabilities of the bins without an error, their change by each kind of error).

    The shapes are (n_noise, n_bins) and (n_noise, n_kinds, n_bins).
    """
    # Readings of N(size, width^2), in sds of the noise, with kinds in the order: no error, one size
    # (either sign, of which absolute values are the same), normal error.
    edges = HISTOGRAM_EDGES / NOISE_SDS[:, None, None]
    sizes = np.r_[0.0, SIZES, np.zeros_like(WIDE)][:, None]
    widths = np.r_[1.0, np.ones_like(SIZES), WIDE][:, None]
    # Probability of an absolute value below each edge, shape (n_noise, n_kinds + 1, n_edges).
    below = ndtr((edges - sizes) / widths) - ndtr((-edges - sizes) / widths)
    probability = np.maximum(np.diff(below, axis=-1), LEAST_PROBABILITY)
    # A further kind: errors of all sizes up to each of `SIZES`.
    of_each_size = probability[:, 1 : 1 + len(SIZES)]
    uniform = np.cumsum(of_each_size, axis=1) / np.arange(1, len(SIZES) + 1)[:, None]
    no_error = probability[:, :1]
    return no_error[:, 0], np.concatenate([probability[:, 1:], uniform], axis=1) - no_error
