"""
The derivative of the measured rate, and its error, for stamps of any kind.

Samples of a clock count as equally spaced; irregular ones are fitted by least squares over stamps.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from imu_calibration.compensation.angular_acceleration import (
    NO_SLOPE,
    RESET_NS,
    CausalDerivative,
    StampedDerivative,
    TimedDerivative,
)
from imu_calibration.preprocessing import stamping
from imu_calibration.preprocessing.stamping import (
    CLOCK_BLOCK,
    COUNTED,
    IRREGULAR,
    LAG,
    PAUSE_NS,
    REGULAR,
    StampLine,
    describe_stamps,
)

REVIEWED_STAMPS = 4 * LAG + 1
"""Stamps needed to separate counted from irregular stamps."""
CHANGED = {REGULAR: 0.02, COUNTED: 0.05, IRREGULAR: 0.25}
"""
A period that differs by more than this share is a new one; the scatter of the stamps limits the
resolution of the latter two.
"""
FASTEST_NS = 10_000.0
"""Irregular stamps with a shorter mean step are frozen: they contain no time for a derivative."""
AGREE = 4
"""
Reviews in a row that replace irregular stamps by counted ones: so many blocks contain new stamps
only.
"""
RECENT_SPAN = 5.0, 64, 2048
"""
Seconds, smallest and largest number of derivatives that are stored: they show how large the
derivative may be after a gap.
"""
PRESENT_SPAN = 1.0
"""
Seconds of the stored derivatives, but at least the smallest number in `RECENT_SPAN`, from which the
error in a full window is estimated.
"""
POSSIBLE = 3.0
"""
Standard deviation of each component of the angular acceleration before any motion was seen,
rad/s^2: robots and vehicles that start a turn have 1 to 5 rad/s^2.
"""
POSSIBLE_RATE = 0.5
"""Standard deviation of each component of the rate in motion, rad/s, as for POSSIBLE."""
START_SPAN = 0.01, 0.05
"""
Seconds between the oldest and the newest reading from which the size of the derivative is estimated
before the kind of the stamps is known: below the first one the noise is larger than any motion,
above the second one the motion changes.
"""
ROUGH_SLOPE_SECONDS = 0.02
"""
Seconds over which the rate is compared where there is no derivative: the longest delay that a
derivative may have.
"""
EQUAL_STEPS = 0.005
"""
The first steps of a stream are those of a clock, before there are enough for `describe_stamps`, if
they differ by at most this share.
"""
UNKNOWN = (float('nan'),) * 3
"""Stored where the window was not full."""
WITHOUT = (
    ': no angular acceleration, the lever-arm effect is not corrected and the covariance includes'
    ' its size'
)
"""Consequence of frozen stamps."""


@dataclass(frozen=True, eq=False)
class _RateNoise:
    """Noise of the rate."""

    precision: np.ndarray
    """Inverse of its covariance, s^2/rad^2, shape (3, 3)."""
    log_sd: float
    """Logarithm of the product of the three standard deviations."""


@lru_cache(maxsize=8)
def _rate_noise(rate_cov: bytes) -> _RateNoise | None:
    """
    Return the noise of a covariance, nine numbers; None where a direction has none.

    Kept, because most messages state the same covariance and each sample of a new window needs it.
    """
    covariance = np.frombuffer(rate_cov).reshape(3, 3)
    if np.min(np.linalg.eigvalsh(covariance)) <= 0.0:
        return None
    return _RateNoise(np.linalg.inv(covariance), 0.5 * np.linalg.slogdet(covariance)[1])


@dataclass(frozen=True, eq=False)
class MotionEvidence:
    """Measured rate and its slopes, from which the probability of a motion follows."""

    rate: np.ndarray
    """Newest rate less the bias of the gyroscope, rad/s, shape (3,)."""
    moment: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Mean of slope times slope, (rad/s^2)^2, shape (3, 3)."""
    noise_gain: float = 0.0
    """Covariance of a slope's noise over the covariance of the rate's noise, 1/s^2."""
    n_slopes: float = 0.0
    """Number of independent slopes; 0: one reading only."""

    def chance_of_motion(self, rate_cov: np.ndarray) -> float:
        """
        Return the probability that the rate changes, given the readings, from equal priors.

        Hypotheses for the rate w and its slope b, with covariances N and g N of their noise::

            rest            w = 0,               b = 0
            constant rate   w ~ POSSIBLE_RATE,   b = 0
            motion          w ~ POSSIBLE_RATE,   b ~ POSSIBLE (standard deviations per component)

        A Gaussian of sd s that is tested with a much smaller noise n loses against zero by
        ``log(s / n)`` per component, and wins by half the excess of its square over the noise. A
        square below that of the noise is no further evidence. With the log likelihoods L relative
        to motion, the result is ``1 / (1 + exp(L constant) + exp(L rest))``.
        """
        noise = _rate_noise(rate_cov.tobytes())
        if noise is None:  # without noise every change of the rate is a motion
            return 1.0
        precision = noise.precision
        log_rate_noise = noise.log_sd

        # Log likelihood of b = 0. One reading has no slope to test.
        log_zero_slope = 0.0
        log_constant_rate = -np.inf
        if self.n_slopes:
            slope_excess = np.trace(precision @ self.moment) / self.noise_gain - 3.0
            log_slope_noise = log_rate_noise + 1.5 * np.log(self.noise_gain)
            log_zero_slope = max(3.0 * np.log(POSSIBLE) - log_slope_noise, 0.0)
            log_zero_slope -= 0.5 * self.n_slopes * max(slope_excess, 0.0)
            log_constant_rate = log_zero_slope

        # Log likelihood of w = 0 in addition.
        rate_excess = float(self.rate @ precision @ self.rate) - 3.0
        log_zero_rate_prior = max(3.0 * np.log(POSSIBLE_RATE) - log_rate_noise, 0.0)
        log_rest = log_zero_slope + log_zero_rate_prior - 0.5 * max(rate_excess, 0.0)
        return float(np.exp(-np.logaddexp.reduce([0.0, log_constant_rate, log_rest])))


