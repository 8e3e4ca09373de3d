"""
Trends in the readings at rest, and the level of the noise in different rests.

The trends are due to temperature, settling after turn-on and steady drift. They are subtracted
before the Allan variances are computed.
"""

from dataclasses import dataclass, field

import numpy as np

from imu_calibration.allan.processes import (
    FLICKER,
    RANDOM_WALK,
    WHITE,
    NoiseProcess,
    mean_covariance,
)

MAX_TREND_BLOCKS = 200
"""Approximate number of blocks of a recording."""
MIN_TREND_SDS = {'temperature': 3.3, 'turn_on': 4.0, 'ramp': 4.0}
"""
Least standard deviations of a trend: chance exceeds them in 1 of 1000 recordings, with all shapes
of turn-on.
"""
MIN_WARMTH_RANGE = 0.1
"""Range of the temperature, K, above which a trend with it is tested."""
MIN_SPARE_BLOCKS = 12
"""Least number of blocks in excess of the number of parts for a test of trends."""
SETTLING_SHARES = (1 / 40, 1 / 20, 1 / 10, 1 / 5)
"""Time constants of turn-on that are tried, as shares of the recording."""
WALK_VARIANCE_RATIOS = np.concatenate([[0.0], np.geomspace(1e-4, 1e5, 37)])
"""
Variance of the random walk in the middle of the recording over that of the white noise of a block.
"""
TEMPERATURE_TREND, TURN_ON_TREND, RAMP_TREND = 'temperature', 'turn_on', 'ramp'


@dataclass(frozen=True, eq=False)
class Blocks:
    """Means over n equal stretches at rest."""

    time: np.ndarray
    """Middle, s since the beginning of the recording, shape (n,)."""
    mean: np.ndarray
    """Readings, shape (n, 6)."""
    part: np.ndarray
    """Number of the part of each block, shape (n,)."""
    seconds: float
    """Length of a block."""
    temperature_c: np.ndarray | None = None
    """Mean temperature, shape (n,); None without."""


@dataclass(frozen=True)
class AxisTrend:
    """One trend of one axis."""

    name: str
    """'temperature', 'turn_on' or 'ramp'."""
    value: float
    """Coefficient per kelvin, size at the beginning, or slope per second."""
    sd: float
    """Standard deviation of the value."""
    time: float = 0.0
    """Time constant of turn-on, s."""

    def at(
        self, time: np.ndarray, temperature_c: np.ndarray | None, reference: 'TrendReference'
    ) -> np.ndarray:
        """Return the trend at instants (s since the beginning), shape (n,)."""
        return self.value * _shape(self.name, self.time, time, temperature_c, reference)


@dataclass(frozen=True)
class TrendReference:
    """Times and temperature at which trends are zero or begin."""

    begin: float = 0.0
    """Beginning of the recording, s."""
    middle: float = 0.0
    """Middle of the blocks, s."""
    temperature_c: float = 0.0
    """Mean temperature."""


def _shape(
    name: str,
    time_constant: float,
    time: np.ndarray,
    temperature_c: np.ndarray | None,
    reference: TrendReference,
) -> np.ndarray:
    """
    Return the regressor of a trend at times, shape (n,).

    Temperature: T - T_ref; turn-on: exp(-(t - begin) / time constant); ramp: t - middle.
    """
    if name == TEMPERATURE_TREND:
        assert temperature_c is not None, 'a trend with the temperature was found with one'
        return temperature_c - reference.temperature_c
    if name == TURN_ON_TREND:
        return np.exp(-(time - reference.begin) / time_constant)
    return time - reference.middle


def _log_determinants(triangles: np.ndarray) -> np.ndarray:
    """
    Return the logarithms of the determinants of ``T.T @ T``, for triangular T of shape (k, n, n).
    """
    return 2 * np.log(np.abs(np.diagonal(triangles, axis1=1, axis2=2))).sum(axis=1)


