"""noise.yaml: the figures of the noise with units, intervals and statuses, written and read."""

import math

import numpy as np

from imu_calibration.allan.figures import HORIZON, AxisFigures, NoiseFigures, TrendFigure
from imu_calibration.allan.processes import FLICKER, QUANTISATION, RANDOM_WALK, WHITE
from imu_calibration.allan.terms import DETERMINED, HELD, TIME, WEAK, Term
from imu_calibration.core.documents import finite, from_text, to_text
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.effects.base import AXES, SENSORS

FORMAT = 'imu_calibration/noise/1'
UNITS = {
    'accelerometer': {QUANTISATION.name: 'm/s', WHITE.name: 'm/s^2/sqrt(Hz)', FLICKER.name: 'm/s^2', 'gauss_markov': 'm/s^2', TIME: 's',
                      RANDOM_WALK.name: 'm/s^3/sqrt(Hz)', 'temperature': 'm/s^2/K', 'turn_on': 'm/s^2', 'ramp': 'm/s^3'},
    'gyroscope': {QUANTISATION.name: 'rad', WHITE.name: 'rad/s/sqrt(Hz)', FLICKER.name: 'rad/s', 'gauss_markov': 'rad/s', TIME: 's',
                  RANDOM_WALK.name: 'rad/s^2/sqrt(Hz)', 'temperature': 'rad/s/K', 'turn_on': 'rad/s', 'ramp': 'rad/s^2'}}
"""Unit of every figure."""
TERMS = (QUANTISATION.name, WHITE.name, FLICKER.name, 'gauss_markov', TIME, RANDOM_WALK.name)
STATUSES = (DETERMINED, WEAK, HELD)


def noise_to_text(figures: NoiseFigures, horizon: float = HORIZON) -> str:
    """Return noise.yaml."""
    return to_text(to_mapping(figures, horizon))


def to_mapping(figures: NoiseFigures, horizon: float = HORIZON) -> dict:
    """Return the document as plain dicts, lists, numbers and strings, in a fixed order."""
    document = {'format': FORMAT, 'frame_id': figures.frame_id, 'sampling_rate': float(f'{figures.rate:.9g}'),
                'recording': figures.recording}
    for sensor in SENSORS:
        document[sensor] = _sensor_section(sensor, figures.sensor(sensor))
    document['for_filters'] = {'horizon': horizon} | {sensor: _for_filters(figures, sensor, horizon) for sensor in SENSORS}
    document['allan_deviation'] = {'tau': list(figures.tau)} | {
        sensor: [list(axis.deviation) for axis in figures.sensor(sensor)] for sensor in SENSORS}
    document['provenance'] = figures.provenance
    return document


def _sensor_section(sensor, axes):
    section: dict = {}
    for name in TERMS:
        if any(name in axis.terms for axis in axes):
            section[name] = _entry([axis.terms.get(name) for axis in axes], UNITS[sensor][name])
    section['slow_part'] = [list(axis.form) for axis in axes]
    section['also_possible'] = [[list(form) for form in axis.others] for axis in axes]
    section['alternatives'] = {name: _entry([axis.alternatives.get(name) for axis in axes], UNITS[sensor][name])
                               for name in TERMS if any(name in axis.alternatives for axis in axes)}
    section['taken_out'] = _trends(sensor, axes)
    section['record_for'] = {name: [axis.record_for.get(name) for axis in axes]
                             for name in TERMS if any(name in axis.record_for for axis in axes)}
    section['sample_sd'] = [float(axis.sample_sd) for axis in axes]
    section['shortest_averaging_time'] = [float(axis.shortest) for axis in axes]
    section['excess'] = [float(axis.excess) for axis in axes]
    section['scatter_between_rests'] = [float(axis.scatter) for axis in axes]
    section['oscillation'] = [None if axis.oscillation is None else list(axis.oscillation) for axis in axes]
    return section


def _entry(terms, unit):
    """Return value, interval, status, reason and unit of three axes; None where an axis has no such figure."""
    return {'value': [None if term is None or term.value is None else float(term.value) for term in terms],
            'interval95': [None if term is None else [finite(end) for end in term.interval] for term in terms],
            'status': [None if term is None else term.status for term in terms],
            'reason': ['' if term is None else term.reason for term in terms], 'unit': unit}


