"""
The page of a calibration, and its sections with figures.

Observability, error budget, readings at rest.
"""

from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np

from imu_calibration.calibration.installation_angles import AXIS_PAIRS, derive, in_paper_units
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import CalibrationResult, WindowErrors
from imu_calibration.core.settings import describe
from imu_calibration.core.units import for_people
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import harmed
from imu_calibration.document.trust import usage
from imu_calibration.effects.base import PREFIXES, UNITS, Effect
from imu_calibration.report.figures import (
    AFTER,
    AXIS_COLOURS,
    GREY,
    INK,
    MARKER,
    STATUS,
    Drawn,
    axis_legend,
    draw,
    lever_figure,
    log_axis,
)
from imu_calibration.report.navigation_section import navigation_section
from imu_calibration.report.observation_texts import OBSERVATION_TEXTS
from imu_calibration.report.page import render

ROW = 0.155
"""Height of one bar, inches."""


def observability_section(result: CalibrationResult) -> dict[str, Any]:
    """Return figures of the standard deviations, correlations and singular values."""
    calibration = result.calibration
    live = calibration.sd > 0  # estimated, or at least uncertain
    figures = {
        'bars': draw(
            'bars',
            (8.6, 0.9 + ROW * live.sum()),
            _bars,
            result,
            live,
            label='Standard deviation over tolerance of every parameter',
        ),
        'correlation': draw(
            'correlation',
            (7.2, 6.4),
            _heat_map,
            *_correlation(calibration, live),
            label='Correlation between the parameters',
        ),
    }
    if len(result.singular_values):
        figures['singular'] = draw(
            'singular',
            (8.6, 2.5),
            _stems,
            result.singular_values,
            label='Singular values of the design in units of the tolerances',
        )
    return {**figures, 'strongest': strongest(calibration, live)}


def strongest(calibration: Calibration, live: np.ndarray) -> list[tuple[str, str, float]]:
    """Return the five strongest correlations of the `live` parameters as (name, name, value)."""
    correlation, names = _correlation(calibration, live)
    rows, columns = np.triu_indices(len(names), 1)
    order = np.argsort(-np.abs(correlation[rows, columns]), kind='stable')[:5]
    return [(names[rows[k]], names[columns[k]], correlation[rows[k], columns[k]]) for k in order]


