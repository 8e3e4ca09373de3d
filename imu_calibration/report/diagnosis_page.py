"""
The report of a diagnosis.

Each finding as a sentence with its figure, and the evidence on every candidate effect.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis, Finding
from imu_calibration.calibration.diagnosis.diagnosis_workflow import (
    DiagnosisResult,
    beyond_lines,
    timing_lines,
)
from imu_calibration.calibration.diagnosis.traces import Traces
from imu_calibration.core.units import STANDARD_GRAVITY, for_people
from imu_calibration.document.decision import DECISION, PARAMETERS
from imu_calibration.document.verdict import judge, unexplained_text
from imu_calibration.effects.base import AXES, UNITS
from imu_calibration.references.turntable.residuals.proposals import Proposal
from imu_calibration.report.figures import AFTER, BEFORE, GREY, INK, Drawn, draw, draw_tones
from imu_calibration.report.observation_texts import OBSERVATION_TEXTS
from imu_calibration.report.page import render

BINS = 16
FEW = 200
"""
Below this number of points the effect is drawn against its own prediction, with points that can be
seen.
"""
MIN_DRAWN_FIT = 0.5
"""
Share of the fitted effect that a single variable must explain for the effect to be drawn against
it.
"""


def diagnosis_report(result: DiagnosisResult) -> str:
    """
    Return the report of a diagnosis as one self-contained HTML page.

    The same input gives the same bytes.

    Parameters
    ----------
    result : DiagnosisResult

    """
    diagnosis = result.diagnosis
    # Sensor -> significant residual that no finding explains.
    significant = {
        sensor: residual
        for sensor, residual in diagnosis.unexplained.items()
        if residual.significant
    }
    # Colour of the headline: a residual without a formula, with one, or none.
    word = 'good'
    if any(residual.proposal is None for residual in significant.values()):
        word = 'bad'
    elif significant or diagnosis.findings:
        word = 'weak'

    # Lines and spectra of the unexplained residuals.
    beyond = list(timing_lines(diagnosis))
    spectra = []
    for sensor, residual in diagnosis.unexplained.items():
        beyond += beyond_lines(sensor, residual)
        drawn = draw_tones(sensor, residual)
        if drawn:
            spectra.append(drawn)
    return render(
        'diagnosis.html',
        title='IMU diagnosis',
        texts=OBSERVATION_TEXTS[result.observations],
        word=word,
        result=result,
        diagnosis=diagnosis,
        rests=significant,
        draw_finding=draw_finding,
        draw_formula=draw_formula,
        unexplained_text=unexplained_text,
        overlay=overlay_section(
            diagnosis.traces, diagnosis.baseline.model.joint_names, _causes(diagnosis)
        ),
        beyond=[*beyond, *result.notes],
        spectra=spectra,
        reasons=[
            reason
            for reason in judge(result.calibration, result.tolerances).reasons
            if reason.word in (DECISION, PARAMETERS)
        ],
    )


def draw_finding(diagnosis: Diagnosis, finding: Finding, number: int) -> Drawn:
    """Return the residual against the cause of a finding, before and after, as SVG."""
    label = f'Residual against the cause, before and after: {finding.effect}'
    cause = (diagnosis, finding.gain.sensor, finding.against)
    return draw(f'finding-{number}', (8.6, 3.1), _against_cause, *cause, label=label)


def draw_formula(diagnosis: Diagnosis, proposal: Proposal) -> Drawn:
    """Return the residual against the variable of a proposed formula, before and after, as SVG."""
    variable = ' and '.join(proposal.columns)
    label = f'Residual against the variable of the formula, before and after: {variable}'
    cause = (diagnosis, proposal.sensor, _kinds_of(proposal))
    return draw(f'formula-{proposal.sensor}', (8.6, 3.1), _against_cause, *cause, label=label)


def draw_over_time(result: DiagnosisResult) -> Drawn:
    """Return the size of the residuals over time, before and after the extension, as SVG."""
    return draw(
        'traces',
        (8.6, 4.2),
        _over_time,
        result.diagnosis.traces,
        OBSERVATION_TEXTS[result.observations].span,
        label='Residuals over time before and after the extension',
    )


def _causes(diagnosis: Diagnosis) -> dict[str, str]:
    """Return sensor -> label of the variable of its first finding, or of its formula."""
    pairs = []  # (sensor, kinds of variables)
    for rest in diagnosis.unexplained.values():
        if rest.proposal is not None:
            pairs.append((rest.proposal.sensor, _kinds_of(rest.proposal)))
    # Later entries replace earlier ones: the first finding of a sensor is the last entry.
    pairs += [(finding.gain.sensor, finding.against) for finding in reversed(diagnosis.findings)]
    labels = variables(diagnosis.traces, diagnosis.baseline.model.joint_names)
    causes = {}
    for sensor, kinds in pairs:
        _, label, _ = cause_of(diagnosis, sensor, kinds)
        if label in labels:  # not the prediction of the effect
            causes[sensor] = label
    return causes


def _kinds_of(proposal: Proposal) -> tuple[str, ...]:
    """Return the kinds of variables that the effects of a formula depend on."""
    kinds: tuple[str, ...] = ()
    for effect in proposal.effects:
        kinds += tuple(effect.against)
    return kinds


def explained_share(values: np.ndarray, signal: np.ndarray) -> float:
    """
    Return the share of the variance of `signal` that its means over bins of `values` explain.

    The bins have equal numbers of values; 0 for a constant signal. Both arguments: shape (n,).
    """
    edges = np.quantile(values, np.linspace(0, 1, BINS + 1)[1:-1])
    count, means = _binned(edges, values, signal)
    total = np.sum((signal - signal.mean()) ** 2)
    return float(np.sum(count * (means - signal.mean()) ** 2) / total) if total > 0 else 0.0


def _binned(edges, values, *signals):
    """
    Return (number of values in each bin, mean of each signal there), shape (BINS,) each.

    `edges` between the bins, shape (BINS - 1,).
    """
    index = np.searchsorted(edges, values)
    count = np.bincount(index, minlength=BINS)
    return count, *(np.bincount(index, signal, BINS) / np.maximum(count, 1) for signal in signals)


def cause_of(
    diagnosis: Diagnosis, sensor: str, against: Sequence[str]
) -> tuple[int, str, np.ndarray]:
    """
    Return (axis, label, values) for the plot of a residual against the cause of an effect.

    The axis of the sensor whose residual the effect changes most; and, among the variables whose
    kind is in `against`, label and values of the one that explains most of this change, (n,). If it
    explains less than `MIN_DRAWN_FIT`, or there are few values, the change itself takes its place.
    """
    traces = diagnosis.traces
    change = traces.before[sensor] - traces.after[sensor]
    axis = int(np.argmax((change**2).mean(axis=0)))
    kinds = against if len(change) >= FEW else ()  # bins of few poses have uncertain means
    best_share = 0.0
    best_label = ''
    best_values = None
    for label, (kind, values) in variables(traces, diagnosis.baseline.model.joint_names).items():
        if kind in kinds:
            share = explained_share(values, change[:, axis])
            if best_values is None or share > best_share:
                best_share = share
                best_label = label
                best_values = values
    if best_values is None or best_share < MIN_DRAWN_FIT:
        factor, unit = for_people(UNITS[sensor])
        return axis, f'prediction of the effect, {unit}', change[:, axis] * factor
    return axis, best_label, best_values


def _against_cause(figure, diagnosis, sensor, against):
    """Draw the residual against its cause: before, with the fitted curve, and after."""
    traces = diagnosis.traces
    axis, label, values = cause_of(diagnosis, sensor, against)
    factor, unit = for_people(UNITS[sensor])
    before = traces.before[sensor][:, axis] * factor
    after = traces.after[sensor][:, axis] * factor
    left, right = figure.subplots(1, 2, sharey=True)
    drawn = slice(None, None, max(1, len(values) // 2500))
    for axes, residual, colour, title in (
        (left, before, BEFORE, 'before'),
        (right, after, AFTER, 'after'),
    ):
        axes.plot(
            values[drawn],
            residual[drawn],
            '.',
            color=colour,
            markersize=_marker_size(values, 4),
            alpha=0.5,
            mew=0,
        )
        axes.axhline(0, color=GREY, lw=0.6)
        axes.set(title=title, xlabel=label)
    middles, curve = _curve(values, before - after)
    left.plot(middles, curve, color=INK, lw=1.8, label='fitted effect')
    left.legend(loc='best')
    limit = 1.1 * float(np.quantile(np.abs(np.concatenate([before, after])), 0.998))
    left.set(ylabel=f'{sensor} {"xyz"[axis]} residual, {unit}', ylim=(-limit, limit))


def _marker_size(values, usual):
    """Return the size of markers: larger than usual for few values."""
    return 9 if len(values) < FEW else usual


def _curve(values: np.ndarray, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return means of (values of the cause, fitted signal) over bins of equal width of the cause.

    Only bins with enough values. Of few values no means, but all of them in ascending order.
    """
    if len(values) < FEW:
        order = np.argsort(values)
        return values[order], signal[order]
    edges = np.linspace(values.min(), values.max(), BINS + 1)[1:-1]
    count, mean_values, mean_signal = _binned(edges, values, values, signal)
    enough = count >= max(3, 0.002 * len(values))
    return mean_values[enough], mean_signal[enough]


