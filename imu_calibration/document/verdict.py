"""The verdict of a calibration and its notes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from imu_calibration.core.exit_codes import dropped_text
from imu_calibration.core.units import error_text, for_people, significant
from imu_calibration.document.calibration import (
    CONVERT,
    SHOWN_NAMES,
    Calibration,
    beyond_known,
    implausible,
    listed,
    never_applied,
    scale_questions,
    surpassed_limit,
)
from imu_calibration.document.decision import (
    DECISION,
    HELPS,
    NOTE,
    PARAMETERS,
    UNPROVEN,
    WARNING,
    Reason,
    SensorDecision,
    StatementKind,
    Verdict,
    decide,
    lines_of,
    most_cautious,
    reason_of,
    same_directions,
    worse_regimes,
)
from imu_calibration.document.outcome import (
    ParameterCount,
    dropped_of,
    parameter_count,
    shortcomings,
)
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.document.rest_noise import motions_at_rest, moved_at_rest
from imu_calibration.document.trust import uncorrected_lines
from imu_calibration.effects.base import SECTIONS, SENSORS, UNITS, Role
from imu_calibration.effects.forward_equations import without_input
from imu_calibration.estimation.solution import (
    COMMON_SCALE,
    DETERMINED,
    DRIFT,
    GRAVITY,
    HELD,
    MODEL_ERROR,
    MOVED_REMEDY,
    REJECTED,
    REMEDIES,
    REMEDY_KEYS,
    Status,
)
from imu_calibration.preprocessing.window import UnusedReason
from imu_calibration.selection.stamp_jitter import jitter_text

MAX_MISFIT_RATIO = 10.0
"""
Moving windows that scatter by more than this factor in variance beyond the noise at rest do not fit
the model.
"""
NOTED_MISFIT = 2.0
"""From this factor on the misfit is worth a note."""
MIN_STRUCTURE = 1.25
"""
Ratio of the slow over the fast residual variance from which the residual of moving windows has
structure in time (`BandMisfit.slow_over_fast`).
"""
ATTITUDE_P_VALUE = 1e-3
"""Chance of a dependence on the attitude of the means at rest of a complete model."""
LOUDER_ONLY = 'without structure in time: noise or vibration that is larger in motion'
"""Description of residuals that are larger in motion, but not correlated."""
MISFIT_FACTOR = 2.0
"""
A scatter of window means up to this factor times an unexplained residual is that residual, not a
bias that moves.
"""
SCATTER_P_VALUE = 0.025
"""Chance that the scatter of a bias is below its lower limit."""
LOST_SHARE = 0.05
"""A warning is issued when more than this share of the samples is lost."""


def _to_diagnose(word: StatementKind, text: str, sensor: str) -> Reason:
    """Return a statement on a sensor whose next step is a diagnosis."""
    return Reason(word, text, 'find the cause', key='diagnose', sensors=(sensor,))


def _doubtful_scales(calibration: Calibration) -> list[Reason]:
    """Return a warning for each sensor with a scale factor that a wrong unit may explain."""
    return [
        Reason(WARNING, question, CONVERT, key=f'{sensor}_unit', sensors=(sensor,))
        for sensor, question in scale_questions(calibration).items()
    ]


def _harmed_regimes(calibration: Calibration) -> list[Reason]:
    """Return a warning for each regime of motion in which the error grows on held-out data."""
    reasons = []
    for sensor, entry in calibration.proof.items():
        for line in worse_regimes(entry):
            reasons.append(_to_diagnose(WARNING, f'{sensor}: {line}', sensor))
    return reasons


def _unused_rests(calibration: Calibration) -> list[Reason]:
    """
    Return a warning if a recording has many samples at rest, but no static window.

    Noise and sds are then estimated only from motion.
    """
    counts = calibration.statistics.get('stream') or {}
    unused = {}  # reason -> number of samples at rest
    for reason in (UnusedReason.REST_TOO_SHORT, UnusedReason.NOT_QUIET):
        if counts.get(reason):
            unused[reason] = counts[reason]
    n_unused = sum(unused.values())
    n_used = sum((calibration.statistics.get('samples_used') or {}).values())
    if rested(calibration.statistics) or n_unused <= LOST_SHARE * n_used:
        return []
    numbers = ', '.join(f'{count} {reason}' for reason, count in unused.items())
    return [
        Reason(
            WARNING,
            f'the recording has {n_unused} samples at rest, but no static window is used'
            f' ({numbers}):'
            ' noise and bias changes come from motion only, and the standard deviations of the'
            ' biases may be too small',
            'reduce static_minimum, or increase quiet_ratio',
            key='setting',
        )
    ]


class _ModelChange(NamedTuple):
    """The note on effects by which the recording changes the model, or fails to."""

    note: str
    """Its text, with a place for the names of the effects."""
    next_step: str
    key: str | None
    """The input needed for the next step, a key of `errors.ERROR_KEYS`."""


CHANGES = {
    'added': _ModelChange(
        'added to the model, because the recording demands it: {}',
        'see the evidence; the requested model omits it',
        'diagnose',
    ),
    'denied': _ModelChange(
        (
            'not added to the model, because parts of the recording disagree, no coefficient is'
            ' significant or the size is implausible: {}; the standard deviations allow for it'
        ),
        'see the evidence',
        'diagnose',
    ),
    'lacking': _ModelChange(
        (
            'the motion demands {}, which cannot join the model, since not all of it is kept: the'
            ' standard deviations allow for it'
        ),
        'calibrate the recording offline',
        None,
    ),
}
"""Entry of the statistics with the names of effects -> the note on them."""


def _model_changes(calibration: Calibration) -> list[Reason]:
    """Return a note for each change of the model by the recording (`CHANGES`)."""
    reasons = []
    for entry, change in CHANGES.items():
        names = calibration.statistics.get(entry)
        if not names:
            continue
        if entry == 'added':
            names = [_with_size(calibration, name) for name in names]
        note = change.note.format(', '.join(names))
        reasons.append(Reason(NOTE, note, change.next_step, key=change.key))
    return reasons


def _held_as_implausible(calibration: Calibration) -> list[Reason]:
    """Return a note on parameters that are held, because the misfit gives implausible values."""
    values = calibration.statistics.get('not_believed')
    if not values:
        return []
    next_step = 'move the table so that gravity or the rate of turn act along their axes'
    # The motions suffice where the remedy is no motion: the misfit has another cause.
    for need in _by_need(calibration, list(values)):
        if need in REMEDY_KEYS:
            next_step = need
            break
    shown = [f'{name} ({values[name]:.3g})' for name in list(values)[:SHOWN_NAMES]]
    if len(values) > SHOWN_NAMES:
        shown.append('...')
    return [
        Reason(
            NOTE,
            'held, because only the misfit of the model determines them, at an implausible value:'
            f' {", ".join(shown)}',
            next_step,
            key=REMEDY_KEYS.get(next_step),
        )
    ]


def _unexplained(calibration: Calibration) -> list[Reason]:
    """Return a note for each sensor with an unexplained residual, by the test of diagnoses."""
    reasons = []
    for sensor, residual in (calibration.statistics.get('unexplained') or {}).items():
        text = unexplained_text(sensor, residual['rms'], residual.get('unit'))
        if residual['axes']:
            text += f' ({", ".join(residual["axes"])})'
        reasons.append(_to_diagnose(NOTE, text, sensor))
    return reasons


def unexplained_text(sensor: str, rms: float, unit: str | None = None) -> str:
    """Return the statement of an unexplained residual; `unit` where it is not the sensor's."""
    return (
        f'{error_text(rms, unit or UNITS[sensor], 2)} rms of the {sensor} residual are unexplained'
    )