class TrendSearch:
    """
    Finds trends in the means of n blocks by generalised least squares.

    The model of an axis is a constant for each part, trends, white noise and a random walk. The
    ratio of both variances is the likeliest one of `WALK_VARIANCE_RATIOS` (restricted maximum
    likelihood). A trend is a pair (name, time constant in s).

    Parameters
    ----------
    blocks : Blocks

    """

    def __init__(self, blocks: Blocks):
        self.blocks = blocks
        # 1 in the blocks of each part, shape (n, n_parts).
        self._constants = (blocks.part[:, None] == np.unique(blocks.part)[None, :]).astype(float)
        temperature_c = blocks.temperature_c
        begin = float(blocks.time[0] - blocks.seconds / 2)
        self.reference = TrendReference(
            begin,
            float(blocks.time.mean()),
            0.0 if temperature_c is None else float(temperature_c.mean()),
        )
        # Time between blocks, s, shape (n, n).
        self._lag = blocks.time[:, None] - blocks.time[None, :]

        # Covariance of the blocks by a random walk, and its mean variance about the mean block, to
        # which the variance ratios are relative.
        walk = mean_covariance(RANDOM_WALK, self._lag, blocks.seconds)
        centred = walk - walk.mean(axis=0) - walk.mean(axis=1)[:, None] + walk.mean()
        scale = float(np.trace(centred)) / len(walk)

        # For each variance ratio the covariance of unit white noise and the change of a random walk
        # since the first block: its whitening, the inverse Cholesky factor, shape (n_ratios, n, n),
        # and the logarithm of its determinant, shape (n_ratios,).
        change = walk - walk[:1] - walk[:, :1] + walk[0, 0]
        factors = np.linalg.cholesky(
            np.eye(len(walk)) + WALK_VARIANCE_RATIOS[:, None, None] / scale * change
        )
        self._whitenings = np.linalg.inv(factors)
        self._log_determinant_of_ratio = _log_determinants(factors)

    @property
    def usable(self) -> bool:
        """Whether there are enough blocks."""
        return len(self.blocks.time) - self._constants.shape[1] >= MIN_SPARE_BLOCKS

    def find(self, axis: int) -> tuple[AxisTrend, ...]:
        """
        Return the significant trends of an axis (0 to 5), the temperature first.

        An axis that never changes has none.
        """
        if not self.usable or not np.any(np.ptp(self.blocks.mean[:, axis])):
            return ()
        chosen: list[tuple[str, float]] = []
        temperature_c = self.blocks.temperature_c
        if temperature_c is not None and np.ptp(temperature_c) > MIN_WARMTH_RANGE:
            by_temperature = self._most_significant(axis, chosen, [TEMPERATURE_TREND])
            if by_temperature is not None:
                chosen.append(by_temperature)
        # Forward selection of trends with time, beside that with the temperature.
        while True:
            trend = self._most_significant(axis, chosen, [TURN_ON_TREND, RAMP_TREND])
            if trend is None:
                break
            chosen.append(trend)
        if not chosen:
            return ()
        fit = self.regress(axis, chosen)
        trends = []
        for (name, time_constant), value, sd in zip(chosen, fit.values, fit.sds):
            trends.append(AxisTrend(name, float(value), float(sd), time_constant))
        return tuple(trends)

    def _most_significant(
        self, axis: int, chosen: list[tuple[str, float]], names: list[str]
    ) -> tuple[str, float] | None:
        """
        Return the most significant trend of some names in addition to the chosen trends, or None.
        """
        # Settling after turn-on is tried with several time constants.
        span = np.ptp(self.blocks.time) + self.blocks.seconds
        settling_times = [share * span for share in SETTLING_SHARES]
        chosen_names = {name for name, _ in chosen}
        trials = []
        for name in names:
            if name in chosen_names:
                continue
            for time_constant in settling_times if name == TURN_ON_TREND else [0.0]:
                trials.append((name, time_constant))
        if not trials:
            return None

        scores = []
        for trial in trials:
            fit = self.regress(axis, [*chosen, trial])
            scores.append(abs(fit.values[-1]) / fit.sds[-1])
        best = int(np.argmax(scores))
        name, _ = trials[best]
        return None if scores[best] < MIN_TREND_SDS[name] else trials[best]

    def columns(self, trends: list[tuple[str, float]]) -> np.ndarray:
        """Return the regressors of trends, shape (n, n_trends)."""
        blocks = self.blocks
        regressors = np.zeros((len(blocks.time), len(trends)))
        for k, (name, time_constant) in enumerate(trends):
            regressors[:, k] = _shape(
                name, time_constant, blocks.time, blocks.temperature_c, self.reference
            )
        return regressors

    def regress(self, axis: int, trends: list[tuple[str, float]]) -> '_TrendFit':
        """
        Return the fit of trends with the likeliest variance ratio.

        By generalised least squares for each ratio. With the covariance C, the design X of p
        columns and the weighted sum r of squared residuals, the likeliest ratio has the least::

            ln det C + ln det X' C^-1 X + (n - p) ln r

        """
        design = np.column_stack([self._constants, self.columns(trends)])
        target = self.blocks.mean[:, axis]
        # For all variance ratios r: QR of the whitened design, of shape (r, n, p), with columns of
        # similar size, and the weighted sum of squared residuals.
        norms = np.linalg.norm(design, axis=0)
        basis, triangle = np.linalg.qr(self._whitenings @ (design / norms))
        white = self._whitenings @ target
        projected = np.einsum('rnk,rn->rk', basis, white)
        total = np.sum(white**2, axis=1)
        freedom = len(target) - design.shape[1]
        # The residual of an axis with constant readings is a rounding error.
        squares = np.maximum(
            total - np.sum(projected**2, axis=1), np.finfo(float).eps * total + np.finfo(float).tiny
        )
        log_determinants = self._log_determinant_of_ratio + _log_determinants(triangle)
        best = int(np.argmin(log_determinants + freedom * np.log(squares)))

        # Values R^-1 Q' y, and their covariance R^-1 R^-T with the variance of the residuals.
        root = np.linalg.inv(triangle[best])
        values = root @ projected[best] / norms
        sd = np.sqrt(squares[best] / freedom * np.einsum('ij,ij->i', root, root)) / norms
        return _TrendFit(values[-len(trends) :], sd[-len(trends) :], self._whitenings[best])

    def kept(self, axis: int, trends: tuple[AxisTrend, ...]) -> 'KeptShare':
        """
        Return the share of the Allan variance that remains after subtraction of these trends.

        The fitted trends are a linear function of the readings y, and contain a part of the noise:
        with the design A and the whitening W of the fit, ``(1 - A (W A)^+ W) y`` remains.
        """
        if not trends:
            return KeptShare()
        pairs = [(trend.name, trend.time) for trend in trends]
        whitening = self.regress(axis, pairs).whitening
        design = np.column_stack([self._constants, self.columns(pairs)])
        remaining = np.eye(len(design)) - design @ np.linalg.pinv(whitening @ design) @ whitening
        # Blocks per mean, two per octave; 0.01 includes the last one in spite of rounding.
        counts = np.unique(
            np.rint(2.0 ** np.arange(0, np.log2(max(len(design) / 2, 1)) + 0.01, 0.5)).astype(int)
        )
        shares = {}
        for process in (WHITE, FLICKER, RANDOM_WALK):
            shares[process.name] = self._shares(process, counts, remaining)
        return KeptShare(counts * self.blocks.seconds, shares)

    def _shares(
        self, process: NoiseProcess, counts: np.ndarray, remaining: np.ndarray
    ) -> np.ndarray:
        """
        Return the remaining share of the Allan variance of a process, shape (n_counts,).

        With the second differences D at each of `counts` blocks per mean, the covariance C of the
        process and the matrix R = `remaining`::

            share = tr(D R C R' D') / tr(D C D')

        """
        covariance = mean_covariance(process, self._lag, self.blocks.seconds)
        shares = np.ones(len(counts))
        for k, count in enumerate(counts):
            difference = self._differences(count)
            if len(difference):
                detrended = difference @ remaining
                remaining_trace = np.sum(detrended @ covariance * detrended)
                trace = np.sum(difference @ covariance * difference)
                shares[k] = remaining_trace / trace
        # Not nearly zero: the model of the Allan variances is multiplied by it.
        return np.clip(shares, 0.02, 1.0)

    def _differences(self, count: int) -> np.ndarray:
        """
        Return the matrix of differences of neighbouring means of `count` blocks, within parts.

        Its shape is (n_differences, n).
        """
        n = len(self.blocks.time)
        part = self.blocks.part
        starts = [k for k in range(n - 2 * count + 1) if part[k] == part[k + 2 * count - 1]]
        rows = np.zeros((len(starts), n))
        for row, k in zip(rows, starts):
            row[k : k + count] = -1.0 / count
            row[k + count : k + 2 * count] = 1.0 / count
        return rows


