"""The verdict on a calibration: the decision per sensor, the parameters within tolerance, warnings, and the next steps."""

from dataclasses import replace

import numpy as np

from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import (
    HELPS,
    UNPROVEN,
    decide,
    helps_everywhere,
    reason_of,
)
from imu_calibration.document.plausibility import beyond_known, implausible
from imu_calibration.document.reasons import MISFIT, listed, misfit_ratios, quiet, rested
from imu_calibration.document.statements import DECISION, PARAMETERS, WARNING, Reason, Verdict, lines_of
from imu_calibration.document.verdict_notes import notes_on
from imu_calibration.effects.base import SECTIONS, SENSORS, Role
from imu_calibration.estimation.status import COMMON_SCALE, DETERMINED, HELD, Status


def judge(calibration: Calibration, tolerances: np.ndarray) -> Verdict:
    """
    Return the Verdict on a calibration.

    The decision follows from the proof (`decision.decide`); `helps` without rests and with large residuals becomes `unproven`. Warnings are
    values beyond any known instrument, residuals in motion far above the noise at rest, known causes that are not in the model, and a
    sensor without any determined parameter.

    Parameters
    ----------
    calibration : Calibration
    tolerances : ndarray, shape (n_params,)
        Largest standard deviation of a determined parameter.

    """
    decisions = {sensor: _decision(calibration, sensor) for sensor in SENSORS}
    found = list(calibration.requested.values())
    share = np.where(calibration.model.requested, calibration.own_sd / tolerances, 0.0)
    worst = int(np.argmax(share))
    limiting = (calibration.param_names[worst], float(share[worst])) if found else ('', 0.0)
    if common := calibration.common_scale:
        limiting = max(limiting, (COMMON_SCALE, common['sd'] / common['tolerance']), key=lambda pair: pair[1])
    within = found.count(DETERMINED)
    reasons = [_decided(calibration, sensor, word) for sensor, word in decisions.items()]
    reasons.append(_parameters(calibration, within, limiting, complete=within == len(found) and set(decisions.values()) == {HELPS}))
    reasons += _undetermined(calibration) + _blind(calibration) + _implausible(calibration) + _misfits(calibration)
    return Verdict(decisions, (*reasons, *_strange_causes(calibration), *notes_on(calibration, tolerances)), within, len(found), limiting)


def judged(calibration: Calibration, tolerances: np.ndarray) -> Calibration:
    """Return the calibration with its verdict, which its document contains; arguments as in `judge`."""
    found = judge(calibration, tolerances)
    counts = {'requested': found.requested, 'determined': found.within, 'limiting': found.limiting[0],
              'sd_over_tolerance': found.limiting[1]}
    return replace(calibration, decision={sensor: str(word) for sensor, word in found.decisions.items()},
                   decision_reasons={sensor: _reason(calibration, sensor) for sensor in SENSORS},
                   notes=tuple(lines_of(reason for reason in found.reasons if reason.word is not DECISION)),
                   judgement=found, statistics=calibration.statistics | {'parameters': counts})


def _decided(calibration, sensor, word):
    entry, step, key = calibration.proof.get(sensor), '', None
    if word is not HELPS and entry and not entry.get('one_attitude'):
        step, key = 'find the cause', 'diagnose'
    elif word is not HELPS:
        step = 'record more windows, or hold it still in more attitudes'
    return Reason(DECISION, f'{sensor} {word}: {_reason(calibration, sensor)}', step, key=key, sensors=(sensor,))


def _decision(calibration, sensor):
    found = decide(calibration.proof.get(sensor))
    return UNPROVEN if found is HELPS and _periodic(calibration, sensor) else found


def _reason(calibration, sensor):
    more = '; unproven, because stamps that are late by a period of this motion without rests would give the same errors'
    return reason_of(calibration.proof.get(sensor)) + more * _periodic(calibration, sensor)


def _periodic(calibration, sensor):
    """Return whether held-out windows may repeat an error of the clock: no rests, and residuals far above the noise."""
    return not rested(calibration) and any(ratio > MISFIT for ratio in misfit_ratios(calibration, sensor).values())