def _over_time(figure, traces, over):
    """
    Draw the size of the residual over time, before and after, in a panel per sensor.

    `over`: text on the span of a residual.
    """
    panels = figure.subplots(len(traces.before), 1, sharex=True, squeeze=False)[:, 0]
    for axes, sensor in zip(panels, traces.before):
        factor, unit = for_people(UNITS[sensor])
        drawn = slice(None, None, max(1, len(traces.time) // 3000))
        for residual, colour, label in (
            (traces.before, BEFORE, 'before'),
            (traces.after, AFTER, 'after'),
        ):
            size = np.sqrt((residual[sensor] ** 2).sum(axis=1)) * factor
            axes.plot(
                traces.time[drawn],
                size[drawn],
                '.',
                color=colour,
                markersize=_marker_size(size, 3),
                alpha=0.5,
                mew=0,
                label=label,
            )
        axes.set_title(f'{sensor}, size of the residual {over}, {unit}')
        axes.set_ylim(bottom=0)
    axes.set_xlabel('time, s')
    figure.axes[0].legend(loc='upper right', markerscale=3)


MOST_POINTS = 1200
"""Points of a chart against a variable."""
HISTOGRAM_BINS = 40
WHEN = ('before', 'after')
"""Without and with the found effects in the model: fields of Traces."""


def variables(traces: Traces, joint_names: Sequence[str]) -> dict[str, tuple[str, np.ndarray]]:
    """Return label -> (kind, values) of the variables of residual plots, in people's units."""
    listed = {'time, s': ('time', traces.time)}
    if traces.temperature_c is not None:
        listed['temperature, °C'] = ('temperature', traces.temperature_c)
    for k, axis in enumerate(AXES):
        listed[f'specific force {axis}, g'] = ('force', traces.force_s[:, k] / STANDARD_GRAVITY)
        listed[f'rate {axis}, deg/s'] = ('rate', np.rad2deg(traces.rate_s[:, k]))
    listed['speed, deg/s'] = ('speed', np.rad2deg(np.linalg.norm(traces.rate_s, axis=1)))
    for name, angle in zip(joint_names, traces.position.T):  # by hand there are no joints
        within_turn = np.angle(np.exp(1j * angle))
        listed[f'angle of {name}, deg'] = ('angle', np.rad2deg(within_turn))
    return listed


def overlay_section(
    traces: Traces, joint_names: Sequence[str], causes: Mapping[str, str]
) -> list[dict[str, Any]]:
    """
    Return for each sensor its name, unit, table of frequency bands and rows of charts by axis.

    Rows: signals, differences, residuals, spectra and histograms.

    Parameters
    ----------
    traces : Traces
    joint_names : sequence of str
    causes : mapping
        Sensor -> label of the variable that is shown first, as in `variables`.

    """
    against = {label: values for label, (_, values) in variables(traces, joint_names).items()}
    return [
        _sensor_section(traces, sensor, against, causes.get(sensor, 'time, s'))
        for sensor in traces.before
    ]


def _row(title: str, chart: Callable[[int], dict[str, Any]], **options: Any) -> dict[str, Any]:
    """Return a row of three charts, ``chart(axis)`` each, with further content of the template."""
    charts = [json.dumps(chart(axis)) for axis in range(3)]
    return {'title': title, 'charts': charts, 'variables': '', 'labels': (), **options}


def _sensor_section(
    traces: Traces, sensor: str, against: Mapping[str, np.ndarray], first: str
) -> dict[str, Any]:
    """
    Return the content of `overlay_section` of one sensor.

    `against`: label -> values of the variables; `first`: label of the variable shown first.
    """
    factor, unit = for_people(UNITS[sensor])
    rows = _segment_rows(traces, sensor)

    def residuals(axis: int, points: slice = slice(None)) -> dict[str, np.ndarray]:
        """Return 'before', 'after' -> residual of an axis in the units of the page."""
        return {when: getattr(traces, when)[sensor][points, axis] * factor for when in WHEN}

    drawn = slice(None, None, -(-len(traces.time) // MOST_POINTS))
    against_variable = _row(
        f'Residual, {unit}, against',
        lambda k: _chart(
            f'{sensor} {AXES[k]}', first, against[first][drawn], residuals(k, drawn), kind='points'
        ),
        variables=json.dumps({label: _plain(values[drawn]) for label, values in against.items()}),
        first=first,
        labels=list(against),
    )
    rows.append(against_variable)
    if sensor in traces.distances:
        frequency, density, noise = traces.distances[sensor].density()
        spectrum = _row(
            f'Spectrum of the residual, {unit}/√Hz, with the noise at rest',
            lambda k: _chart(
                f'{sensor} {AXES[k]}',
                'frequency, Hz',
                frequency,
                {
                    **{when: density[w, :, k] * factor for w, when in enumerate(WHEN)},
                    'noise': noise[:, k] * factor,
                },
                kind='log',
            ),
        )
        rows.append(spectrum)
    histograms = _row(
        f'Histogram of the residual, {unit}',
        lambda k: _histogram(f'{sensor} {AXES[k]}', unit, residuals(k)),
    )
    rows.append(histograms)
    bands = []
    if sensor in traces.distances:
        for name, rms, noise in traces.distances[sensor].bands():
            bands.append((name, rms.T * factor, float(np.sqrt(np.mean(noise**2))) * factor))
    return {'sensor': sensor, 'unit': unit, 'bands': bands, 'rows': rows}


def _segment_rows(traces: Traces, sensor: str) -> list[dict[str, Any]]:
    """Return the rows of signals and differences on the segment of each axis, none without it."""
    segments = traces.segments.get(sensor)
    if not segments:
        return []
    factor, unit = for_people(UNITS[sensor])

    def chart(axis: int, series: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Return the chart of series over the time of the segment."""
        in_unit = {name: values * factor for name, values in series.items()}
        return _chart(f'{sensor} {AXES[axis]}', 'time, s', segments[axis].time, in_unit)

    return [
        _row(
            f'Measured and simulated on the segment with the largest difference, {unit}',
            lambda k: chart(k, segments[k].signals),
        ),
        _row(
            f'Measured minus simulated on that segment, {unit}',
            lambda k: chart(
                k, {when: segments[k].difference(f'simulated {when}') for when in WHEN}
            ),
        ),
    ]


def histogram(residuals: Mapping[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """
    Return (middles of the bins, name -> counts) of residuals, shape (n,) each.

    The bins contain 99.9 % of each.
    """
    limit = max(float(np.quantile(np.abs(each), 0.999)) for each in residuals.values()) or 1.0
    edges = np.linspace(-limit, limit, HISTOGRAM_BINS + 1)
    middles = edges[:-1] + edges[1] / 2 - edges[0] / 2
    return middles, {name: np.histogram(each, edges)[0] for name, each in residuals.items()}


def _histogram(title, unit, residuals):
    """Return the chart of the histograms of named residuals."""
    middles, counts = histogram(residuals)
    return _chart(title, f'residual, {unit}', middles, counts, kind='steps')


def _chart(
    title: str,
    x: str,
    values: np.ndarray,
    series: Mapping[str, np.ndarray],
    kind: str = 'line',
) -> dict[str, Any]:
    """
    Return the data of a chart for the script of the page.

    `x`: label of the `values` on the horizontal axis; `series`: name -> values on the vertical
    axis; `kind`: 'line', 'points', 'steps' or 'log' (both axes logarithmic).
    """
    if kind == 'log':
        series = {name: np.where(ys > 0, ys, np.nan) for name, ys in series.items()}
    return {
        'title': title,
        'x': x,
        'kind': kind,
        'names': list(series),
        'data': [_plain(values), *(_plain(ys) for ys in series.values())],
    }


def _plain(values: np.ndarray) -> list[float | None]:
    """Return values with five digits for JSON, None for NaN and infinity."""
    return [float(f'{value:.5g}') if np.isfinite(value) else None for value in values]
