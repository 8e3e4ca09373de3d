"""Observability of the parameters: standard deviations against tolerances, singular values, weak directions, correlations."""

from typing import Any

import numpy as np

from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import SHORT
from imu_calibration.report.figures import AFTER, GREY, INK, STATUS, draw, log_axis
from imu_calibration.report.numbers import text

ROW = 0.155
"""Height of one bar, inches."""


def observability_section(result: CalibrationResult) -> dict[str, Any]:
    """Return figures and weak directions."""
    calibration = result.calibration
    live = calibration.sd > 0
    figures = {'bars': draw('bars', (8.6, 0.9 + ROW * live.sum()), _Bars(result, live),
                            label='Standard deviation over tolerance of every parameter'),
               'correlation': draw('correlation', (7.2, 6.4), _Correlation(calibration, live), label='Correlation between the parameters')}
    if len(result.singular_values):
        figures['singular'] = draw('singular', (8.6, 2.5), _Singular(result.singular_values),
                                   label='Singular values of the design in units of the tolerances')
    return {**figures, 'directions': directions(calibration), 'strongest': strongest(calibration, live)}


def directions(calibration: Calibration) -> list[list[tuple[str, str]]]:
    """Return the weak directions: (parameter, weight) of each."""
    return [[(name, text(weight, 2)) for name, weight in d['parameters'].items()] for d in calibration.undetermined]


def strongest(calibration: Calibration, live: np.ndarray, count: int = 5) -> list[tuple[str, str, str]]:
    """Return the strongest correlations as (name, name, value)."""
    correlation, names = _correlation(calibration, live)
    rows, columns = np.triu_indices(len(names), 1)
    order = np.argsort(-np.abs(correlation[rows, columns]), kind='stable')[:count]
    return [(names[rows[k]], names[columns[k]], text(correlation[rows[k], columns[k]], 2)) for k in order]


def _correlation(calibration, live):
    sd = calibration.sd[live]
    names = [name for name, flag in zip(calibration.param_names, live) if flag]
    return calibration.covariance[np.ix_(live, live)] / np.outer(sd, sd), names


def short_name(name: str) -> str:
    """Return a parameter or effect name that fits a figure."""
    sensor, _, rest = name.partition('.')
    rest = rest.removeprefix(SHORT.get(sensor, '') + '_').replace('_', ' ').replace('.', ' ')
    return rest if sensor == 'reference' else f'{SHORT[sensor]} {rest}'


class _Bars:
    """One bar per parameter on a logarithmic axis, one at the tolerance."""

    def __init__(self, result, live):
        self.result, self.live = result, live

    def __call__(self, figure):
        calibration = self.result.calibration
        share = (calibration.sd / self.result.tolerances)[self.live]
        names = [n for n, flag in zip(calibration.param_names, self.live) if flag]
        colours = [STATUS[s] for s, flag in zip(calibration.status, self.live) if flag]
        axes = figure.subplots()
        place = np.arange(len(names))[::-1]
        low = min(1e-3, float(share.min()) / 2)
        axes.barh(place, share - low, left=low, height=0.68, color=colours)
        axes.axvline(1.0, color=INK, lw=1.0)
        axes.annotate('tolerance', (1.0, len(names) - 0.2), ha='center', va='bottom', fontsize=8.5, color=INK, annotation_clip=False)
        log_axis(axes.xaxis)
        axes.set_xlim(low, max(10.0, 2 * float(share.max())))
        axes.set_ylim(-0.8, len(names) - 0.2)
        axes.set_yticks(place, [short_name(name) for name in names], fontsize=8)
        axes.tick_params(axis='y', length=0)
        axes.grid(axis='y', visible=False)
        axes.set_xlabel('standard deviation / tolerance (left is better)')


class _Singular:
    """Descending stems on a logarithmic axis."""

    def __init__(self, values):
        self.values = np.maximum(values, 1e-3)

    def __call__(self, figure):
        axes = figure.subplots()
        place = np.arange(1, len(self.values) + 1)
        colours = [AFTER if v >= 1 else STATUS['held'] for v in self.values]
        axes.vlines(place, min(0.3, self.values.min() / 2), self.values, colors=colours, lw=2.2)
        axes.scatter(place, self.values, s=14, c=colours, zorder=3)
        axes.axhline(1.0, color=INK, lw=1.0)
        log_axis(axes.yaxis)
        axes.set_xlim(0, len(place) + 1)
        axes.set_ylim(bottom=min(0.3, self.values.min() / 2))
        axes.grid(axis='x', visible=False)
        axes.set_xlabel('direction, best determined first')
        axes.set_ylabel('tolerances per sd')


class _Correlation:
    """Heat map with lines between the effects."""

    def __init__(self, calibration, live):
        self.matrix, self.names = _correlation(calibration, live)

    def __call__(self, figure):
        axes = figure.subplots()
        image = axes.imshow(self.matrix, cmap='RdBu_r', vmin=-1, vmax=1, interpolation='nearest')
        groups = [short_name(name.rpartition('.')[0] + '.').strip() for name in self.names]
        edges = [k for k in range(1, len(groups)) if groups[k] != groups[k - 1]]
        for edge in edges:
            axes.axhline(edge - 0.5, color=GREY, lw=0.6)
            axes.axvline(edge - 0.5, color=GREY, lw=0.6)
        bounds = [0, *edges, len(groups)]
        middles = [(a + b - 1) / 2 for a, b in zip(bounds, bounds[1:])]
        labels = [groups[a] for a in bounds[:-1]]
        axes.set_xticks(middles, labels, rotation=40, ha='right', rotation_mode='anchor')
        axes.set_yticks(middles, labels)
        axes.tick_params(length=0)
        axes.grid(visible=False)
        for side in axes.spines.values():
            side.set_visible(False)
        bar = figure.colorbar(image, ax=axes, shrink=0.6, pad=0.02)
        bar.outline.set_visible(False)
