"""
Inputs of effects that depend on past samples.

The branch of a thermal hysteresis, the slope of the temperature, and the running variance of
vibration.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

CORNER = 5.0
"""
Frequency of a triple high pass, whose output is vibration, Hz: gravity rotating at 200 deg/s
contributes 0.02 m/s^2, slow oscillation of joints zero.
"""
MEAN_SQUARE_SECONDS = 0.5
"""Time constant of the running mean of the squared vibration, s: as long as a table settles."""
_STAGES = 3
"""Number of high-pass stages."""


class BandVariance:
    """
    Running variance of specific force above `CORNER`, for each axis.

    ``y = h * h * h * x`` with ``h_k: y_k = a y_(k-1) + (1 + a) / 2 (x_k - x_(k-1))``, ``a = exp(-2
    pi corner dt)``, and ``v_k = b v_(k-1) + (1 - b) y_k^2``, ``b = exp(-dt / memory)``. It is
    causal, uses the measured force sample by sample, and has fifteen state variables; vibration
    above half the sample rate is aliased.
    """

    def __init__(self) -> None:
        self._inputs: list[list[float]] = []
        """
        Last input of each stage, and last output of the last stage, each for three axes; the input
        of a stage is the output of the one before. Empty before the first sample.
        """
        self.now: tuple[float, ...] = (0.0, 0.0, 0.0)
        """Variance of each axis at the last sample, (m/s^2)^2."""

    def push(self, period: float, force: tuple[float, float, float]) -> tuple[float, ...]:
        """
        Process the next sample, `period` s after the last one, and return the variances, (m/s^2)^2.
        """
        if not self._inputs:
            self._begin(force)
        keep, forget = _decays(period)
        gain = 0.5 * (1.0 + keep)
        inputs = self._inputs
        variance = []
        for axis, value in enumerate(force):
            for stage in range(_STAGES):
                # High pass y_k = a y_(k-1) + (1 + a) / 2 (x_k - x_(k-1)); y is the next input x.
                input_before = inputs[stage][axis]
                inputs[stage][axis] = value
                value = keep * inputs[stage + 1][axis] + gain * (value - input_before)
            inputs[_STAGES][axis] = value
            variance.append(forget * self.now[axis] + (1.0 - forget) * value * value)
        self.now = tuple(variance)
        return self.now

    def of(self, period: float, force_s: np.ndarray) -> np.ndarray:
        """Process the next n samples as `push` does, and return the variances, shape (n, 3)."""
        if not len(force_s):
            return np.zeros((0, 3))
        if not self._inputs:
            self._begin(force_s[0].tolist())
        keep, forget = _decays(period)
        gain = 0.5 * (1.0 + keep)
        values = np.asarray(force_s, float)
        for stage in range(_STAGES):
            steps = np.diff(values, axis=0, prepend=[self._inputs[stage]])
            self._inputs[stage] = values[-1].tolist()
            values = autoregressive(gain * steps, keep, self._inputs[stage + 1])
        self._inputs[_STAGES] = values[-1].tolist()
        variance = autoregressive((1.0 - forget) * values**2, forget, self.now)
        self.now = tuple(variance[-1].tolist())
        return variance

    def _begin(self, force: Sequence[float]) -> None:
        """Set the state after a constant force since long before the first sample."""
        self._inputs = [list(force)] + [[0.0, 0.0, 0.0] for _ in range(_STAGES)]


def autoregressive(drive: np.ndarray, decay: float, before: ArrayLike) -> np.ndarray:
    """
    Return ``y_k = decay y_(k-1) + drive_k``, shape (n, m), from ``y_(-1) = before``, shape (m,).

    A unit triangular system with one band below the diagonal, as the import of scipy.signal is
    slow.
    """
    from scipy.linalg.blas import dtbsv

    # The value before the first is part of the first drive. Rows of `band`: the diagonal, then the
    # band below it; `diag`: the diagonal is one.
    drive = np.array(drive, float)
    band = np.tile([[1.0], [-decay]], (1, len(drive)))
    drive[:1] += decay * np.asarray(before)
    return np.stack([dtbsv(1, band, column, lower=1, diag=1) for column in drive.T], axis=1)


def _decays(period: float) -> tuple[float, float]:
    """Return the decay per sample of a high-pass stage, a, and of the running mean, b."""
    return math.exp(-2.0 * math.pi * CORNER * period), math.exp(-period / MEAN_SQUARE_SECONDS)


HALF_WIDTH = 1.0
"""
Half of the play between the branches, K: the temperature reverses by twice this from one branch to
the other. A package needs some kelvins to strain its element in the other direction; the noise and
the steps of thermometers are much smaller.
"""


class ThermalBranch:
    """
    Play operator (Prandtl-Ishlinskii's element) on the temperature.

    With T the reading and p the middle that is dragged along, ``p <- min(max(p, T - w), T + w)``,
    and the branch is ``(T - p) / w``: 1 during warming, -1 during cooling, between them until it
    has reversed by 2 w. It starts at 0, as the earlier temperature is unknown. It does not depend
    on the rate of the temperature, has one state variable, and is causal.
    """

    def __init__(self) -> None:
        self._middle: float | None = None
        """The middle p, degrees Celsius; None before the first reading."""
        self.now = 0.0
        """The branch at the last reading, in [-1, 1]."""

    def push(self, temperature_c: float) -> float:
        """Process the next reading and return the branch, in [-1, 1]."""
        middle = temperature_c if self._middle is None else self._middle
        self._middle = min(max(middle, temperature_c - HALF_WIDTH), temperature_c + HALF_WIDTH)
        self.now = (temperature_c - self._middle) / HALF_WIDTH
        return self.now

    def of(self, temperature_c: np.ndarray) -> np.ndarray:
        """Return the branch at each of the next readings, shape (n,)."""
        return np.array(
            [self.push(reading) for reading in np.asarray(temperature_c, float).tolist()]
        )


SLOPE_SECONDS = 5.0
"""
Time constant of the slope of the temperature, s: readings of a thermometer each second, with noise
of 0.02 K, give it to 4 mK/s; a slope that changes within a minute has little delay.
"""


class TemperatureSlope:
    """
    Slope of the temperature over the last `SLOPE_SECONDS`.

    With T_k the reading at t_k and ``a = exp(-(t_k - t_(k-1)) / SLOPE_SECONDS)``::

        rise_k = a rise_(k-1) + T_k - T_(k-1)
        span_k = a span_(k-1) + t_k - t_(k-1)
        slope_k = rise_k / span_k

    A steady change has its slope from the second reading on; a changing one is late by the time
    constant. It starts at 0, and is causal.
    """

    def __init__(self) -> None:
        self._before: tuple[int, float] | None = None
        """(stamp in ns, temperature in degrees Celsius) of the last reading."""
        self._rise = 0.0
        """Decaying sum of temperature changes, K."""
        self._span = 0.0
        """Decaying sum of time steps, s."""

    def of(self, stamp_ns: np.ndarray, temperature_c: np.ndarray) -> np.ndarray:
        """Return the slope at each of the next readings, K/s, shape (n,)."""
        slopes = []
        for stamp, reading in zip(stamp_ns.tolist(), temperature_c.tolist(), strict=True):
            last_stamp, last_reading = self._before or (stamp, reading)
            seconds = 1e-9 * max(stamp - last_stamp, 0)
            kept = math.exp(-seconds / SLOPE_SECONDS)
            self._rise = kept * self._rise + reading - last_reading
            self._span = kept * self._span + seconds
            self._before = (stamp, reading)
            slopes.append(self._rise / self._span if self._span > 0.0 else 0.0)
        return np.array(slopes)