def _least_squares(calibration: Calibration) -> list[Reason]:
    """Return a note for each sensor with values by plain least squares."""
    reasons = []
    for sensor, entry in (calibration.statistics.get('least_squares') or {}).items():
        unit = entry.get('unit') or UNITS[sensor]
        error = error_text(entry['error'], unit)
        error_of_model = error_text(entry['error_of_model'], unit)
        reasons.append(
            _to_diagnose(
                NOTE,
                f'{sensor}: bias and matrix are those of plain least squares without other effects,'
                f' because the residual is unexplained (held-out error {error}, {error_of_model}'
                ' with the model)',
                sensor,
            )
        )
    return reasons


def _stamp_jitter(calibration: Calibration) -> list[Reason]:
    """Return a note on independent errors of the stamps."""
    jitter = calibration.statistics.get('stamp_jitter')
    if not jitter:
        return []
    return [Reason(NOTE, jitter_text(jitter['sd_s']), "use stamps of the sensor's own clock")]


def _with_size(calibration: Calibration, name: str) -> str:
    """Return the name of an effect with its most significant parameter, in common units."""
    effect = next((effect for effect in calibration.model.effects if effect.name == name), None)
    if effect is None:
        return name
    parameters = calibration.model.slices[effect.key]
    values = calibration.values[parameters]
    sds = calibration.sd[parameters]
    shown = int(np.argmax(np.abs(values) / np.maximum(sds, 1e-300)))  # the most significant one
    factor, unit = for_people(effect.unit_of(shown), calibration.param_names[parameters][shown])
    value = significant(values[shown] * factor)
    return f'{name} ({value} ± {significant(sds[shown] * factor, 2)} {unit})'


