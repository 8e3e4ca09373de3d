"""
Trends in the readings at rest, and noise that differs between rests.

The trends are due to temperature, settling after turn-on and steady drift. The noise is not the
same at every rest.
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
MIN_TREND_SDS = {'temperature': 3.3, 'turn_on': 4.0, 'ramp': 4.0}
"""
A trend counts from this many standard deviations on: 1 in 1000, also with the shapes of turn-on
that are tried.
"""
MIN_WARMTH_RANGE = 0.1
"""Range of the temperature, K, above which a trend with it is tested."""
MIN_SPARE_BLOCKS = 12
"""Trends are tested only with this many more blocks than constants."""
SETTLING_SHARES = (1 / 40, 1 / 20, 1 / 10, 1 / 5)
"""Time constants of turn-on that are tried, as shares of the recording."""
WALK_VARIANCE_RATIOS = np.concatenate([[0.0], np.geomspace(1e-4, 1e5, 37)])
"""
Variance of the random walk in the middle of the recording over that of the white noise of a block.
"""
TEMPERATURE_TREND, TURN_ON_TREND, RAMP_TREND = 'temperature', 'turn_on', 'ramp'


@dataclass(frozen=True, eq=False)
class Blocks:
    """Means of equal stretches at rest."""

    time: np.ndarray
    """Middle, s since the beginning of the recording, shape (n,)."""
    mean: np.ndarray
    """Readings, shape (n, 6)."""
    part: np.ndarray
    """Part that each belongs to, shape (n,)."""
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
        return self.value * _shape_of(self.name, self.time)(time, temperature_c, reference)


@dataclass(frozen=True)
class TrendReference:
    """Where the trends are zero, or begin."""

    begin: float = 0.0
    """Beginning of the recording, s."""
    middle: float = 0.0
    """Middle of the blocks, s."""
    temperature_c: float = 0.0
    """Mean temperature."""


def _shape_of(name, constant=0.0):
    """Return the regressor of a trend as a function of (time, temperature, reference)."""
    return {
        TEMPERATURE_TREND: lambda time, warmth, reference: warmth - reference.temperature_c,
        TURN_ON_TREND: lambda time, warmth, reference: np.exp(-(time - reference.begin) / constant),
        RAMP_TREND: lambda time, warmth, reference: time - reference.middle,
    }[name]


def _log_determinants(triangles):
    """
    Return the logarithms of the determinants of ``T.T @ T``, for triangular T of shape (k, n, n).
    """
    return 2 * np.log(np.abs(np.diagonal(triangles, axis1=1, axis2=2))).sum(axis=1)


class TrendSearch:
    """
    Finds trends in the means of blocks.

    Parameters
    ----------
    blocks : Blocks

    """

    def __init__(self, blocks: Blocks):
        self.blocks = blocks
        self._constants = (blocks.part[:, None] == np.unique(blocks.part)[None, :]).astype(float)
        warmth = blocks.temperature_c
        begin = float(blocks.time[0] - blocks.seconds / 2)
        self.reference = TrendReference(
            begin, float(blocks.time.mean()), 0.0 if warmth is None else float(warmth.mean())
        )
        lag = blocks.time[:, None] - blocks.time[None, :]
        self._walk = mean_covariance(RANDOM_WALK, lag, blocks.seconds)
        self._lag = lag
        centred = (
            self._walk
            - self._walk.mean(axis=0)
            - self._walk.mean(axis=1)[:, None]
            + self._walk.mean()
        )
        self._scale = float(np.trace(centred)) / len(lag)
        # Unit white noise and, for each ratio, the change of a random walk since the first block.
        change = self._walk - self._walk[:1] - self._walk[:, :1] + self._walk[0, 0]
        factors = np.linalg.cholesky(
            np.eye(len(lag)) + WALK_VARIANCE_RATIOS[:, None, None] / self._scale * change
        )
        self._inverses = np.linalg.inv(factors)
        self._logs = _log_determinants(factors)

    @property
    def usable(self) -> bool:
        """Whether there are enough blocks."""
        return len(self.blocks.time) - self._constants.shape[1] >= MIN_SPARE_BLOCKS

    def find(self, axis: int) -> tuple[AxisTrend, ...]:
        """
        Return the trends of an axis (0 to 5), the temperature first.

        None of one that never changes.
        """
        if not self.usable or not np.any(np.ptp(self.blocks.mean[:, axis])):
            return ()
        chosen: list[tuple[str, float]] = []
        warmth = self.blocks.temperature_c
        while True:
            asked = (
                [TEMPERATURE_TREND]
                if not chosen and warmth is not None and np.ptp(warmth) > MIN_WARMTH_RANGE
                else []
            )
            found = self._clearest(axis, chosen, asked) or self._clearest(
                axis, chosen, [TURN_ON_TREND, RAMP_TREND]
            )
            if found is None:
                break
            chosen.append(found)
        if not chosen:
            return ()
        values, sd, _ = self.regress(axis, chosen)
        return tuple(
            AxisTrend(name, float(v), float(s), constant)
            for (name, constant), v, s in zip(chosen, values, sd)
        )

    def _clearest(self, axis, chosen, names):
        """
        Return the (name, time constant) of the most significant coefficient, or None.

        The significance is given the coefficients that are already selected.
        """
        # Settling after turn-on is tried with several time constants.
        span = np.ptp(self.blocks.time) + self.blocks.seconds
        settling_times = [share * span for share in SETTLING_SHARES]
        taken = {name for name, _ in chosen}
        trials = []
        for name in names:
            if name in taken:
                continue
            for time_constant in settling_times if name == TURN_ON_TREND else [0.0]:
                trials.append((name, time_constant))
        if not trials:
            return None

        scores = []
        for trial in trials:
            values, sd, _ = self.regress(axis, [*chosen, trial])
            scores.append(abs(values[-1]) / sd[-1])
        best = int(np.argmax(scores))
        name, _ = trials[best]
        return None if scores[best] < MIN_TREND_SDS[name] else trials[best]

    def columns(self, trends: list[tuple[str, float]]) -> np.ndarray:
        """Return the regressors of (name, time constant), shape (n_blocks, n_trends)."""
        shapes = [
            _shape_of(*trend)(self.blocks.time, self.blocks.temperature_c, self.reference)
            for trend in trends
        ]
        return np.column_stack([self._constants, *shapes])[:, self._constants.shape[1] :]

    def regress(
        self, axis: int, trends: list[tuple[str, float]]
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """
        Return coefficients, their standard deviations, and the index of a ratio.

        The index is that of the likeliest ratio of `WALK_VARIANCE_RATIOS`.
        """
        design = np.column_stack([self._constants, self.columns(trends)])
        target = self.blocks.mean[:, axis]
        size = np.linalg.norm(design, axis=0)
        basis, triangle = np.linalg.qr(self._inverses @ (design / size))
        rest = self._inverses @ target
        along = np.einsum('rnk,rn->rk', basis, rest)
        total = np.sum(rest**2, axis=1)
        freedom = len(target) - design.shape[1]
        # The residual of an axis with constant readings is a rounding error.
        squares = np.maximum(
            total - np.sum(along**2, axis=1), np.finfo(float).eps * total + np.finfo(float).tiny
        )
        best = int(np.argmin(self._logs + _log_determinants(triangle) + freedom * np.log(squares)))
        root = np.linalg.inv(triangle[best])
        values = root @ along[best] / size
        sd = np.sqrt(squares[best] / freedom * np.einsum('ij,ij->i', root, root)) / size
        return values[-len(trends) :], sd[-len(trends) :], best

    def kept(self, axis: int, trends: tuple[AxisTrend, ...]) -> 'KeptShare':
        """Return the share of the Allan variance that remains after subtraction of these trends."""
        if not trends:
            return KeptShare()
        shapes = [(trend.name, trend.time) for trend in trends]
        inverse = self._inverses[self.regress(axis, shapes)[2]]
        design = np.column_stack([self._constants, self.columns(shapes)])
        whitened = inverse @ design
        taken = np.eye(len(design)) - design @ np.linalg.pinv(whitened) @ inverse
        counts = np.unique(
            np.rint(2.0 ** np.arange(0, np.log2(max(len(design) / 2, 1)) + 0.01, 0.5)).astype(int)
        )
        shares = {
            process.name: self._shares(process, counts, taken)
            for process in (WHITE, FLICKER, RANDOM_WALK)
        }
        return KeptShare(counts * self.blocks.seconds, shares)

    def _shares(self, process, counts, taken):
        covariance = mean_covariance(process, self._lag, self.blocks.seconds)
        shares = np.ones(len(counts))
        for k, count in enumerate(counts):
            difference = self._differences(count)
            if len(difference):
                left = difference @ taken
                shares[k] = np.einsum('ij,jk,ik->', left, covariance, left) / np.einsum(
                    'ij,jk,ik->', difference, covariance, difference
                )
        return np.clip(shares, 0.02, 1.0)

    def _differences(self, count):
        """Return the second differences at `count` blocks per mean as rows, within parts only."""
        n = len(self.blocks.time)
        starts = [
            k
            for k in range(n - 2 * count + 1)
            if self.blocks.part[k] == self.blocks.part[k + 2 * count - 1]
        ]
        rows = np.zeros((len(starts), n))
        for row, k in zip(rows, starts):
            row[k : k + count], row[k + count : k + 2 * count] = -1.0 / count, 1.0 / count
        return rows


@dataclass(frozen=True, eq=False)
class KeptShare:
    """Share of the Allan variance of a process that remains after subtraction of trends."""

    tau: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Averaging times, s; empty without trends."""
    shares: dict = field(default_factory=dict)
    """Name of the process -> shares at `tau`."""

    def of(self, process: NoiseProcess, tau: np.ndarray) -> np.ndarray:
        """Return the shares at averaging times."""
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
    """Second differences that each is the mean of, shape (n_parts, n_scales)."""

    def share(self) -> np.ndarray:
        """
        Return the variance of the mean of all parts over that of a part.

        If only their levels differ, shape (n_scales,).
        """
        return (self.terms**2).sum(axis=0) / self.terms.sum(axis=0) ** 2

    def scatter(self, used: np.ndarray, chance: np.ndarray) -> float:
        """
        Return the relative standard deviation of the variances' level between parts.

        It is the standard deviation between parts of the level of the variances, over the level, in
        excess of sampling error.

        The moment estimate of DerSimonian and Laird (Controlled Clinical Trials 7:177, 1986) with
        the numbers of terms for weights, averaged over the averaging times, weighted by precision.

        Parameters
        ----------
        used : ndarray of bool, shape (n_scales,)
            Which averaging times count.
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
        spread = total - (terms**2).sum(axis=0) / total
        known = freedom > 0
        if not known.any():
            return 0.0
        between = (squares - freedom * chance * total)[known] / spread[known]
        precision = (spread / (chance * total))[known] ** 2 / freedom[known]
        return float(np.sqrt(max(np.sum(precision * between) / precision.sum(), 0.0)))
