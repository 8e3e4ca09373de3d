"""Figures of the residuals: windows before and after calibration with the noise floor, and their autocorrelation."""

import numpy as np

from imu_calibration.calibration.result import CalibrationResult, WindowErrors
from imu_calibration.core.units import for_people
from imu_calibration.effects.base import SENSORS, UNITS
from imu_calibration.report.figures import AXIS_COLOURS, GREY, MARKER, Drawn, axis_legend, draw

LAG_SECONDS = 2.0
"""Longest lag that is drawn."""
MOST_WINDOWS = 60


def residual_figure(result: CalibrationResult) -> Drawn | None:
    """Return the autocorrelation of the residuals as SVG; None without moving windows."""
    if not (traces := autocorrelation(result)):
        return None
    return draw('autocorrelation', (8.6, 2.7), _autocorrelations, traces, label='Autocorrelation of the residuals within moving windows')


def draw_windows(errors: WindowErrors, sensor: str) -> Drawn:
    """Return the errors of raw and corrected readings of one sensor in every held-out window, as SVG."""
    label = f'Errors of raw and corrected readings of the {sensor} in every held-out window'
    return draw(f'residuals-{sensor}', (7.2, 3.6), _windows, errors, sensor, label=label)


def _windows(figure, errors, sensor):
    """Two panels over time: raw, and corrected with the expected residual from noise."""
    factor, unit = for_people(UNITS[sensor])
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1, 1.25])
    _points(upper, errors.time, errors.before[sensor] * factor, hollow=True)
    floor = 2 * errors.floor[sensor].max(axis=1) * factor
    order = np.argsort(errors.time)
    lower.fill_between(errors.time[order], -floor[order], floor[order], step='mid', color='#dfe5ec', lw=0, zorder=0.5)
    _points(lower, errors.time, errors.after[sensor] * factor)
    for axes, title in ((upper, f'{sensor}, raw'), (lower, 'corrected; grey: two sd of the noise')):
        axes.axhline(0, color=GREY, lw=0.6)
        axes.set(title=title, ylabel=unit)
    lower.set_xlabel('time, s')
    axis_legend(upper, 'lower right', bbox_to_anchor=(0.56, 1.0), borderaxespad=0.1)   # visible on a narrow screen without scrolling


def _points(axes, time, values, hollow=False):
    for (name, colour), column in zip(AXIS_COLOURS.items(), values.T):
        axes.plot(time, column, MARKER[name], color=colour, markersize=3.8, mfc='none' if hollow else colour, mew=0.8,
                  alpha=0.9, label=name)


def autocorrelation(result: CalibrationResult) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """
    Return sensor -> (lags in s, autocorrelation (n_lags, 3), two-sided 95 % bound of white noise), from the kept moving windows.

    The mean of each window is subtracted from its residual; windows are weighted by their length.
    """
    windows = [w for w in result.gathered.kept if len(w) >= 100]
    if not windows:
        return {}
    typical = np.median([len(w) for w in windows])
    windows = [w for w in windows if len(w) >= typical][:MOST_WINDOWS]
    period = float(np.median([w.period for w in windows]))
    n_lags = max(2, min(int(LAG_SECONDS / period), int(typical) // 2))
    sums = {sensor: np.zeros((n_lags, 3)) for sensor in SENSORS}
    for window in windows:
        for sensor, rest in result.residuals_of(window).items():
            sums[sensor] += _lagged(rest - rest.mean(axis=0), n_lags)
    bound = 1.96 / np.sqrt(sum(len(w) for w in windows))
    return {sensor: (np.arange(n_lags) * period, total / np.where(total[0] > 0, total[0], 1.0), bound) for sensor, total in sums.items()}


def _lagged(rest, n_lags):
    """Return sums of products at each lag, shape (n_lags, 3), by FFT."""
    size = 2**int(np.ceil(np.log2(2 * len(rest))))
    spectrum = np.fft.rfft(rest, size, axis=0)
    return np.fft.irfft(np.abs(spectrum)**2, size, axis=0)[:n_lags]


def _autocorrelations(figure, traces):
    """One panel per sensor."""
    panels = figure.subplots(1, len(traces), sharey=True, squeeze=False)[0]
    for axes, (sensor, (lags, values, bound)) in zip(panels, traces.items()):
        axes.axhspan(-bound, bound, color='#dfe5ec', lw=0, zorder=0.5)
        for (name, colour), column in zip(AXIS_COLOURS.items(), values[1:].T):
            axes.plot(lags[1:], column, color=colour, lw=1.0, marker=MARKER[name], markersize=3, markevery=max(1, len(column) // 12))
        limit = max(0.15, 1.1 * float(np.max(np.abs(values[1:]))))
        axes.set(title=sensor, xlabel='lag, s', ylim=(-limit, limit))
    panels[0].set_ylabel('autocorrelation')
    axis_legend(panels[-1])
