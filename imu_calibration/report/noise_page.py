"""The page of the noise of an IMU, with its Allan curves."""

import numpy as np
from scipy.special import chdtri

from imu_calibration.allan import document
from imu_calibration.allan.document import position_budget
from imu_calibration.allan.figures import HORIZON, NoiseFigures
from imu_calibration.allan.identify import NoiseIdentification
from imu_calibration.allan.processes import FLATNESS, FLICKER, RANDOM_WALK, WHITE
from imu_calibration.allan.terms import predicted
from imu_calibration.core.units import NOISE_QUANTITY, for_people
from imu_calibration.effects.base import SENSORS, UNITS
from imu_calibration.estimation.solution import DETERMINED, HELD, WEAK
from imu_calibration.report.figures import AXIS_COLOURS, FAINT, GREY, MARKER, Drawn, draw, log_axis
from imu_calibration.report.page import render, text, tile


def draw_curve(result: NoiseIdentification, sensor: str) -> Drawn:
    """Return the Allan deviations of the axes of one sensor as SVG."""
    return draw(f'allan-{sensor}', (8.6, 5.0), _Curves(result, sensor), label=f'Allan deviation of the {sensor} against averaging time')


class _Curves:
    """Points with 95 % bands, the model's line, the contribution of the trends, and a slope for each process of the noisiest axis."""

    def __init__(self, result, sensor):
        self.result, self.sensor = result, sensor
        self.factor, self.unit = for_people(UNITS[sensor], NOISE_QUANTITY)

    def __call__(self, figure):
        axes, tau = figure.subplots(), self.result.record.curve.tau
        log_axis(axes.xaxis)
        log_axis(axes.yaxis)
        first = 3 * SENSORS.index(self.sensor)
        for k, name in zip(range(first, first + 3), AXIS_COLOURS):
            self._axis(axes, tau, k, name)
        axes.set_ylim(*self._limits(first))
        self._slopes(axes, tau, max(range(first, first + 3), key=lambda k: self.result.axes[k].terms[WHITE.name].interval[1]))
        axes.set_xlabel('averaging time τ, s')
        axes.set_ylabel(f'Allan deviation, {self.unit}')
        self._legend(axes)

    def _axis(self, axes, tau, k, name):
        """Draw one axis: measured, band, model, and the curve with its trends."""
        curve, colour = self.result.record.curve, AXIS_COLOURS[name]
        measured, raw = (np.sqrt(values[:, k]) * self.factor for values in (curve.variance, curve.raw))
        model, freedom = predicted(self.result.record.moments[k], self.result.axes[k])
        lower, upper = (measured * np.sqrt(freedom / chdtri(freedom, tail)) for tail in (0.025, 0.975))
        axes.fill_between(tau, lower, upper, color=colour, alpha=0.13, lw=0)
        axes.plot(tau, measured, MARKER[name], color=colour, markersize=3.2, zorder=3)
        axes.plot(tau, np.sqrt(model) * self.factor, color=colour, lw=1.3, zorder=2)
        if self.result.record.trends[k]:
            axes.plot(tau, raw, ':', color=colour, lw=1.1)
        left_out = tau < self.result.axes[k].shortest * 0.999
        axes.plot(tau[left_out], measured[left_out], 'o', color='white', markersize=1.8, zorder=4)

    def _limits(self, first):
        """Return the range of the measured values with a margin; bands of single averages are much wider."""
        curve = self.result.record.curve
        shown = np.sqrt(np.concatenate([curve.variance[:, first:first + 3], curve.raw[:, first:first + 3]])) * self.factor
        return np.nanmin(shown[shown > 0]) / 2.5, np.nanmax(shown) * 2.0

    def _slopes(self, axes, tau, k):
        """Draw a straight line for every process of an axis, with the letter and the slope."""
        terms = self.result.axes[k].terms
        lines = ((WHITE.name, 'N: slope −½', lambda t, c: c / np.sqrt(t), 0.35),
                 (RANDOM_WALK.name, 'K: slope +½', lambda t, c: c * np.sqrt(t / 3), 0.8),
                 (FLICKER.name, 'B: flat at 0.664 B', lambda t, c: c * FLATNESS + 0 * t, 0.8))
        for name, label, line, where in lines:
            term = terms.get(name)
            if term is None or term.value is None:
                continue
            values = line(tau, term.value) * self.factor
            axes.plot(tau, values, '--', color=FAINT, lw=0.9, zorder=1)
            at = min(int(where * len(tau)), len(tau) - 1)
            axes.annotate(label, (tau[at], values[at]), (-6, -12), textcoords='offset points', color=GREY, fontsize=8,
                          ha='right')

    def _legend(self, axes):
        from matplotlib.lines import Line2D
        handles = [Line2D([], [], color=hue, marker=MARKER[name], markersize=4, lw=1.3, label=name) for name, hue in AXIS_COLOURS.items()]
        if any(self.result.record.trends[3 * SENSORS.index(self.sensor) + k] for k in range(3)):
            handles.append(Line2D([], [], color=GREY, ls=':', label='with its trends'))
        axes.legend(handles=handles, loc='upper right', ncols=len(handles))