@dataclass(frozen=True, eq=False)
class SlopeError:
    """Error of the derivative in the present motion, in addition to its noise."""

    moment: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Mean of error times error, noise of the rate included, (rad/s^2)^2, shape (3, 3)."""
    noise_gain: float = 0.0
    """
    Covariance of the noise in `moment` over the covariance of the rate's noise, 1/s^2.

    Negative where noise has to be added to `moment`.
    """
    weights: np.ndarray | None = None
    """
    Weights of the newest to the oldest reading in the derivative, 1/s, shape (n,); None: those of
    the full window.
    """
    evidence: MotionEvidence | None = None
    """Rate and slopes from which the probability of a motion follows; None: it is 1."""

    def covariance(self, rate_cov: np.ndarray) -> np.ndarray:
        """
        Return the covariance of the error without the noise, (rad/s^2)^2, shape (3, 3).

        ``p (moment - noise_gain rate_cov)`` with the probability p of a motion, because there is no
        error without one; negative eigenvalues become zero.
        """
        sizes, directions = np.linalg.eigh(self.moment - self.noise_gain * rate_cov)
        covariance = (directions * np.maximum(sizes, 0.0)) @ directions.T
        if self.evidence is None:
            return covariance
        return self.evidence.chance_of_motion(rate_cov) * covariance


@dataclass(frozen=True, eq=False)
class FirstSlope:
    """Slope of the rate over the first readings."""

    slope: np.ndarray
    """rad/s^2, shape (3,)."""
    spread: float
    """Sum of the squared distances of the stamps from their mean, s^2; 0: no slope."""
    seconds: float
    """From the oldest to the newest reading, s."""


@dataclass(frozen=True, eq=False)
class _ArrayAndNew:
    """Rows of three numbers in an array, and those that were added since it was made."""

    array: np.ndarray
    """Oldest first, shape (n, 3)."""
    new: deque[tuple]
    """At most as many as are kept: where they are so many, none of the array remains."""


class RecentRows:
    """
    The newest rows of three numbers, at most `most`.

    Each sample adds one row; in new windows each asks for the array too. The array is therefore
    made of the one before and of the rows since then.
    """

    def __init__(self, most: int):
        self._most = most
        self._rows = _ArrayAndNew(np.empty((0, 3)), deque(maxlen=most))
        """Replaced as a whole, because another thread may read both parts."""

    def __len__(self) -> int:
        return min(len(self._rows.array) + len(self._rows.new), self._most)

    def append(self, row: tuple) -> None:
        """Add a row, in the thread that calls `array`."""
        self._rows.new.append(row)

    def extend(self, rows: np.ndarray) -> None:
        """Add rows, shape (n, 3), in the thread that calls `array`."""
        self._rows.new.extend(map(tuple, rows[-self._most :].tolist()))

    def array(self) -> np.ndarray:
        """Return the rows, oldest first, shape (n, 3)."""
        if self._rows.new:
            self._rows = _ArrayAndNew(self.copied(), deque(maxlen=self._most))
        return self._rows.array

    def copied(self) -> np.ndarray:
        """Return the rows as `array` does, in any thread."""
        rows = self._rows
        new = np.array(list(rows.new)).reshape(-1, 3)
        return np.concatenate([rows.array, new])[-self._most :]


class RateSlope:
    """
    Derivative of the rate of a stream, one sample or one block at a time.

    The outcome does not depend on how the stream is cut.

    By the kind of the stamps, which is reviewed every `CLOCK_BLOCK` samples:

    - regular: they show where samples are missing;
    - scattered about a clock (packets, times of arrival, jitter, in any order): the samples are
      counted (`_push_counted`);
    - irregular: least squares over the stamped times;
    - frozen: the derivative is zero and `error` returns its size.

    Parameters
    ----------
    choose : callable
        Returns the CausalDerivative for a period in s.
    changed : callable
        Called when another derivative is in use, or none.
    bias : sequence of 3 floats
        Bias of the gyroscope's readings, rad/s.

    """

    def __init__(
        self,
        choose: Callable[[float], CausalDerivative],
        changed: Callable[[], None] = lambda: None,
        bias: Sequence[float] = (0.0, 0.0, 0.0),
    ):
        self._make_derivative = choose
        self._notify = changed
        self._bias = np.array(bias)

        # The kind of the stamps and its reviews.
        self.line: StampLine | None = None
        """Class of the stamps; None while they are too few."""
        self._stamps: deque[int] = deque(maxlen=REVIEWED_STAMPS)
        """Newest stamps in the order of arrival, ns."""
        self._n_until_review = stamping.MIN_PERIOD_STEPS + 1
        """Samples until the stamps are classified again."""
        self._is_unreviewed = True
        """Whether no review has followed the last change of the derivative."""
        self._n_agreeing = 0
        """Successive reviews that classify irregular stamps as counted."""

        # The derivative and its window.
        self.derivative: CausalDerivative | None = None
        """The derivative in use, or None."""
        self._tracker: StampedDerivative | TimedDerivative | None = None
        """Window of the derivative in use; None without one."""
        self._newest_ns: int | None = None
        """Stamp of the newest sample."""
        self._newest_rate: tuple = NO_SLOPE
        """Rate of the newest sample, rad/s."""
        self._slope: tuple = NO_SLOPE
        """Derivative after the newest sample, rad/s^2."""
        self._recent = RecentRows(RECENT_SPAN[1])
        """
        Newest derivatives, `UNKNOWN` where the window was not full, rad/s^2; without a derivative
        the newest rates, rad/s.
        """
        self._size_before: SlopeError | None = None
        """Size of the derivative before the last change of the stamps."""

        # Counted samples.
        self._max_step_ns = 0.0
        """Longest step between stamps without a lost sample; 0: samples are not counted."""
        self._n_counted = 0
        """Number of the newest counted sample, lost samples included."""
        self._undecided_rates: list[tuple] = []
        """Rates since a long step, which may be of lost samples or a late stamp, rad/s."""
        self._undecided_ns = 0
        """Time from the stamp before these rates to the newest one."""

        # Counters for the user of the derivative.
        self.restarts = 0
        """Number of windows that were restarted."""
        self.n_changes = 0
        """Number of samples after which the error was no longer the same."""
        self._n_growing = CLOCK_BLOCK
        """Samples of a new window for which the error is estimated again after each."""
        self._n_in_window = 0
        """Samples in the derivative since its window was begun, at most `_n_growing`."""
        self.n_without = 0
        """Samples without a derivative because their stamps are frozen."""

    @property
    def period(self) -> float | None:
        """Time between samples, s; None while the stamps are too few."""
        return None if self.line is None else 1e-9 * self.line.period_ns

    @property
    def doubt(self) -> str:
        """Reason why there is no derivative; '' with one, or before the stamps are classified."""
        return f'{self.line}{WITHOUT}' if self.line is not None and self._tracker is None else ''

    @property
    def window_begins(self) -> bool:
        """
        Whether the newest sample is the first or second of a window.

        The derivative of two readings is the noisiest; each later one is better than that before.
        """
        return self._n_in_window <= 2

    def push(self, stamp_ns: int, x: float, y: float, z: float) -> tuple:
        """Return the derivative (x, y, z) after one more sample, per second."""
        if stamp_ns == self._newest_ns and (x, y, z) == self._newest_rate:  # the same message again
            return self._slope
        step_ns = 0 if self._newest_ns is None else stamp_ns - self._newest_ns
        self._newest_ns = stamp_ns
        self._newest_rate = (x, y, z)
        self._stamps.append(stamp_ns)

        # The class of the stamps, which may change the derivative in use.
        self._n_until_review -= 1
        if not self._n_until_review:
            self._review()
        if self.line is None and self._begins_equally():
            period_ns = (stamp_ns - self._stamps[0]) / (len(self._stamps) - 1)
            self.settle(StampLine(REGULAR, period_ns))

        # Without a derivative the rates are stored instead.
        if self._tracker is None:
            if self.line is None:
                self.n_changes += 1
            else:
                self.n_without += 1
            self._recent.append((x, y, z))
            return NO_SLOPE

        n_used_before = self._tracker.n_used
        if self._max_step_ns:
            slope = self._push_counted(self._tracker, step_ns, (x, y, z))
        else:
            slope = self._tracker.push(stamp_ns, x, y, z)
        n_used = self._tracker.n_used
        self._slope = slope
        self._recent.append(slope if n_used == self._tracker.taps else UNKNOWN)

        # In a new window each sample changes the derivative's noise, delay and error.
        is_restarted = n_used < n_used_before
        if is_restarted:
            self.restarts += 1
            self._n_growing = self._tracker.taps
        if is_restarted or not n_used:
            self._n_in_window = 0
        if self._n_in_window < self._n_growing:
            self._n_in_window += 1
            self.n_changes += 1
        return slope

    def push_block(self, stamp_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
        """
        Return the derivatives after each of the samples of a block, shape (n, 3).

        The same as `push` one by one.
        """
        out = np.empty(values.shape)
        start = 0
        while start < len(values):
            # Regular samples at once, then one sample that `push` has to process.
            stop = self._end_of_regular(stamp_ns, values, start)
            if stop > start:
                assert isinstance(self._tracker, StampedDerivative), (
                    'regular stamps have equal steps'
                )
                is_full = np.empty(stop - start, bool)
                out[start:stop] = self._tracker.push_block(
                    stamp_ns[start:stop], values[start:stop], is_full
                )
                recent = np.where(is_full[:, None], out[start:stop], UNKNOWN)
                self._store_block(stamp_ns[start:stop], values[stop - 1], out[start:stop], recent)
            if stop < len(values):
                out[stop] = self.push(int(stamp_ns[stop]), *values[stop].tolist())
            start = stop + 1
        return out

    def _begins_equally(self) -> bool:
        """
        Return whether the first stamps are those of a clock.

        Samples of a packet have equal steps too, but are together shorter than `START_SPAN`.
        """
        if len(self._stamps) > stamping.MIN_PERIOD_STEPS:
            return False
        steps = np.diff(np.array(self._stamps, np.int64))
        total_ns = float(steps.sum())
        if len(steps) < 2 or total_ns < 1e9 * START_SPAN[0]:
            return False
        return float(np.ptp(steps)) <= EQUAL_STEPS * total_ns / len(steps)

    def settle(self, line: StampLine) -> None:
        """
        Use the derivative for stamps of the class `line`.

        The window is kept while the period is unchanged.
        """
        is_first = self.line is None and bool(self._stamps)
        self.line = line
        self._undecided_rates = []
        self._n_agreeing = 0
        self._max_step_ns = 0.0
        if line.word == COUNTED:
            scatter_ns = line.high_ns - line.low_ns
            self._max_step_ns = scatter_ns + stamping.MAX_REGULAR_STEP * line.period_ns

        # The same window with another time of its newest sample: the number of the counted sample,
        # or the stamp before the newest, which is not in the window yet.
        if isinstance(self._tracker, StampedDerivative) and self._is_kept_for(line):
            if self._max_step_ns:
                self._tracker.rebase(round(self._n_counted * 1e9 * self._tracker.period))
            else:
                self._tracker.rebase(self._stamps[-2])
            return

        # The size of the derivative, before the past that shows it is discarded.
        if is_first:
            self._size_before = self._size_at_start()
        else:
            self._size_before = self._size(self._recent.array())
        first_readings = self._recent.array().tolist()
        self._begin_window(line)

        # The first readings were stored before there was a derivative and fill its window. Counted
        # samples need the number of lost ones, which these stamps do not show yet.
        if is_first and self._tracker is not None and not self._max_step_ns:
            stamps = list(self._stamps)[:-1]  # the newest sample is added by `push`
            n_stored = min(len(stamps), len(first_readings))
            for stamp_ns, reading in zip(stamps[-n_stored:], first_readings[-n_stored:]):
                slope = self._tracker.push(stamp_ns, *reading)
                self._recent.append(
                    slope if self._tracker.n_used == self._tracker.taps else UNKNOWN
                )
        self._notify()

    def _begin_window(self, line: StampLine) -> None:
        """Begin an empty window for stamps of a class, without a derivative if they are frozen."""
        self.derivative = None
        self._tracker = None
        if not _is_frozen(line):
            self.derivative = self._make_derivative(line.period_ns * 1e-9)
            if line.word == IRREGULAR:
                self._tracker = TimedDerivative(self.derivative)
            else:
                self._tracker = StampedDerivative(self.derivative)
        seconds, least, most = RECENT_SPAN
        self._recent = RecentRows(int(min(max(seconds * 1e9 / line.period_ns, least), most)))
        self._slope = NO_SLOPE
        self._is_unreviewed = True
        self._n_in_window = 0
        self._n_growing = CLOCK_BLOCK

    def _is_kept_for(self, line: StampLine) -> bool:
        """Return whether the derivative in use, or none, remains right for stamps of a class."""
        if self._tracker is None:
            return _is_frozen(line)
        if isinstance(self._tracker, TimedDerivative) != (line.word == IRREGULAR):
            return False
        return abs(1e-9 * line.period_ns / self._tracker.period - 1) <= CHANGED[line.word]

    def prepare(self, before: 'RateSlope') -> None:
        """Use the class of stamps and the recent derivatives of another RateSlope."""
        if before.line is not None:
            self.settle(before.line)
            self._size_before = before._size_before
            self._recent.extend(before._recent.copied())

    def follow(self, before: 'RateSlope') -> None:
        """Continue from the latest sample of another RateSlope, after `prepare`."""
        self._stamps = before._stamps
        self._n_until_review = before._n_until_review
        self._n_counted = before._n_counted
        self._newest_ns, self._newest_rate = before._newest_ns, before._newest_rate
        self._n_agreeing = before._n_agreeing
        self._undecided_ns = before._undecided_ns
        self._undecided_rates = before._undecided_rates
        if self._tracker is not None and isinstance(before._tracker, type(self._tracker)):
            self._tracker.seed(before._tracker)  # type: ignore[arg-type]

    def error(self) -> SlopeError:
        """
        Return the recent error of the derivative.

        The error of a delayed derivative is the change of the true one in that time, estimated a
        delay later: ``alpha(t + delay) - alpha(t)``. Without a derivative the error is its
        size: that before the gap, or that from the rate over `ROUGH_SLOPE_SECONDS`; also after a
        change of the stamps, until there is new motion. Before any motion it is `POSSIBLE`, unless
        the rates exclude a motion (`MotionEvidence`).
        """
        error = self._error()
        return replace(error, evidence=self._evidence())

    def _evidence(self) -> MotionEvidence | None:
        """Return the newest rate and its recent slopes; None without a slope to test."""
        if self._newest_ns is None:
            return None
        rate = np.array(self._newest_rate) - self._bias
        if self.line is None:
            # The only slope is the one over all readings.
            first = self._slope_at_start()
            if not first.spread:
                return MotionEvidence(rate)
            moment = np.outer(first.slope, first.slope)
            return MotionEvidence(rate, moment, 1.0 / first.spread, 1.0)
        if self.derivative is None or self._tracker is None:
            return None
        slopes = _without_unknown(self._recent_slopes(self._tracker))
        if len(slopes):
            # Slopes of windows that share no reading are independent.
            gain = float(self.derivative.weights @ self.derivative.weights)
            n_slopes = max(len(slopes) / self._tracker.taps, 1.0)
            return MotionEvidence(rate, _mean_square(slopes), gain, n_slopes)
        # No window was full yet: the slope of the readings in the present window.
        weights = CausalDerivative(max(self._tracker.n_used, 2), self._tracker.period).weights
        slope = np.array(self._slope)
        if self._tracker.n_used < 2 or not slope.any():
            return None
        return MotionEvidence(rate, np.outer(slope, slope), float(weights @ weights), 1.0)

    def _error(self) -> SlopeError:
        """
        Return the error of the derivative if there is a motion.

        With the derivative a_k after sample k, its delay of d samples and the lag l, d rounded up::

            moment     = (d / l)^2 mean (a_k - a_(k-l)) (a_k - a_(k-l))'
            noise_gain = (d / l)^2 sum (weights of a_k - a_(k-l))^2
        """
        # Without a derivative the error is its size.
        stored = self._recent.array()
        if self.line is None:
            return self._size_at_start()
        if self.derivative is None or self._tracker is None:
            if len(stored) < stamping.MIN_PERIOD_STEPS and self._size_before is not None:
                return self._size_before
            return self._size(stored)
        n_used = self._tracker.n_used
        if not n_used:
            return replace(self._size(stored), weights=np.zeros(1))

        # A window with fewer samples has a shorter delay.
        recent = self._recent_slopes(self._tracker)
        weights = CausalDerivative(n_used, self._tracker.period).weights
        delay = (n_used - 1) / 2  # in samples
        lag = max(round(delay + 0.01), 1)  # half samples are rounded up
        change = _without_unknown(recent[lag:] - recent[:-lag])
        if not len(change):
            # No two slopes of full windows are a lag apart: their size, if there is one.
            if len(_without_unknown(recent)):
                return replace(self._size(recent), weights=weights)
            # The first slope of a stream shows the size of the motion, with its own noise.
            slope = np.array(self._slope)
            return SlopeError(np.outer(slope, slope), float(weights @ weights), weights)

        # The change over the delay, from that over the lag.
        share = (delay / lag) ** 2
        change_weights = np.convolve(self.derivative.weights, [1.0] + [0.0] * (lag - 1) + [-1.0])
        noise_gain = share * float(change_weights @ change_weights)
        return SlopeError(share * _mean_square(change), noise_gain, weights)

    def _recent_slopes(self, tracker: StampedDerivative | TimedDerivative) -> np.ndarray:
        """
        Return the recent derivatives, shape (n, 3).

        With a full window only those of the last `PRESENT_SPAN`.
        """
        recent = self._recent.array()
        if tracker.n_used < tracker.taps:
            return recent
        n_present = PRESENT_SPAN / tracker.period
        return recent[-int(max(n_present, RECENT_SPAN[1])) :]

    def _slope_at_start(self) -> FirstSlope:
        """
        Return the least-squares slope b of the last `START_SPAN` of readings over their stamps t.

        Its covariance is ``N / Sxx``, ``Sxx = sum((t - mean t)^2)``, N the covariance of the rate.
        """
        # The newest stamps and the rates that were stored with them: before the kind of the stamps
        # is known, `_recent` has rates; afterwards derivatives.
        n = min(len(self._stamps), len(self._recent))
        stamps = np.array(list(self._stamps)[len(self._stamps) - n :], np.int64)
        readings = self._recent.array()[len(self._recent) - n :]
        if n:
            age = (stamps.max() - stamps) * 1e-9
            is_recent = age <= START_SPAN[1]
            stamps = stamps[is_recent]
            readings = readings[is_recent]
        if not len(stamps) or not np.ptp(stamps):
            return FirstSlope(np.zeros(3), 0.0, 0.0)
        time = (stamps - stamps[0]) * 1e-9
        time = time - time.mean()
        spread = float(time @ time)
        return FirstSlope(time @ readings / spread, spread, np.ptp(stamps) * 1e-9)

    def _size_at_start(self) -> SlopeError:
        """
        Return the size of the derivative before the kind of the stamps is known.

        ``E[alpha alpha'] = b b' + N / Sxx`` with the slope b of `_slope_at_start`.
        """
        first = self._slope_at_start()
        if first.seconds < START_SPAN[0]:
            return SlopeError(POSSIBLE**2 * np.eye(3), weights=np.zeros(1))
        moment = np.outer(first.slope, first.slope)
        return SlopeError(moment, -1.0 / first.spread, np.zeros(1))

    def _size(self, recent: np.ndarray) -> SlopeError:
        """
        Return the size of the derivative: the mean square of recent ones.

        `recent` are recent derivatives, shape (n, 3), `UNKNOWN` among them; without a derivative in
        use recent rates, whose differences over `ROUGH_SLOPE_SECONDS` take its place.
        """
        if self.derivative is not None:
            slopes = _without_unknown(recent)
            if len(slopes):
                weights = self.derivative.weights
                return SlopeError(_mean_square(slopes), float(weights @ weights))
            return self._size_before or SlopeError(POSSIBLE**2 * np.eye(3))

        # Differences of rates, by the mean step between their stamps.
        step = np.diff(np.array(list(self._stamps)[-len(recent) :], np.int64))
        step = step[np.abs(step) <= PAUSE_NS]
        period = max(float(step.mean()) * 1e-9, 0.0) if len(step) else 0.0
        if len(recent) < 3 or not period:
            return SlopeError(POSSIBLE**2 * np.eye(3))
        lag = int(min(max(round(ROUGH_SLOPE_SECONDS / period), 1), len(recent) - 2))
        slopes = (recent[lag:] - recent[:-lag]) / (lag * period)
        return SlopeError(_mean_square(slopes), 2.0 / (lag * period) ** 2)

    def _push_counted(
        self, tracker: StampedDerivative | TimedDerivative, step_ns: int, reading: tuple
    ) -> tuple:
        """
        Return the derivative after a sample that is counted.

        After a step longer than the scatter of the stamps samples may be lost, or one stamp was
        late. The derivative is kept until a later stamp decides; the window is restarted when half
        a window of samples has not decided, or at once where the step exceeds a window.
        """
        self._undecided_ns = step_ns + (self._undecided_ns if self._undecided_rates else 0)
        self._undecided_rates.append(reading)
        # Time that the undecided samples may need if none between them is lost.
        most_ns = self._max_step_ns + 1e9 * tracker.period * (len(self._undecided_rates) - 1)
        none_lost = -RESET_NS < step_ns and self._undecided_ns <= most_ns
        if not none_lost:
            # A later stamp may still show that this one was late.
            is_within_window = self._undecided_ns <= most_ns + 1e9 * tracker.period * tracker.taps
            is_undecided = step_ns > 0 and is_within_window
            if is_undecided and 2 * len(self._undecided_rates) <= tracker.taps:
                return self._slope
            # Samples are lost: numbers with a gap of a window restart the derivative.
            self._n_counted += tracker.taps
        slope = self._slope
        for x, y, z in self._undecided_rates:
            self._n_counted += 1
            slope = tracker.push(round(self._n_counted * 1e9 * tracker.period), x, y, z)
        self._undecided_rates = []
        return slope

    def _review(self) -> None:
        """Classify the latest stamps again, and use the derivative for a new class."""
        # The first block after a change shows the error of the new derivative.
        if self.line is not None and self._is_unreviewed:
            self._is_unreviewed = False
            self._notify()

        # Class of the last block, or where that is not sufficient of all stored stamps.
        stamps = np.array(self._stamps, np.int64)
        last_block = stamps[-CLOCK_BLOCK - 1 :]
        if self.line is None:
            self._n_until_review = stamping.MIN_PERIOD_STEPS
            line = describe_stamps(stamps)
        else:
            self._n_until_review = CLOCK_BLOCK
            if self.line.word == REGULAR and _has_clock_steps(last_block, self.line.period_ns):
                return
            line = None
            # Counted stamps may appear regular for some time; regular ones are identified at once.
            if self.line.word != COUNTED:
                line = describe_stamps(last_block)
            if line is None and len(stamps) == REVIEWED_STAMPS:
                line = describe_stamps(stamps)
        if line is None:  # too few stamps
            if self.line is None:
                self._notify()  # so that the covariances contain the size of the derivative
            return

        # Independent steps appear counted in one of four reviews: several must agree.
        word_before = None if self.line is None else self.line.word
        becomes_counted = word_before == IRREGULAR and line.word == COUNTED
        if becomes_counted and self._tracker is not None:
            self._n_agreeing += 1
            if self._n_agreeing < AGREE:
                return
        self._n_agreeing = 0

        # Another class or another period.
        if line.word != word_before or not self._is_kept_for(line):
            self.settle(line)
        self._n_until_review = CLOCK_BLOCK

    def _end_of_regular(self, stamp_ns: np.ndarray, values: np.ndarray, start: int) -> int:
        """
        Return the first sample of a block, from `start` on, that `push` has to process.

        It repeats a stamp, or its review may change the class of the stamps; before it only the
        window moves.
        """
        if self.line is None or self.line.word != REGULAR:
            return start
        earlier = np.array(self._stamps, np.int64)[-CLOCK_BLOCK:]
        stamps = np.concatenate([earlier, stamp_ns[start:]])

        # Samples are numbered from `start` below. A repeated stamp may be the same message again,
        # which `push` recognises by its reading.
        stop = len(values) - start
        repeated = np.flatnonzero(np.diff(stamps) == 0) + 1 - len(earlier)
        repeated = repeated[repeated >= 0]
        if len(repeated):
            stop = int(repeated[0])

        # A review reads the stamps of its sample and of the CLOCK_BLOCK samples before.
        reviewed = np.arange(self._n_until_review - 1, stop, CLOCK_BLOCK)
        first_stamp = reviewed + len(earlier) - CLOCK_BLOCK
        may_change = first_stamp < 0  # too few stamps
        indices = first_stamp[~may_change, None] + np.arange(CLOCK_BLOCK + 1)
        may_change[~may_change] = ~_has_clock_steps(stamps[indices], self.line.period_ns)
        if may_change.any():
            stop = int(reviewed[may_change][0])
        return start + stop

    def _store_block(
        self, stamp_ns: np.ndarray, reading: np.ndarray, slopes: np.ndarray, recent: np.ndarray
    ) -> None:
        """
        Store the state after a block that was processed at once.

        Parameters
        ----------
        stamp_ns : ndarray, shape (n,)
        reading : ndarray, shape (3,)
            Rate of the last sample.
        slopes, recent : ndarray, shape (n, 3)
            Derivatives; in `recent` they are `UNKNOWN` where the window was not full.

        """
        self._stamps.extend(stamp_ns[-REVIEWED_STAMPS:].tolist())
        self._newest_ns = int(stamp_ns[-1])
        self._newest_rate = tuple(reading.tolist())
        self._slope = tuple(slopes[-1].tolist())
        self._n_until_review = (self._n_until_review - len(stamp_ns) - 1) % CLOCK_BLOCK + 1
        self._recent.extend(recent)


def _is_frozen(line: StampLine) -> bool:
    """Return whether irregular stamps advance too slowly for a derivative."""
    return line.word == IRREGULAR and line.period_ns < FASTEST_NS


def _has_clock_steps(stamps: np.ndarray, period_ns: float) -> np.ndarray:
    """
    Return whether stamps, shape (..., n), are from a clock of that period, without a missing one.
    """
    step = np.diff(stamps, axis=-1)
    none_lost = np.all(stamping.is_regular(step, period_ns), axis=-1)
    mean_step = (stamps[..., -1] - stamps[..., 0]) / (period_ns * max(step.shape[-1], 1))
    return none_lost & (np.abs(mean_step - 1) <= CHANGED[REGULAR])  # in periods


def _without_unknown(rows: np.ndarray) -> np.ndarray:
    """Return the rows without `UNKNOWN`."""
    return rows[np.isfinite(rows).all(axis=1)]


def _mean_square(rows: np.ndarray) -> np.ndarray:
    """Return the mean of ``row row'``, shape (3, 3), of rows, shape (n, 3)."""
    return rows.T @ rows / len(rows)
