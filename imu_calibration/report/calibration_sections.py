"""Sections of the page of a calibration: origin, proof, error budget, observability, readings at rest."""

from functools import singledispatch
from typing import Any

import numpy as np

from imu_calibration.calibration.result import CalibrationResult, WindowErrors
from imu_calibration.calibration.table_result import TableResult
from imu_calibration.core.settings import describe
from imu_calibration.core.units import error_text, for_people
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import harmed, ratio_text
from imu_calibration.document.trust import usage
from imu_calibration.effects.base import PREFIXES, SENSORS
from imu_calibration.estimation.solution import DETERMINED
from imu_calibration.papers.zhang2017 import axis_readings
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.report.figures import AFTER, GREY, INK, STATUS, derived_section, draw, lever_section, log_axis
from imu_calibration.report.navigation_section import navigation_section
from imu_calibration.report.page import fixed, in_unit, parameter_groups, render, text, tile
from imu_calibration.report.residuals import draw_windows, residual_section


def recording_facts(result: CalibrationResult) -> list[tuple[str, str]]:
    """Return (item, value) of the recording, for the head of the page."""
    calibration, conditions = result.calibration, result.calibration.conditions
    bags = calibration.provenance.get('bags') or []
    facts = [('recording', ', '.join(bag['name'] for bag in bags) or 'not named'),
             ('date', str(conditions.get('date') or 'unknown').replace('T', ' ').replace('Z', ' UTC')),
             ('length', _duration(conditions.get('duration_s'))), ('frame', calibration.frame_id or 'not named'),
             ('reference', result.reference)]
    facts += [(name, str(calibration.provenance[name])) for name in ('serial', 'operator') if calibration.provenance.get(name)]
    if conditions.get('largest_rate'):
        facts.append(('fastest turn', in_unit(conditions['largest_rate'], 'rad/s')))
    if conditions.get('temperature_range_c'):
        facts.append(('temperature', ' to '.join(fixed(t, 1) for t in conditions['temperature_range_c']) + ' °C'))
    return facts


def _duration(seconds):
    if seconds is None:
        return 'unknown'
    minutes, rest = divmod(round(seconds), 60)
    return f'{minutes} min {rest} s' if minutes else f'{rest} s'


def origin_section(result: CalibrationResult) -> dict[str, Any]:
    """Return the tables of windows, drops, settings, table description and provenance."""
    calibration, statistics = result.calibration, result.calibration.statistics
    used = [(kind, count, (statistics.get('samples_used') or {}).get(kind, ''))
            for kind, count in (statistics.get('windows') or {}).items()]
    stream = statistics.get('stream') or {}
    kept_out = [(reason, count) for reason, count in stream.items() if reason not in dict(statistics.get('windows') or {}) and count]
    bags = [(bag['name'], bag['sha256']) for bag in calibration.provenance.get('bags') or []]
    return {'windows': used, 'kept_out': kept_out, 'dropped': list((statistics.get('dropped') or {}).items()),
            'warnings': [found['text'] for found in statistics.get('preflight') or []], 'settings': _settings(result.options),
            'table': table_rows(result), 'bags': bags, 'software': calibration.provenance.get('software', ''), 'gauge': calibration.gauge,
            'model': [(sensor, ' + '.join(getattr(calibration.model, sensor)) or 'nothing')
                      for sensor in ('accelerometer', 'gyroscope', 'reference')]}


def _settings(options):
    """Return (name, value, unit, meaning, whether it was changed) of the settings in force."""
    options = options or CalibrationOptions()
    values = [(item, getattr(options.windows, item.name)) for item in describe(options.windows)]
    return [(item.name, text(value), item.unit, item.text, value != item.default) for item, value in values]


def _joint(joint):
    said = [f'{"turns about" if joint.turns else "slides along"} ({", ".join(text(a) for a in joint.axis)})']
    if any(joint.xyz):
        said.append(f'at ({", ".join(text(a) for a in joint.xyz)}) m')
    if any(joint.rpy_deg):
        said.append(f'turned by roll, pitch, yaw ({", ".join(text(a) for a in joint.rpy_deg)})°')
    if joint.mimic is not None:
        said.append(f'follows {joint.mimic.joint} times {text(joint.mimic.multiplier)}')
    return ', '.join(said)


