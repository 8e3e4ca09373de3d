"""The report of a diagnosis: each finding as a sentence with its figure, and the evidence on every candidate effect."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis, Finding, formula_gain
from imu_calibration.calibration.diagnosis.diagnosis_workflow import DiagnosisResult, beyond_lines
from imu_calibration.core.units import for_people
from imu_calibration.document.decision import DECISION, PARAMETERS
from imu_calibration.document.verdict import judge, unexplained_text
from imu_calibration.effects.base import AXES, SENSORS, UNITS
from imu_calibration.report.figures import AFTER, BEFORE, GREY, INK, Drawn, draw, draw_tones
from imu_calibration.report.overlay import overlay_section, variables
from imu_calibration.report.page import in_unit, parameter_groups, people, render, text, tile

BINS = 16
FEW = 200
"""Below this number of points the effect is drawn against its own prediction, with points that can be seen."""
SPAN = {'windows': 'over 0.25 s', 'poses': 'of each pose'}
"""Averaging span of a point of a residual over time."""
MIN_DRAWN_FIT = 0.5
"""Share of the fitted effect that a single variable must explain for the effect to be drawn against it."""


def diagnosis_report(result: DiagnosisResult) -> str:
    """
    Return the report of a diagnosis as one self-contained HTML page; the same input gives the same bytes.

    Parameters
    ----------
    result : DiagnosisResult

    """
    diagnosis = result.diagnosis
    rests = [(sensor, rest) for sensor, rest in diagnosis.unexplained.items() if rest.significant]
    word = 'bad' if any(rest.proposal is None for _, rest in rests) else 'weak' if rests or diagnosis.findings else 'good'
    return render('diagnosis.html', title='IMU diagnosis', word=word, headline=_headline(diagnosis, rests),
                  lines=_reasons(diagnosis, rests), tiles=_tiles(diagnosis),
                  findings=[_finding(diagnosis, finding, number) for number, finding in enumerate(diagnosis.findings, 1)],
                  formulas=[_formula(diagnosis, rest) for rest in diagnosis.unexplained.values() if rest.proposal is not None],
                  overlay=overlay_section(diagnosis.traces, diagnosis.baseline.model.joint_names, _causes(diagnosis)),
                  candidates=[_candidate(row) for row in diagnosis.candidates],
                  rests=[_rest(*pair) for pair in diagnosis.unexplained.items()],
                  beyond=[f'{_capital(line)}.'
                          for line in (*(line for pair in diagnosis.unexplained.items() for line in beyond_lines(*pair)), *result.notes)],
                  spectra=[drawn for pair in diagnosis.unexplained.items() if (drawn := draw_tones(*pair))],
                  not_testable=list(diagnosis.not_testable),
                  reasons=[reason for reason in judge(result.calibration, result.tolerances).reasons
                           if reason.word in (DECISION, PARAMETERS)],
                  groups=parameter_groups(result), observations=result.observations, windows=diagnosis.windows, locked=diagnosis.locked,
                  bags=result.calibration.provenance.get('bags') or [], software=result.calibration.provenance.get('software', ''))


def _capital(line):
    return line[0].upper() + line[1:]


def _headline(diagnosis, rests):
    count, formulas = len(diagnosis.findings), [rest.proposal for _, rest in rests if rest.proposal is not None]
    unexplained = 'an unexplained residual remains' if len(formulas) < len(rests) else ''
    if count == 0 and not formulas:
        return 'No effect of the catalogue explains the residual' if rests else 'The model is adequate'
    found = [f'{count} cause{"s" * (count > 1)} found'] * bool(count)
    found += [f'a formula explains {100 * formula.share:.0f} % of the {formula.sensor} residual' for formula in formulas]
    return _capital(', and '.join([*found, *[unexplained] * bool(unexplained)]))


def _reasons(diagnosis, rests):
    lines = [(in_type(finding.explanation), _next_step(finding)) for finding in diagnosis.findings]
    if not lines and not rests:
        lines = [(f'None of the {len(diagnosis.candidates)} effects under test explains more than noise.', '')]
    for sensor, rest in rests:
        if rest.proposal is not None:
            rms = in_unit(rest.rms, rest.unit or UNITS[sensor])
            lines.append((f'{rms} rms of the {sensor} residual match no effect of the catalogue; they follow '
                          f'{" and ".join(rest.proposal.columns)}.', f'to confirm the formula: {rest.proposal.motion}'))
            continue
        more = f', correlated with {rest.correlates_with}' if rest.correlates_with else ''
        lines.append((f'{unexplained_text(sensor, rest.rms, rest.unit)}{more}.',
                      'check the mount and the joints for a knock or slip, and causes outside the catalogue'))
    return lines


def _next_step(finding):
    if finding.implausible:
        return 'the extended calibration.yaml is without it: name it in the model where you expect it, with this size'
    if not finding.indistinguishable_from:
        return 'the extended calibration.yaml contains it'
    others = ', '.join(name.replace('_', ' ') for name in finding.indistinguishable_from)
    return f'this recording does not separate it from {others}; to separate them: {finding.separating_motion}'


def _tiles(diagnosis):
    tiles = [tile('effects tested', str(len(diagnosis.candidates)), note=f'{len(diagnosis.not_testable)} more could not be tested')]
    if diagnosis.findings:
        gain = diagnosis.gain
        number, _, unit = in_unit(gain.heldout_rms_after, UNITS[gain.sensor]).partition(' ')
        tiles.append(tile(f'{gain.of} ({gain.sensor}, held-out {gain.measure})', number, unit,
                          before=in_unit(gain.heldout_rms_before, UNITS[gain.sensor]), note=_reduction(gain)))
    navigation = diagnosis.traces.dead_reckoning
    if navigation and diagnosis.findings:
        tiles.append(tile(f'position error after {text(navigation["seconds"], 2)} s', text(navigation['position_after']), 'm',
                          before=f'{text(navigation["position_before"])} m',
                          note=f'dead reckoning, runs: {navigation["stretches"]}, median'))
    return tiles


def _reduction(gain):
    interval = '' if not np.all(np.isfinite(gain.ci95)) else f' (95 %: {text(100 * gain.ci95[0], 2)} to {text(100 * gain.ci95[1], 2)} %)'
    return f'{text(100 * gain.reduction, 2)} % less{interval}'


def _finding(diagnosis, finding, number):
    rows = [{'name': name, 'cells': people(value, sd, unit, quantity=name), 'sigma': text(abs(value) / sd, 2) if sd > 0 else '–'}
            for name, (value, sd, unit) in finding.parameters.items()]
    return {'number': number, 'title': finding.effect.replace('_', ' '), 'rows': rows,
            'p': chance(finding.p_value), **_gained(finding.gain), 'mates': [n.replace('_', ' ') for n in finding.indistinguishable_from],
            'implausible': finding.implausible, 'figure': draw_finding(diagnosis, finding, number)}


def _gained(gain):
    return {'before': in_unit(gain.heldout_rms_before, UNITS[gain.sensor]), 'after': in_unit(gain.heldout_rms_after, UNITS[gain.sensor]),
            'reduction': _reduction(gain), 'sensor': gain.sensor, 'of': gain.of, 'measure': gain.measure}


def _formula(diagnosis, rest):
    """Return the formula of an unexplained residual with its gain, curve, values and recommended motion."""
    proposal = rest.proposal
    rows = [{'name': f'{effect.name}.{axis}', 'cells': people(value, sd, effect.unit_of(k)), 'sigma': text(abs(value) / sd, 2)}
            for effect, values, sds in zip(proposal.effects, proposal.values, proposal.sds)
            for k, (axis, value, sd) in enumerate(zip(AXES, values, sds))]
    against = tuple(kind for effect in proposal.effects for kind in effect.against)
    return {'title': ' and '.join(proposal.columns), 'sentence': f'{_capital(in_type(proposal.relation))}.', 'rows': rows,
            'p': chance(proposal.p_value), **_gained(formula_gain(rest)),
            'figure': draw(f'formula-{proposal.sensor}', (8.6, 3.1), _against_cause, diagnosis, proposal.sensor, against,
                           label=f'Residual against the variable of the formula, before and after: {" and ".join(proposal.columns)}')}


def draw_finding(diagnosis: Diagnosis, finding: Finding, number: int) -> Drawn:
    """Return the residual against the cause of a finding, before and after, as SVG."""
    label = f'Residual against the cause, before and after: {finding.effect}'
    return draw(f'finding-{number}', (8.6, 3.1), _against_cause, diagnosis, finding.gain.sensor, finding.against, label=label)


def draw_over_time(result: DiagnosisResult) -> Drawn:
    """Return the size of the residuals over time, before and after the extension, as SVG."""
    return draw('traces', (8.6, 4.2), _over_time, result.diagnosis.traces, SPAN[result.observations],
                label='Residuals over time before and after the extension')


def _causes(diagnosis):
    """Return sensor -> label of the variable of its first finding, or of its formula."""
    pairs = [(rest.proposal.sensor, [kind for effect in rest.proposal.effects for kind in effect.against])
             for rest in diagnosis.unexplained.values() if rest.proposal is not None]
    pairs += [(finding.gain.sensor, finding.against) for finding in reversed(diagnosis.findings)]
    known = variables(diagnosis.traces, diagnosis.baseline.model.joint_names)
    return {sensor: label for sensor, against in pairs if (label := cause_of(diagnosis, sensor, against)[1]) in known}


def explained_share(values: np.ndarray, signal: np.ndarray) -> float:
    """Return the share of the variance of `signal` that its means over bins of `values` carry."""
    edges = np.quantile(values, np.linspace(0, 1, BINS + 1)[1:-1])
    index = np.searchsorted(edges, values)
    count = np.bincount(index, minlength=BINS)
    means = np.bincount(index, signal, BINS) / np.maximum(count, 1)
    total = np.sum((signal - signal.mean())**2)
    return float(np.sum(count * (means - signal.mean())**2) / total) if total > 0 else 0.0


def cause_of(diagnosis: Diagnosis, sensor: str, against: Sequence[str]) -> tuple[int, str, np.ndarray]:
    """Return (axis, label, values): the axis of a sensor that changes most, and the variable of some kinds that its change follows."""
    traces = diagnosis.traces
    signal = traces.before[sensor] - traces.after[sensor]
    axis = int(np.argmax((signal**2).mean(axis=0)))
    kinds = against if len(signal) >= FEW else ()   # bins of few poses have uncertain means
    best = max(((explained_share(values, signal[:, axis]), label, values)
                for label, (kind, values) in variables(traces, diagnosis.baseline.model.joint_names).items() if kind in kinds),
               default=(0.0, '', None), key=lambda entry: entry[0])
    if best[2] is None or best[0] < MIN_DRAWN_FIT:
        factor, unit = for_people(UNITS[sensor])
        return axis, f'prediction of the effect, {unit}', signal[:, axis] * factor
    return axis, best[1], best[2]


def _against_cause(figure, diagnosis, sensor, against):
    """Two panels with one scale: before with the fitted curve, and after."""
    traces = diagnosis.traces
    axis, label, values = cause_of(diagnosis, sensor, against)
    factor, unit = for_people(UNITS[sensor])
    before, after = (residual[sensor][:, axis] * factor for residual in (traces.before, traces.after))
    left, right = figure.subplots(1, 2, sharey=True)
    some = slice(None, None, max(1, len(values) // 2500))
    for axes, residual, colour, title in ((left, before, BEFORE, 'before'), (right, after, AFTER, 'after')):
        axes.plot(values[some], residual[some], '.', color=colour, markersize=_marker(values, 4), alpha=0.5, mew=0)
        axes.axhline(0, color=GREY, lw=0.6)
        axes.set_title(title)
        axes.set_xlabel(label)
    place, curve = _curve(values, before - after)
    left.plot(place, curve, color=INK, lw=1.8, label='fitted effect')
    left.legend(loc='best')
    left.set_ylabel(f'{sensor} {"xyz"[axis]} residual, {unit}')
    limit = 1.1 * float(np.quantile(np.abs(np.concatenate([before, after])), 0.998))
    left.set_ylim(-limit, limit)


def _marker(values, many):
    return 9 if len(values) < FEW else many


def _curve(values, signal):
    """Return means of the fitted signal over bins of equal width of the cause, where a bin holds enough to have a mean."""
    if len(values) < FEW:
        order = np.argsort(values)
        return values[order], signal[order]
    edges = np.linspace(values.min(), values.max(), BINS + 1)[1:-1]
    index = np.searchsorted(edges, values)
    count = np.bincount(index, minlength=BINS)
    filled = count >= max(3, 0.002 * len(values))
    return tuple(np.bincount(index, column, BINS)[filled] / count[filled] for column in (values, signal))


def _over_time(figure, traces, over):
    """Size of the residual over time, before and after, one panel per sensor."""
    for axes, sensor in zip(figure.subplots(2, 1, sharex=True), SENSORS):
        factor, unit = for_people(UNITS[sensor])
        some = slice(None, None, max(1, len(traces.time) // 3000))
        for residual, colour, label in ((traces.before, BEFORE, 'before'), (traces.after, AFTER, 'after')):
            size = np.sqrt((residual[sensor]**2).sum(axis=1)) * factor
            axes.plot(traces.time[some], size[some], '.', color=colour, markersize=_marker(size, 3), alpha=0.5, mew=0, label=label)
        axes.set_title(f'{sensor}, size of the residual {over}, {unit}')
        axes.set_ylim(bottom=0)
    axes.set_xlabel('time, s')
    figure.axes[0].legend(loc='upper right', markerscale=3)


def _candidate(row):
    return {'effect': row.effect.replace('_', ' '), 'sensor': row.sensor, 'gain': text(row.gain_alone), 'p': chance(row.p_value_alone),
            'beside': text(row.gain_beside) if row.gain_beside is not None else '',
            'p_beside': chance(row.p_value_beside) if row.p_value_beside is not None else '', 'verdict': row.verdict,
            'mark': row.verdict == 'found'}


def chance(probability: float) -> str:
    """Return a probability as text; an underflow is not shown as zero."""
    return text(probability, 2) if probability > 1e-99 else 'below 10⁻⁹⁹'


def in_type(sentence: str) -> str:
    """Return a sentence with printed signs."""
    return sentence.replace(' +- ', ' ± ').replace(' -', ' −').replace('^2', '²').replace('^3', '³')


def _rest(sensor, rest):
    share = f' ({text(100 * rest.share, 2)} % of its variance)' if rest.correlates_with and rest.share else ''
    return {'sensor': sensor, 'significant': rest.significant, 'rms': in_unit(rest.rms, rest.unit or UNITS[sensor]),
            'sigma': text(rest.sigma, 2), 'with': (rest.correlates_with or '–') + share}