RATES = (50.0, 100.0, 200.0, 400.0, 1000.0)
"""Rates for discrete figures in addition to the rate of the recording, Hz."""


def noise_report(result: NoiseIdentification, figures: NoiseFigures, horizon: float = HORIZON) -> str:
    """Return the report as one self-contained HTML page; the same input gives the same bytes."""
    found = document.counts(figures)
    word = 'good' if not found[WEAK] and not found[HELD] else 'weak'
    headline = f'{found[DETERMINED]} of {sum(found.values())} figures determined'
    first, *rest = document.lines(figures)
    return render('noise.html', title='Noise of an IMU', headline=headline, word=word, first=first, lines=rest, facts=_facts(figures),
                  tiles=_tiles(figures, horizon), tables=_tables(figures),
                  curves={sensor: draw_curve(result, sensor) for sensor in SENSORS},
                  filters=_filters(figures, horizon), horizon=text(horizon), rates=_rates(figures, horizon), runs=_runs(figures),
                  left_out=_shortest(figures), provenance=figures.provenance, frame=figures.frame_id)


def _facts(figures):
    bags = figures.provenance.get('bags') or []
    return [('recording', ', '.join(bag['name'] for bag in bags) or 'not named'), ('frame', figures.frame_id or 'not named'),
            ('sampling', f'{text(figures.rate, 4)} Hz'), ('at rest', document.duration(figures.recording['seconds_at_rest']))]


def _tiles(figures, horizon):
    """Return the numbers that most filters need."""
    tiles = []
    for sensor, unit, walk_unit in (('accelerometer', 'm/s²/√Hz', 'm/s³/√Hz'), ('gyroscope', 'rad/s/√Hz', 'rad/s²/√Hz')):
        found = figures.densities(sensor, horizon)
        for what, number, of, note in (('noise density', found.white, unit, 'of the worst axis'),
                                       ('random walk', found.walk, walk_unit, document.BASIS[found.basis])):
            tiles.append(tile(f'{sensor} {what}', text(number), of, note=note))
    return tiles


def _tables(figures):
    """Return the rows of each sensor, one group for every figure."""
    tables = {sensor: {} for sensor in SENSORS}
    for row in document.rows(figures):
        tables[row.sensor].setdefault((row.title, row.unit), []).append(row)
    return tables


def _filters(figures, horizon):
    rows = []
    for sensor in SENSORS:
        found = figures.densities(sensor, horizon)
        rows.append({'sensor': sensor, 'white': text(found.white, 4), 'walk': text(found.walk, 4), 'basis': document.BASIS[found.basis]})
    return rows


def _rates(figures, horizon):
    """Return the discrete figures for usual rates, that of the recording among them."""
    rows = []
    for rate in sorted({*RATES, round(figures.rate, 3)}):
        cells = []
        for sensor in SENSORS:
            found = figures.densities(sensor, horizon)
            cells += [text(found.sample_sd(rate)), text(found.step_sd(rate))]
        rows.append({'rate': text(rate, 4), 'cells': cells, 'own': abs(rate - figures.rate) < 1e-3 * figures.rate})
    return rows


def _runs(figures):
    """Return the rows of the budget in metres."""
    return [{'seconds': text(seconds), 'both': text(float(np.hypot(*shares.values())))} | {sensor: text(m) for sensor, m in shares.items()}
            for seconds, shares in position_budget(figures)]


def _shortest(figures):
    """Return the axes on which the shortest averaging times were not fitted."""
    return [{'name': f'{sensor} {letter}', 'from': text(axis.shortest)}
            for sensor in SENSORS for letter, axis in zip('xyz', figures.sensor(sensor)) if axis.shortest * figures.rate > 1.5]
