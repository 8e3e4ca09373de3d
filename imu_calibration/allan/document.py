"""noise.yaml and its summary for people."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from scipy.linalg import toeplitz

from imu_calibration.allan.figures import HORIZON, SLOW_PROCESSES, AxisFigures, NoiseFigures
from imu_calibration.allan.processes import (
    FLICKER,
    QUANTISATION,
    RANDOM_WALK,
    WHITE,
    NoiseProcess,
    mean_covariance,
)
from imu_calibration.allan.terms import GAUSS_MARKOV, TIME_KEY, Term
from imu_calibration.allan.trends import AxisTrend
from imu_calibration.core.documents import finite, from_text, to_text
from imu_calibration.core.errors import DocumentError
from imu_calibration.core.exit_codes import dropped_text, exit_code_of
from imu_calibration.core.schema import (
    Document,
    Requirement,
    list_of,
    mapping,
    maybe,
    number,
    require,
    text,
)
from imu_calibration.core.units import NOISE_QUANTITY, STANDARD_GRAVITY, for_people, significant
from imu_calibration.effects.base import AXES, SENSORS, UNITS
from imu_calibration.estimation.solution import DETERMINED, HELD, WEAK

NOISE_FORMAT = 'imu_calibration/noise/1'
NOISE_UNITS = {
    'accelerometer': {
        QUANTISATION.name: 'm/s',
        WHITE.name: 'm/s^2/sqrt(Hz)',
        FLICKER.name: 'm/s^2',
        GAUSS_MARKOV: 'm/s^2',
        TIME_KEY: 's',
        RANDOM_WALK.name: 'm/s^3/sqrt(Hz)',
        'temperature': 'm/s^2/K',
        'turn_on': 'm/s^2',
        'ramp': 'm/s^3',
    },
    'gyroscope': {
        QUANTISATION.name: 'rad',
        WHITE.name: 'rad/s/sqrt(Hz)',
        FLICKER.name: 'rad/s',
        GAUSS_MARKOV: 'rad/s',
        TIME_KEY: 's',
        RANDOM_WALK.name: 'rad/s^2/sqrt(Hz)',
        'temperature': 'rad/s/K',
        'turn_on': 'rad/s',
        'ramp': 'rad/s^2',
    },
}
"""Unit of every figure."""
TERMS = (QUANTISATION.name, WHITE.name, FLICKER.name, GAUSS_MARKOV, TIME_KEY, RANDOM_WALK.name)
LARGEST_FIGURE = 1e30
"""Figures of a document at most; their squares are finite."""
STATUSES = (DETERMINED, WEAK, HELD)
"""Statuses of a figure."""
_FIGURE = number(-LARGEST_FIGURE, LARGEST_FIGURE)
_SIZE = number(0.0, LARGEST_FIGURE)
_BOUND = number(0.0, LARGEST_FIGURE, code='status_or_interval')
_FORM = list_of(text(*TERMS, code='not_a_text'))


def _of_axes(each: Requirement) -> Requirement:
    """Require a list with one item for each axis."""
    return list_of(each, len(AXES))


_TERM = mapping(
    {
        'value': _of_axes(maybe(_SIZE)),
        'interval95': _of_axes(maybe(list_of(maybe(_BOUND), 2, code='status_or_interval'))),
        'status': _of_axes(maybe(text(*STATUSES, code='status_or_interval'))),
    },
    {'reason': maybe(_of_axes(text(code='not_a_text')))},
)
_TREND = mapping(
    {'value': _of_axes(maybe(_FIGURE)), 'sd': _of_axes(maybe(_SIZE))},
    {'time_constant': _of_axes(maybe(_SIZE))},
)
_SENSOR = mapping(
    {
        'slow_part': _of_axes(_FORM),
        'also_possible': _of_axes(list_of(_FORM)),
        **dict.fromkeys(('sample_sd', 'shortest_averaging_time', 'excess'), _of_axes(_SIZE)),
    },
    {
        **dict.fromkeys(TERMS, _TERM),
        'alternatives': maybe(mapping(optional=dict.fromkeys(TERMS, _TERM), closed=True)),
        'taken_out': maybe(
            mapping(optional=dict.fromkeys(('temperature', 'turn_on', 'ramp'), _TREND), closed=True)
        ),
        'record_for': maybe(mapping(each=_of_axes(maybe(_SIZE)))),
        'scatter_between_rests': maybe(_of_axes(_SIZE)),
        'oscillation': maybe(_of_axes(maybe(list_of(_SIZE, 2)))),
    },
)
_CURVE = list_of(_SIZE)
NOISE = Document(
    'noise document',
    mapping(
        {'sampling_rate': number(0.0, LARGEST_FIGURE, above=True, code='rate_not_positive')},
        {
            **dict.fromkeys(SENSORS, _SENSOR),
            'frame_id': text(code='not_a_text'),
            'recording': maybe(mapping(optional={'seconds_at_rest': maybe(_SIZE)})),
            'provenance': maybe(mapping()),
            'allan_deviation': maybe(
                mapping(
                    optional={
                        'tau': maybe(_CURVE),
                        **dict.fromkeys(SENSORS, maybe(_of_axes(_CURVE))),
                    }
                )
            ),
        },
    ),
    'identify the noise again',
    dict.fromkeys(('type', 'range'), 'figure_not_a_number')
    | dict.fromkeys(('missing', 'unknown', 'length'), 'document_parts'),
)


def noise_to_text(figures: NoiseFigures, horizon: float = HORIZON) -> str:
    """Return noise.yaml."""
    return to_text(noise_mapping(figures, horizon))


def noise_mapping(figures: NoiseFigures, horizon: float = HORIZON) -> dict:
    """Return the document as plain dicts, lists, numbers and strings, in a fixed order."""
    document: dict[str, Any] = {
        'format': NOISE_FORMAT,
        'frame_id': figures.frame_id,
        'sampling_rate': float(f'{figures.rate:.9g}'),
        'recording': figures.recording,
    }
    for sensor in figures.sensors:
        document[sensor] = _sensor_section(sensor, figures.sensor(sensor))
    document['for_filters'] = {'horizon': horizon}
    document['allan_deviation'] = {'tau': list(figures.tau)}
    for sensor in figures.sensors:
        document['for_filters'][sensor] = _for_filters(figures, sensor, horizon)
        deviations = [list(axis.deviation) for axis in figures.sensor(sensor)]
        document['allan_deviation'][sensor] = deviations
    document['provenance'] = figures.provenance
    return document


def _sensor_section(sensor: str, axes: Sequence[AxisFigures]) -> dict[str, Any]:
    """Return the section of a sensor: each key has a list with one item for each axis."""
    section = _entries(sensor, [axis.terms for axis in axes])
    section['slow_part'] = [list(axis.form) for axis in axes]
    section['also_possible'] = [list(map(list, axis.others)) for axis in axes]
    section['alternatives'] = _entries(sensor, [axis.alternatives for axis in axes])
    section['taken_out'] = _trends(sensor, axes)
    section['record_for'] = {}
    for name in TERMS:
        if any(name in axis.record_for for axis in axes):
            section['record_for'][name] = [axis.record_for.get(name) for axis in axes]
    section['sample_sd'] = [float(axis.sample_sd) for axis in axes]
    section['shortest_averaging_time'] = [float(axis.shortest) for axis in axes]
    section['excess'] = [float(axis.excess) for axis in axes]
    section['scatter_between_rests'] = [float(axis.scatter) for axis in axes]
    section['oscillation'] = [
        None if axis.oscillation is None else list(axis.oscillation) for axis in axes
    ]
    return section


def _entries(sensor: str, terms_of_axes: Sequence[Mapping[str, Term]]) -> dict[str, Any]:
    """Return name -> entry of each term that an axis has, in the order of `TERMS`."""
    entries: dict[str, Any] = {}
    for name in TERMS:
        if any(name in terms for terms in terms_of_axes):
            terms_of_name = [terms.get(name) for terms in terms_of_axes]
            entries[name] = _entry(terms_of_name, NOISE_UNITS[sensor][name])
    return entries


def _entry(terms: Sequence[Term | None], unit: str) -> dict[str, Any]:
    """
    Return the entry of one term: value, interval, status and reason of each axis, and the unit.

    `terms`: that of each axis; None where an axis has no such figure.
    """
    values = []
    intervals = []
    for term in terms:
        value = None if term is None else term.value
        values.append(None if value is None else float(value))
        intervals.append(None if term is None else list(map(finite, term.interval)))
    return {
        'value': values,
        'interval95': intervals,
        'status': [None if term is None else term.status for term in terms],
        'reason': ['' if term is None else term.reason for term in terms],
        'unit': unit,
    }


def _trends(sensor: str, axes: Sequence[AxisFigures]) -> dict[str, Any]:
    """Return name -> value, sd and unit of each trend that was subtracted, by axis."""
    # Name -> trend of each axis, in the order of the first axis that has it.
    trends_of: dict[str, list[Any]] = {}
    for index, axis in enumerate(axes):
        for trend in axis.trends:
            trends_of.setdefault(trend.name, [None] * len(axes))[index] = trend
    entries: dict[str, Any] = {}
    for name, trends in trends_of.items():
        entry: dict[str, Any] = {
            'value': [None if trend is None else float(trend.value) for trend in trends],
            'sd': [None if trend is None else float(trend.sd) for trend in trends],
        }
        if name == 'turn_on':
            times = [None if trend is None else float(trend.time) for trend in trends]
            entry['time_constant'] = times
        entry['unit'] = NOISE_UNITS[sensor][name]
        entries[name] = entry
    return entries


def _for_filters(figures: NoiseFigures, sensor: str, horizon: float) -> dict[str, Any]:
    """Return the parameters of most filters, continuous and at the rate of the recording."""
    densities = figures.densities(sensor, horizon)
    return {
        'white_noise': densities.white,
        'random_walk': finite(densities.walk),
        'random_walk_is': densities.basis,
        'sample_sd': densities.sample_sd(figures.rate),
        'bias_step_sd': finite(densities.step_sd(figures.rate)),
    }


def noise_from_text(text: str) -> NoiseFigures:
    """
    Return the figures in noise.yaml.

    Raises
    ------
    DocumentError
        When the text is no such document, newer, or a figure is missing or cannot be.

    """
    return noise_from_mapping(from_text(text, 'noise document'))


def noise_from_mapping(document: Mapping[str, Any]) -> NoiseFigures:
    """Return the figures in the mapping of noise.yaml; raises as `noise_from_text`."""
    received = str(document.get('format'))
    if received != NOISE_FORMAT:
        raise DocumentError(
            f"a noise document must have 'format: {NOISE_FORMAT}', got '{received}'; give a file"
            " written by 'imu_calibration noise'",
            code='document_format',
        )
    require(document, NOISE)
    curve = document.get('allan_deviation') or {}
    figures = {}
    for sensor in SENSORS:
        if sensor in document:
            deviations = curve.get(sensor) or [[]] * len(AXES)
            figures[sensor] = tuple(
                _axis(document[sensor], k, deviations[k]) for k in range(len(AXES))
            )
    if not figures:
        raise DocumentError(
            'a noise document must have figures of a sensor, it has none; write the noise document'
            ' again',
            code='part_missing',
        )
    return NoiseFigures(
        figures.get('accelerometer', ()),
        figures.get('gyroscope', ()),
        rate=float(document['sampling_rate']),
        frame_id=document.get('frame_id', ''),
        recording=document.get('recording') or {},
        tau=tuple(map(float, curve.get('tau') or ())),
        provenance=document.get('provenance') or {},
    )


def _axis(section: Mapping[str, Any], k: int, deviation: Sequence[float]) -> AxisFigures:
    """Return the figures of axis k in the section of a sensor, with its Allan deviations."""
    terms = _terms({name: section[name] for name in TERMS if name in section}, k)
    form = section['slow_part'][k]
    time_constant = [TIME_KEY] if GAUSS_MARKOV in form else []
    for needed in (WHITE.name, RANDOM_WALK.name, *form, *time_constant):
        if needed not in terms:
            raise DocumentError(
                f"every axis must have '{needed}', it is missing; write the noise document again",
                code='part_missing',
            )
    trends = []
    for name, entry in (section.get('taken_out') or {}).items():
        if entry['value'][k] is not None:
            value = float(entry['value'][k])
            sd = float(entry['sd'][k])
            time = float(entry.get('time_constant', [0, 0, 0])[k])
            trends.append(AxisTrend(name, value, sd, time))

    # The recording time that would determine a figure.
    record_for = {}
    for name, values in (section.get('record_for') or {}).items():
        if name in terms and terms[name].status != DETERMINED:
            record_for[name] = values[k]

    # Parts that a document may omit.
    oscillation = (section.get('oscillation') or [None] * 3)[k]
    scatter = (section.get('scatter_between_rests') or [0.0] * 3)[k]
    return AxisFigures(
        terms,
        tuple(form),
        others=tuple(tuple(other) for other in section['also_possible'][k]),
        alternatives=_terms(section.get('alternatives') or {}, k),
        shortest=float(section['shortest_averaging_time'][k]),
        excess=float(section['excess'][k]),
        oscillation=None if oscillation is None else (float(oscillation[0]), float(oscillation[1])),
        scatter=float(scatter),
        trends=tuple(trends),
        record_for=record_for,
        sample_sd=float(section['sample_sd'][k]),
        deviation=tuple(map(float, deviation)),
    )


def _terms(entries: Mapping[str, Any], k: int) -> dict[str, Term]:
    """Return the figures of axis k; an entry without an interval does not exist on this axis."""
    terms = {}
    for name, entry in entries.items():
        if entry['interval95'][k] is not None:
            terms[name] = _term(name, entry, k)
    return terms


def _term(name: str, entry: Mapping[str, Any], k: int) -> Term:
    """Return the figure of axis k in an entry of `_entry`; raises DocumentError."""
    value = entry['value'][k]
    status = entry['status'][k]
    # An end without a number is infinite: `_entry` writes null for it.
    lower, upper = entry['interval95'][k]
    interval = (math.inf if lower is None else lower, math.inf if upper is None else upper)
    if status is None or interval[0] > interval[1]:
        raise DocumentError(
            f"'{name}' must have a status ({', '.join(STATUSES)}) and an interval of two numbers in"
            f' rising order, got {status!r} and {list(interval)}; write the noise document again',
            code='status_or_interval',
        )
    if (value is None) != (status == HELD):
        raise DocumentError(
            f"'{name}' must have a finite value unless it is held, got {value!r} and '{status}'; "
            'write the noise document again',
            code='value_missing',
        )
    return Term(
        name,
        None if value is None else float(value),
        interval,
        status,
        (entry.get('reason') or [''] * 3)[k],
    )


MAX_RUN_BLOCKS, MAX_NAVIGATION_BLOCKS = 150, 1000
"""Blocks of the run at most, and of alignment and run together."""
RUNS = (1.0, 10.0, 60.0, 600.0)
"""Lengths of dead reckoning, s."""


def position_budget(figures: NoiseFigures) -> list[tuple[float, dict[str, float]]]:
    """
    Return the standard deviation of the position along one horizontal axis after each of `RUNS`, m.

    By sensor, of the worst axes.
    """
    budget = []
    for seconds in RUNS:
        worst = {}
        for sensor in figures.sensors:
            axes = figures.sensor(sensor)
            worst[sensor] = max(_position_sd_of_axis(axis, sensor, seconds) for axis in axes)
        budget.append((seconds, worst))
    return budget


def _position_sd_of_axis(axis: AxisFigures, sensor: str, seconds: float) -> float:
    """Return the standard deviation of the position by all processes of an axis, m."""
    processes = axis.processes()
    shares = position_sd(
        [process for process, _ in processes],
        [coefficient for _, coefficient in processes],
        sensor,
        seconds=seconds,
    )
    return float(np.sqrt((shares**2).sum()))


def position_sd(
    processes: Sequence[NoiseProcess],
    coefficients: Sequence[float],
    sensor: str,
    *,
    seconds: float,
    alignment: float = 60.0,
    gravity: float = STANDARD_GRAVITY,
) -> np.ndarray:
    """
    Return the standard deviation of the position by each process of one axis, m.

    Shape (n_processes,). With the means m_k of the sensor's noise over blocks of h seconds, the
    bias b, which is the mean over the alignment, and the time u_k from the middle of a block to the
    end of the run::

        accelerometer: position = sum_k u_k h (m_k - b)
        gyroscope:     position = sum_k g u_k^2 h / 2 (m_k - b)    tilt turns gravity into it

    Parameters
    ----------
    processes : sequence of NoiseProcess
    coefficients : sequence of float
        Squares of the figures.
    sensor : str
        'accelerometer' or 'gyroscope'.
    seconds : float
        Length of the run.
    alignment : float
        Time at rest before it, over which the bias is averaged, s.
    gravity : float
        m/s^2.

    """
    # Blocks of the run and of the alignment, of the same length.
    n_run = int(
        np.ceil(min(MAX_RUN_BLOCKS, MAX_NAVIGATION_BLOCKS * seconds / (seconds + alignment)))
    )
    step = seconds / n_run
    n_alignment = max(round(alignment / step), 1)

    # Weights of the blocks in the position, the alignment first; their sum is zero.
    until_end = (n_run - np.arange(n_run) - 0.5) * step
    weights = until_end * step if sensor == 'accelerometer' else 0.5 * gravity * until_end**2 * step
    weights = np.concatenate([np.full(n_alignment, -weights.sum() / n_alignment), weights])
    lag = np.arange(n_alignment + n_run) * step
    variances = [
        weights @ toeplitz(mean_covariance(process, lag, step)) @ weights for process in processes
    ]
    return np.sqrt(np.maximum(np.array(variances), 0.0) * np.asarray(coefficients, float))


TITLES = {
    'quantisation': 'quantisation Q',
    'white_noise': 'white noise N',
    'bias_instability': 'bias instability B',
    GAUSS_MARKOV: 'Gauss–Markov σ',
    TIME_KEY: 'correlation time τ',
    'random_walk': 'random walk K',
    'temperature': 'follows the temperature',
    'turn_on': 'settles after turn-on',
    'ramp': 'drifts steadily',
}
BASIS = {
    'walk': 'as found',
    'equivalent': 'equivalent of the slow noise',
    'bound': 'none detected: upper limit',
}
NO_BOUND = 'no bound'
WORTH_SAYING = 0.04
"""Scatter of the variances between rests above which it is reported: two per cent of the noise."""


@dataclass(frozen=True)
class FigureRow:
    """One figure of one axis as text."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    axis: str
    """'x', 'y' or 'z'."""
    name: str
    """Name in noise.yaml."""
    title: str
    """Usual name, with its letter."""
    value: str
    """The figure; '<' and the upper end where it is held."""
    interval: str
    """95 %."""
    unit: str
    """The unit that data sheets use."""
    status: str
    """'determined', 'weak' or 'held'."""
    note: str
    """Why it is not determined, and for how long one must record."""


