"""Good, weak or bad: whether a calibration may be used, why, and what to do next."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.plausibility import beyond_known, implausible
from imu_calibration.calibration.proof_words import disproved, helps_everywhere
from imu_calibration.calibration.reasons import BAD, GOOD, HAND_AXES, MISFIT, WEAK, Judgement, Reason, listed, misfit_ratios, quiet, rested
from imu_calibration.calibration.shown import verdict_text
from imu_calibration.calibration.status import DETERMINED, HELD, Status
from imu_calibration.calibration.verdict_notes import notes_on
from imu_calibration.constants import STANDARD_GRAVITY
from imu_calibration.effects.base import SECTIONS, SENSORS, Role
from imu_calibration.effects.sensor_model import linear_names
from imu_calibration.errors import with_hint

SCALES = tuple(linear_names('accelerometer').diagonal().tolist())


@dataclass(frozen=True)
class Verdict:
    """The verdict with its reasons, the gravest first."""

    word: Judgement
    """GOOD, WEAK or BAD."""
    reasons: tuple
    """Reason, ..."""
    sensors: dict[str, Judgement]
    """Sensor -> the same of its parameters alone."""

    @property
    def text(self) -> str:
        """The verdict in words, sensor by sensor where they differ."""
        return verdict_text(self.word, self.sensors)

    def lines(self, hints: dict[str, str] | None = None) -> list[str]:
        """Return reasons and next steps, a line each; `hints` as for `errors.with_hint`."""
        lines = []
        for reason in self.reasons:
            lines.append(reason.what if reason.word in (GOOD, self.word) else f'{reason.word}: {reason.what}')
            lines += [f'next: {with_hint(reason.next, reason.key, hints or {})}'] if reason.next else []
        return list(dict.fromkeys(lines))


def judge(calibration: Calibration, tolerances: np.ndarray) -> Verdict:
    """
    Return the Verdict on a calibration.

    Bad: no help on data that took no part, or harm in some motion; a value outside what is known of any instrument; residuals in motion far
    above the noise at rest, where nothing proves that the calibration helps in every motion all the same; or a sensor of which nothing was
    determined and the whole matrix is held (after a rest in one attitude). Weak: a requested parameter is not determined to its tolerance,
    what explains the rest has a size that is known of no instrument, or such residuals beside that proof. Good: neither.

    Parameters
    ----------
    calibration : Calibration
    tolerances : ndarray, shape (n_params,)
        Largest standard deviation of a determined parameter.

    """
    against = grave_reasons(calibration) + _misfits(calibration, WEAK) + _strange_causes(calibration) + _undetermined(calibration)
    words = {sensor: _worst([reason for reason in against if sensor in reason.sensors]) for sensor in SENSORS}
    favour = [] if against else [_all_well(calibration, tolerances)]
    order = (BAD, WEAK)
    against = sorted(against, key=lambda r: order.index(r.word))
    return Verdict(_worst(against), tuple(favour + against + notes_on(calibration, tolerances)), words)


def _worst(against):
    return BAD if any(reason.word == BAD for reason in against) else WEAK if against else GOOD


def grave_reasons(calibration: Calibration) -> list[Reason]:
    """Return what makes a verdict bad; it follows from what a document says."""
    return _disproved(calibration) + _implausible(calibration) + _misfits(calibration, BAD) + _blind(calibration)


def judged(calibration: Calibration, tolerances: np.ndarray) -> Calibration:
    """Return the calibration with its verdict and the reasons in it, so that its document carries them; arguments as in `judge`."""
    found = judge(calibration, tolerances)
    return replace(calibration, verdict=str(found.word), verdicts={sensor: str(word) for sensor, word in found.sensors.items()},
                   verdict_reasons=tuple(found.lines()), judgement=found)


def _disproved(calibration):
    return [Reason(BAD, line, "run 'imu_calibration diagnose' to find the cause", sensors=(sensor,))
            for sensor, entry in calibration.proof.items() for line in disproved({sensor: entry})]


def _implausible(calibration):
    return [Reason(BAD, line.partition(': check')[0], 'check the units of the recording and the axes in the table description',
                   sensors=_whose([section]))
            for section in SECTIONS for line in implausible(calibration, section)]


def _whose(sections):
    """Return the sensors that something of these sections concerns; table and clock concern both."""
    found = set(sections)
    return tuple(sensor for sensor in SENSORS if sensor in found) if found <= set(SENSORS) else SENSORS


def _strange_causes(calibration):
    """Return reasons why a cause that is known stays out of the model."""
    found = calibration.statistics.get('implausible') or {}
    catalogue = {effect.name: effect.sensor for effect in calibration.model.catalogue.effects(calibration.model.joint_names).values()}
    return [Reason(WEAK, f'{name} {beyond_known(share, catalogue.get(name, ""))}; '
                   'it is not in the model, and the standard deviations allow for it',
                   f"see 'imu_calibration diagnose'; where {name} is what you expect, "
                   "name it in the model", sensors=_whose([catalogue.get(name, '')]))
            for name, share in found.items()]


def _misfits(calibration, word):
    """
    Return the residuals in motion that are too large, of the sensors for which that weighs as much as the word says.

    A table that shakes while it turns, a cable, a mount that gives way: a calibration is better than none. Without rests no proof counts:
    stamps that are late by a period of the motion predict the next period as well as this one.
    """
    return [Reason(word, f'the {sensor} residuals of {kind} windows are {np.sqrt(ratio):.1f} times {quiet(calibration)}: '
                   f'the model leaves something out{", though the calibration helps in every motion" if word == WEAK else ""}',
                   "run 'imu_calibration diagnose' to find the cause", sensors=(sensor,))
            for sensor in SENSORS if (word == WEAK) == (rested(calibration) and helps_everywhere(calibration.proof.get(sensor)))
            for kind, ratio in misfit_ratios(calibration, sensor).items() if ratio > MISFIT]


def _blind(calibration):
    reasons = []
    for sensor in SENSORS:
        own = [status for name, status in calibration.requested.items() if name.startswith(sensor)]
        matrix_held = all(status == HELD for status in calibration.status[calibration.model.part(sensor, Role.LINEAR)])
        if own and matrix_held and DETERMINED not in own:
            reasons.append(Reason(BAD, f'the recording says nothing about the {sensor}', _first_need(calibration, sensor),
                                  sensors=(sensor,)))
    return reasons


def _first_need(calibration, start=''):
    needs = [d['needs'] for d in calibration.undetermined if any(name.startswith(start) for name in d['parameters'])]
    return needs[0] if needs else 'record static poses and turns about all three axes'


def _undetermined(calibration):
    reasons = []
    for status, text in ((Status.WEAK, 'known less well than its tolerance asks'),
                         (HELD, 'not shown by this recording, held at the prior value')):
        names = [name for name, found in calibration.requested.items() if found == status]
        if status == Status.WEAK and _gravity_unknown(calibration, names):
            scale, names = [n for n in names if n in SCALES], [n for n in names if n not in SCALES]
            what = f'{listed(scale)}: the local gravity was not given, which scales them together'
            reasons.append(Reason(WEAK, what, 'give the local gravity', key='gravity', sensors=SENSORS[:1]))
        for next_step, members in _by_need(calibration, names).items():
            reasons.append(Reason(WEAK, f'{listed(members)}: {text}', next_step,
                                  sensors=_whose(name.partition('.')[0] for name in members)))
    return reasons


def _gravity_unknown(calibration, names):
    by_hand = calibration.gauge.get('axes') == HAND_AXES
    return by_hand and calibration.conditions.get('gravity') == STANDARD_GRAVITY and set(SCALES) <= set(names)


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


def _all_well(calibration, tolerances):
    share = np.where(calibration.model.requested, calibration.sd / tolerances, 0.0)
    worst = int(np.argmax(share))
    fit = [ratio for sensor in SENSORS for ratio in misfit_ratios(calibration, sensor).values()]
    more = f'; residuals in motion are at most {np.sqrt(max(fit)):.2f} times {quiet(calibration)}' if fit else ''
    return Reason(GOOD, f'all {len(calibration.requested)} parameters are within their tolerance (the closest, '
                        f'{calibration.param_names[worst]}, '
                        f'at {100 * share[worst]:.0f} % of it){more}', "compensate with it: 'imu_calibration compensate', "
                        "or compensator_node")
