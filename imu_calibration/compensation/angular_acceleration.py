"""Angular acceleration from the measured rate: a causal filter whose delay and noise are known."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.preprocessing.stamping import MAX_REGULAR_STEP, MIN_REGULAR_STEP


@dataclass(frozen=True)
class CausalDerivative:
    """
    Slope of a straight line through the last `taps` samples of the rate.

    The slope is that of the middle of the window: the delay is ``(taps - 1) / 2`` periods. The
    noise of the slope is ``rate_sd * sqrt(12 / (taps (taps^2 - 1))) / period``, the smallest that a
    linear filter of that length can have.
    """

    taps: int
    """Number of samples, at least 2."""
    period: float
    """Sampling period, s."""

    @property
    def delay(self) -> float:
        """Delay of the angular acceleration, s."""
        return (self.taps - 1) / 2 * self.period

    @property
    def weights(self) -> np.ndarray:
        """Weights of the newest to the oldest sample, 1/s, shape (taps,)."""
        index = (self.taps - 1) / 2 - np.arange(self.taps)
        return index / (index @ index) / self.period

    def noise_sd(self, rate_sd: float) -> float:
        """
        Return the standard deviation of the angular acceleration for white rate noise, rad/s^2.
        """
        return rate_sd * np.sqrt(12.0 / (self.taps * (self.taps**2 - 1.0))) / self.period


MAX_DERIVATIVE_DELAY = 0.02
"""The window of a derivative does not grow beyond this delay, s."""


def choose_derivative(
    period: float, rate_sd: float, arm: float, *, force_sd: float
) -> CausalDerivative:
    """
    Return the shortest derivative whose noise times the arm is at most ``force_sd / 3``.

    Parameters
    ----------
    period : float
        Sampling period, s.
    rate_sd, force_sd : float
        Noise of single samples, rad/s and m/s^2; when one is unknown (zero) the window has half the
        largest delay.
    arm : float
        Longest corrected lever arm, m.

    """
    longest = max(2, int(2 * MAX_DERIVATIVE_DELAY / period) + 1)
    if not (rate_sd > 0 and force_sd > 0):
        return CausalDerivative((longest + 2) // 2, period)
    for taps in range(2, longest):
        derivative = CausalDerivative(taps, period)
        if derivative.noise_sd(rate_sd) * arm <= force_sd / 3:
            return derivative
    return CausalDerivative(longest, period)


RESET_NS = 1_000_000_000
"""A larger step back is a reset of the clock, a smaller one a late sample."""


MAX_SUM_AGE = 1000
"""The running sums are recomputed after this many samples, so that rounding does not accumulate."""
NO_SLOPE = (0.0, 0.0, 0.0)
WHOLE_GAP_SHARE, MAX_LATE_STEP = 0.25, 3.5
"""
A longer step is a gap if it is within this share of a whole number of periods, or longer than this
many of them.
"""


class StampedDerivative:
    """
    Slope of a straight line through the last samples of a vector.

    It is updated one sample or one block at a time.

    The samples count as equally spaced, as from a sensor with its own clock, independent of the
    jitter of their stamps; the stamps show missing samples: a step of about a whole number of
    periods; otherwise a stamp was late. A gap shorter than the window is bridged by a straight
    line; after a longer one, or when the clock is set back by more than a second, the window
    restarts. A duplicate or late sample does not enter the window and gets the derivative of the
    newest one. While the window is less than half full the derivative is zero.

    Parameters
    ----------
    derivative : differentiation.CausalDerivative
        Window and period.

    """

    def __init__(self, derivative: CausalDerivative):
        self.taps = derivative.taps
        self.period = derivative.period
        self._period_ns = derivative.period * 1e9
        self._min_samples = max(2, (self.taps + 1) // 2)
        """Samples from which the derivative is not zero."""
        self._scale = [0.0, 0.0]
        """
        ``1 / (Sxx period)`` of n samples at index n, with ``Sxx = n (n^2 - 1) / 12`` of the numbers
        of the samples, 1/s.
        """
        for n in range(2, self.taps + 1):
            self._scale.append(12.0 / (n * (n * n - 1.0)) / self.period)
        self._restart()
        self._newest: int | None = None
        """Stamp of the newest sample, ns."""
        self.alpha: tuple = NO_SLOPE
        """Derivative after the newest sample, per second."""

    def _restart(self) -> None:
        """Empty the window."""
        self._window: deque[tuple[float, float, float]] = deque()
        """Samples of the window, the oldest first."""
        self._sums = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        """``S = sum v_k`` and ``P = sum k v_k`` per axis, k from the oldest sample."""
        self._sum_age = 0
        """Samples since the sums were recomputed."""

    @property
    def n_used(self) -> int:
        """Number of samples in the present derivative; 0 while there are too few of them."""
        return len(self._window) if len(self._window) >= self._min_samples else 0

    def push(self, stamp_ns: int, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Return the derivative (x, y, z) after one more sample, per second."""
        if self._newest is not None:
            step = (stamp_ns - self._newest) / self._period_ns
            if not MIN_REGULAR_STEP < step <= MAX_REGULAR_STEP:
                # A duplicate or late sample.
                if step <= 0 and stamp_ns - self._newest > -RESET_NS:
                    return self.alpha
                is_reset = step <= 0
                is_whole = step > MAX_REGULAR_STEP and abs(step - round(step)) <= WHOLE_GAP_SHARE
                if is_reset or is_whole or step > MAX_LATE_STEP:
                    self._bridge_gap(step, x, y, z)
        self._newest = stamp_ns
        self._add(x, y, z)
        n = len(self._window)
        if n < self._min_samples:
            self.alpha = NO_SLOPE
        else:
            sx, sy, sz, px, py, pz = self._sums
            middle = 0.5 * (n - 1)
            scale = self._scale[n]
            self.alpha = (
                (px - middle * sx) * scale,
                (py - middle * sy) * scale,
                (pz - middle * sz) * scale,
            )
        return self.alpha

    def _add(self, x: float, y: float, z: float) -> None:
        """Add a sample v_n to the window: S += v_n, P += n v_n; of a full one drop the oldest."""
        window = self._window
        sx, sy, sz, px, py, pz = self._sums
        n = len(window)
        if n == self.taps:
            ox, oy, oz = window.popleft()
            sx = sx - ox
            sy = sy - oy
            sz = sz - oz
            n = n - 1
            # The number k of each remaining sample falls by one.
            px = px - sx
            py = py - sy
            pz = pz - sz
        window.append((x, y, z))
        self._sums = (sx + x, sy + y, sz + z, px + n * x, py + n * y, pz + n * z)
        self._sum_age += 1
        if self._sum_age >= MAX_SUM_AGE:
            self._recompute_sums()

    def _recompute_sums(self) -> None:
        """Compute S and P from the window."""
        values = np.array(self._window).reshape(-1, 3)
        self._sums = (*values.sum(axis=0).tolist(), *(np.arange(len(values)) @ values).tolist())
        self._sum_age = 0

    def _bridge_gap(self, step: float, x: float, y: float, z: float) -> None:
        """Interpolate the missing samples before (x, y, z), `step` periods after the newest one."""
        n_missing = round(step) - 1
        # After a clock that was set back, or a gap of a window, the past is of no use.
        if not self._window or step < 0 or n_missing >= self.taps:
            self._restart()
            return
        ox, oy, oz = self._window[-1]
        for k in range(1, n_missing + 1):
            part = k / (n_missing + 1)
            self._add(ox + part * (x - ox), oy + part * (y - oy), oz + part * (z - oz))

    def rebase(self, stamp_ns: int) -> None:
        """Change the time of the newest sample."""
        self._newest = stamp_ns

    def seed(self, other: 'StampedDerivative') -> None:
        """
        Add the window of another derivative of the same stream, within the length of this window.
        """
        self._newest = other._newest
        for x, y, z in list(other._window)[-self.taps :]:
            self._add(x, y, z)

    def push_block(
        self, stamp_ns: np.ndarray, values: np.ndarray, full: np.ndarray | None = None
    ) -> np.ndarray:
        """
        Return the derivatives after each of the samples of a block, shape (n, 3).

        The same as `push` one by one.

        Parameters
        ----------
        stamp_ns : ndarray, shape (n,)
        values : ndarray, shape (n, 3)
        full : ndarray of bool, shape (n,), optional
            Becomes true where the window was full.

        """
        if full is None:
            full = np.empty(len(values), bool)
        out = np.empty(values.shape)
        steps = np.diff(stamp_ns) / self._period_ns
        is_irregular = (steps <= MIN_REGULAR_STEP) | (steps > MAX_REGULAR_STEP)
        starts = [0, *(1 + np.flatnonzero(is_irregular)).tolist()]
        ends = [*starts[1:], len(values)]
        for start, end in zip(starts, ends):
            for k in range(start, end):
                # From here on the window contains regular samples of this stretch only: its first
                # one, after an irregular step, has left it. The newest stamp is another one if the
                # sample before was late and did not enter.
                if k == start + self.taps + 1 and self._newest == stamp_ns[k - 1]:
                    self._push_regular(stamp_ns, values, k, end, out)
                    full[k:end] = True
                    break
                out[k] = self.push(int(stamp_ns[k]), *values[k].tolist())
                full[k] = self.n_used == self.taps
        return out

    def _push_regular(
        self, stamp_ns: np.ndarray, values: np.ndarray, start: int, end: int, out: np.ndarray
    ) -> None:
        """
        Fill out[start:end] with the derivatives at regular samples, by a convolution.

        Requires regular steps also between the samples of the window before `start`.
        """
        # Slope of a full window, with the weights of the newest to the oldest sample.
        taps = self.taps
        index = (taps - 1) / 2 - np.arange(taps)
        stretch = values[start - taps + 1 : end]
        out[start:end] = np.stack(
            [np.convolve(axis, index * self._scale[taps], 'valid') for axis in stretch.T], axis=1
        )
        # The state after the last sample.
        self._newest = int(stamp_ns[end - 1])
        self.alpha = tuple(out[end - 1].tolist())
        self._window = deque(map(tuple, values[end - taps : end].tolist()))
        self._recompute_sums()