def rows(figures: NoiseFigures) -> list[FigureRow]:
    """Return the figures of all axes, sensor by sensor, figure by figure."""
    figure_rows = []
    for sensor in figures.sensors:
        for name in TERMS:
            for letter, axis in zip(AXES, figures.sensor(sensor)):
                if name in axis.terms:
                    figure_rows.append(_row(sensor, letter, axis, axis.terms[name]))
    return figure_rows


def _row(sensor: str, letter: str, axis: AxisFigures, term: Term) -> FigureRow:
    """Return the row of a figure, in a unit for people; a bound where it has no value."""
    factor, unit = for_people(NOISE_UNITS[sensor][term.name], NOISE_QUANTITY)
    lower, upper = (end * factor for end in term.interval)
    if term.value is None:
        value = f'< {significant(upper)}' if np.isfinite(upper) else NO_BOUND
        interval = ''
    else:
        value = _digits(term.value * factor, upper - lower)
        interval = f'{_digits(lower, upper - lower)} … {_digits(upper, upper - lower)}'
    return FigureRow(
        sensor,
        letter,
        term.name,
        TITLES[term.name],
        value,
        interval,
        unit,
        term.status,
        _note(axis, term),
    )


def _digits(value: float, width: float) -> str:
    """Return a value with the digits that an interval of this width supports."""
    if not np.isfinite(width) or width <= 0 or not 0 < value < np.inf:
        return '0' if value == 0 else _bounded(value)
    return significant(value, int(np.clip(np.ceil(np.log10(value / width)) + 2, 2, 6)))


