"""The verdict of a calibration and its notes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

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
    needs_accelerometer,
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


def _doubtful_scales(calibration: Calibration) -> list[Reason]:
    """Return a warning for each sensor with a scale factor that a wrong unit may explain."""
    found = []
    for sensor, question in scale_questions(calibration).items():
        found.append(
            Reason(
                WARNING,
                question,
                CONVERT,
                key=f'{sensor}_unit',
                sensors=(sensor,),
            )
        )
    return found


def _worse(calibration: Calibration) -> list[Reason]:
    reasons = []
    for sensor, entry in calibration.proof.items():
        for line in worse_regimes(entry):
            text = f'{sensor}: {line}'
            reasons.append(
                Reason(WARNING, text, 'find the cause', key='diagnose', sensors=(sensor,))
            )
    return reasons


def _unused_rests(calibration: Calibration) -> list[Reason]:
    """
    Return a warning about rests without any static window.

    Noise and sds are then estimated only from motion.
    """
    counts = calibration.statistics.get('stream') or {}
    unused = {
        reason: counts.get(reason, 0)
        for reason in (UnusedReason.REST_TOO_SHORT, UnusedReason.NOT_QUIET)
    }
    total = sum(unused.values())
    used = sum((calibration.statistics.get('samples_used') or {}).values())
    if rested(calibration.statistics) or total <= LOST_SHARE * used:
        return []
    return [
        Reason(
            WARNING,
            f'the recording has {total} samples at rest, but no static window is used'
            f' ({", ".join(f"{count} {reason}" for reason, count in unused.items() if count)}):'
            ' noise and bias changes come from motion only, and the standard deviations of the'
            ' biases may be too small',
            'reduce static_minimum, or increase quiet_ratio',
            key='setting',
        )
    ]


CHANGES = {
    'added': (
        'added to the model, because the recording demands it: {}',
        'see the evidence; the requested model omits it',
        'diagnose',
    ),
    'denied': (
        (
            'not added to the model, because parts of the recording disagree, no coefficient is'
            ' significant or the size is implausible: {}; the standard deviations allow for it'
        ),
        'see the evidence',
        'diagnose',
    ),
    'lacking': (
        (
            'the motion demands {}, which cannot join the model, since not all of it is kept: the'
            ' standard deviations allow for it'
        ),
        'calibrate the recording offline',
        None,
    ),
    'not_believed': (
        'held, because only the misfit of the model determines them, at an implausible value: {}',
        'move the table so that gravity or the rate of turn act along their axes',
        None,
    ),
}
"""
Entry of the statistics -> (note with the names, next step, its key) on a change of the model by the
recording.
"""


def _adopted(calibration: Calibration) -> list[Reason]:
    """Return notes on the changes of the model by the recording."""
    names: dict[str, Any] = {}
    for change in CHANGES:
        names[change] = calibration.statistics.get(change) or []
    names['added'] = [_with_size(calibration, name) for name in names['added']]
    held = names['not_believed']
    if held:
        names['not_believed'] = [f'{name} ({value:.3g})' for name, value in held.items()][
            :SHOWN_NAMES
        ]
        if len(held) > SHOWN_NAMES:
            names['not_believed'].append('...')
    reasons = []
    for change, (text, step, key) in CHANGES.items():
        if change == 'not_believed':
            # Where the motions determine them, the misfit has another cause.
            remedies = [need for need in _by_need(calibration, held) if need in REMEDY_KEYS]
            if remedies:
                step = remedies[0]
                key = REMEDY_KEYS[remedies[0]]
        if names[change]:
            reasons.append(Reason(NOTE, text.format(', '.join(names[change])), step, key=key))
    return reasons


def _unexplained(calibration: Calibration) -> list[Reason]:
    """Return notes on the unexplained residuals of the search, by the test of diagnoses."""
    found = []
    for sensor, rest in (calibration.statistics.get('unexplained') or {}).items():
        found.append(
            Reason(
                NOTE,
                unexplained_text(sensor, rest['rms'], rest.get('unit'))
                + (f' ({", ".join(rest["axes"])})' if rest['axes'] else ''),
                'find the cause',
                key='diagnose',
                sensors=(sensor,),
            )
        )
    return found


def unexplained_text(sensor: str, rms: float, unit: str | None = None) -> str:
    """Return the statement of an unexplained residual; `unit` where it is not the sensor's."""
    return (
        f'{error_text(rms, unit or UNITS[sensor], 2)} rms of the {sensor} residual are unexplained'
    )