def _correlation(calibration: Calibration, live: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return (correlation, names) of the n parameters that are `live`, shapes (n, n) and (n,)."""
    sd = calibration.sd[live]
    correlation = calibration.covariance[np.ix_(live, live)] / np.outer(sd, sd)
    return correlation, list(compress(calibration.param_names, live))


def short_name(name: str) -> str:
    """Return a parameter or effect name that fits a figure."""
    sensor, _, label = name.partition('.')
    label = label.removeprefix(PREFIXES.get(sensor, '') + '_').replace('_', ' ').replace('.', ' ')
    return label if sensor == 'reference' else f'{PREFIXES[sensor]} {label}'


def _bars(figure, result, live):
    """Draw sd / tolerance of each `live` parameter as a bar on a logarithmic axis."""
    calibration = result.calibration
    share = (calibration.sd / result.tolerances)[live]
    names = list(compress(calibration.param_names, live))
    colours = [STATUS[status] for status in compress(calibration.status, live)]
    axes = figure.subplots()
    place = np.arange(len(names))[::-1]  # the first parameter at the top
    low = min(1e-3, float(share.min()) / 2)  # where all bars begin
    axes.barh(place, share - low, left=low, height=0.68, color=colours)
    axes.axvline(1.0, color=INK, lw=1.0)
    axes.annotate(
        'tolerance',
        (1.0, len(names) - 0.2),
        ha='center',
        va='bottom',
        fontsize=8.5,
        color=INK,
        annotation_clip=False,
    )
    log_axis(axes.xaxis)
    axes.set(
        xlim=(low, max(10.0, 2 * float(share.max()))),
        ylim=(-0.8, len(names) - 0.2),
        xlabel='standard deviation / tolerance (left is better)',
    )
    axes.set_yticks(place, [short_name(name) for name in names], fontsize=8)
    axes.tick_params(axis='y', length=0)
    axes.grid(axis='y', visible=False)


def _stems(figure, values):
    """Draw singular values, descending, as stems on a logarithmic axis; grey below one."""
    values = np.maximum(values, 1e-3)
    axes = figure.subplots()
    place = np.arange(1, len(values) + 1)
    colours = [AFTER if v >= 1 else STATUS['held'] for v in values]
    axes.vlines(place, min(0.3, values.min() / 2), values, colors=colours, lw=2.2)
    axes.scatter(place, values, s=14, c=colours, zorder=3)
    axes.axhline(1.0, color=INK, lw=1.0)
    log_axis(axes.yaxis)
    axes.set(
        xlim=(0, len(place) + 1),
        xlabel='direction, best determined first',
        ylabel='tolerances per sd',
    )
    axes.set_ylim(bottom=min(0.3, values.min() / 2))
    axes.grid(axis='x', visible=False)


def _heat_map(figure, matrix, names):
    """Draw the correlations of named parameters, with lines between the effects."""
    axes = figure.subplots()
    image = axes.imshow(matrix, cmap='RdBu_r', vmin=-1, vmax=1, interpolation='nearest')
    # Effect of each parameter, and the first parameter of every further effect.
    groups = [short_name(name.rpartition('.')[0] + '.').strip() for name in names]
    edges = [k for k in range(1, len(groups)) if groups[k] != groups[k - 1]]
    for edge in edges:
        axes.axhline(edge - 0.5, color=GREY, lw=0.6)
        axes.axvline(edge - 0.5, color=GREY, lw=0.6)
    # The name of each effect in the middle of its parameters.
    bounds = [0, *edges, len(groups)]
    middles = [(a + b - 1) / 2 for a, b in zip(bounds, bounds[1:])]
    labels = [groups[a] for a in bounds[:-1]]
    axes.set_xticks(middles, labels, rotation=40, ha='right', rotation_mode='anchor')
    axes.set_yticks(middles, labels)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    figure.colorbar(image, ax=axes, shrink=0.6, pad=0.02).outline.set_visible(False)


CAUSE_COLOURS = {
    'noise': '#1f66a8',
    'levelling': '#c0561b',
    'joint position': '#2b8a57',
    'table rate': '#8a5aa8',
    'gravity': '#b8860b',
}
MIN_DRAWN_SHARE = 1e-5
"""Shares of the tolerance below this are drawn at the edge."""


def budget_section(result: CalibrationResult) -> dict[str, Any]:
    """
    Return the figure, and the standard deviations of the parameters.

    The standard deviations are given by cause and by term of the reported variances.
    """
    budget = result.error_budget()
    terms = {}
    for name, variance in result.calibration.covariance_terms.items():
        if np.any(variance > 0):
            terms[name] = np.sqrt(np.maximum(variance, 0.0))
    figure = draw(
        'budget',
        (8.6, 0.9 + 0.26 * len(_effects(result))),
        _dots,
        result,
        budget,
        label='Error budget of each effect by cause, in tolerances',
    )
    return {
        'figure': figure,
        'texts': budget.texts,
        'effects': _effects(result),
        'tolerances': result.tolerances,
        'tables': (
            ('cause', {**budget.causes, 'total': budget.total}),
            ('term', {**terms, 'total': result.calibration.sd}),
        ),
    }


def _effects(result: CalibrationResult) -> list[tuple[Effect, slice]]:
    """Return (effect, slice of its parameters) of each effect that was estimated."""
    model = result.calibration.model
    effects = []
    for effect in model.effects:
        part = model.slices[effect.key]
        if np.any(result.calibration.sd[part] > 0):
            effects.append((effect, part))
    return effects


def _dots(figure, result, budget):
    """Draw a line per effect with a dot per cause: its largest sd / tolerance."""
    axes = figure.subplots()
    effects = _effects(result)
    place = np.arange(len(effects))[::-1]  # the first effect at the top

    def largest_share(sd: np.ndarray) -> np.ndarray:
        """Return the largest sd / tolerance of the parameters of each effect, (n_effects,)."""
        return np.array([np.max(sd[part] / result.tolerances[part]) for _, part in effects])

    highest = 1.0
    for cause, sd in budget.causes.items():
        share = largest_share(sd)
        highest = max(highest, share.max())
        shown = share > MIN_DRAWN_SHARE
        axes.plot(
            share[shown],
            place[shown],
            'o',
            color=CAUSE_COLOURS.get(cause, INK),
            label=cause,
            markersize=6,
            ls='none',
        )
    axes.plot(
        largest_share(budget.total),
        place,
        '|',
        color=INK,
        markersize=13,
        mew=1.6,
        label='total',
        ls='none',
    )
    axes.axvline(1.0, color=INK, lw=1.0)
    log_axis(axes.xaxis)
    axes.set(
        xlim=(MIN_DRAWN_SHARE, 3 * highest),
        ylim=(-0.7, len(effects) - 0.3),
        xlabel='largest standard deviation / tolerance',
    )
    axes.set_yticks(place, [short_name(f'{e.sensor}.{e.name}') for e, _ in effects])
    axes.tick_params(axis='y', length=0)
    axes.legend(
        ncols=6,
        loc='lower center',
        bbox_to_anchor=(0.45, 1.0),
        columnspacing=1.2,
        handletextpad=0.1,
    )


LEVEL_FORCE_SHARE = 0.02
"""
Windows with a mean specific force further than this share from 1 g turn through the vertical and
have no reading at 1 g.
"""


WITHIN_DEG = 5.0
"""Windows within this angle between force and a sensor axis are used."""
STILL_DEG_S = 0.2
"""Slower windows are at rest, faster ones are grouped by rate rounded to 1 deg/s."""


@dataclass(frozen=True)
class AxisReading:
    """One line of Zhang's Table 2 (at rest) or Table 4 (in rotation)."""

    position: str
    """Sensor axis that points up or down, '+x' to '-z'."""
    rate_deg_s: float
    """Turn rate, deg/s; 0 at rest."""
    n_windows: int
    """Windows averaged in this line."""
    sensor: str
    """Sensor whose reading this is, 'x', 'y' or 'z'."""
    theoretical_g: float
    """Reading of a perfect sensor, g."""
    before_g: float
    """Reading before compensation, g."""
    after_g: float
    """Reading after compensation, g."""

    @property
    def improvement(self) -> float:
        """Return the error before over the error after, in sizes."""
        after = abs(self.after_g - self.theoretical_g)
        return abs(self.before_g - self.theoretical_g) / after if after > 0 else np.inf


def axis_readings(
    measured: np.ndarray,
    compensated: np.ndarray,
    reference: np.ndarray,
    *,
    rate: np.ndarray,
    gravity: float,
) -> list[AxisReading]:
    """
    Return readings at +-1 g, at rest and in rotation, before and after compensation.

    As lines of Zhang's Tables 2 and 4.

    Parameters
    ----------
    measured, compensated, reference : arrays, shape (n, 3)
        Window means of specific force: raw, corrected, and of a perfect sensor at the reference
        point, m/s^2.
    rate : array, shape (n,)
        Turn rate of the table in each window, rad/s.
    gravity : float
        Local gravity, m/s^2: the g of the lines.

    Returns
    -------
    list of AxisReading
        At rest first, then by rate; three lines per position; empty when no window fits.

    """
    reference_g = np.asarray(reference, float).reshape(-1, 3) / gravity
    measured_g = np.asarray(measured, float).reshape(-1, 3) / gravity
    compensated_g = np.asarray(compensated, float).reshape(-1, 3) / gravity
    rate_deg_s = np.abs(np.rad2deg(np.asarray(rate, float)))
    rate_deg_s = np.where(rate_deg_s < STILL_DEG_S, 0.0, np.maximum(np.round(rate_deg_s), 1.0))

    # The sensor axis nearest to the vertical in each window, and the force along it.
    length = np.linalg.norm(reference_g, axis=1)
    axis = np.argmax(np.abs(reference_g), axis=1)
    along_axis = reference_g[np.arange(len(axis)), axis]
    is_near = np.abs(along_axis) >= np.cos(np.deg2rad(WITHIN_DEG)) * length

    # Windows with one rate, direction and axis are averaged; sorted by rate, then up before down.
    is_down = np.sign(along_axis) < 0
    positions = zip(rate_deg_s[is_near], is_down[is_near], axis[is_near])
    lines = []
    for line_rate, line_is_down, line_axis in sorted(set(positions)):
        chosen = is_near & (rate_deg_s == line_rate) & (axis == line_axis)
        chosen &= is_down == line_is_down
        means = [np.mean(g[chosen], axis=0) for g in (reference_g, measured_g, compensated_g)]
        for sensor, theoretical, before, after in zip('xyz', *means):
            lines.append(
                AxisReading(
                    position=('-' if line_is_down else '+') + 'xyz'[line_axis],
                    rate_deg_s=float(line_rate),
                    n_windows=int(np.sum(chosen)),
                    sensor=sensor,
                    theoretical_g=float(theoretical),
                    before_g=float(before),
                    after_g=float(after),
                )
            )
    return lines


def reading_tables(result: CalibrationResult, errors: WindowErrors) -> list[list[AxisReading]]:
    """
    Return the readings at rest (Table 2) and in rotation (Table 4).

    They are the readings of three sensors in each position.
    """
    if 'accelerometer' not in errors.true:
        return [[], []]
    gravity = result.gravity
    true = errors.true['accelerometer']
    chosen = np.abs(np.linalg.norm(true, axis=1) / gravity - 1) < LEVEL_FORCE_SHARE
    if 'gyroscope' in errors.true:
        chosen &= errors.kind != 'dynamic'
        rate = np.linalg.norm(errors.true['gyroscope'], axis=1)
    else:
        # The rows of the gyroscope contain the rates: without them readings at rest only.
        chosen &= errors.kind == 'static'
        rate = np.zeros(len(true))
    readings = axis_readings(
        errors.measured['accelerometer'][chosen],
        (true + errors.after['accelerometer'])[chosen],
        true[chosen],
        rate=rate[chosen],
        gravity=gravity,
    )
    at_rest = [reading for reading in readings if reading.rate_deg_s == 0]
    in_rotation = [reading for reading in readings if reading.rate_deg_s != 0]
    return [at_rest, in_rotation]


def calibration_report(result: CalibrationResult) -> str:
    """
    Return the report of a calibration, on a table or by hand, as one self-contained HTML page.

    The same input gives the same bytes.

    Parameters
    ----------
    result : CalibrationResult

    """
    errors = result.window_errors()
    windows = (result.options or CalibrationOptions()).windows
    return render(
        'calibration.html',
        title='IMU calibration',
        texts=OBSERVATION_TEXTS[result.observations],
        result=result,
        usage=usage(result.calibration),
        harmed=harmed,
        derived=[derive(result.calibration, sensor) for sensor in result.calibration.sensors],
        in_paper_units=in_paper_units,
        axis_pairs=AXIS_PAIRS,
        residuals=residual_figure(result),
        errors=[draw_windows(errors, sensor) for sensor in result.calibration.sensors],
        observability=observability_section(result),
        levers=lever_figure(result.calibration),
        navigation=navigation_section(result, errors),
        readings=reading_tables(result, errors),
        budget=budget_section(result),
        settings=[(item, getattr(windows, item.name)) for item in describe(windows)],
    )


LAG_SECONDS = 2.0
"""Longest lag that is drawn."""
MOST_WINDOWS = 60


def residual_figure(result: CalibrationResult) -> Drawn | None:
    """Return the autocorrelation of the residuals as SVG; None without moving windows."""
    traces = autocorrelation(result)
    if not traces:
        return None
    return draw(
        'autocorrelation',
        (8.6, 2.7),
        _autocorrelations,
        traces,
        label='Autocorrelation of the residuals within moving windows',
    )


def draw_windows(errors: WindowErrors, sensor: str) -> Drawn:
    """
    Return the errors of raw and corrected readings of one sensor in every held-out window, as SVG.
    """
    label = f'Errors of raw and corrected readings of the {sensor} in every held-out window'
    return draw(f'residuals-{sensor}', (7.2, 3.6), _windows, errors, sensor, label=label)


def _windows(figure, errors, sensor):
    """Draw errors over time, raw above, corrected below with the expected sd from noise."""
    factor, unit = for_people(UNITS[sensor])
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1, 1.25])
    _points(upper, errors.time, errors.before[sensor] * factor, hollow=True)
    two_sd = 2 * errors.floor[sensor].max(axis=1) * factor
    order = np.argsort(errors.time)
    lower.fill_between(
        errors.time[order],
        -two_sd[order],
        two_sd[order],
        step='mid',
        color='#dfe5ec',
        lw=0,
        zorder=0.5,
    )
    _points(lower, errors.time, errors.after[sensor] * factor)
    for axes, title in ((upper, f'{sensor}, raw'), (lower, 'corrected; grey: two sd of the noise')):
        axes.axhline(0, color=GREY, lw=0.6)
        axes.set(title=title, ylabel=unit)
    lower.set_xlabel('time, s')
    # Visible on a narrow screen without scrolling.
    axis_legend(upper, 'lower right', bbox_to_anchor=(0.56, 1.0), borderaxespad=0.1)