def misfit_ratios(statistics: Mapping, sensor: str) -> dict[str, float]:
    """
    Return kind of window -> residual variance / variance of the noise and of errors of the stamps.

    Parameters
    ----------
    statistics : mapping
        Of a calibration.
    sensor : str

    """
    chi2 = statistics.get(sensor, {}).get('chi2_per_dof') or {}
    jitter = statistics.get('stamp_jitter') or {}
    # Kind of window -> variance of noise and errors of the stamps / variance of the noise.
    with_stamps = jitter.get('variance_ratio', {}).get(sensor, {})
    ratios = {}
    for kind, ratio in chi2.items():
        # 'means' is the entry of the window means, the others are of samples within windows.
        if kind != 'means' and ratio is not None:
            ratios[kind] = ratio / with_stamps.get(kind, 1.0)
    return ratios


def incomplete_windows(statistics: Mapping, sensor: str) -> dict[str, float]:
    """
    Return kind of window -> ratio of variances where the model of the sensor is incomplete.

    The ratio exceeds `NOTED_MISFIT`. In motion it is that of `misfit_ratios`, with a residual that
    is correlated in time (`BandMisfit.slow_over_fast`, if it is known). Without a rest it compares
    the residual with its slow part, so that every excess has structure. At rest it is the variance
    of the means over that of a significant fit with the attitude (`AttitudeDependence`). Arguments
    as for `misfit_ratios`.
    """
    slow_over_fast = statistics.get(sensor, {}).get('slow_over_fast') or {}
    at_rest = rested(statistics)
    incomplete = {}
    for kind, ratio in misfit_ratios(statistics, sensor).items():
        has_structure = slow_over_fast.get(kind, np.inf) > MIN_STRUCTURE
        if ratio > NOTED_MISFIT and (has_structure or not at_rest):
            incomplete[kind] = ratio
    attitude = statistics.get(sensor, {}).get('attitude')
    is_significant = bool(attitude) and attitude['p_value'] < ATTITUDE_P_VALUE
    if is_significant and attitude['variance_ratio'] > NOTED_MISFIT:
        incomplete['static'] = attitude['variance_ratio']
    return incomplete


def rested(statistics: Mapping) -> bool:
    """Return whether a recording on a table has rests, from which the noise is known."""
    windows = statistics.get('windows')
    return windows is None or bool(windows.get('static'))


def helps_everywhere(entry: ProofEntry | None) -> bool:
    """Return whether an entry of a proof shows a smaller error in total and in each regime."""
    if decide(entry) is not HELPS or entry is None:
        return False
    return all(part.after < part.before and part.ci95[1] < 1.0 for part in entry.regimes.values())