def _least_squares(calibration: Calibration) -> list[Reason]:
    """Return a note for each sensor with values by plain least squares."""
    reasons = []
    for sensor, entry in (calibration.statistics.get('least_squares') or {}).items():
        error, of_model = (
            error_text(entry[name], entry.get('unit') or UNITS[sensor])
            for name in ('error', 'error_of_model')
        )
        reasons.append(
            Reason(
                NOTE,
                f'{sensor}: bias and matrix are those of plain least squares without other effects,'
                f' because the residual is unexplained (held-out error {error}, {of_model} with the'
                ' model)',
                'find the cause',
                key='diagnose',
                sensors=(sensor,),
            )
        )
    return reasons


def _jitter(calibration: Calibration) -> list[Reason]:
    """Return a note on independent errors of the stamps."""
    found = calibration.statistics.get('stamp_jitter')
    return (
        [Reason(NOTE, jitter_text(found['sd_s']), "use stamps of the sensor's own clock")]
        if found
        else []
    )


def _with_size(calibration: Calibration, name: str) -> str:
    """Return an effect with its most significant parameter, in common units."""
    effect = next((effect for effect in calibration.model.effects if effect.name == name), None)
    if effect is None:
        return name
    part = calibration.model.slices[effect.key]
    best = part.start + int(
        np.argmax(np.abs(calibration.values[part]) / np.maximum(calibration.sd[part], 1e-300))
    )
    factor, unit = for_people(effect.unit_of(best - part.start), calibration.param_names[best])
    return (
        f'{name} ({significant(calibration.values[best] * factor)} ±'
        f' {significant(calibration.sd[best] * factor, 2)} {unit})'
    )


