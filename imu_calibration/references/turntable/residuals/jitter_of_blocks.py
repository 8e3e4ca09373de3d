"""Errors of the stamps from the scatter of blocks in motion."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.selection.stamp_jitter import StampJitter

JITTER_STEPS = 6
"""Steps in which the noise at rest and the variance of the stamps are estimated in turn."""
BOUND_SDS = 3.0
"""
Standard deviations above its own estimate to which a sensor limits the variance of the stamps.
"""
CLEAR_SDS = 5.0
"""Standard deviations from which the scatter of a sensor shows errors of the stamps."""
ALIKE_VARIANCES = 0.3
"""Largest relative difference of the variances of the stamps by the two sensors."""
MEDIAN_SD = np.sqrt(np.pi / 2)
"""Standard deviation of a median over that of a mean, Gaussian."""


def stamp_jitter(
    rough: Sequence[np.ndarray], slope: Sequence[np.ndarray], freedom: np.ndarray
) -> StampJitter:
    """
    Return the errors of the stamps from the scatter in motion.

    The sample of a stamp with the error d has the residual ``d dy/dt``. Errors of variance v add
    ``v mean((dy/dt)^2)`` to the variance within a block, with the same v on all axes of both
    sensors. Each sensor estimates v as the weighted median of ``(variance - noise) /
    mean((dy/dt)^2)``; a sensor whose slopes show a smaller v limits that of the other one, because
    scatter that only one sensor has is not an error of the stamps.

    Parameters
    ----------
    rough : sequence of ndarray, shape (b, 3)
        Per sensor the variance within the blocks by second differences, SI.
    slope : sequence of ndarray, shape (b, 3)
        Per sensor the mean square of the predicted output's rate of change, SI.
    freedom : ndarray, shape (b,)
        Degrees of freedom of the variances.

    """
    # Estimate of each sensor with its standard deviation, s^2.
    estimates = [
        _stamp_variance(rough_of_sensor, slope_of_sensor, freedom)
        for rough_of_sensor, slope_of_sensor in zip(rough, slope, strict=True)
    ]
    value, sd = np.array(estimates).T

    # The weighted mean, within the limit of each sensor.
    mean = np.average(value, weights=1 / sd**2)
    variance = max(min(mean, *(value + BOUND_SDS * sd)), 0.0)

    # Clear: every sensor shows the errors, and all agree on their variance.
    difference = np.abs(value - variance)
    alike = (difference < BOUND_SDS * sd) | (difference < ALIKE_VARIANCES * variance)
    clear = bool(np.all(value > CLEAR_SDS * sd) and alike.all())
    return StampJitter(float(np.sqrt(variance)), clear)


def jitter_ratio(rough: np.ndarray, slope: np.ndarray, jitter: float) -> np.ndarray:
    """
    Return the variance of noise and stamp errors together over that of the noise, shape (b, 3).

    With the mean square slope of each block, and the noise variance of each axis::

        ratio = 1 + jitter^2 slope / noise

    Parameters
    ----------
    rough, slope : ndarray, shape (b, 3)
        As for `stamp_jitter`, of one sensor.
    jitter : float
        Standard deviation of the errors of the stamps, s.

    """
    return 1.0 + jitter**2 * slope / _noise(rough, slope, jitter**2)


def _noise(rough: np.ndarray, slope: np.ndarray, variance: float) -> np.ndarray:
    """
    Return the noise of each axis, shape (3,), with the `variance` of the stamps subtracted.

    It is the median over the half of the blocks with the smaller slopes.
    """
    flat = slope <= np.median(slope, axis=0)
    noise = np.where(flat, np.maximum(rough - variance * slope, 0.0), np.nan)
    return np.maximum(np.nanmedian(noise, axis=0), 1e-3 * np.median(rough, axis=0))


def _stamp_variance(
    rough: np.ndarray, slope: np.ndarray, freedom: np.ndarray
) -> tuple[float, float]:
    """
    Return (variance of the stamps by one sensor, its standard deviation), s^2.

    Noise n and variance v are estimated in turn: v is the median of ``(rough - n) / slope`` over
    all blocks and axes, weighted by the inverse sd of that ratio, ``slope sqrt(f / 2) / (n + v
    slope)``. The median of chi-square over its degrees of freedom f is ``(1 - 2 / (9 f))^3``
    (Wilson and Hilferty, Proc. Natl. Acad. Sci. 17, 1931).
    """
    # The median of the variances of blocks is then that of the distribution.
    rough = rough / (1.0 - 2.0 / (9.0 * np.maximum(freedom, 1.0)))[:, None] ** 3
    variance = 0.0
    for _ in range(JITTER_STEPS):
        noise = _noise(rough, slope, variance)
        ratio = ((rough - noise) / np.maximum(slope, np.finfo(float).tiny)).ravel()
        weight = (np.sqrt(freedom / 2)[:, None] * slope / (noise + variance * slope)).ravel()
        # Weighted median: half of the weight is below it.
        order = np.argsort(ratio)
        sum_of_weights = np.cumsum(weight[order])
        middle = np.searchsorted(sum_of_weights, sum_of_weights[-1] / 2)
        variance = max(float(ratio[order][middle]), 0.0)
    return variance, MEDIAN_SD / np.sqrt((weight**2).sum() + np.finfo(float).tiny)