@singledispatch
def table_rows(_result: CalibrationResult) -> list[tuple[str, ...]]:
    """Return (item, value) of the table; empty for a calibration without a table."""
    return []


@table_rows.register
def _(result: TableResult):
    table = result.table
    rows = [(f'joint {joint.name}', _joint(joint)) for joint in table.joints]
    if table.joint_error_rad or table.joint_error_m:
        rows.append(('joints may be off by', ' and '.join(in_unit(value, unit) for value, unit in (
            (table.joint_error_rad, 'rad'), (table.joint_error_m, 'm')) if value) + ' (sd)'))
    rows += [('up', f'({", ".join(text(a) for a in table.up)})'),
             ('gravity', f'{fixed(table.gravity_value, 5)} m/s²' + (' as given' if table.gravity is not None else ', WGS 84 normal gravity')
              + (f', sd {text(table.gravity_sd_value)} m/s²' if table.gravity_sd_value else ''))]
    rows.append(('place', 'not given: Earth rate is estimated' if table.latitude is None
                 else f'latitude {text(table.latitude, 5)}°'
                 + (f', azimuth {text(table.azimuth_deg, 4)}°' if table.azimuth_deg is not None else ', azimuth not given')))
    rows.append(('mount', f'roll, pitch, yaw ({", ".join(text(a) for a in table.mount_rpy_deg)})°'
                 + ('; place not given' if table.mount_xyz is None else f'; at ({", ".join(text(a) for a in table.mount_xyz)}) m')))
    return rows


def proof_section(calibration: Calibration) -> list[dict[str, str | bool]]:
    """Return a row for each sensor and motion: 'sensor', 'motion', 'much', 'before', 'after', 'ratio', 'bad'; empty without a proof."""
    rows = []
    for sensor, found in calibration.proof.items():
        worse = harmed(found)
        for motion, part in (('all', found), *(found.get('regimes') or {}).items()):
            before, after = (error_text(part[name], part.get('unit', found['unit'])) for name in ('before', 'after'))
            much = f'{part["seconds"]:.0f} s' if 'seconds' in part else f'{found["windows"]}'
            rows.append({'sensor': sensor, 'motion': motion, 'much': much, 'before': before, 'after': after,
                         'ratio': ratio_text(part), 'bad': motion in worse})
    return rows


ROW = 0.155
"""Height of one bar, inches."""