def _trends(sensor, axes):
    names = dict.fromkeys(trend.name for axis in axes for trend in axis.trends)
    found = {}
    for name in names:
        trends = [next((trend for trend in axis.trends if trend.name == name), None) for axis in axes]
        found[name] = {key: [None if trend is None else float(getattr(trend, key)) for trend in trends] for key in ('value', 'sd')}
        if name == 'turn_on':
            found[name]['time_constant'] = [None if trend is None else float(trend.time) for trend in trends]
        found[name]['unit'] = UNITS[sensor][name]
    return found


def _for_filters(figures, sensor, horizon):
    """Return the parameters of most filters, continuous and at the rate of the recording."""
    found = figures.densities(sensor, horizon)
    return {'white_noise': found.white, 'random_walk': finite(found.walk), 'random_walk_is': found.basis,
            'sample_sd': found.sample_sd(figures.rate), 'bias_step_sd': finite(found.step_sd(figures.rate))}


def noise_from_text(text: str) -> NoiseFigures:
    """
    Return the figures in noise.yaml.

    Raises
    ------
    DocumentError
        When the text is no such document, newer, or a figure is missing or cannot be.

    """
    try:
        document = from_text(text, 'noise document')
    except InputError as error:
        raise DocumentError(str(error), code=error.code) from error
    found = str(document.get('format'))
    if found != FORMAT:
        raise DocumentError(f"a noise document must have 'format: {FORMAT}', got '{found}'; give a file written by 'imu_calibration noise'",
                            code='document_format')
    try:
        return _parse(document)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise DocumentError(f'a noise document must have the parts of {FORMAT}, one is missing or has another shape '
                            f'({type(error).__name__}: {error}); identify the noise again', code='document_parts') from error


def _parse(document):
    curve = document.get('allan_deviation') or {}
    sensors = {sensor: tuple(_axis(document[sensor], k, (curve.get(sensor) or [[]] * 3)[k]) for k in range(len(AXES)))
               for sensor in SENSORS}
    rate = float(document['sampling_rate'])
    if not (math.isfinite(rate) and rate > 0):
        raise DocumentError(f'the sampling rate must be above zero, got {rate:g}; write the noise document again', code='rate_not_positive')
    return NoiseFigures(**sensors, rate=rate, frame_id=str(document.get('frame_id', '')), recording=dict(document.get('recording') or {}),
                        tau=tuple(float(t) for t in curve.get('tau') or ()), provenance=dict(document.get('provenance') or {}))


def _axis(section, k, deviation):
    terms = {name: _term(name, section[name], k) for name in TERMS if name in section and section[name]['interval95'][k] is not None}
    for needed in (WHITE.name, RANDOM_WALK.name):
        if needed not in terms:
            raise DocumentError(f"every axis must have '{needed}', it is missing; write the noise document again", code='part_missing')
    alternatives = {name: _term(name, entry, k) for name, entry in (section.get('alternatives') or {}).items()
                    if entry['interval95'][k] is not None}
    trends = tuple(TrendFigure(name, float(entry['value'][k]), float(entry['sd'][k]), float(entry.get('time_constant', [0, 0, 0])[k]))
                   for name, entry in (section.get('taken_out') or {}).items() if entry['value'][k] is not None)
    record_for = {name: values[k] for name, values in (section.get('record_for') or {}).items() if terms[name].status != DETERMINED}
    others = tuple(tuple(form) for form in section['also_possible'][k])
    return AxisFigures(terms, tuple(section['slow_part'][k]), others, alternatives, trends, record_for, float(section['sample_sd'][k]),
                       float(section['shortest_averaging_time'][k]), float(section['excess'][k]),
                       _pair((section.get('oscillation') or [None] * 3)[k]),
                       float((section.get('scatter_between_rests') or [0.0] * 3)[k]), tuple(float(v) for v in deviation))


def _pair(values):
    return None if values is None else (float(values[0]), float(values[1]))


def _term(name, entry, k):
    value, status = entry['value'][k], entry['status'][k]
    interval = tuple(math.inf if end is None else float(end) for end in entry['interval95'][k])
    if status not in STATUSES or len(interval) != 2 or not 0 <= interval[0] <= interval[1]:
        raise DocumentError(f"'{name}' must have a status ({', '.join(STATUSES)}) and an interval of two numbers in rising order, got "
                            f'{status!r} and {list(interval)}; write the noise document again', code='status_or_interval')
    if (value is None) != (status == HELD) or (value is not None and not np.isfinite(float(value))):
        raise DocumentError(f"'{name}' must have a finite value unless it is held, got {value!r} and '{status}'; "
                            'write the noise document again', code='value_missing')
    return Term(name, None if value is None else float(value), interval, status, str((entry.get('reason') or [''] * 3)[k]))