def misfit_ratios(statistics: Mapping, sensor: str) -> dict[str, float]:
    """
    Return kind of window -> ratio of residual variance to expected variance.

    It is the ratio of the residual variance of the sensor to that of its noise and of errors of the
    stamps.

    Parameters
    ----------
    statistics : mapping
        Of a calibration.
    sensor : str

    """
    chi2 = statistics.get(sensor, {}).get('chi2_per_dof') or {}
    of_stamps = (statistics.get('stamp_jitter') or {}).get('variance_ratio', {}).get(sensor, {})
    ratios = {}
    for kind, ratio in chi2.items():
        if kind != 'means' and ratio is not None:
            ratios[kind] = ratio / of_stamps.get(kind, 1.0)
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
    found = {}
    for kind, ratio in misfit_ratios(statistics, sensor).items():
        has_structure = slow_over_fast.get(kind, np.inf) > MIN_STRUCTURE
        if ratio > NOTED_MISFIT and (has_structure or not at_rest):
            found[kind] = ratio
    attitude = statistics.get(sensor, {}).get('attitude')
    is_significant = bool(attitude) and attitude['p_value'] < ATTITUDE_P_VALUE
    if is_significant and attitude['variance_ratio'] > NOTED_MISFIT:
        found['static'] = attitude['variance_ratio']
    return found


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
    Return the residuals in motion above the noise at rest, and means at rest that are not noise.

    Notes, or warnings where residuals with structure in time are far above; diagnoses use the same
    test. Residuals without structure are noise or vibration, which no effect of a model explains.

    Without a rest they are compared with their slow part; lags are visible in the fast part.
    """
    at_rest = rested(calibration.statistics)
    reference = (
        'the noise at rest' if at_rest else 'their slow part (as after a lag or a late clock)'
    )
    reasons = []
    for sensor in SENSORS:
        more = (
            ', although the calibration helps in each regime'
            if at_rest and helps_everywhere(calibration.proof.get(sensor))
            else ''
        )
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
            reasons.append(
                Reason(
                    WARNING if ratio > MAX_MISFIT_RATIO else NOTE,
                    f'{size}: the model is incomplete{more}',
                    'find the cause',
                    key='diagnose',
                    sensors=(sensor,),
                )
            )
        if 'static' in incomplete:
            size = (
                f'the {sensor} means at rest scatter {np.sqrt(incomplete["static"]):.1f} times as'
                ' much as around a dependence on the attitude'
            )
            reasons.append(
                Reason(
                    NOTE,
                    f'{size}: the model is incomplete{more}',
                    'find the cause',
                    key='diagnose',
                    sensors=(sensor,),
                )
            )
    return reasons


def _misfit(calibration: Calibration, sensor: str) -> float:
    """Return the scatter of window means that the model may cause, in the unit of the sensor."""
    if any(sensor in reason.sensors for reason in _strange_causes(calibration)):
        return np.inf
    if incomplete_windows(calibration.statistics, sensor):
        return np.inf
    # Parameters that are weak because of an error of the model.
    if REMEDIES[MODEL_ERROR, DRIFT, REJECTED] in _needs_of(calibration, sensor):
        return np.inf
    left = (calibration.statistics.get('unexplained') or {}).get(sensor)
    if left is None or left.get('unit', UNITS[sensor]) != UNITS[sensor]:
        return 0.0
    return MISFIT_FACTOR * left['rms']


def unsteady(calibration: Calibration, tolerances: np.ndarray) -> list[Reason]:
    """
    Return notes on biases that move from window to window by more than the tolerance on their mean.

    A residual that the model does not explain scatters from window to window as well, although the
    bias does not move. So does a sensor that moved where it was held still.
    """
    reasons = []
    for sensor in calibration.sensors:
        part = calibration.model.part(sensor, Role.OFFSET)
        scatter = float(np.max(calibration.noise(sensor)[1]))
        certain = scatter * _smallest_share(calibration, sensor)
        if motions_at_rest(calibration.by_hand, (sensor,)):
            continue
        if certain > tolerances[part][0] and scatter > _misfit(calibration, sensor):
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
            windows = (
                'a window, whose mean is an outlier'
                if len(times) == 1
                else f'{len(times)} windows, whose means are outliers'
            )
            notes.append(
                Reason(
                    NOTE,
                    f'left out of the {sensor}: {windows}, '
                    f'at {", ".join(f"{time:.0f} s" for time in times[:SHOWN_NAMES])}'
                    + (' ...' if len(times) > SHOWN_NAMES else ''),
                    'the table or the IMU may have been touched',
                )
            )
    return notes


def _lost(calibration: Calibration) -> list[Reason]:
    dropped = dropped_of(calibration)[0]
    if not dropped:
        return []
    text = 'dropped: ' + ', '.join(f'{count} {reason}' for reason, count in dropped.items())
    many = dropped_text(*dropped_of(calibration))
    if many:
        return [Reason(WARNING, many, 'find the cause', key='inspect')]
    return [Reason(NOTE, text, '')]


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
    decided = replace(calibration, decision={each: str(word) for each, word in decisions.items()})
    complete = not shortcomings(decided)
    count = parameter_count(calibration)
    counted = np.array([name in calibration.requested for name in calibration.param_names])
    share = np.where(counted, calibration.own_sd / tolerances, 0.0)
    worst = int(np.argmax(share))
    limiting = ('', 0.0)
    if count.requested:
        limiting = (calibration.param_names[worst], float(share[worst]))
    common = calibration.common_scale
    if common:
        limiting = max(
            limiting, (COMMON_SCALE, common['sd'] / common['tolerance']), key=lambda pair: pair[1]
        )
    reasons = [_decided(calibration, sensor, word) for sensor, word in decisions.items()]
    reasons += _absent(calibration)
    reasons.append(_parameters(count, limiting, complete=complete))
    reasons += (
        _undetermined(calibration)
        + _blind(calibration)
        + _moved(calibration)
        + _implausible(calibration)
        + motion_misfits(calibration)
    )
    reasons += _doubtful_scales(calibration) + _strange_causes(calibration)
    reasons += _worse(calibration) + _unused_rests(calibration)
    reasons += [Reason(NOTE, line, '') for line in uncorrected_lines(calibration.statistics)]
    reasons += (
        _adopted(calibration)
        + _unexplained(calibration)
        + _least_squares(calibration)
        + _jitter(calibration)
        + unsteady(calibration, tolerances)
    )
    return Verdict(
        decisions,
        (*reasons, *_left_out(calibration), *_lost(calibration)),
        count.determined,
        count.requested,
        limiting,
        complete,
    )


def judged(calibration: Calibration, tolerances: np.ndarray) -> Calibration:
    """
    Return the calibration with its verdict, which its document contains; arguments as in `judge`.
    """
    found = judge(calibration, tolerances)
    counts = {
        'requested': found.requested,
        'determined': found.within,
        'limiting': found.limiting[0],
        'sd_over_tolerance': found.limiting[1],
    }
    return replace(
        calibration,
        decision={sensor: str(word) for sensor, word in found.decisions.items()},
        decision_reasons={sensor: _reason(calibration, sensor) for sensor in calibration.sensors},
        notes=tuple(lines_of(reason for reason in found.reasons if reason.word is not DECISION)),
        judgement=found,
        statistics=calibration.statistics | {'parameters': counts},
    )


def _absent(calibration: Calibration) -> list[Reason]:
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
            lacking = []
            for effect in without_input(calibration.model, [sensor]):
                if effect.sensor != sensor and effect.compensation == 'exact':
                    lacking.append(effect.name)
            if lacking:
                text += f'; without its readings {", ".join(lacking)} cannot be corrected'
            reasons.append(Reason(NOTE, text, '', sensors=(sensor,)))
    return reasons


def _decided(calibration: Calibration, sensor: str, word: SensorDecision) -> Reason:
    step, key = ('', None) if word is HELPS else _step_of(calibration, sensor)
    return Reason(
        DECISION,
        f'{sensor} {word}: {_reason(calibration, sensor)}',
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
    found = dict(calibration.decisions)
    for sensor, decision in found.items():
        if _periodic(calibration, sensor) or _undecided_motion(calibration, sensor):
            found[sensor] = most_cautious([decision, UNPROVEN])
    if needs_accelerometer(calibration, found):
        found['gyroscope'] = most_cautious([found['gyroscope'], UNPROVEN])
    return found


def _undecided_motion(calibration: Calibration, sensor: str) -> str:
    """
    Return why a smaller error on held-out data proves nothing; '' where it does.

    A sensor moved where it was held still, or none of its requested parameters is determined:
    held-out windows then contain the same motions.
    """
    moved = moved_at_rest(calibration.by_hand, sensor)
    if moved:
        return moved
    own = [status for name, status in calibration.requested.items() if name.startswith(sensor)]
    if own and DETERMINED not in own:
        return f'none of its {len(own)} parameters is determined'
    return ''


def _held_out_motions(calibration: Calibration, sensor: str) -> str:
    """
    Return that held-out data prove the recorded motions only; '' if they show each parameter.

    A parameter that is held and needs a motion is shown by no motion of the recording, held-out
    data included. One that is held because of an error of the model is.
    """
    own = {name: state for name, state in calibration.requested.items() if name.startswith(sensor)}
    held = [name for name, state in own.items() if state == HELD]
    n_unseen = 0
    for need, names in _by_need(calibration, held).items():
        if need not in REMEDY_KEYS:
            n_unseen += len(names)
    if not n_unseen:
        return ''
    return f'; in motions as recorded, which do not show {n_unseen} of its {len(own)} parameters'


def _reason(calibration: Calibration, sensor: str) -> str:
    more = (
        '; unproven, because stamps that are late by a period of this motion without rests would'
        ' give the same errors'
    )
    reason = reason_of(calibration.proof.get(sensor)) + more * _periodic(calibration, sensor)
    if decide(calibration.proof.get(sensor)) is HELPS:
        why = _undecided_motion(calibration, sensor)
        reason += f'; unproven, because {why}' if why else _held_out_motions(calibration, sensor)
    why = never_applied(calibration, sensor)
    if why:
        reason += f'; not applied: {why}'
    return reason


def _periodic(calibration: Calibration, sensor: str) -> bool:
    """
    Return whether held-out windows may repeat an error of the clock.

    No rests, and residuals far above the noise.
    """
    return not rested(calibration.statistics) and any(
        ratio > MAX_MISFIT_RATIO for ratio in misfit_ratios(calibration.statistics, sensor).values()
    )


def _parameters(count: ParameterCount, limiting: tuple[str, float], *, complete: bool) -> Reason:
    name, share = limiting
    limit = f'; limiting: {name}, its sd is {share:.2g} of its tolerance' if name else ''
    return Reason(
        PARAMETERS,
        f'{count.determined} of {count.requested} parameters are within their tolerance{limit}',
        "compensate with it: 'imu_calibration compensate', or compensator_node" if complete else '',
    )


def _implausible(calibration: Calibration) -> list[Reason]:
    check = 'check the units of the recording and the axes in the table description'
    reasons = []
    for section in SECTIONS:
        for line in implausible(calibration, section):
            text, _, _ = line.partition(': check')
            reasons.append(Reason(WARNING, text, check, sensors=_whose([section])))
    return reasons


def _whose(sections: Iterable[str]) -> tuple[str, ...]:
    """
    Return the sensors that something of these sections concerns; table and clock concern both.
    """
    found = set(sections)
    return (
        tuple(sensor for sensor in SENSORS if sensor in found) if found <= set(SENSORS) else SENSORS
    )


def _strange_causes(calibration: Calibration) -> list[Reason]:
    """Return reasons why a known cause is not in the model."""
    found = calibration.statistics.get('implausible') or {}
    catalogue = {
        effect.name: effect.sensor
        for effect in calibration.model.catalogue.effects(calibration.model.joint_names).values()
    }
    return [
        Reason(
            WARNING,
            f'{name} {beyond_known(share, catalogue.get(name, ""))}; '
            'it is not in the model, and the standard deviations allow for it',
            f'see the evidence; if {name} is expected, name it in the model',
            key='diagnose',
            sensors=_whose([catalogue.get(name, '')]),
        )
        for name, share in found.items()
    ]


def _blind(calibration: Calibration) -> list[Reason]:
    reasons = []
    for sensor in calibration.sensors:
        own = [status for name, status in calibration.requested.items() if name.startswith(sensor)]
        matrix_held = all(
            status == HELD
            for status in calibration.status[calibration.model.part(sensor, Role.LINEAR)]
        )
        if own and matrix_held and DETERMINED not in own:
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
    """Return what the undetermined parameters of a sensor need."""
    needs = []
    for direction in calibration.undetermined:
        if any(name.startswith(sensor) for name in direction['parameters']):
            needs.append(direction['needs'])
    return needs


def _moved(calibration: Calibration) -> list[Reason]:
    """Return a warning for each motion of an IMU that was held still."""
    motions = motions_at_rest(calibration.by_hand, calibration.sensors)
    return [
        Reason(WARNING, text, MOVED_REMEDY, sensors=sensors) for text, sensors in motions.items()
    ]


def _undetermined(calibration: Calibration) -> list[Reason]:
    reasons = []
    for status, text in (
        (Status.WEAK, 'sd above the tolerance'),
        (HELD, 'held at the prior value'),
    ):
        names = [name for name, found in calibration.requested.items() if found == status]
        if COMMON_SCALE in names:
            names.remove(COMMON_SCALE)
            what = (
                f'{COMMON_SCALE}: sd {100 * calibration.common_scale["sd"]:.2g} %, that of gravity;'
                ' it is not part of the other sds'
            )
            reasons.append(
                Reason(PARAMETERS, what, REMEDIES[GRAVITY,], key='gravity', sensors=SENSORS[:1])
            )
        for next_step, members in _by_need(calibration, names).items():
            reasons.append(
                Reason(
                    PARAMETERS,
                    f'{listed(members)}: {text}',
                    next_step,
                    key=REMEDY_KEYS.get(next_step),
                    sensors=_whose(name.partition('.')[0] for name in members),
                )
            )
    return reasons


def _by_need(calibration: Calibration, names: Sequence[str]) -> dict[str, list[str]]:
    """
    Return {motion: names}: each name with the motion of the weak direction in which it weighs most.
    """
    by_need: dict[str, list[str]] = {}
    for name in names:
        need, largest_weight = '', 0.0
        for direction in calibration.undetermined:
            weight = abs(direction['parameters'].get(name, 0.0))
            if weight > largest_weight:
                need = direction['needs']
                largest_weight = weight
        if largest_weight == 0.0:  # in no direction: that of another component of its effect
            need = _need_of_effect(calibration, name.rpartition('.')[0])
        by_need.setdefault(need, []).append(name)
    return by_need


def _need_of_effect(calibration: Calibration, effect: str) -> str:
    """Return the motion of the first weak direction that contains a component of an effect."""
    for direction in calibration.undetermined:
        if any(name.rpartition('.')[0] == effect for name in direction['parameters']):
            return direction['needs']
    return 'record the same motion for longer'