def _parameters(calibration, within, limiting, *, complete):
    name, share = limiting
    limit = f'; limiting: {name}, its sd is {share:.2g} of its tolerance' if name else ''
    return Reason(PARAMETERS, f'{within} of {len(calibration.requested)} parameters are within their tolerance{limit}',
                  "compensate with it: 'imu_calibration compensate', or compensator_node" if complete else '')


def _implausible(calibration):
    return [Reason(WARNING, line.partition(': check')[0], 'check the units of the recording and the axes in the table description',
                   sensors=_whose([section]))
            for section in SECTIONS for line in implausible(calibration, section)]


def _whose(sections):
    """Return the sensors that something of these sections concerns; table and clock concern both."""
    found = set(sections)
    return tuple(sensor for sensor in SENSORS if sensor in found) if found <= set(SENSORS) else SENSORS


def _strange_causes(calibration):
    """Return reasons why a known cause is not in the model."""
    found = calibration.statistics.get('implausible') or {}
    catalogue = {effect.name: effect.sensor for effect in calibration.model.catalogue.effects(calibration.model.joint_names).values()}
    return [Reason(WARNING, f'{name} {beyond_known(share, catalogue.get(name, ""))}; '
                   'it is not in the model, and the standard deviations allow for it',
                   f'see the evidence; if {name} is expected, name it in the model',
                   key='diagnose', sensors=_whose([catalogue.get(name, '')]))
            for name, share in found.items()]


def _misfits(calibration):
    """Return the residuals in motion that are far above the noise at rest."""
    return [Reason(WARNING, f'the {sensor} residuals of {kind} windows are {np.sqrt(ratio):.1f} times {quiet(calibration)}: '
                            f'the model is incomplete{", although the calibration helps in each regime" if helps else ""}',
                   'find the cause', key='diagnose', sensors=(sensor,))
            for sensor in SENSORS for helps in [rested(calibration) and helps_everywhere(calibration.proof.get(sensor))]
            for kind, ratio in misfit_ratios(calibration, sensor).items() if ratio > MISFIT]


def _blind(calibration):
    reasons = []
    for sensor in SENSORS:
        own = [status for name, status in calibration.requested.items() if name.startswith(sensor)]
        matrix_held = all(status == HELD for status in calibration.status[calibration.model.part(sensor, Role.LINEAR)])
        if own and matrix_held and DETERMINED not in own:
            reasons.append(Reason(WARNING, f'the recording does not determine the {sensor}', _first_need(calibration, sensor),
                                  sensors=(sensor,)))
    return reasons


def _first_need(calibration, start=''):
    needs = [d['needs'] for d in calibration.undetermined if any(name.startswith(start) for name in d['parameters'])]
    return needs[0] if needs else 'record static poses and turns about all three axes'


def _undetermined(calibration):
    reasons = []
    for status, text in ((Status.WEAK, 'sd above the tolerance'),
                         (HELD, 'held at the prior value')):
        names = [name for name, found in calibration.requested.items() if found == status]
        if COMMON_SCALE in names:
            names.remove(COMMON_SCALE)
            what = f'{COMMON_SCALE}: sd {100 * calibration.common_scale["sd"]:.2g} %, that of gravity; it is not part of the other sds'
            reasons.append(Reason(PARAMETERS, what, 'give the local gravity', key='gravity', sensors=SENSORS[:1]))
        for next_step, members in _by_need(calibration, names).items():
            reasons.append(Reason(PARAMETERS, f'{listed(members)}: {text}', next_step,
                                  sensors=_whose(name.partition('.')[0] for name in members)))
    return reasons


def _by_need(calibration, names):
    """Return {motion: names}: each name with the motion of the weak direction in which it weighs most."""
    found = {}
    for name in names:
        weights = [(abs(d['parameters'].get(name, 0.0)), d['needs']) for d in calibration.undetermined]
        best = max(weights, default=(0.0, ''), key=lambda pair: pair[0])
        if best[0] == 0.0:
            same = [d['needs']
                    for d in calibration.undetermined if any(n.rpartition('.')[0] == name.rpartition('.')[0] for n in d['parameters'])]
            best = (1.0, same[0] if same else 'record the same motion for longer')
        found.setdefault(best[1], []).append(name)
    return found
