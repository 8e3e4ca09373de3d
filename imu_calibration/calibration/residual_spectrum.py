"""Amplitude spectral density of the residuals within moving windows: lines indicate causes, the floor is the noise."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.effects.base import SENSORS
from imu_calibration.preprocessing.window import Window

LONGEST = 1024
"""Most samples of a segment: a finer resolution than that of a recording of a minute is not useful."""
SHORTEST = 64
"""Windows with fewer samples are left out."""


def residual_spectrum(result: CalibrationResult, windows: Sequence[Window]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """
    Return (frequency, sensor -> density) of the residuals of the windows with motion among some.

    Welch's method [1]: the power of segments of one length, each about its own mean, averaged over all windows.

    Parameters
    ----------
    result : CalibrationResult
        The calibration that predicts them.
    windows : sequence of Window
        With their samples.

    Returns
    -------
    frequency : ndarray
        Above zero, Hz, shape (n,); none where no window is long enough.
    dict
        Sensor -> one-sided amplitude density, (m/s^2)/sqrt(Hz) or (rad/s)/sqrt(Hz), shape (n, 3).

    References
    ----------
    .. [1] P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70-73.

    """
    windows = [window for window in windows if window.kind != 'static' and len(window) >= SHORTEST]
    if not windows:
        return np.zeros(0), {sensor: np.zeros((0, 3)) for sensor in SENSORS}
    segment = min(LONGEST, int(np.median([len(window) for window in windows])))
    windows = [window for window in windows if len(window) >= segment]
    rate = 1 / float(np.median([window.period for window in windows]))
    weights = np.array([len(window) for window in windows], float)
    residuals = [result.residuals_of(window) for window in windows]
    density = {}
    for sensor in SENSORS:
        spectra = [_power(own[sensor], rate, segment) for own in residuals]
        density[sensor] = np.sqrt(np.average(spectra, axis=0, weights=weights))[1:]
    return np.fft.rfftfreq(segment, 1 / rate)[1:], density


def _power(values, rate, segment):
    """
    Return the one-sided power density, shape (segment // 2 + 1, 3), by segments that overlap by half under a Hann window.

    As ``scipy.signal.welch``, whose import takes longer than the figure.
    """
    pieces = np.lib.stride_tricks.sliding_window_view(values, segment, axis=0)[::segment - segment // 2]
    hann = np.hanning(segment + 1)[:-1]
    power = (np.abs(np.fft.rfft((pieces - pieces.mean(axis=-1, keepdims=True)) * hann))**2).mean(axis=0).T / (rate * (hann**2).sum())
    power[1:-1 if segment % 2 == 0 else None] *= 2
    return power
