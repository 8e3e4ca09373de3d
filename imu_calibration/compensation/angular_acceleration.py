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
    Return the shortest window with little enough noise through the arm.

    The noise of the window, through the arm, is below a third of the accelerometer's noise.

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
    candidates = [CausalDerivative(taps, period) for taps in range(2, longest + 1)]
    return next(
        (each for each in candidates if each.noise_sd(rate_sd) * arm <= force_sd / 3),
        candidates[-1],
    )


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
        self.taps, self.period = derivative.taps, derivative.period
        self._period_ns = derivative.period * 1e9
        self._least = max(2, (self.taps + 1) // 2)
        self._scale = [
            0.0,
            0.0,
            *(12.0 / (n * (n * n - 1.0)) / self.period for n in range(2, self.taps + 1)),
        ]
        self._restart()
        self._newest: int | None = None
        self.alpha: tuple = NO_SLOPE

    def _restart(self):
        self._window = deque()
        self._sums = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._age = 0

    @property
    def n_used(self) -> int:
        """Number of samples in the derivative of now; 0 while there are too few of them."""
        return len(self._window) if len(self._window) >= self._least else 0

    def push(self, stamp_ns: int, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Return the derivative (x, y, z) after one more sample, per second."""
        if self._newest is not None:
            step = (stamp_ns - self._newest) / self._period_ns
            if not MIN_REGULAR_STEP < step <= MAX_REGULAR_STEP:
                if step <= 0 and stamp_ns - self._newest > -RESET_NS:
                    return self.alpha
                if (
                    step <= 0
                    or (step > MAX_REGULAR_STEP and abs(step - round(step)) <= WHOLE_GAP_SHARE)
                    or step > MAX_LATE_STEP
                ):
                    self._hole(step, x, y, z)
        self._newest = stamp_ns
        self._add(x, y, z)
        n = len(self._window)
        if n < self._least:
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

    def _add(self, x, y, z):
        """Slide the window: S = sum of v_k, P = sum of k v_k, k from the oldest."""
        window = self._window
        sx, sy, sz, px, py, pz = self._sums
        n = len(window)
        if n == self.taps:
            ox, oy, oz = window.popleft()
            sx = sx - ox
            sy = sy - oy
            sz = sz - oz
            n = n - 1
            px = px - sx
            py = py - sy
            pz = pz - sz
        window.append((x, y, z))
        self._sums = (sx + x, sy + y, sz + z, px + n * x, py + n * y, pz + n * z)
        self._age += 1
        if self._age >= MAX_SUM_AGE:
            self._refresh()

    def _refresh(self):
        values = np.array(self._window).reshape(-1, 3)
        self._sums = (*values.sum(axis=0).tolist(), *(np.arange(len(values)) @ values).tolist())
        self._age = 0

    def _hole(self, step, x, y, z):
        missing = round(step) - 1
        if not self._window or step < 0 or missing >= self.taps:
            self._restart()
            return
        ox, oy, oz = self._window[-1]
        for k in range(1, missing + 1):
            part = k / (missing + 1)
            self._add(ox + part * (x - ox), oy + part * (y - oy), oz + part * (z - oz))

    def rebase(self, stamp_ns: int) -> None:
        """Change the time of the newest sample."""
        self._newest = stamp_ns

    def seed(self, other: 'StampedDerivative') -> None:
        """
        Copy the past of another derivative of the same stream, within the length of this window.
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
        bounds = np.concatenate(
            [
                [0],
                1 + np.flatnonzero((steps <= MIN_REGULAR_STEP) | (steps > MAX_REGULAR_STEP)),
                [len(values)],
            ]
        )
        for start, end in zip(bounds[:-1].tolist(), bounds[1:].tolist()):
            for k in range(start, end):
                if k == start + self.taps + 1 and self._newest == stamp_ns[k - 1]:
                    self._regular(stamp_ns, values, k, end, out)
                    full[k:end] = True
                    break
                out[k] = self.push(int(stamp_ns[k]), *values[k].tolist())
                full[k] = self.n_used == self.taps
        return out

    def _regular(self, stamp_ns, values, start, end, out):
        """
        Fill out[start:end].

        Where every step is regular and the window is full of samples of this very stretch.
        """
        taps = self.taps
        index = (taps - 1) / 2 - np.arange(taps)
        stretch = values[start - taps + 1 : end]
        out[start:end] = np.stack(
            [np.convolve(axis, index * self._scale[taps], 'valid') for axis in stretch.T], axis=1
        )
        self._newest, self.alpha = int(stamp_ns[end - 1]), tuple(out[end - 1].tolist())
        self._window = deque(map(tuple, values[end - taps : end].tolist()))
        self._refresh()


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
        self.taps, self.period = derivative.taps, derivative.period
        self._enough = self.taps * (self.taps**2 - 1) / 12 * self.period**2 * 1e18
        self._stamps: deque[int] = deque()
        self._values: deque[tuple] = deque()
        self.alpha: tuple = NO_SLOPE
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
        past = np.array([stamp_ns - other for other in reversed(self._stamps)], float)
        spread = np.cumsum(past**2) - np.cumsum(past) ** 2 / np.arange(1, len(past) + 1)
        n = min(int(np.searchsorted(spread, self._enough)) + 1, len(past))
        for _ in range(len(past) - n):
            self._stamps.popleft()
            self._values.popleft()
        if 8 * spread[n - 1] < self._enough:
            self.alpha, self.n_used = NO_SLOPE, 0
        else:
            # Sxx of n equal steps is about n^3 / 12.
            share = min(float(spread[n - 1]) / self._enough, 1.0)
            self.n_used = min(max(round(self.taps * share ** (1 / 3)), 2), self.taps)
            values = np.array(self._values)[::-1]
            self.alpha = tuple(
                (-1e9 * (past[:n] - past[:n].mean()) @ values / spread[n - 1]).tolist()
            )
        return self.alpha

    def seed(self, other: 'TimedDerivative') -> None:
        """Copy the past of another derivative of the same stream."""
        self._stamps, self._values, self.alpha = (
            other._stamps.copy(),
            other._values.copy(),
            other.alpha,
        )
        self.n_used = min(other.n_used, self.taps)


def typical_period(stamp_ns: Sequence[float] | np.ndarray) -> float | None:
    """Return the median of the steps ahead between stamps, s; None without one."""
    steps = np.diff(np.asarray(stamp_ns, np.int64))
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if len(steps) else None