def _points(axes, time, values, hollow=False):
    """Draw the three axes of values, (n, 3), over time with their markers."""
    for (name, colour), column in zip(AXIS_COLOURS.items(), values.T):
        axes.plot(
            time,
            column,
            MARKER[name],
            color=colour,
            markersize=3.8,
            mfc='none' if hollow else colour,
            mew=0.8,
            alpha=0.9,
            label=name,
        )


def autocorrelation(result: CalibrationResult) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """
    Return sensor -> (lags in s, autocorrelation (n_lags, 3), two-sided 95 % bound of white noise).

    From the residuals of the longer moving windows, with the mean of each window subtracted. The
    sums of products at each lag are added over the windows and divided by those at lag 0.
    """
    windows = [w for w in result.gathered.kept if len(w) >= 100]
    if not windows:
        return {}
    # The longer half of them: a short window has few pairs at the largest lags.
    typical = np.median([len(w) for w in windows])
    windows = [w for w in windows if len(w) >= typical][:MOST_WINDOWS]
    period = float(np.median([w.period for w in windows]))
    n_lags = max(2, min(int(LAG_SECONDS / period), int(typical) // 2))
    sums = {sensor: np.zeros((n_lags, 3)) for sensor in result.calibration.sensors}
    for window in windows:
        for sensor, residual in result.residuals_of(window).items():
            if sensor in sums:
                sums[sensor] += _lagged_products(residual - residual.mean(axis=0), n_lags)
    bound = 1.96 / np.sqrt(sum(len(w) for w in windows))
    lags = np.arange(n_lags) * period
    traces = {}
    for sensor, products in sums.items():
        power = np.where(products[0] > 0, products[0], 1.0)
        traces[sensor] = (lags, products / power, bound)
    return traces


def _lagged_products(residual: np.ndarray, n_lags: int) -> np.ndarray:
    """Return ``sum_t r(t) r(t + lag)`` of a residual (n, 3) at each lag, (n_lags, 3), by FFT."""
    size = 2 ** int(np.ceil(np.log2(2 * len(residual))))  # with zeros, so that no lag wraps
    spectrum = np.fft.rfft(residual, size, axis=0)
    return np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[:n_lags]


def _autocorrelations(figure, traces):
    """Draw the `autocorrelation` of each sensor in a panel."""
    panels = figure.subplots(1, len(traces), sharey=True, squeeze=False)[0]
    for axes, (sensor, (lags, values, bound)) in zip(panels, traces.items()):
        axes.axhspan(-bound, bound, color='#dfe5ec', lw=0, zorder=0.5)
        for (name, colour), column in zip(AXIS_COLOURS.items(), values[1:].T):
            axes.plot(
                lags[1:],
                column,
                color=colour,
                lw=1.0,
                marker=MARKER[name],
                markersize=3,
                markevery=max(1, len(column) // 12),
            )
        limit = max(0.15, 1.1 * float(np.max(np.abs(values[1:]))))
        axes.set(title=sensor, xlabel='lag, s', ylim=(-limit, limit))
    panels[0].set_ylabel('autocorrelation')
    axis_legend(panels[-1])
