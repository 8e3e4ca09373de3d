"""
The derivative of the measured rate for stamps of any kind.

By equal steps or by least squares over the stamps, and its error.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

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
Seconds, smallest and largest number of samples of which the derivatives are stored: they show how
large it may be after a gap.
"""
PRESENT_SPAN = 1.0
"""Seconds of them, at least the smallest number, that show the error in a full window."""
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
ROUGH = 0.02
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
class MotionEvidence:
    """Rate and its slopes so far, which show whether the rate changes at all."""

    rate: np.ndarray
    """Newest rate less the bias of the gyroscope, rad/s, shape (3,)."""
    moment: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Mean of slope times slope, (rad/s^2)^2, shape (3, 3)."""
    noise_gain: float = 0.0
    """The noise of a slope is this times the covariance of the rate, 1/s^2."""
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
        square below that of the noise is no further evidence.
        """
        if np.min(np.linalg.eigvalsh(rate_cov)) <= 0.0:
            return 1.0
        precision = np.linalg.inv(rate_cov)
        volume = 0.5 * np.linalg.slogdet(rate_cov)[1]
        for_constant = -np.inf
        steady = 0.0
        if self.n_slopes:
            excess = np.trace(precision @ self.moment) / self.noise_gain - 3.0
            noise_volume = volume + 1.5 * np.log(self.noise_gain)
            steady = max(3.0 * np.log(POSSIBLE) - noise_volume, 0.0)
            steady -= 0.5 * self.n_slopes * max(excess, 0.0)
            for_constant = steady
        excess = float(self.rate @ precision @ self.rate) - 3.0
        for_rest = steady + max(3.0 * np.log(POSSIBLE_RATE) - volume, 0.0) - 0.5 * max(excess, 0.0)
        return float(np.exp(-np.logaddexp.reduce([0.0, for_constant, for_rest])))


@dataclass(frozen=True, eq=False)
class SlopeError:
    """Error of the derivative in the present motion, in addition to its noise."""

    moment: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Mean of error times error, noise of the rate included, (rad/s^2)^2, shape (3, 3)."""
    noise_gain: float = 0.0
    """
    That noise is this times the covariance of the rate, 1/s^2.

    Negative where noise is missing in `moment`.
    """
    weights: np.ndarray | None = None
    """
    Weights of the newest to the oldest reading in the derivative, 1/s, shape (n,); None: those of
    the full window.
    """
    evidence: MotionEvidence | None = None
    """What the readings show of a motion; None: it is certain."""

    def covariance(self, rate_cov: np.ndarray) -> np.ndarray:
        """
        Return the covariance of the error without the noise, not negative in any direction.

        Shape (3, 3). Without a motion there is no error: it counts with the chance of a motion.
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


