"""Notes on a calibration: effects that were added, windows that were excluded, lost samples, biases that change between windows."""

import numpy as np

from imu_calibration.core.units import for_people, significant
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import worse_regimes
from imu_calibration.document.reasons import HAND_AXES, LOOSE, MISFIT, SHOWN_NAMES, misfit_ratios, quiet, rested
from imu_calibration.document.statements import NOTE, WARNING, Reason
from imu_calibration.document.uncorrected import uncorrected_lines
from imu_calibration.effects.base import SENSORS, UNIT, Role
from imu_calibration.preprocessing.window import UnusedReason

LOST_SHARE = 0.05
"""A warning is issued when more than this share of the samples is lost."""


def notes_on(calibration: Calibration, tolerances: np.ndarray) -> list[Reason]:
    """Return the notes; arguments as in `verdict.judge`."""
    remaining = [Reason(NOTE, line, '') for line in uncorrected_lines(calibration.statistics)]
    return (_worse(calibration) + _unused_rests(calibration) + remaining + _adopted(calibration) + _loose(calibration)
            + unsteady(calibration, tolerances) + _left_out(calibration) + _lost(calibration))


def _worse(calibration):
    return [Reason(WARNING, f'{sensor}: {line}', 'find the cause', key='diagnose', sensors=(sensor,))
            for sensor, entry in calibration.proof.items() for line in worse_regimes(entry)]


def _unused_rests(calibration):
    """Return a warning about rests without any static window: noise and sds are then estimated only from motion."""
    counts = calibration.statistics.get('stream') or {}
    unused = {reason: counts.get(reason, 0) for reason in (UnusedReason.REST_TOO_SHORT, UnusedReason.NOT_QUIET)}
    total, used = sum(unused.values()), sum((calibration.statistics.get('samples_used') or {}).values())
    if rested(calibration) or total <= LOST_SHARE * used:
        return []
    return [Reason(WARNING, f'the recording has {total} samples at rest, but no static window is used '
                   f'({", ".join(f"{count} {reason}" for reason, count in unused.items() if count)}): noise and bias changes '
                   'come from motion alone, and the standard deviations of the biases may be too small',
                   'reduce static_minimum, or increase quiet_ratio', key='setting')]


def _adopted(calibration):
    """Return notes on the changes of the model by the recording."""
    added, denied = (calibration.statistics.get(name) or [] for name in ('added', 'denied'))
    notes = [Reason(NOTE, 'added to the model, because the recording demands it: '
                    f'{", ".join(_with_size(calibration, name) for name in added)}',
                    'see the evidence; the requested model omits it', key='diagnose')] if added else []
    notes += [Reason(NOTE, f'not added to the model, because parts of the recording disagree, no coefficient is significant or the size is '
                    f'implausible: {", ".join(denied)}; the standard deviations allow for it',
                     'see the evidence', key='diagnose')] if denied else []
    lacking = calibration.statistics.get('lacking') or []
    notes += [Reason(NOTE, f'the motion demands {", ".join(lacking)}, which cannot join the model, since not all of it is kept: '
                     'the standard deviations allow for it', 'calibrate the recording offline')] if lacking else []
    strange = calibration.statistics.get('not_believed') or {}
    return notes + ([Reason(NOTE, 'held, because only the misfit of the model determines them, at an implausible value: '
                            f'{_strange(strange)}',
                            'move the table so that gravity or the rate of turn act along their axes')] if strange else [])


def _strange(values):
    """Return names with the values they would have had; of many, the first ones."""
    told = ', '.join(f'{name} ({value:.3g})' for name, value in list(values.items())[:SHOWN_NAMES])
    return told + (' ...' if len(values) > SHOWN_NAMES else '')


def _with_size(calibration, name):
    """Return an effect with its most significant parameter, in common units."""
    effect = next((effect for effect in calibration.model.effects if effect.name == name), None)
    if effect is None:
        return name
    part = calibration.model.slices[effect.key]
    best = part.start + int(np.argmax(np.abs(calibration.values[part]) / np.maximum(calibration.sd[part], 1e-300)))
    factor, unit = for_people(effect.unit_of(best - part.start), effect.sensor)
    return f'{name} ({significant(calibration.values[best] * factor)} ± {significant(calibration.sd[best] * factor, 2)} {unit})'


def _loose(calibration):
    return [Reason(NOTE, f'the {sensor} residuals of {kind} windows are {np.sqrt(ratio):.1f} times {quiet(calibration)}',
                   'find the cause where it matters', key='diagnose')
            for sensor in SENSORS for kind, ratio in misfit_ratios(calibration, sensor).items() if LOOSE < ratio <= MISFIT]


def unsteady(calibration: Calibration, tolerances: np.ndarray) -> list[Reason]:
    """Return notes on biases that move from window to window by more than the tolerance on their mean."""
    reasons, by_hand = [], calibration.gauge.get('axes') == HAND_AXES
    for sensor in SENSORS:
        part = calibration.model.part(sensor, Role.OFFSET)
        scatter = float(np.max(calibration.noise(sensor)[1]))
        if scatter > tolerances[part][0]:
            factor, unit = for_people(UNIT[sensor])
            reasons.append(Reason(NOTE, f'the {sensor} reads the same motion differently from window to window by '
                                        f'{significant(scatter * factor, 2)} {unit}, more than '
                                        'the tolerance on its bias: the mean is well known, the bias of the moment is not',
                                  f'let the IMU warm up{"" if by_hand else " and the table stand firm"}, or estimate the bias in use',
                                  sensors=(sensor,)))
    return reasons


def _left_out(calibration):
    """Return notes on windows that are inconsistent with the remaining windows."""
    notes = []
    for sensor in SENSORS:
        times = (calibration.statistics.get(sensor) or {}).get('left_out_s') or []
        if times:
            windows = ('a window, whose mean is an outlier' if len(times) == 1
                       else f'{len(times)} windows, whose means are outliers')
            notes.append(Reason(NOTE, f'left out of the {sensor}: {windows}, '
                                f'at {", ".join(f"{time:.0f} s" for time in times[:SHOWN_NAMES])}'
                                      + (' ...' if len(times) > SHOWN_NAMES else ''), 'the table or the IMU may have been touched'))
    return notes


def _lost(calibration):
    dropped = calibration.statistics.get('dropped')
    if not dropped:
        return []
    total, used = sum(dropped.values()), sum((calibration.statistics.get('samples_used') or {}).values())
    text = 'dropped: ' + ', '.join(f'{count} {reason}' for reason, count in dropped.items())
    many = total > LOST_SHARE * max(used, 1)
    return [Reason(NOTE, text, 'find the cause' if many else '', key='inspect')]
