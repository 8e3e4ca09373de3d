"""The page of the noise of an IMU, with its Allan curves."""

import numpy as np
from scipy.special import chdtri

from imu_calibration.allan import document
from imu_calibration.allan.figures import HORIZON, NoiseFigures
from imu_calibration.allan.identify import NoiseIdentification
from imu_calibration.allan.processes import FLATNESS, FLICKER, RANDOM_WALK, WHITE
from imu_calibration.allan.terms import predicted
from imu_calibration.core.units import NOISE_QUANTITY, for_people
from imu_calibration.effects.base import AXES, SENSORS, UNITS
from imu_calibration.estimation.solution import DETERMINED, HELD, WEAK
from imu_calibration.report.figures import (
    AXIS_COLOURS,
    FAINT,
    GREY,
    MARKER,
    Drawn,
    axis_handles,
    draw,
    log_axis,
)
from imu_calibration.report.page import render


def draw_curve(result: NoiseIdentification, sensor: str) -> Drawn:
    """Return the Allan deviations of the axes of one sensor as SVG."""
    return draw(
        f'allan-{sensor}',
        (8.6, 5.0),
        _curves,
        result,
        sensor,
        label=f'Allan deviation of the {sensor} against averaging time',
    )


def _curves(figure, result, sensor):
    """
    Draw the Allan deviations of a sensor: points with 95 % bands, model, and curve with trends.

    There is also a slope for each process of the noisiest axis.
    """
    axes = figure.subplots()
    curve = result.record.curve
    factor, unit = for_people(UNITS[sensor], NOISE_QUANTITY)
    log_axis(axes.xaxis)
    log_axis(axes.yaxis)
    # Columns of the sensor among the six axes.
    first = 3 * SENSORS.index(sensor)
    columns = range(first, first + 3)
    for k, name in zip(columns, AXIS_COLOURS):
        _axis(axes, result, k, factor, name)
    # The bands of single averages are much wider than the range of the measured values.
    shown = factor * np.sqrt(np.concatenate([curve.variance[:, columns], curve.raw[:, columns]]))
    axes.set_ylim(np.nanmin(shown[shown > 0]) / 2.5, np.nanmax(shown) * 2.0)
    noisiest = max(
        (result.axes[k].terms for k in columns), key=lambda terms: terms[WHITE.name].interval[1]
    )
    _slopes(axes, curve.tau, noisiest, factor)
    axes.set(xlabel='averaging time τ, s', ylabel=f'Allan deviation, {unit}')
    from matplotlib.lines import Line2D

    handles = axis_handles(lw=1.3)
    if any(result.record.trends[k] for k in columns):
        handles.append(Line2D([], [], color=GREY, ls=':', label='with its trends'))
    axes.legend(handles=handles, loc='upper right', ncols=len(handles))


def _axis(axes, result, k, factor, name):
    """Draw axis k: measured, band, model, and the curve with its trends; `factor` of the unit."""
    curve = result.record.curve
    colour = AXIS_COLOURS[name]
    measured = np.sqrt(curve.variance[:, k]) * factor
    raw = np.sqrt(curve.raw[:, k]) * factor
    model, freedom = predicted(result.record.moments[k], result.axes[k])
    # The estimated variance times freedom / true variance has a chi-square distribution.
    lower = measured * np.sqrt(freedom / chdtri(freedom, 0.025))
    upper = measured * np.sqrt(freedom / chdtri(freedom, 0.975))
    axes.fill_between(curve.tau, lower, upper, color=colour, alpha=0.13, lw=0)
    axes.plot(curve.tau, measured, MARKER[name], color=colour, markersize=3.2, zorder=3)
    axes.plot(curve.tau, np.sqrt(model) * factor, color=colour, lw=1.3, zorder=2)
    if result.record.trends[k]:
        axes.plot(curve.tau, raw, ':', color=colour, lw=1.1)
    left_out = curve.tau < result.axes[k].shortest * 0.999
    axes.plot(curve.tau[left_out], measured[left_out], 'o', color='white', markersize=1.8, zorder=4)


def _slopes(axes, tau, terms, factor):
    """Draw a straight line for every process of an axis, with the letter and the slope."""
    # Process, label, line of a coefficient c, and place of the label as a share of the curve.
    lines = (
        (WHITE.name, 'N: slope −½', lambda c: c / np.sqrt(tau), 0.35),
        (RANDOM_WALK.name, 'K: slope +½', lambda c: c * np.sqrt(tau / 3), 0.8),
        (FLICKER.name, 'B: flat at 0.664 B', lambda c: c * FLATNESS + 0 * tau, 0.8),
    )
    for name, label, line, label_share in lines:
        term = terms.get(name)
        if term is None or term.value is None:
            continue
        values = line(term.value) * factor
        axes.plot(tau, values, '--', color=FAINT, lw=0.9, zorder=1)
        place = min(int(label_share * len(tau)), len(tau) - 1)
        axes.annotate(
            label,
            (tau[place], values[place]),
            (-6, -12),
            textcoords='offset points',
            color=GREY,
            fontsize=8,
            ha='right',
        )


RATES = (50.0, 100.0, 200.0, 400.0, 1000.0)
"""Rates for discrete figures in addition to the rate of the recording, Hz."""


def noise_report(
    result: NoiseIdentification, figures: NoiseFigures, horizon: float = HORIZON
) -> str:
    """Return the report as one self-contained HTML page; the same input gives the same bytes."""
    counts = document.counts(figures)
    # Sensor -> (title, unit) of a table -> its rows.
    tables = {sensor: {} for sensor in figures.sensors}
    for row in document.rows(figures):
        tables[row.sensor].setdefault((row.title, row.unit), []).append(row)
    # The sensor filters its noise at averaging times of more than one sample.
    left_out = []
    for sensor in figures.sensors:
        for letter, axis in zip(AXES, figures.sensor(sensor)):
            if axis.shortest * figures.rate > 1.5:
                left_out.append((f'{sensor} {letter}', axis.shortest))
    return render(
        'noise.html',
        title='Noise of an IMU',
        headline=f'{counts[DETERMINED]} of {sum(counts.values())} figures determined',
        word='weak' if counts[WEAK] or counts[HELD] else 'good',
        lines=document.lines(figures),
        figures=figures,
        tables=tables,
        curves={sensor: draw_curve(result, sensor) for sensor in figures.sensors},
        horizon=horizon,
        densities={sensor: figures.densities(sensor, horizon) for sensor in figures.sensors},
        basis=document.BASIS,
        rates=sorted({*RATES, round(figures.rate, 3)}),
        runs=document.position_budget(figures),
        duration=document.duration,
        left_out=left_out,
    )