def motion_misfits(calibration: Calibration) -> list[Reason]:
    """
    Return notes on residuals in motion above the noise at rest, and on means at rest beyond noise.

    A residual with structure in time that is far above is a warning; diagnoses use the same test.
    Residuals without structure are noise or vibration, which no effect of a model explains.

    Without a rest they are compared with their slow part; lags are visible in the fast part.
    """
    at_rest = rested(calibration.statistics)
    reference = 'the noise at rest'
    if not at_rest:
        reference = 'their slow part (as after a lag or a late clock)'
    reasons = []
    for sensor in SENSORS:
        exception = ''
        if at_rest and helps_everywhere(calibration.proof.get(sensor)):
            exception = ', although the calibration helps in each regime'
        incomplete = incomplete_windows(calibration.statistics, sensor)
        for kind, ratio in misfit_ratios(calibration.statistics, sensor).items():
            if ratio <= NOTED_MISFIT:
                continue
            size = (
                f'the {sensor} residuals of {kind} windows are {np.sqrt(ratio):.1f} times'
                f' {reference}'
            )
            if kind not in incomplete:
                reasons.append(
                    Reason(NOTE, f'{size}, {LOUDER_ONLY}', 'reduce vibration', sensors=(sensor,))
                )
                continue
            word = WARNING if ratio > MAX_MISFIT_RATIO else NOTE
            text = f'{size}: the model is incomplete{exception}'
            reasons.append(_to_diagnose(word, text, sensor))
        if 'static' in incomplete:
            text = (
                f'the {sensor} means at rest scatter {np.sqrt(incomplete["static"]):.1f} times as'
                f' much as around a dependence on the attitude: the model is incomplete{exception}'
            )
            reasons.append(_to_diagnose(NOTE, text, sensor))
    return reasons


def _misfit_scatter(calibration: Calibration, sensor: str) -> float:
    """
    Return the scatter of window means that errors of the model may cause, in the sensor's unit.

    It is infinite for an incomplete model, whose error is not known.
    """
    if any(sensor in reason.sensors for reason in _implausible_causes(calibration)):
        return np.inf
    if incomplete_windows(calibration.statistics, sensor):
        return np.inf
    # Parameters that are weak because of an error of the model.
    if REMEDIES[MODEL_ERROR, DRIFT, REJECTED] in _needs_of(calibration, sensor):
        return np.inf
    residual = (calibration.statistics.get('unexplained') or {}).get(sensor)
    if residual is None or residual.get('unit', UNITS[sensor]) != UNITS[sensor]:
        return 0.0
    return MISFIT_FACTOR * residual['rms']


def unsteady(calibration: Calibration, tolerances: np.ndarray) -> list[Reason]:
    """
    Return notes on biases that move from window to window by more than the tolerance on their mean.

    A residual that the model does not explain scatters from window to window as well, although the
    bias does not move. So does a sensor that moved where it was held still.
    """
    reasons = []
    for sensor in calibration.sensors:
        if motions_at_rest(calibration.by_hand, (sensor,)):
            continue
        bias = calibration.model.part(sensor, Role.OFFSET)
        scatter = float(calibration.noise(sensor)[1])
        lower_limit = scatter * _smallest_share(calibration, sensor)
        if lower_limit > tolerances[bias][0] and scatter > _misfit_scatter(calibration, sensor):
            factor, unit = for_people(UNITS[sensor])
            reasons.append(
                Reason(
                    NOTE,
                    f'the {sensor} reads the same motion differently from window to window by'
                    f' {significant(scatter * factor, 2)} {unit}, more than the tolerance on its'
                    ' bias: the mean is well determined, the present bias is not',
                    calibration.texts.unsteady_bias,
                    sensors=(sensor,),
                )
            )
    return reasons