def observability_section(result: CalibrationResult) -> dict[str, Any]:
    """Return figures and weak directions."""
    calibration = result.calibration
    live = calibration.sd > 0
    figures = {'bars': draw('bars', (8.6, 0.9 + ROW * live.sum()), _bars, result, live,
                            label='Standard deviation over tolerance of every parameter'),
               'correlation': draw('correlation', (7.2, 6.4), _heat_map, *_correlation(calibration, live),
                                   label='Correlation between the parameters')}
    if len(result.singular_values):
        figures['singular'] = draw('singular', (8.6, 2.5), _stems, result.singular_values,
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
    rest = rest.removeprefix(PREFIXES.get(sensor, '') + '_').replace('_', ' ').replace('.', ' ')
    return rest if sensor == 'reference' else f'{PREFIXES[sensor]} {rest}'


def _bars(figure, result, live):
    """One bar per parameter on a logarithmic axis, one at the tolerance."""
    calibration = result.calibration
    share = (calibration.sd / result.tolerances)[live]
    names = [n for n, flag in zip(calibration.param_names, live) if flag]
    colours = [STATUS[s] for s, flag in zip(calibration.status, live) if flag]
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


def _stems(figure, values):
    """Descending stems on a logarithmic axis."""
    values = np.maximum(values, 1e-3)
    axes = figure.subplots()
    place = np.arange(1, len(values) + 1)
    colours = [AFTER if v >= 1 else STATUS['held'] for v in values]
    axes.vlines(place, min(0.3, values.min() / 2), values, colors=colours, lw=2.2)
    axes.scatter(place, values, s=14, c=colours, zorder=3)
    axes.axhline(1.0, color=INK, lw=1.0)
    log_axis(axes.yaxis)
    axes.set_xlim(0, len(place) + 1)
    axes.set_ylim(bottom=min(0.3, values.min() / 2))
    axes.grid(axis='x', visible=False)
    axes.set_xlabel('direction, best determined first')
    axes.set_ylabel('tolerances per sd')


def _heat_map(figure, matrix, names):
    """Heat map with lines between the effects."""
    axes = figure.subplots()
    image = axes.imshow(matrix, cmap='RdBu_r', vmin=-1, vmax=1, interpolation='nearest')
    groups = [short_name(name.rpartition('.')[0] + '.').strip() for name in names]
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


CAUSE_COLOURS = {'noise': '#1f66a8', 'levelling': '#c0561b', 'joint position': '#2b8a57', 'table rate': '#8a5aa8', 'gravity': '#b8860b'}
MIN_DRAWN_SHARE = 1e-5
"""Shares of the tolerance below this are drawn at the edge."""


def budget_section(result: CalibrationResult) -> dict[str, Any]:
    """Return the figure, the rows (largest component of each effect) and the assumptions."""
    budget = result.error_budget()
    terms = {name: np.sqrt(np.maximum(variance, 0.0)) for name, variance in result.calibration.covariance_terms.items()
             if np.any(variance > 0)}
    return {'figure': draw('budget', (8.6, 0.9 + 0.26 * len(_effects(result))), _dots, result, budget,
                           label='Error budget of each effect by cause, in tolerances'),
            'causes': list(budget.causes), 'texts': [(cause, budget.texts[cause]) for cause in budget.causes],
            'rows': _rows(result, list(budget.causes.values()), budget.total), 'terms': list(terms),
            'term_rows': _rows(result, list(terms.values()), result.calibration.sd)}


def _effects(result):
    model = result.calibration.model
    return [(e, model.slices[e.key]) for e in model.effects if np.any(result.calibration.sd[model.slices[e.key]] > 0)]


def _rows(result, causes, total):
    """Return a row per effect: the sd of its largest component by cause, and the total."""
    rows = []
    for effect, part in _effects(result):
        factor, unit = for_people(effect.unit_of(0), effect.sensor)
        parts = [*causes, total]
        rows.append({'name': f'{effect.sensor} {effect.name.replace("_", " ")}', 'unit': '' if unit == '1' else unit,
                     'cells': [text(float(p[part].max()) * factor, 2) if p[part].max() > 1e-15 else '0' for p in parts],
                     'tolerance': text(result.tolerances[part][0] * factor, 2)})
    return rows


def _dots(figure, result, budget):
    """One line per effect, one dot per cause, in tolerances."""
    axes, effects = figure.subplots(), _effects(result)
    place = np.arange(len(effects))[::-1]
    highest = 1.0
    for cause, values in budget.causes.items():
        share = np.array([np.max(values[part] / result.tolerances[part]) for _, part in effects])
        highest = max(highest, share.max())
        shown = share > MIN_DRAWN_SHARE
        axes.plot(share[shown], place[shown], 'o', color=CAUSE_COLOURS.get(cause, INK), label=cause, markersize=6, ls='none')
    total = np.array([np.max(budget.total[part] / result.tolerances[part]) for _, part in effects])
    axes.plot(total, place, '|', color=INK, markersize=13, mew=1.6, label='total', ls='none')
    axes.axvline(1.0, color=INK, lw=1.0)
    log_axis(axes.xaxis)
    axes.set_xlim(MIN_DRAWN_SHARE, 3 * highest)
    axes.set_ylim(-0.7, len(effects) - 0.3)
    axes.set_yticks(place, [short_name(f'{e.sensor}.{e.name}') for e, _ in effects])
    axes.tick_params(axis='y', length=0)
    axes.set_xlabel('largest standard deviation / tolerance')
    axes.legend(ncols=6, loc='lower center', bbox_to_anchor=(0.45, 1.0), columnspacing=1.2, handletextpad=0.1)


LEVEL_FORCE_SHARE = 0.02
"""Windows with a mean specific force further than this share from 1 g turn through the vertical and have no reading at 1 g."""


def reading_tables(result: CalibrationResult, errors: WindowErrors) -> list[list[dict[str, Any]]]:
    """Return two lists of lines: at rest (Table 2) and in rotation (Table 4)."""
    gravity = result.gravity
    true = errors.true['accelerometer']
    chosen = (np.abs(np.linalg.norm(true, axis=1) / gravity - 1) < LEVEL_FORCE_SHARE) & (errors.kind != 'dynamic')
    lines = axis_readings(errors.measured['accelerometer'][chosen], (true + errors.after['accelerometer'])[chosen], true[chosen],
                          rate=np.linalg.norm(errors.true['gyroscope'][chosen], axis=1), gravity=gravity)
    return [_lines([line for line in lines if (line.rate_deg_s == 0) == at_rest]) for at_rest in (True, False)]


def _lines(readings):
    """Return lines of three sensors each: position, rate, and per sensor theoretical, before, after, errors in mg."""
    lines = []
    for first in range(0, len(readings), 3):
        triple = readings[first:first + 3]
        cells = [{'sensor': r.sensor, 'theory': fixed(r.theoretical_g, 5), 'before': fixed(r.before_g, 5), 'after': fixed(r.after_g, 5),
                  'error_before': text(abs(r.before_g - r.theoretical_g) * 1e3, 3),
                  'error_after': text(abs(r.after_g - r.theoretical_g) * 1e3, 2),
                  'gain': text(r.improvement, 2) if np.isfinite(r.improvement) else '–'} for r in triple]
        lines.append({'position': triple[0].position.replace('-', '−'), 'rate': text(triple[0].rate_deg_s), 'windows': triple[0].n_windows,
                      'cells': cells})
    return lines


def calibration_report(result: CalibrationResult) -> str:
    """
    Return the report of a calibration, on a table or by hand, as one self-contained HTML page.

    The same input gives the same bytes.

    Parameters
    ----------
    result : CalibrationResult

    """
    errors = result.window_errors()
    at_rest, moving = reading_tables(result, errors)
    navigation = navigation_section(result, errors)
    return render('calibration.html', title='IMU calibration', verdict=result.verdict, usage=usage(result.calibration),
                  facts=recording_facts(result), proof=proof_section(result.calibration), tiles=tiles(result, navigation),
                  groups=parameter_groups(result),
                  derived=derived_section(result), residuals=residual_section(result),
                  errors=[draw_windows(errors, sensor) for sensor in SENSORS],
                  observability=observability_section(result), levers=lever_section(result), navigation=navigation, at_rest=at_rest,
                  moving=moving, budget=budget_section(result), origin=origin_section(result), observations=result.observations)


def tiles(result: CalibrationResult, navigation: dict[str, Any]) -> list[dict[str, str | None]]:
    """Return the main figures: the determined parameters, and the errors before and after."""
    asked = list(result.calibration.requested.values())
    found = [tile('parameters determined', f'{asked.count(DETERMINED)} of {len(asked)}', note='to their tolerances')]
    for sensor, entry in result.calibration.proof.items():
        after, before = (error_text(entry[which], entry['unit']) for which in ('after', 'before'))
        number, _, unit = after.partition(' ')
        found.append(tile(f'{sensor} error on held-out data', number, unit, before=before, note=f'{entry["windows"]} windows'))
    if navigation['rest']:
        after, before = navigation['rest']['position'][::-1]
        found.append(tile('position error after 50 s at rest', after, 'm', before=f'{before} m',
                          note=f"part of the calibration: {navigation['rest']['parts'][0][2]} m"))
    return found