class RateSlope:
    """
    Derivative of the rate of a stream, one sample or one block at a time.

    The outcome does not depend on how the stream is cut.

    Regular stamps show where samples are missing. Where stamps scatter about a clock (packets,
    times of arrival, jitter, in any order) the samples are counted: `_count_on`. Irregular stamps
    are used as they are: least squares over the stamped times. Where stamps are frozen the
    derivative is zero and `error` returns its size. The kind of the stamps is reviewed every
    `CLOCK_BLOCK` samples.

    Parameters
    ----------
    choose : callable
        Returns the CausalDerivative for a period in s.
    changed : callable
        Called when another derivative is in use, or none.
    bias : sequence of 3 floats
        Of the readings, rad/s.

    """

    def __init__(
        self,
        choose: Callable[[float], CausalDerivative],
        changed: Callable[[], None] = lambda: None,
        bias: Sequence[float] = (0.0, 0.0, 0.0),
    ):
        self._choose, self._changed = choose, changed
        self._bias = np.array(bias)
        self.line: StampLine | None = None
        """Class of the stamps; None while they are too few."""
        self.derivative: CausalDerivative | None = None
        """The derivative in use, or None."""
        self._tracker: StampedDerivative | TimedDerivative | None = None
        self._stamps: deque[int] = deque(maxlen=REVIEWED_STAMPS)
        self._due = stamping.MIN_PERIOD_STEPS + 1
        self._newest: int | None = None
        self._reading: tuple = NO_SLOPE
        self._slope: tuple = NO_SLOPE
        self._count = 0
        self._longest_ns = 0.0
        self._young = True
        self._agreeing, self._ahead_ns = 0, 0
        self._doubtful: list[tuple] = []
        self._recent: deque[tuple] = deque(maxlen=RECENT_SPAN[1])
        self._all_of_it: SlopeError | None = None
        self.restarts, self.n_changes = 0, 0
        """Number of windows begun, and of samples after which the error is no longer the same."""
        self._n_young = CLOCK_BLOCK
        """Samples of a new window for which the error is estimated again after each."""
        self._age = 0
        """Samples in the derivative since its window was begun, at most `_n_young`."""
        self.n_without = 0
        """Samples without a derivative because their stamps are frozen."""

    @property
    def period(self) -> float | None:
        """Time between samples, s; None while the stamps are too few."""
        return None if self.line is None else 1e-9 * self.line.period_ns

    @property
    def doubt(self) -> str:
        """Why there is no derivative; '' when there is one, or that is not known yet."""
        return f'{self.line}{WITHOUT}' if self.line is not None and self._tracker is None else ''

    def push(self, stamp_ns: int, x: float, y: float, z: float) -> tuple:
        """Return the derivative (x, y, z) after one more sample, per second."""
        if stamp_ns == self._newest and (x, y, z) == self._reading:  # the same message again
            return self._slope
        step_ns = 0 if self._newest is None else stamp_ns - self._newest
        self._newest = stamp_ns
        self._reading = (x, y, z)
        self._stamps.append(stamp_ns)
        self._due -= 1
        if not self._due:
            self._review()
        if self.line is None and self._begins_equally():
            period_ns = (stamp_ns - self._stamps[0]) / (len(self._stamps) - 1)
            self.settle(StampLine(REGULAR, period_ns))
        if self._tracker is None:
            self.n_without += self.line is not None
            self.n_changes += self.line is None
            self._recent.append((x, y, z))
            return NO_SLOPE
        before = self._tracker.n_used
        if self._longest_ns:
            slope = self._count_on(self._tracker, step_ns, (x, y, z))
        else:
            slope = self._tracker.push(stamp_ns, x, y, z)
        n_used = self._tracker.n_used
        self._slope = slope
        self._recent.append(slope if n_used == self._tracker.taps else UNKNOWN)
        # In a new window each sample changes the derivative's noise, delay and error.
        if n_used < before:
            self.restarts += 1
            self._n_young = self._tracker.taps
        if n_used < before or not n_used:
            self._age = 0
        if self._age < self._n_young:
            self._age += 1
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
            stop = self._usual_until(stamp_ns, values, start)
            if stop > start:
                assert isinstance(self._tracker, StampedDerivative), (
                    'regular stamps have equal steps'
                )
                full = np.empty(stop - start, bool)
                out[start:stop] = self._tracker.push_block(
                    stamp_ns[start:stop], values[start:stop], full
                )
                shown = np.where(full[:, None], out[start:stop], UNKNOWN)
                self._note(stamp_ns[start:stop], values[stop - 1], out[start:stop], shown)
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
        Use the derivative for stamps of that kind.

        The window is kept while the period is unchanged.
        """
        is_first = self.line is None and bool(self._stamps)
        self.line = line
        self._doubtful = []
        self._agreeing = 0
        self._longest_ns = (
            line.high_ns - line.low_ns + stamping.MAX_REGULAR_STEP * line.period_ns
            if line.word == COUNTED
            else 0.0
        )
        if isinstance(self._tracker, StampedDerivative) and self._suits(line):
            self._tracker.rebase(
                round(self._count * 1e9 * self._tracker.period)
                if self._longest_ns
                else self._stamps[-2]
            )
            return
        if is_first:
            self._all_of_it = self._size_at_start()
        else:
            self._all_of_it = self._size_of_all(np.array(self._recent).reshape(-1, 3))
        stamps = list(self._stamps)[:-1]
        readings = list(self._recent)
        self.derivative = self._tracker = None
        if not _stand_still(line):
            self.derivative = self._choose(line.period_ns * 1e-9)
            self._tracker = (TimedDerivative if line.word == IRREGULAR else StampedDerivative)(
                self.derivative
            )
        seconds, least, most = RECENT_SPAN
        self._recent = deque(maxlen=int(min(max(seconds * 1e9 / line.period_ns, least), most)))
        self._slope, self._young = NO_SLOPE, True
        self._age, self._n_young = 0, CLOCK_BLOCK
        # Counted samples need the number of lost ones, which these stamps do not show yet.
        if is_first and self._tracker is not None and not self._longest_ns:
            for stamp_ns, reading in zip(stamps[-len(readings) :], readings[-len(stamps) :]):
                slope = self._tracker.push(stamp_ns, *reading)
                self._recent.append(
                    slope if self._tracker.n_used == self._tracker.taps else UNKNOWN
                )
        self._changed()

    def _suits(self, line: StampLine) -> bool:
        """Return whether the derivative in use suits stamps of that kind."""
        if self._tracker is None or isinstance(self._tracker, TimedDerivative) != (
            line.word == IRREGULAR
        ):
            return self._tracker is None and _stand_still(line)
        return abs(1e-9 * line.period_ns / self._tracker.period - 1) <= CHANGED[line.word]

    def prepare(self, before: 'RateSlope') -> None:
        """Settle for the stamps of another one, with the motion that it has seen."""
        if before.line is not None:
            self.settle(before.line)
            self._all_of_it = before._all_of_it
            self._recent.extend(list(before._recent))

    def follow(self, before: 'RateSlope') -> None:
        """Continue from another one, after `prepare`."""
        self._stamps = before._stamps
        self._due = before._due
        self._count = before._count
        self._newest, self._reading = before._newest, before._reading
        self._agreeing = before._agreeing
        self._ahead_ns = before._ahead_ns
        self._doubtful = before._doubtful
        if self._tracker is not None and isinstance(before._tracker, type(self._tracker)):
            self._tracker.seed(before._tracker)  # type: ignore[arg-type]

    def error(self) -> SlopeError:
        """
        Return the recent error of the derivative.

        The error of a delayed derivative is the change of the true one in that time, estimated a
        delay later: ``alpha(t + delay) - alpha(t)``. Without one the error is the whole derivative:
        its size before the gap, or from the rate over `ROUGH` seconds; also after a change of the
        stamps, until there is new motion. Before any motion was seen it is `POSSIBLE`, unless the
        rates exclude a motion (`MotionEvidence`).
        """
        error = self._error()
        return replace(error, evidence=self._evidence())

    def _evidence(self) -> MotionEvidence | None:
        """Return what the rate and its slopes show of a motion; None without a derivative."""
        if self._newest is None:
            return None
        rate = np.array(self._reading) - self._bias
        if self.line is None:
            # The only slope is the one over all readings.
            first = self._slope_at_start()
            if not first.spread:
                return MotionEvidence(rate)
            moment = np.outer(first.slope, first.slope)
            return MotionEvidence(rate, moment, 1.0 / first.spread, 1.0)
        if self.derivative is None or self._tracker is None:
            return None
        slopes = _known(self._recent_slopes(self._tracker))
        if len(slopes):
            # Slopes of windows that share no reading are independent.
            gain = float(self.derivative.weights @ self.derivative.weights)
            n_slopes = max(len(slopes) / self._tracker.taps, 1.0)
            return MotionEvidence(rate, _moment(slopes), gain, n_slopes)
        weights = CausalDerivative(max(self._tracker.n_used, 2), self._tracker.period).weights
        slope = np.array(self._slope)
        if self._tracker.n_used < 2 or not slope.any():
            return None
        return MotionEvidence(rate, np.outer(slope, slope), float(weights @ weights), 1.0)

    def _error(self) -> SlopeError:
        """Return the error of the derivative if there is a motion."""
        recent = np.array(list(self._recent)).reshape(-1, 3)
        if self.line is None:
            return self._size_at_start()
        if self.derivative is None or self._tracker is None:
            if len(recent) < stamping.MIN_PERIOD_STEPS and self._all_of_it is not None:
                return self._all_of_it
            return self._size_of_all(recent)
        n_used = self._tracker.n_used
        if not n_used:
            return replace(self._size_of_all(recent), weights=np.zeros(1))
        recent = self._recent_slopes(self._tracker)
        # A window with fewer samples has a shorter delay.
        weights = CausalDerivative(n_used, self._tracker.period).weights
        late = (n_used - 1) / 2
        lag = max(round(late + 0.01), 1)
        change = _known(recent[lag:] - recent[:-lag])
        if not len(change):
            if not len(_known(recent)):
                # The first slope of a stream shows the size of the motion, with its own noise.
                slope = np.array(self._slope)
                return SlopeError(np.outer(slope, slope), float(weights @ weights), weights)
            return replace(self._size_of_all(recent), weights=weights)
        share = (late / lag) ** 2
        apart = np.convolve(self.derivative.weights, [1.0] + [0.0] * (lag - 1) + [-1.0])
        return SlopeError(share * _moment(change), share * float(apart @ apart), weights)

    def _recent_slopes(self, tracker: StampedDerivative | TimedDerivative) -> np.ndarray:
        """Return the recent derivatives; of a full window the ones in the present motion."""
        recent = np.array(list(self._recent)).reshape(-1, 3)
        if tracker.n_used < tracker.taps:
            return recent
        n_present = PRESENT_SPAN / tracker.period
        return recent[-int(max(n_present, RECENT_SPAN[1])) :]

    def _slope_at_start(self) -> FirstSlope:
        """
        Return the least-squares slope b over stamps t of the last readings.

        Its covariance is ``N / Sxx``, ``Sxx = sum((t - mean t)^2)``, N the covariance of the rate.
        """
        n = min(len(self._stamps), len(self._recent))
        most = START_SPAN[1]
        stamps = np.array(list(self._stamps)[len(self._stamps) - n :], np.int64)
        readings = np.array(list(self._recent)[len(self._recent) - n :]).reshape(-1, 3)
        if n:
            age = (stamps.max() - stamps) * 1e-9
            stamps = stamps[age <= most]
            readings = readings[age <= most]
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

    def _size_of_all(self, rates: np.ndarray) -> SlopeError:
        """Return the size of the derivative, from rates, or from the derivative in use."""
        if self.derivative is not None:
            slopes = _known(rates)
            if len(slopes):
                weights = self.derivative.weights
                return SlopeError(_moment(slopes), float(weights @ weights))
            return self._all_of_it or SlopeError(POSSIBLE**2 * np.eye(3))
        step = np.diff(np.array(list(self._stamps)[-len(rates) :], np.int64))
        step = step[np.abs(step) <= PAUSE_NS]
        period = max(float(step.mean()) * 1e-9, 0.0) if len(step) else 0.0
        if len(rates) < 3 or not period:
            return SlopeError(POSSIBLE**2 * np.eye(3))
        lag = int(min(max(round(ROUGH / period), 1), len(rates) - 2))
        return SlopeError(
            _moment((rates[lag:] - rates[:-lag]) / (lag * period)), 2.0 / (lag * period) ** 2
        )

    def _count_on(
        self, tracker: StampedDerivative | TimedDerivative, step_ns: int, reading: tuple
    ) -> tuple:
        """
        Return the derivative after a sample that is counted.

        After a step longer than the scatter of the stamps samples may be lost, or one stamp was
        late. The derivative is kept until a later stamp decides; the window is restarted when half
        a window of samples has not decided, or at once where the step exceeds a window.
        """
        self._ahead_ns = step_ns + (self._ahead_ns if self._doubtful else 0)
        self._doubtful.append(reading)
        usual_ns = self._longest_ns + 1e9 * tracker.period * (len(self._doubtful) - 1)
        in_order = -RESET_NS < step_ns and self._ahead_ns <= usual_ns
        may_return = (
            step_ns > 0 and self._ahead_ns <= usual_ns + 1e9 * tracker.period * tracker.taps
        )
        if not in_order and may_return and 2 * len(self._doubtful) <= tracker.taps:
            return self._slope
        self._count += 0 if in_order else tracker.taps
        slope = self._slope
        for x, y, z in self._doubtful:
            self._count += 1
            slope = tracker.push(round(self._count * 1e9 * tracker.period), x, y, z)
        self._doubtful = []
        return slope

    def _review(self) -> None:
        """
        Classify the latest stamps again.

        After the first block following a change, update the error of the derivative.
        """
        if self.line is not None and self._young:
            self._young = False
            self._changed()
        stamps = np.array(self._stamps, np.int64)
        if self.line is None:
            self._due = stamping.MIN_PERIOD_STEPS
            line = describe_stamps(stamps)
        else:
            self._due = CLOCK_BLOCK
            if self.line.word == REGULAR and _usual(
                stamps[-CLOCK_BLOCK - 1 :], self.line.period_ns
            ):
                return
            # Counted stamps may appear regular for some time; regular ones are identified at once.
            line = (
                None if self.line.word == COUNTED else describe_stamps(stamps[-CLOCK_BLOCK - 1 :])
            )
            line = line or (describe_stamps(stamps) if len(stamps) == REVIEWED_STAMPS else None)
        if line is None:
            if self.line is None:
                self._changed()  # so that the omitted part is known
            return
        if (
            self.line is not None
            and (self.line.word, line.word) == (IRREGULAR, COUNTED)
            and self._tracker is not None
        ):
            self._agreeing += 1  # independent steps appear counted in one of four reviews
            if self._agreeing < AGREE:
                return
        self._agreeing = 0
        if self.line is None or line.word != self.line.word or not self._suits(line):
            self.settle(line)
        self._due = CLOCK_BLOCK

    def _usual_until(self, stamp_ns: np.ndarray, values: np.ndarray, start: int) -> int:
        """
        Return the number of samples of a block for which only the window moves.

        No duplicate message, the same class of stamps.
        """
        if self.line is None or self.line.word != REGULAR:
            return start
        before = np.array(self._stamps, np.int64)[-CLOCK_BLOCK:]
        stamps = np.concatenate([before, stamp_ns[start:]])
        step = np.diff(stamps)
        # The counting branch compares their readings.
        again = np.flatnonzero(step[max(len(before) - 1, 0) :] == 0)
        stop = len(values) - start if not len(again) else int(again[0]) + (0 if len(before) else 1)
        due = np.arange(self._due - 1, stop, CLOCK_BLOCK)
        first = due + len(before) - CLOCK_BLOCK
        unusual = first < 0
        unusual[~unusual] = ~_usual(
            stamps[first[~unusual, None] + np.arange(CLOCK_BLOCK + 1)], self.line.period_ns
        )
        return start + (int(due[unusual][0]) if unusual.any() else stop)

    def _note(
        self, stamp_ns: np.ndarray, reading: np.ndarray, slopes: np.ndarray, shown: np.ndarray
    ) -> None:
        """Store the state after a block that was processed as a whole."""
        self._stamps.extend(stamp_ns[-REVIEWED_STAMPS:].tolist())
        self._newest, self._reading, self._slope = (
            int(stamp_ns[-1]),
            tuple(reading.tolist()),
            tuple(slopes[-1].tolist()),
        )
        self._due = (self._due - len(stamp_ns) - 1) % CLOCK_BLOCK + 1
        self._recent.extend(map(tuple, shown[-(self._recent.maxlen or len(shown)) :].tolist()))


def _stand_still(line: StampLine) -> bool:
    return line.word == IRREGULAR and line.period_ns < FASTEST_NS


def _usual(stamps: np.ndarray, period_ns: float) -> np.ndarray:
    """
    Return whether stamps, shape (..., n), are from a clock of that period, without a missing one.
    """
    step = np.diff(stamps, axis=-1)
    within = np.all(stamping.is_regular(step, period_ns), axis=-1)
    return within & (
        np.abs((stamps[..., -1] - stamps[..., 0]) / (period_ns * max(step.shape[-1], 1)) - 1)
        <= CHANGED[REGULAR]
    )


def _known(rows: np.ndarray) -> np.ndarray:
    """Return the rows without `UNKNOWN`."""
    return rows[np.isfinite(rows).all(axis=1)]


def _moment(rows: np.ndarray) -> np.ndarray:
    return rows.T @ rows / len(rows)