def _smallest_share(calibration: Calibration, sensor: str) -> float:
    """
    Return the lower limit of a scatter as a share of its estimate.

    The estimate s of a standard deviation with k degrees of freedom: ``k s^2 / sd^2`` is chi-square
    with k degrees of freedom, so that ``sd >= s sqrt(k / q)`` with its quantile q. With
    k = 3 the share is 0.57.
    """
    dof = calibration.statistics.get(sensor, {}).get('between_window_dof')
    if dof is None:
        return 1.0
    return float(np.sqrt(dof / chdtri(dof, SCATTER_P_VALUE))) if dof > 0 else 0.0


def _left_out(calibration: Calibration) -> list[Reason]:
    """Return notes on windows that are inconsistent with the remaining windows."""
    notes = []
    for sensor in SENSORS:
        times = (calibration.statistics.get(sensor) or {}).get('left_out_s') or []
        if times:
            windows = f'{len(times)} windows, whose means are outliers'
            if len(times) == 1:
                windows = 'a window, whose mean is an outlier'
            shown = ', '.join(f'{time:.0f} s' for time in times[:SHOWN_NAMES])
            if len(times) > SHOWN_NAMES:
                shown += ' ...'
            text = f'left out of the {sensor}: {windows}, at {shown}'
            notes.append(Reason(NOTE, text, 'the table or the IMU may have been touched'))
    return notes


def _dropped(calibration: Calibration) -> list[Reason]:
    """Return a note on dropped samples, or a warning if they make the result incomplete."""
    dropped, n_valid = dropped_of(calibration)
    if not dropped:
        return []
    warning = dropped_text(dropped, n_valid)  # '' up to `DROPPED_SHARE`
    if warning:
        return [Reason(WARNING, warning, 'find the cause', key='inspect')]
    counts = ', '.join(f'{count} {reason}' for reason, count in dropped.items())
    return [Reason(NOTE, f'dropped: {counts}', '')]


def judge(calibration: Calibration, tolerances: np.ndarray) -> Verdict:
    """
    Return the Verdict on a calibration.

    The decision follows from the proof (`decision.decide`); `helps` without rests and with large
    residuals becomes `unproven`. Warnings are values beyond any known instrument, residuals in
    motion far above the noise at rest, known causes that are not in the model, and a sensor without
    any determined parameter.

    Parameters
    ----------
    calibration : Calibration
    tolerances : ndarray, shape (n_params,)
        Largest standard deviation of a determined parameter.

    """
    decisions = _decisions(calibration)
    # The exit code follows from the decisions as the document will have them.
    texts = {sensor: str(decision) for sensor, decision in decisions.items()}
    complete = not shortcomings(replace(calibration, decision=texts))

    # The requested parameter with the largest sd relative to its tolerance.
    count = parameter_count(calibration)
    requested = np.array([name in calibration.requested for name in calibration.param_names])
    sd_over_tolerance = np.where(requested, calibration.own_sd / tolerances, 0.0)
    worst = int(np.argmax(sd_over_tolerance))
    limiting = ('', 0.0)
    if count.requested:
        limiting = (calibration.param_names[worst], float(sd_over_tolerance[worst]))
    # The common scale of the accelerometer is in none of these sds.
    common = calibration.common_scale
    if common:
        common_ratio = common['sd'] / common['tolerance']
        if common_ratio > limiting[1]:
            limiting = (COMMON_SCALE, common_ratio)

    # The order of the statements is that of their importance.
    reasons = (
        *(_decided(calibration, sensor, decision) for sensor, decision in decisions.items()),
        *_absent(calibration),
        _parameters(count, limiting, complete=complete),
        *_undetermined(calibration),
        *_undetermined_sensors(calibration),
        *_moved_sensors(calibration),
        *_implausible(calibration),
        *motion_misfits(calibration),
        *_doubtful_scales(calibration),
        *_implausible_causes(calibration),
        *_harmed_regimes(calibration),
        *_unused_rests(calibration),
        *(Reason(NOTE, line, '') for line in uncorrected_lines(calibration.statistics)),
        *_model_changes(calibration),
        *_held_as_implausible(calibration),
        *_unexplained(calibration),
        *_least_squares(calibration),
        *_stamp_jitter(calibration),
        *unsteady(calibration, tolerances),
        *_left_out(calibration),
        *_dropped(calibration),
    )
    return Verdict(
        decisions=decisions,
        reasons=reasons,
        within=count.determined,
        requested=count.requested,
        limiting=limiting,
        complete=complete,
    )


