"""From windows to findings: the one function that asks every effect, and the sentence that says what was found."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.diagnosis.explained_share import Explained, pruned, sensors_of
from imu_calibration.diagnosis.extended_model import extended_solution
from imu_calibration.diagnosis.gain import Gain, heldout_gain
from imu_calibration.diagnosis.linearisation import Attempt, without_saturation
from imu_calibration.diagnosis.questions import testable_effects
from imu_calibration.diagnosis.result import Diagnosis, Finding, parameters_of
from imu_calibration.diagnosis.saturation import (
    find_saturation,
    may_be_clipped,
    measured,
    noise_at_rest,
    predictions,
    simple_fit,
    without_clipped,
)
from imu_calibration.diagnosis.sentences import candidates_of, sentence
from imu_calibration.diagnosis.separating_motion import separating_motion
from imu_calibration.diagnosis.traces import residual_traces
from imu_calibration.diagnosis.unexplained import unexplained
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.catalogue import find_effect
from imu_calibration.errors import NotObservableError

LINEARISATIONS = 3
"""Times that the columns are taken anew, at most."""
LEAST_WINDOWS = 8


def diagnose(windows, table, model, settings=None, progress=None):
    """
    Say what a model gets wrong, and why.

    The recording is reduced once to sufficient statistics of every effect's columns per window; the search then asks each effect
    that is not in the model on held-out windows.

    Parameters
    ----------
    windows : sequence of Window
        One recording in order; windows of kind 'unused' are not fitted to, but let dead reckoning run through.
    table : Table
        The reference.
    model : SensorModel
        The model to diagnose.
    settings : optional
        Reserved.
    progress : callable, optional
        Called with the share that is done, in [0, 1].

    Returns
    -------
    Diagnosis

    Raises
    ------
    NotObservableError
        When there are too few windows to hold any out.

    """
    found = investigate(windows, table, model, progress)
    result = _assembled(windows, table, found)
    if progress:
        progress(1.0)
    return result


@dataclass(frozen=True, eq=False)
class Investigation:
    """The search before it is put into words."""

    used: list
    """Windows that were fitted to, without clipped samples."""
    attempt: Attempt
    """The last linearisation with its evidence."""
    explained: Explained
    """What noise leaves and what the choices leave."""
    named: list
    """Questions that became findings, in the order found."""
    limits: list
    """Saturations."""
    not_testable: list
    """Effects that could not be asked about."""


def investigate(windows, table, model, progress=None):
    """Return the `Investigation` of a recording: the search itself, arguments as in `diagnose`."""
    used = [window for window in windows if window.kind != 'unused']
    if len(used) < LEAST_WINDOWS:
        raise NotObservableError(f'a diagnosis needs at least {LEAST_WINDOWS} windows, so that some can be held out, '
                                 f'{len(used)} were found; rest in more poses, or spin and swing the table')
    report = progress or (lambda share: None)
    model = with_joints_of(model, table)
    used, limits = _without_clipping(used, table, model)
    effects, not_testable = testable_effects(model, table, used)
    asked = without_saturation(effects)
    attempt = Attempt(used, table, model, asked, progress=lambda share: report(0.5 * share))
    chosen = attempt.search.run()
    for _ in range(LINEARISATIONS - 1):
        if not attempt.needs_another(chosen):
            break
        attempt = Attempt(used, table, model, asked, attempt.point(chosen), lambda share: report(0.5 + 0.2 * share))
        chosen = attempt.search.run()
    # A warm-up of the bank that appears this late has no columns of its own for the final solution.
    chosen = [question for question in chosen if '@' not in question.label]
    report(0.75)
    explained = Explained(attempt.evidence, attempt.search)
    named = _that_help(attempt, pruned(chosen, explained.share))
    for _ in range(LINEARISATIONS - 1):
        if not attempt.acts_beside(named):
            break
        attempt = Attempt(used, table, model, asked, attempt.point(named))
        explained = Explained(attempt.evidence, attempt.search)
        again = [next(q for q in attempt.questions if q.label == question.label) for question in named]
        named = _that_help(attempt, pruned(again, explained.share))
    return Investigation(used, attempt, explained, named, limits, not_testable)


def _that_help(attempt, named):
    """
    Return the findings that are possible and predict the locked windows better, one at a time the least helpful taken out.

    Without rests the noise is known from the misfit alone, and a misfit that repeats with the motion makes evidence of anything that
    goes with it: there the plain residual of the locked windows must fall.
    """
    kept = [question for question in named if attempt.search.allowed(named, question)]
    while kept:
        helps = [attempt.locked_gain(kept, question) for question in kept]
        if min(helps) >= 0.0:
            break
        del kept[int(np.argmin(helps))]
    if np.any(attempt.lifted.kind == 'static'):
        return kept
    while kept:
        least = [heldout_gain(attempt, [q for q in kept if q is not each], kept, sensors_of(each.effect)).ci95[0] for each in kept]
        if not np.min(least) <= 0.0:
            break
        del kept[int(np.argmin(least))]
    return kept


def with_joints_of(model, table):
    """Return the model with the joints of the table."""
    return model if model.joint_names == table.joint_names else replace(model, joint_names=table.joint_names)


def _without_clipping(windows, table, model):
    """Return (windows without samples that a limit spoils, the limits found)."""
    suspects = [sensor for sensor in SENSORS if may_be_clipped(windows, sensor)]
    if not suspects:
        return windows, []
    limits = {sensor: float(max(np.abs(measured(w, sensor)).max() for w in windows)) for sensor in suspects}
    noise_sd = {sensor: noise_at_rest(windows, sensor) for sensor in SENSORS}
    kept, found = windows, []
    for _ in range(2):
        fit = simple_fit(kept, table, model)
        predicted = predictions(windows, table, model, fit)
        kept = without_clipped(windows, predicted, limits, noise_sd)
    fit = simple_fit(kept, table, model)
    predicted = predictions(windows, table, model, fit)
    found = [limit for limit in (find_saturation(windows, predicted, noise_sd[sensor], sensor) for sensor in suspects) if limit]
    if not found:
        return windows, []
    return without_clipped(windows, predicted, {limit.sensor: limit.level for limit in found}, noise_sd), found


def _assembled(windows, table, found):
    attempt, named, limits = found.attempt, found.named, found.limits
    model = attempt.baseline
    baseline = extended_solution(attempt.space, attempt.noise, model, [])
    solution = extended_solution(attempt.space, attempt.noise, model, named, limits) if named or limits else baseline
    findings = [_clipping(limit, solution) for limit in limits]
    for place in range(len(named)):
        findings.append(_finding(attempt, found.explained, named, place, solution, table))
    sensors = sorted({s for q in named for s in sensors_of(q.effect)}) or list(SENSORS)
    return Diagnosis(tuple(findings), unexplained(attempt, found.explained, named), candidates_of(attempt.search, named), tuple(found.not_testable),
                     baseline, solution, heldout_gain(attempt, [], named, sensors), residual_traces(windows, table, baseline, solution),
                     len(found.used), int(attempt.locked.sum()))


def _finding(attempt, explained, named, place, solution, table):
    question = named[place]
    rest = [q for q in named if q is not question]
    score = attempt.search.score(rest, question)
    mates = attempt.search.class_mates(named, question)
    parameters = parameters_of(solution, question.sensor, question.name)
    gain = heldout_gain(attempt, named[:place], named[:place + 1], sensors_of(question.effect))
    motion = separating_motion(solution, question, mates[0][0], table.gravity_value) if mates else ''
    return Finding(question.name, question.sensor, sentence(question.effect, parameters, gain), parameters, score.p_value, score.gain,
                   explained.share(named, question), gain, tuple(mate.name for mate, _ in mates), motion)


def _clipping(limit, solution):
    short = {'accelerometer': 'accel', 'gyroscope': 'gyro'}[limit.sensor]
    effect = find_effect(limit.sensor, f'{short}_saturation')
    parameters = parameters_of(solution, limit.sensor, effect.name)
    gain = Gain(limit.sensor, 'clipped samples', limit.rms_before, limit.rms_after, (float('nan'), float('nan')), 0)
    return Finding(effect.name, limit.sensor, sentence(effect, parameters, None, limit.n_clipped), parameters, limit.p_value,
                   limit.n_expected, 1.0, gain, (), '')
