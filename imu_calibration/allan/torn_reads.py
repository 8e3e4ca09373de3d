"""Torn register reads within the noise: high byte of the reading before, low byte of the next."""

from dataclasses import dataclass

import numpy as np

HIGH_BYTE = 256
"""Steps of the converter by which a torn register read differs."""
LARGEST_PARTIAL_STEP = 0.05
"""Largest median distance of readings from whole steps: beyond, the pages are not known."""
LEAST_SENSITIVITY = 0.1
"""Share of pairs that a torn read moves to one page, less that of a filter, at least."""
LEAST_SDS = 1.0
"""sds of the share of torn reads from which on it raises the noise."""
MOST_ORDER = 4
"""Terms of the series of the probability of equal pages, in the correlation of neighbours."""
HALVINGS = 40
"""Bisections of the share."""
LEAST_VARIANCE = 0.1
"""Least variance of the noise over that of the readings."""


@dataclass(frozen=True)
class Excess:
    """By how much readings that are not noise of the sensor may raise the noise of means."""

    ratio: float
    """Noise of means over that of the sensor, at least 1."""
    sds: float
    """Excess over its sd without such readings."""


NO_EXCESS = Excess(1.0, 0.0)


@dataclass(frozen=True, eq=False)
class _Pages:
    """Pages of 256 steps that the readings of an axis visit."""

    probabilities: np.ndarray
    """Share of the readings in each page, shape (n_pages,)."""
    same: float
    """Share of neighbours in one page."""
    correlation: float
    """Correlation of neighbours."""
    page_correlation: float
    """Covariance of the first steps of the pages with the readings, over their variance."""
    coefficients: np.ndarray
    """
    ``A_j = sum_page E[He_j(z) 1_page]^2 / j!``, z: standardised readings, shape (MOST_ORDER,).
    """

    @property
    def chance(self) -> float:
        """Probability that two independent readings are in one page."""
        return float(np.sum(self.probabilities**2))

    def same_without_tearing(self, correlation: float) -> float:
        """
        Return the share of neighbours in one page, for normal noise with this correlation.

        ``P = chance + sum_j A_j correlation^j`` (Mehler's expansion of the bivariate density).
        """
        orders = np.arange(1, MOST_ORDER + 1)
        return self.chance + float(np.sum(self.coefficients * correlation**orders))

    @property
    def sensitivity(self) -> float:
        """Change of the share of neighbours in one page by torn reads, at equal correlation."""
        orders = np.arange(1, MOST_ORDER + 1)
        slope = float(np.sum(self.coefficients * orders * self.correlation ** (orders - 1)))
        different = 1.0 - self.same_without_tearing(self.correlation)
        return different - slope * self.page_correlation


def excess_of_torn_reads(readings: np.ndarray, step: float) -> Excess:
    """
    Return by how much torn reads raise the noise of means.

    For errors that are smaller than about 3 sd of the noise, and are not in its tails. A torn read
    ``256 page[k-1] + low[k]`` is in the page of the reading before. A share p of them increases
    the share of neighbours in one page, and a filter of the sensor does, with its correlation c::

        same = p + (1 - p) same_without_tearing(c)
        correlation = p page_correlation + c

    The errors ``e = 256 (page[k-1] - page[k])`` have a sum that is independent of the noise::

        excess^2 = 1 + p E[e^2] / sd^2 = 1 + 2 p var(256 page) / sd^2

    Parameters
    ----------
    readings : ndarray, shape (n,)
        Readings of one axis in their order, raw.
    step : float
        Step of the converter.

    """
    counts = _counts(readings, step)
    if counts is None:
        return NO_EXCESS
    page, low = np.divmod(counts, HIGH_BYTE)
    if page.min() == page.max() or counts.std() == 0.0:
        return NO_EXCESS
    pages = _pages(page, counts)

    # Does tearing differ from a filter, and how well is its share known?
    if pages.sensitivity < LEAST_SENSITIVITY:
        return NO_EXCESS
    # Variance of the share of n pairs in one page, times n, with the shares p of the pages and
    # their sum of squares c. These and the correlation are estimated from the same readings, which
    # subtracts their parts: c - c^2 - 2 (sum p^3 - c^2) - A_1^2.
    chance = pages.chance
    cubes = np.sum(pages.probabilities**3)
    same_variance = max(chance + chance**2 - 2.0 * cubes - pages.coefficients[0] ** 2, 0.0)
    share_sd = np.sqrt(same_variance / len(counts)) / pages.sensitivity
    share = _torn_share(pages)
    if share <= LEAST_SDS * share_sd:
        return NO_EXCESS

    # Variance of the noise: that of a torn read is the sum of both bytes' variances.
    page_variance = float(np.var(HIGH_BYTE * page))
    variance = float(np.var(counts))
    untorn = (variance - share * (page_variance + float(np.var(low)))) / (1.0 - share)
    untorn = max(untorn, LEAST_VARIANCE * variance)
    ratio = float(np.sqrt(1.0 + 2.0 * share * page_variance / untorn))
    return Excess(ratio, float(share / share_sd))


def _counts(readings: np.ndarray, step: float) -> np.ndarray | None:
    """Return the readings in whole steps from zero, or None where they are not on such a grid."""
    # The step from all differences: that of single precision is known to 1e-4 only.
    difference = readings - readings[0]
    n_steps = np.round(difference / step)
    if not n_steps.any():
        return None
    step = float(n_steps @ difference / (n_steps @ n_steps))
    counts = np.round(readings / step)
    partial = np.median(np.abs(readings / step - counts))
    if partial > LARGEST_PARTIAL_STEP:
        return None
    return counts.astype(np.int64)


def _pages(page: np.ndarray, counts: np.ndarray) -> _Pages:
    """Return the pages of readings in steps, `counts`, each of which is in the page `page`."""
    _, index = np.unique(page, return_inverse=True)
    n = len(counts)
    deviation = counts - counts.mean()
    variance = np.mean(deviation**2)
    z = deviation / np.sqrt(variance)
    first_step = HIGH_BYTE * (page - page.mean())
    # Hermite polynomials He_j: He_0 = 1, He_1 = z, He_{j+1} = z He_j - j He_{j-1}.
    coefficients = np.zeros(MOST_ORDER)
    before = np.ones(n)
    polynomial = z
    factorial = 1.0
    for order in range(1, MOST_ORDER + 1):
        factorial *= order
        moments = np.bincount(index, polynomial) / n
        coefficients[order - 1] = np.sum(moments**2) / factorial
        before, polynomial = polynomial, z * polynomial - order * before
    return _Pages(
        probabilities=np.bincount(index) / n,
        same=float(np.mean(page[1:] == page[:-1])),
        correlation=float(np.mean(z[1:] * z[:-1])),
        page_correlation=float(np.mean(first_step * deviation) / variance),
        coefficients=coefficients,
    )


def _torn_share(pages: _Pages) -> float:
    """Return the share of torn reads, by bisection, at least 0."""

    def missing(share: float) -> float:
        """Return the share of neighbours in one page that `share` does not explain."""
        correlation = pages.correlation - share * pages.page_correlation
        return pages.same - share - (1.0 - share) * pages.same_without_tearing(correlation)

    low = 0.0
    high = 0.5
    if missing(low) <= 0.0:
        return 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if missing(middle) > 0.0:
            low = middle
        else:
            high = middle
    return low