def judged(calibration: Calibration, tolerances: np.ndarray) -> Calibration:
    """
    Return the calibration with its verdict, which its document contains; arguments as in `judge`.
    """
    verdict = judge(calibration, tolerances)
    counts = {
        'requested': verdict.requested,
        'determined': verdict.within,
        'limiting': verdict.limiting[0],
        'sd_over_tolerance': verdict.limiting[1],
    }
    # The decisions have their own entry of the document.
    notes = [reason for reason in verdict.reasons if reason.word is not DECISION]
    return replace(
        calibration,
        decision={sensor: str(decision) for sensor, decision in verdict.decisions.items()},
        decision_reasons={sensor: _reason(calibration, sensor) for sensor in calibration.sensors},
        notes=tuple(lines_of(notes)),
        judgement=verdict,
        statistics=calibration.statistics | {'parameters': counts},
    )


def _absent(calibration: Calibration) -> list[Reason]:
    """Return a statement for each sensor that is not calibrated: unusable, or not recorded."""
    unusable = calibration.statistics.get('unusable_sensors') or {}
    reasons = []
    for sensor in calibration.absent:
        if sensor in unusable:
            text = f'the {sensor} is not calibrated: {unusable[sensor]}'
            reasons.append(Reason(WARNING, text, '', sensors=(sensor,)))
        else:
            text = (
                f'the recording has no readings of the {sensor}: it is not calibrated, and its'
                ' readings are not corrected'
            )
            # Effects of the other sensor whose input are the missing readings.
            uncorrected = []
            for effect in without_input(calibration.model, [sensor]):
                if effect.sensor != sensor and effect.compensation == 'exact':
                    uncorrected.append(effect.name)
            if uncorrected:
                text += f'; without its readings {", ".join(uncorrected)} cannot be corrected'
            reasons.append(Reason(NOTE, text, '', sensors=(sensor,)))
    return reasons


def _decided(calibration: Calibration, sensor: str, decision: SensorDecision) -> Reason:
    """Return the statement of the decision on a sensor."""
    step, key = ('', None) if decision is HELPS else _step_of(calibration, sensor)
    return Reason(
        DECISION,
        f'{sensor} {decision}: {_reason(calibration, sensor)}',
        step,
        key=key,
        sensors=(sensor,),
    )


def _step_of(calibration: Calibration, sensor: str) -> tuple[str, str | None]:
    """Return (next step, its key) for a sensor that the calibration does not certainly help."""
    entry = calibration.proof.get(sensor)
    texts = calibration.texts
    # Values that are refused have their own cause, and no measurement of their error is missing.
    limit = surpassed_limit(calibration, sensor)
    if limit:
        return limit.remedy, limit.key
    if moved_at_rest(calibration.by_hand, sensor):
        return MOVED_REMEDY, None
    if entry is None or not entry.windows:
        needs = _needs_of(calibration, sensor)
        if texts.needs_first and needs:
            return needs[0], REMEDY_KEYS.get(needs[0])
        return texts.too_few[sensor], None
    if entry.few_directions:
        return 'hold it still between the axes of the sensor as well', None
    if same_directions(entry):
        return texts.more_attitudes, None
    if decide(entry) is HELPS and _periodic(calibration, sensor):
        return 'record rests between the motions', None
    if decide(entry) is HELPS:
        # The gyroscope follows the accelerometer, which has its own next step.
        return '', None
    return 'find the cause', 'diagnose'


def _decisions(calibration: Calibration) -> dict[str, SensorDecision]:
    """Return sensor -> decision; at best UNPROVEN for an uncertain clock or motion."""
    decisions = {}
    for sensor, decision in calibration.decisions.items():
        if _periodic(calibration, sensor) or _undecided_motion(calibration, sensor):
            decision = most_cautious([decision, UNPROVEN])
        decisions[sensor] = decision
    return decisions


