"""The report of an identification of noise: the figures first, then the curves and derived values."""

import numpy as np

from imu_calibration.allan import document
from imu_calibration.allan.document import position_budget
from imu_calibration.allan.figures import HORIZON, NoiseFigures
from imu_calibration.allan.identify import NoiseIdentification
from imu_calibration.allan.terms import DETERMINED, HELD, WEAK
from imu_calibration.effects.base import SENSORS
from imu_calibration.report.noise_curve import draw_curve
from imu_calibration.report.numbers import text
from imu_calibration.report.page import render

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
            tiles.append({'what': f'{sensor} {what}', 'number': text(number), 'unit': of, 'before': '', 'note': note})
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