class TimedDerivative:
    """
    Slope of a straight line through the last samples, for irregular sampling.

    The line through the samples of a vector is fitted by least squares over their stamps.

    ``slope = sum((t_k - mean t) v_k) / Sxx``, ``Sxx = sum((t_k - mean t)^2)``. The window is the
    shortest with at least the Sxx of `derivative` at equal steps: its noise does not exceed that of
    `derivative`, and the mean delay is about the same. A sample whose stamp is earlier than the
    newest stamp is not used. A step of more than two windows and 16 periods restarts the window, as
    does a clock set back by more than a second; the derivative is zero until Sxx equals that of
    half a window.

    Parameters
    ----------
    derivative : differentiation.CausalDerivative
        Window at equal steps, and the mean period.

    """

    def __init__(self, derivative: CausalDerivative):
        self.taps = derivative.taps
        self.period = derivative.period
        self._full_spread = self.taps * (self.taps**2 - 1) / 12 * self.period**2 * 1e18
        """Sxx of `derivative` at equal steps, ns^2."""
        self._stamps: deque[int] = deque()
        """Stamps of the window, ns, the oldest first."""
        self._values: deque[tuple] = deque()
        """Samples at these stamps."""
        self.alpha: tuple = NO_SLOPE
        """Derivative after the newest sample, per second."""
        self.n_used = 0
        """
        Number of samples of the derivative at equal steps with that noise; 0 without a derivative.
        """

    def push(self, stamp_ns: int, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Return the derivative (x, y, z) after one more sample, per second."""
        if self._stamps:
            step_ns = stamp_ns - self._stamps[-1]
            if -RESET_NS < step_ns <= 0:
                return self.alpha
            if not 0 < step_ns <= 2e9 * max(self.taps, 8) * self.period:
                self._stamps.clear()
                self._values.clear()
        self._stamps.append(stamp_ns)
        self._values.append((x, y, z))

        # The shortest window with the Sxx of a full one: Sxx of the newest 1, 2, ... samples.
        age_ns = np.array([stamp_ns - earlier_ns for earlier_ns in reversed(self._stamps)], float)
        spreads = np.cumsum(age_ns**2) - np.cumsum(age_ns) ** 2 / np.arange(1, len(age_ns) + 1)
        n = min(int(np.searchsorted(spreads, self._full_spread)) + 1, len(age_ns))
        spread = spreads[n - 1]
        for _ in range(len(age_ns) - n):
            self._stamps.popleft()
            self._values.popleft()

        # Sxx of n equal steps is about n^3 / 12: half a window has an eighth.
        if 8 * spread < self._full_spread:
            self.alpha = NO_SLOPE
            self.n_used = 0
            return self.alpha
        # Number of samples at equal steps with about this Sxx, and therefore this noise.
        share = min(float(spread) / self._full_spread, 1.0)
        self.n_used = min(max(round(self.taps * share ** (1 / 3)), 2), self.taps)
        values = np.array(self._values)[::-1]
        age_ns = age_ns[:n]
        self.alpha = tuple((-1e9 * (age_ns - age_ns.mean()) @ values / spread).tolist())
        return self.alpha

    def seed(self, other: 'TimedDerivative') -> None:
        """Copy the past of another derivative of the same stream."""
        self._stamps = other._stamps.copy()
        self._values = other._values.copy()
        self.alpha = other.alpha
        self.n_used = min(other.n_used, self.taps)


def typical_period(stamp_ns: Sequence[float] | np.ndarray) -> float | None:
    """Return the median of the positive steps between stamps, s; None without one."""
    steps = np.diff(np.asarray(stamp_ns, np.int64))
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if len(steps) else None