def _undecided_motion(calibration: Calibration, sensor: str) -> str:
    """
    Return why a smaller error on held-out data proves nothing; '' where it does.

    A sensor moved where it was held still, or none of its requested parameters is determined:
    held-out windows then contain the same motions.
    """
    moved = moved_at_rest(calibration.by_hand, sensor)
    if moved:
        return moved
    requested = _requested_of(calibration, sensor)
    if requested and DETERMINED not in requested.values():
        return f'none of its {len(requested)} parameters is determined'
    return ''


def _requested_of(calibration: Calibration, sensor: str) -> dict[str, str]:
    """Return name -> status of the requested parameters of a sensor."""
    requested = calibration.requested.items()
    return {name: status for name, status in requested if name.startswith(sensor)}


def _held_out_motions(calibration: Calibration, sensor: str) -> str:
    """
    Return that held-out data prove the recorded motions only; '' if they show each parameter.

    A parameter that is held and needs a motion is shown by no motion of the recording, held-out
    data included. One that is held because of an error of the model is.
    """
    requested = _requested_of(calibration, sensor)
    held = [name for name, status in requested.items() if status == HELD]
    n_unseen = 0
    for need, names in _by_need(calibration, held).items():
        if need not in REMEDY_KEYS:  # a remedy with a key is not a motion
            n_unseen += len(names)
    if not n_unseen:
        return ''
    return (
        f'; in motions as recorded, which do not show {n_unseen} of its {len(requested)} parameters'
    )


def _reason(calibration: Calibration, sensor: str) -> str:
    """Return the reason for the decision on a sensor: that of its proof, and its limits."""
    reason = reason_of(calibration.proof.get(sensor))
    if _periodic(calibration, sensor):
        reason += (
            '; unproven, because stamps that are late by a period of this motion without rests'
            ' would give the same errors'
        )
    if decide(calibration.proof.get(sensor)) is HELPS:
        why = _undecided_motion(calibration, sensor)
        reason += f'; unproven, because {why}' if why else _held_out_motions(calibration, sensor)
    refusal = never_applied(calibration, sensor)
    if refusal:
        reason += f'; not applied: {refusal}'
    return reason


def _periodic(calibration: Calibration, sensor: str) -> bool:
    """
    Return whether held-out windows may repeat an error of the clock.

    That is so without rests and with residuals far above the noise.
    """
    if rested(calibration.statistics):
        return False
    ratios = misfit_ratios(calibration.statistics, sensor)
    return any(ratio > MAX_MISFIT_RATIO for ratio in ratios.values())


def _parameters(count: ParameterCount, limiting: tuple[str, float], *, complete: bool) -> Reason:
    """Return how many parameters are within their tolerance; `limiting` as in `Verdict`."""
    name, share = limiting
    limit = f'; limiting: {name}, its sd is {share:.2g} of its tolerance' if name else ''
    return Reason(
        PARAMETERS,
        f'{count.determined} of {count.requested} parameters are within their tolerance{limit}',
        "compensate with it: 'imu_calibration compensate', or compensator_node" if complete else '',
    )


def _implausible(calibration: Calibration) -> list[Reason]:
    """Return a warning for each value beyond any known instrument."""
    check = 'check the units of the recording and the axes in the table description'
    reasons = []
    for section in SECTIONS:
        for text in implausible(calibration, section):
            reasons.append(Reason(WARNING, text, check, sensors=_concerned_sensors([section])))
    return reasons


def _concerned_sensors(sections: Iterable[str]) -> tuple[str, ...]:
    """
    Return the sensors that parameters of these sections concern.

    Sections of table and clock, or '' for an unknown one, concern both.
    """
    concerned = set(sections)
    if concerned <= set(SENSORS):
        return tuple(sensor for sensor in SENSORS if sensor in concerned)
    return SENSORS


