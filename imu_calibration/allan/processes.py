"""Noise processes, their Allan variance, and the covariance between scales."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import factorial

SMALL = 1.0
"""
Below this argument the Gauss-Markov kernel is summed as a series: its leading terms cancel in
fourth differences.
"""
SERIES = 1.0 / factorial(np.arange(20, 2, -1))
"""Coefficients of ``exp(u) - 1 - u - u^2 / 2``, the highest first, without the factor u^3."""


@dataclass(frozen=True, eq=False)
class NoiseProcess:
    """A noise process with the coefficient 1."""

    name: str
    """Name in noise.yaml."""
    kernel: Callable[[np.ndarray], np.ndarray]
    """
    Generalised covariance of the integral at lags in s; even, known up to even polynomials of
    degree two.
    """
    lattice: bool = False
    """Whether the kernel lives on the sampling instants only (a spike at zero)."""
    time: float = 0.0
    """Correlation time, s."""


def allan_variance(process: NoiseProcess, tau: np.ndarray) -> np.ndarray:
    """
    Return the Allan variance of a process of unit coefficient.

    ``(3 G(0) - 4 G(tau) + G(2 tau)) / tau^2``.
    """
    tau = np.asarray(tau, float)
    return (
        3 * process.kernel(0.0 * tau) - 4 * process.kernel(tau) + process.kernel(2 * tau)
    ) / tau**2


def mean_covariance(process: NoiseProcess, lag: np.ndarray, seconds: float) -> np.ndarray:
    """
    Return the generalised covariance of means over `seconds` whose beginnings are `lag` s apart.

    With the integral theta of the process and its kernel G::

        m(t) = (theta(t + T) - theta(t)) / T                  mean over T seconds from t on
        cov(m(t), m(t + lag)) = (2 G(lag) - G(lag + T) - G(lag - T)) / T^2

    White noise, ``G = -|lag| / 2``: 1 / T at lag 0, and 0 from lag T on. Processes without a
    variance (random walk, flicker): for combinations whose weights sum to zero.
    """
    lag = np.asarray(lag, float)
    same_ends = process.kernel(lag)  # start with start, and end with end
    end_after_start = process.kernel(lag + seconds)
    start_after_end = process.kernel(lag - seconds)
    return (2 * same_ends - end_after_start - start_after_end) / seconds**2


def _quantisation(lag: np.ndarray) -> np.ndarray:
    """Return 1 at lag 0, else 0."""
    return (np.abs(lag) < 1e-12).astype(float)


def _white(lag: np.ndarray) -> np.ndarray:
    """Return -|lag| / 2."""
    return -0.5 * np.abs(lag)


def _flicker(lag: np.ndarray) -> np.ndarray:
    """Return lag^2 ln|lag| / (2 pi), 0 at lag 0."""
    lag = np.abs(lag)
    return lag**2 * np.log(np.maximum(lag, 1e-300)) / (2 * np.pi)


def _random_walk(lag: np.ndarray) -> np.ndarray:
    """Return |lag|^3 / 12."""
    return np.abs(lag) ** 3 / 12


QUANTISATION = NoiseProcess('quantisation', _quantisation, lattice=True)
WHITE = NoiseProcess('white_noise', _white)
FLICKER = NoiseProcess('bias_instability', _flicker)
RANDOM_WALK = NoiseProcess('random_walk', _random_walk)
"""Allan variances: 3 Q^2 / tau^2, N^2 / tau, (2 ln 2 / pi) B^2 at every tau, K^2 tau / 3."""


@lru_cache(maxsize=512)
def gauss_markov(time: float) -> NoiseProcess:
    """
    Return the first-order Gauss-Markov process of unit variance and correlation time `time`, s.
    """

    def kernel(lag):
        u = np.abs(lag) / time
        values = np.expm1(-u) + u - 0.5 * u**2
        small = u < SMALL
        values[small] = -(u[small] ** 3) * np.polyval(SERIES, -u[small])
        return -(time**2) * values

    return NoiseProcess('gauss_markov', kernel, time=time)


FLATNESS = (2 * np.log(2) / np.pi) ** 0.5
"""Deviation of flicker noise over B: 0.664."""


SECOND_DIFFERENCE = (1.0, -2.0, 1.0)
DENSE = np.arange(-36, 37) / 12
"""
Lags around where a difference begins or ends, in units of the shorter averaging time; good to
thousandths of a correlation.
"""
LAG_GROWTH = 1.5
"""Ratio of neighbouring lags beyond the dense ones."""
MAX_LAG_RATIO = 64.0
"""Largest lag, in units of the longer averaging time."""
DIFFERENCE_ROUNDING = 1e-14
"""Share of the terms of a fourth difference below which it is a rounding error."""
MOST_LENGTHS = 24
"""Largest number of different lengths of stretches."""


class ScaleCovariance:
    """
    Expectations and covariances of Allan variances.

    Parameters
    ----------
    factors : ndarray of int, shape (n_scales,)
        Samples per mean.
    lengths : sequence of int
        Samples of each stretch.
    period : float
        Time between samples, s.

    """

    def __init__(self, factors: np.ndarray, lengths: list[int], period: float):
        self.factors = np.asarray(factors, np.int64)
        self.period = period
        self.tau = self.factors * period
        self.longest = float(np.max(lengths)) * period

        # Pairs of scales, the shorter first: indices, shape (n_pairs,), and samples per mean,
        # shape (n_pairs, 1).
        self._first, self._second = np.triu_indices(len(self.factors))
        self._short = self.factors[self._first][:, None].astype(float)
        self._long = self.factors[self._second][:, None].astype(float)
        self._lengths = _sorted_lengths(lengths)

        # Lags of each pair, samples, shape (n_pairs, n_lags), their steps, and the mean weight of
        # the products of correlations in each step.
        self._lag = _lags(self._short, self._long, self._lengths[0][-1])
        self._step = np.diff(self._lag, axis=1)
        weight = self._pair_weight(self._lag)
        self._weight = 0.5 * (weight[:, 1:] + weight[:, :-1])

        # Results that are needed again.
        self._expectations: dict[NoiseProcess, np.ndarray] = {}
        self._correlations: dict[NoiseProcess, np.ndarray] = {}
        self._products: dict[tuple[NoiseProcess, NoiseProcess], np.ndarray] = {}

    @cached_property
    def _distances(self) -> '_Distances':
        """Distances between the ends of two differences at all lags."""
        return _Distances.of(np.stack([np.abs(shifted) for shifted in self._shifted(self._lag)]))

    def expectation(self, process: NoiseProcess) -> np.ndarray:
        """Return the Allan variances of unit coefficient, shape (n_scales,)."""
        if process not in self._expectations:
            self._expectations[process] = allan_variance(process, self.tau)
        return self._expectations[process]

    def product(self, one: NoiseProcess, other: NoiseProcess) -> np.ndarray:
        """
        Return the part of the covariance that is multiplied by the product of two coefficients.

        Shape (n_scales, n_scales).
        """
        if (one, other) in self._products:
            return self._products[one, other]

        # Spikes on the sampling instants are summed without interpolation.
        if one.lattice:
            product_of_pairs = self._sum_at_spikes(other)
        elif other.lattice:
            product_of_pairs = self._sum_at_spikes(one)
        else:
            product_of_pairs = self._sum_of_products(
                self._correlation(one), self._correlation(other)
            )

        # Symmetric in the scales, and in the processes.
        matrix = np.zeros((len(self.factors), len(self.factors)))
        matrix[self._first, self._second] = product_of_pairs
        matrix[self._second, self._first] = product_of_pairs
        self._products[one, other] = matrix
        self._products[other, one] = matrix
        return matrix

    def tensor(self, processes: tuple[NoiseProcess, ...]) -> np.ndarray:
        """
        Return `product` of each pair, shape (n_processes, n_processes, n_scales, n_scales).
        """
        scales = len(self.factors)
        count = len(processes)
        products = np.empty((count, count, scales, scales))
        for i, one in enumerate(processes):
            for j, other in enumerate(processes):
                products[i, j] = self.product(one, other)
        return products

    def _sum_of_products(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """
        Return the sums of products of two correlations over all integer lags, shape (n_pairs,).

        Both correlations are interpolated linearly between the available lags, which is exact for
        white noise. With their values a, b and c, d at two lags that are h samples apart::

            sum_k (a + (b - a) k / h) (c + (d - c) k / h),   k = 0 ... h, ends with weight 1/2
            = h (2 a c + a d + b c + 2 b d) / 6 + (b - a) (d - c) / (6 h)
        """
        a = first[:, :-1]
        b = first[:, 1:]
        c = second[:, :-1]
        d = second[:, 1:]
        inside = self._step * (2 * a * c + a * d + b * c + 2 * b * d) / 6
        corners = (b - a) * (d - c) / (6 * np.maximum(self._step, 1.0))
        return np.einsum('pg,pg->p', self._weight, inside + corners)

    def _sum_at_spikes(self, other: NoiseProcess) -> np.ndarray:
        """
        Return the sums of products with the correlation of quantisation, shape (n_pairs,).

        That is zero except at the nine lags ``i short - j long`` at which ends of both differences
        meet, with the products of their weights.
        """
        total = np.zeros(len(self._first))
        for i, at_short in enumerate(SECOND_DIFFERENCE):
            for j, at_long in enumerate(SECOND_DIFFERENCE):
                lag = i * self._short - j * self._long
                size = at_short * at_long / (self._short * self._long * self.period**2)
                total += (size * self._pair_weight(lag) * self._evaluate(other, lag))[:, 0]
        return total

    def _pair_weight(self, lag: np.ndarray) -> np.ndarray:
        """
        Return the weights of lags in the covariance of two Allan variances, (n_pairs, n_lags).

        It is the number of pairs of second differences at the distance `lag`, divided by twice the
        product of their numbers: the covariance is the sum of the squared correlations of the
        differences with this weight.
        """
        n_pairs = np.zeros_like(lag)
        n_short = np.zeros_like(self._short)
        n_long = np.zeros_like(self._long)
        for length, n_stretches in zip(*self._lengths):
            n_short_here = _n_terms(length, self._short)
            n_long_here = _n_terms(length, self._long)
            # Terms k of the short scale with a term k + lag of the long one.
            first = np.maximum(-lag, 0.0)
            last = np.minimum(n_short_here, n_long_here - lag)
            n_pairs += n_stretches * np.maximum(last - first, 0.0) * (n_short_here > 0)
            n_short = n_short + n_stretches * n_short_here
            n_long = n_long + n_stretches * n_long_here
        return n_pairs / (2.0 * n_short * n_long)

    def _correlation(self, process: NoiseProcess) -> np.ndarray:
        """
        Return the covariance of second differences at the lags for a unit coefficient.

        Shape (n_pairs, n_lags).
        """
        if process not in self._correlations:
            # Too many to keep for all correlation times.
            for known in [other for other in self._correlations if other.time]:
                del self._correlations[known]
            self._correlations[process] = self._evaluate(process, self._lag)
        return self._correlations[process]

    def _evaluate(self, process: NoiseProcess, lag: np.ndarray) -> np.ndarray:
        """
        Return the covariance of second differences at `lag`, shape (n_pairs, n_lags).

        With the kernel G and the averaging times a and b of the two differences::

            sum_ij c_i c_j G(lag - i a + j b) / (a b),   c = (1, -2, 1),   i, j = 0, 1, 2
        """
        # A correlation time is searched: its kernel is evaluated for many times at the same lags.
        if process.time and lag is self._lag:
            distances = self._distances
            kernel = process.kernel(distances.distinct * self.period)
            values = (kernel[place] for place in distances.place)
        else:
            values = (process.kernel(shifted * self.period) for shifted in self._shifted(lag))
        weights = np.outer(SECOND_DIFFERENCE, SECOND_DIFFERENCE).ravel()
        total = np.zeros(lag.shape)
        size = np.zeros(lag.shape)
        for weight, kernel_here in zip(weights, values):
            term = weight * kernel_here
            total += term
            size += np.abs(term)
        total[np.abs(total) < DIFFERENCE_ROUNDING * size] = 0.0
        return total / (self._short * self._long * self.period**2)

    def _shifted(self, lag: np.ndarray) -> Iterator[np.ndarray]:
        """Yield `lag` from each of three ends of one difference to each of the other."""
        for i in range(3):
            for j in range(3):
                yield lag + j * self._long - i * self._short


@dataclass(frozen=True, eq=False)
class _Distances:
    """
    Distances between the ends of two differences, in samples.

    The kernels are even functions, and most distances occur many times: each is evaluated once.
    """

    distinct: np.ndarray
    """Sorted, shape (n,)."""
    place: np.ndarray
    """Index in `distinct` of each pair of ends, shape (9, n_pairs, n_lags)."""

    @classmethod
    def of(cls, distances: np.ndarray) -> '_Distances':
        """Return the distinct ones of all distances, shape (9, n_pairs, n_lags)."""
        distinct = np.unique(distances)
        return cls(distinct, np.searchsorted(distinct, distances).astype(np.int32))


def _lags(short: np.ndarray, long: np.ndarray, length: float) -> np.ndarray:
    """
    Return the lags at which the correlation of each pair of scales is evaluated, samples.

    They are rising integers, shape (n_pairs, n_lags), dense where one difference begins or ends
    inside the other, and where the slope of the number of pairs of terms in the longest stretch
    (`length` samples) changes.
    """
    # Around one end, in samples: dense within 3 averaging times, then growing by a factor.
    largest_ratio = MAX_LAG_RATIO * float((long / short).max())
    n_far = int(np.log(largest_ratio) / np.log(LAG_GROWTH)) + 1
    far = 3.0 * LAG_GROWTH ** np.arange(1, n_far + 1)
    local = np.concatenate([-far[::-1], DENSE, far])[None, :] * short
    local = np.clip(local, -MAX_LAG_RATIO * long, MAX_LAG_RATIO * long)
    parts = []
    for k in range(3):
        parts.append(short - k * long + local)

    # The number of pairs is linear between these lags (`ScaleCovariance._pair_weight`); a quarter
    # and half of each are included too.
    n_short = _n_terms(length, short)
    n_long = _n_terms(length, long)
    for bend in (-n_short, n_long - n_short, n_long):
        for share in (0.25, 0.5, 1.0):
            parts.append(share * bend)
    return np.sort(np.rint(np.concatenate(parts, axis=1)), axis=1)


def _n_terms(length: float, factor: np.ndarray) -> np.ndarray:
    """Return the number of second differences (of 2 `factor` samples) in `length` samples."""
    return np.maximum(length - 2 * factor + 1, 0.0)


def _sorted_lengths(lengths: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (lengths, numbers of stretches) in rising order.

    More than `MOST_LENGTHS` stretches are joined in classes of about equal length.
    """
    rising = np.sort(np.asarray(lengths, float))
    if len(rising) <= MOST_LENGTHS:
        return rising, np.ones(len(rising))
    # The longest is a class by itself: only it has terms at the longest scales.
    classes = [*np.array_split(rising[:-1], MOST_LENGTHS - 1), rising[-1:]]
    means = []
    numbers = []
    for part in classes:
        means.append(part.mean())
        numbers.append(float(len(part)))
    return np.array(means), np.array(numbers)