def _bounded(value: float) -> str:
    """Return a figure as text; one that is not finite has no bound."""
    return significant(value) if np.isfinite(value) else NO_BOUND


def _note(axis: AxisFigures, term: Term) -> str:
    """Return why a figure is not determined, and the recording time that determines it."""
    parts = [term.reason] if term.reason else []
    if term.name in axis.record_for:
        seconds = axis.record_for[term.name]
        time = 'more than two days' if seconds is None else duration(seconds)
        parts.append(f'needs {time}')
    return '; '.join(parts)


def duration(seconds: float) -> str:
    """Return a length of time in the largest units that suit."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f'{seconds:.0f} s'
    if minutes < 120:
        return f'{minutes} min'
    return f'{minutes / 60:.3g} h'


def requested(axis: AxisFigures) -> list[Term]:
    """
    Return the figures of an axis that count.

    White noise and the slow part, or the random walk where no slow part is seen.
    """
    names = [WHITE.name, *(axis.form or (RANDOM_WALK.name,))]
    if GAUSS_MARKOV in names:
        names.append(TIME_KEY)
    return [axis.terms[name] for name in names]


def _all_axes(figures: NoiseFigures) -> Iterator[AxisFigures]:
    """Return the axes of all sensors."""
    return chain.from_iterable(figures.sensor(sensor) for sensor in figures.sensors)


def counts(figures: NoiseFigures) -> dict[str, int]:
    """Return how many of the figures that count are determined, weak and held."""
    statuses: list[str] = []
    for axis in _all_axes(figures):
        statuses += [term.status for term in requested(axis)]
    return {status: statuses.count(status) for status in STATUSES}


def noise_exit_code(figures: NoiseFigures) -> int:
    """Return 0 when every required figure is determined and few samples were dropped, else 3."""
    return exit_code_of(noise_shortcomings(figures))


def noise_shortcomings(figures: NoiseFigures) -> list[str]:
    """Return why the exit code is 3, a line each; empty for 0."""
    n_of_status = counts(figures)
    lines = []
    lacking = n_of_status[WEAK] + n_of_status[HELD]
    if lacking:
        lines.append(f'{lacking} of {sum(n_of_status.values())} noise figures are not determined')
    for sensor, why in (figures.recording.get('unusable') or {}).items():
        lines.append(f'the noise of the {sensor} is not identified: {why}')
    n_samples = round(figures.recording.get('seconds_at_rest', 0.0) * figures.rate)
    dropped = dropped_text(figures.recording.get('dropped') or {}, n_samples)
    if dropped:
        lines.append(dropped)
    return lines


def lines(figures: NoiseFigures) -> list[str]:
    """
    Return the notes on the figures.

    Excluded parts, subtracted trends, other forms that fit, required recording time.
    """
    notes = [_rest_line(figures.recording), *_fault_lines(figures.recording)]
    for sensor in SENSORS:
        if sensor not in figures.sensors:
            why = (figures.recording.get('unusable') or {}).get(sensor, 'it has no readings')
            notes.append(f'no figures of the {sensor}: {why}')
    for sensor in figures.sensors:
        for letter, axis in zip(AXES, figures.sensor(sensor)):
            notes += _axis_lines(f'{sensor} {letter}', sensor, axis)
    if any(set(axis.form) & set(SLOW_PROCESSES) for axis in _all_axes(figures)):
        notes.append(
            'slow noise (bias instability, Gauss–Markov, random walk): the intervals are valid for'
            ' this recording; values of a second recording can lie outside'
        )
    recording_time = _recording_time(figures)
    if recording_time:
        notes.append(recording_time)

    # The error of dead reckoning: the sensors are independent.
    runs = []
    for seconds, shares in position_budget(figures):
        sd = float(np.linalg.norm(list(shares.values())))
        runs.append(f'{significant(sd, 2)} m after {duration(seconds)}')
    notes.append(f'error of dead reckoning from rest by noise only: {", ".join(runs)}')
    return notes


def _rest_line(recording: Mapping[str, Any]) -> str:
    """Return the time at rest that was used, and what of it was left out."""
    line = f'at rest: {duration(recording["seconds_at_rest"])}'
    if recording['parts'] != 1:
        longest = duration(recording['longest_part'])
        line += f' in {recording["parts"]} parts, the longest {longest}'
    left_out = []
    for name, seconds in recording['left_out'].items():
        if seconds >= 0.05:  # less is printed as 0.0
            left_out.append(f'{seconds:.1f} s of {name.replace("_", " ")}')
    if left_out:
        line += f'; left out: {", ".join(left_out)}'
    return line


def _fault_lines(recording: Mapping[str, Any]) -> list[str]:
    """Return a line for each sensor or axis with readings that are not noise of the sensor."""
    notes = []
    for name, entry in (recording.get('faults') or {}).items():
        share = entry['white_noise_too_high_by'] - 1.0
        cause = 'outliers (heavy tails, torn register reads)'
        if 'repeated' in entry:
            cause = f'{entry["repeated"]:.0%} repeated readings'
        notes.append(
            f'{name}: white noise may be up to {share:.1%} too high because of {cause}; its'
            ' interval is wider by that'
        )
    return notes


def _axis_lines(name: str, sensor: str, axis: AxisFigures) -> list[str]:
    """Return the notes on one axis: trends, other forms, misfit of the curve, scatter of rests."""
    notes = []
    for trend in axis.trends:
        factor, unit = for_people(NOISE_UNITS[sensor][trend.name], NOISE_QUANTITY)
        constant = f' within {duration(trend.time)}' if trend.name == 'turn_on' else ''
        size = f'{significant(trend.value * factor)} ± {significant(trend.sd * factor, 2)} {unit}'
        notes.append(f'{name} {TITLES[trend.name]}: {size}{constant}; removed')
    if axis.others:
        others = ' or '.join(said(form) for form in axis.others)
        notes.append(f'{name}: {others} explains the curve as well as {said(axis.form)}')
    if axis.excess > 1:
        notes.append(
            f'{name}: the curve deviates from every model by {np.sqrt(axis.excess):.2g} times the'
            f' chance limit{_hump(sensor, axis)}; intervals are wider by that'
        )
    if axis.scatter > WORTH_SAYING:
        notes.append(
            f'{name}: from rest to rest the noise differs by {axis.scatter / 2:.0%} beyond chance;'
            ' intervals are wider by that'
        )
    return notes


def _hump(sensor: str, axis: AxisFigures) -> str:
    """Return the line of the periodogram at the hump of a curve, or ''."""
    if axis.oscillation is None:
        return ''
    frequency, amplitude = axis.oscillation
    factor, unit = for_people(UNITS[sensor], NOISE_QUANTITY)
    return (
        f', with an oscillation of {significant(amplitude * factor, 2)} {unit} at'
        f' {significant(frequency, 3)} Hz'
    )


def said(form: tuple[str, ...]) -> str:
    """Return a form as text."""
    if not form:
        return 'white noise alone'
    names = [name.replace('_', ' ') for name in form]
    return ' and '.join(names).replace('gauss markov', 'a Gauss–Markov process')


def _recording_time(figures: NoiseFigures) -> str:
    """Return the recording time that determines all required figures, or ''."""
    needed = []
    for axis in _all_axes(figures):
        names = [term.name for term in requested(axis)]
        needed += [axis.record_for[name] for name in names if name in axis.record_for]
    if not needed:
        return ''
    known = [seconds for seconds in needed if seconds is not None]
    # None: more than the longest time that is tried.
    time = duration(max(known)) if len(known) == len(needed) else 'more than two days'
    return f'to determine all of them: record {time} at rest'


def filter_lines(
    figures: NoiseFigures, rates: Sequence[float], horizon: float = HORIZON
) -> list[str]:
    """Return the lines with the parameters of filters, continuous and at each rate, Hz."""
    parameter_lines = []
    for sensor in figures.sensors:
        densities = figures.densities(sensor, horizon)
        units = NOISE_UNITS[sensor]
        parameter_lines.append(
            f'for filters, {sensor}: white noise {significant(densities.white)}'
            f' {units[WHITE.name]},'
        )
        parameter_lines.append(
            f'    random walk {_bounded(densities.walk)} {units[RANDOM_WALK.name]}'
            f' ({BASIS[densities.basis]})'
        )
        parameter_lines += [
            f'    at {rate:.6g} Hz: sample sd {significant(densities.sample_sd(rate))}'
            f' {UNITS[sensor]}, bias step sd {_bounded(densities.step_sd(rate))} {UNITS[sensor]}'
            for rate in rates
        ]
    return parameter_lines