def _implausible_causes(calibration: Calibration) -> list[Reason]:
    """Return a warning for each effect that was not added, because its size is implausible."""
    model = calibration.model
    sensor_of = {}  # name of an effect -> its sensor
    for effect in model.catalogue.effects(model.joint_names).values():
        sensor_of[effect.name] = effect.sensor
    reasons = []
    for name, share in (calibration.statistics.get('implausible') or {}).items():
        sensor = sensor_of.get(name, '')
        reasons.append(
            Reason(
                WARNING,
                f'{name} {beyond_known(share, sensor)}; '
                'it is not in the model, and the standard deviations allow for it',
                f'see the evidence; if {name} is expected, name it in the model',
                key='diagnose',
                sensors=_concerned_sensors([sensor]),
            )
        )
    return reasons


def _undetermined_sensors(calibration: Calibration) -> list[Reason]:
    """Return a warning for each sensor without a determined parameter and with a held matrix."""
    reasons = []
    for sensor in calibration.sensors:
        requested = _requested_of(calibration, sensor)
        matrix = calibration.model.part(sensor, Role.LINEAR)
        matrix_held = all(status == HELD for status in calibration.status[matrix])
        if requested and matrix_held and DETERMINED not in requested.values():
            needs = _needs_of(calibration, sensor)
            step = needs[0] if needs else 'record static poses and turns about all three axes'
            reasons.append(
                Reason(
                    WARNING,
                    f'the recording does not determine the {sensor}',
                    step,
                    key=REMEDY_KEYS.get(step),
                    sensors=(sensor,),
                )
            )
    return reasons


def _needs_of(calibration: Calibration, sensor: str) -> list[str]:
    """Return the motions or remedies that the undetermined parameters of a sensor need."""
    needs = []
    for direction in calibration.undetermined:
        if any(name.startswith(sensor) for name in direction['parameters']):
            needs.append(direction['needs'])
    return needs


def _moved_sensors(calibration: Calibration) -> list[Reason]:
    """Return a warning for each motion of an IMU that was held still."""
    motions = motions_at_rest(calibration.by_hand, calibration.sensors)
    return [
        Reason(WARNING, text, MOVED_REMEDY, sensors=sensors) for text, sensors in motions.items()
    ]


def _undetermined(calibration: Calibration) -> list[Reason]:
    """Return the parameters that are weak or held, one statement for each next step."""
    reasons = []
    for status, text in (
        (Status.WEAK, 'sd above the tolerance'),
        (HELD, 'held at the prior value'),
    ):
        names = [name for name, state in calibration.requested.items() if state == status]
        if COMMON_SCALE in names:
            names.remove(COMMON_SCALE)
            statement = (
                f'{COMMON_SCALE}: sd {100 * calibration.common_scale["sd"]:.2g} %, that of gravity;'
                ' it is not part of the other sds'
            )
            reasons.append(
                Reason(
                    PARAMETERS, statement, REMEDIES[GRAVITY,], key='gravity', sensors=SENSORS[:1]
                )
            )
        for next_step, members in _by_need(calibration, names).items():
            reasons.append(
                Reason(
                    PARAMETERS,
                    f'{listed(members)}: {text}',
                    next_step,
                    key=REMEDY_KEYS.get(next_step),
                    sensors=_concerned_sensors(name.partition('.')[0] for name in members),
                )
            )
    return reasons


def _by_need(calibration: Calibration, names: Sequence[str]) -> dict[str, list[str]]:
    """
    Return {motion or remedy: names}, by the weak direction with the largest weight of each name.
    """
    by_need: dict[str, list[str]] = {}
    directions = calibration.undetermined
    for name in names:
        weights = [abs(direction['parameters'].get(name, 0.0)) for direction in directions]
        if any(weights):
            need = directions[int(np.argmax(weights))]['needs']
        else:  # in no direction: the need of another component of its effect
            need = _need_of_effect(calibration, name.rpartition('.')[0])
        by_need.setdefault(need, []).append(name)
    return by_need


def _need_of_effect(calibration: Calibration, effect: str) -> str:
    """Return the need of the first weak direction that contains a component of an effect."""
    for direction in calibration.undetermined:
        if any(name.rpartition('.')[0] == effect for name in direction['parameters']):
            return direction['needs']
    return 'record the same motion for longer'