@dataclass(frozen=True, eq=False)
class _TrendFit:
    """Generalised least squares of n_trends trends in n blocks."""

    values: np.ndarray
    """Coefficients of the trends, shape (n_trends,)."""
    sds: np.ndarray
    """Their standard deviations."""
    whitening: np.ndarray
    """Inverse Cholesky factor of the covariance of the blocks, shape (n, n)."""


@dataclass(frozen=True, eq=False)
class KeptShare:
    """Share of the Allan variance of a process that remains after subtraction of trends."""

    tau: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Averaging times, s; empty without trends."""
    shares: dict[str, np.ndarray] = field(default_factory=dict)
    """Name of the process -> shares at `tau`."""

    def of(self, process: NoiseProcess, tau: np.ndarray) -> np.ndarray:
        """Return the shares of a process at averaging times; of Gauss-Markov those of flicker."""
        if not len(self.tau):
            return np.ones(len(tau))
        shares = self.shares.get(process.name, self.shares[FLICKER.name])
        return np.interp(np.log(tau), np.log(self.tau), shares)


@dataclass(frozen=True, eq=False)
class Parts:
    """The Allan variances of one axis, one row for each part at rest."""

    variance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """Shape (n_parts, n_scales); anything where a part has no term."""
    terms: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """Number of second differences of each variance, shape (n_parts, n_scales)."""

    def share(self) -> np.ndarray:
        """
        Return the variance of the mean over all parts, over that of a part, shape (n_scales,).

        It is that of parts of which only the levels differ, with the numbers of terms as weights.
        """
        return (self.terms**2).sum(axis=0) / self.terms.sum(axis=0) ** 2

    def scatter(self, used: np.ndarray, chance: np.ndarray) -> float:
        """
        Return the relative standard deviation of the level of the variances between parts.

        It is in excess of the sampling error. The moment estimate of DerSimonian and Laird
        (Controlled Clinical Trials 7:177, 1986) with the numbers of terms for weights, averaged
        over the averaging times, weighted by precision.

        Parameters
        ----------
        used : ndarray of bool, shape (n_scales,)
            Averaging times that count.
        chance : ndarray, shape (n_used,)
            Sampling variance of the mean of all parts over the square of its expectation.

        """
        if len(self.terms) < 2:
            return 0.0
        terms = self.terms[:, used]
        variance = self.variance[:, used]
        total = terms.sum(axis=0)
        freedom = (terms > 0).sum(axis=0) - 1
        level = (terms * variance).sum(axis=0) / total
        squares = (terms * (variance / level - 1.0) ** 2).sum(axis=0)
        # Expectation of `squares` per variance of the levels.
        squares_per_level = total - (terms**2).sum(axis=0) / total
        known = freedom > 0
        if not known.any():
            return 0.0
        between = (squares - freedom * chance * total)[known] / squares_per_level[known]
        # Inverse variances up to a factor: the sum of squares with `freedom` degrees of freedom has
        # the variance 2 freedom (chance total)^2.
        precision = (squares_per_level / (chance * total))[known] ** 2 / freedom[known]
        return float(np.sqrt(max(np.sum(precision * between) / precision.sum(), 0.0)))
