"""From windows to findings: the function that tests every effect and describes the findings."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.calibration.by_evidence import extended_solution
from imu_calibration.calibration.diagnosis.applied_gain import gain_of_findings
from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis, Finding, parameters_of
from imu_calibration.calibration.diagnosis.sentences import candidates_of, finding, motions_of_one_joint, sentence, separating_motion
from imu_calibration.calibration.diagnosis.traces import residual_traces
from imu_calibration.core.progress import report
from imu_calibration.effects.base import AXES, SENSORS, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.selection.explained_share import sensors_of
from imu_calibration.selection.gain import Gain, gain_in_turn
from imu_calibration.selection.investigation import Investigation
from imu_calibration.selection.residual_analysis import Examination, inquire
from imu_calibration.selection.residual_fit import largest_axes
from imu_calibration.selection.spectrum import find_tones
from imu_calibration.selection.unexplained import IN_MOTION, Unexplained, scatter_of_one_axis

MATE = 0.5
"""Least reduction of the sensor's residual by an alternative to a finding, as a share of the finding's reduction."""

LOUD = 0.5
"""Least mean square of a tone over the variance of the noise at rest, from which it is an unexplained residual."""
HALF = 0.5
"""Share of a finding that an unnamed effect would replace, from which it is reported with the finding."""


def diagnose(windows: Sequence[Window], table: Table, model: SensorModel, *, bias_processes: dict | None = None) -> Diagnosis:
    """
    Diagnose the errors of a model and their causes.

    The recording is reduced once to sufficient statistics of every effect's columns per window; the search then tests each effect
    that is not in the model on held-out windows.

    Parameters
    ----------
    windows : sequence of Window
        One recording in order; windows of kind 'unused' are not fitted, but are used by dead reckoning.
    table : Table
        The reference.
    model : SensorModel
        The model to diagnose.
    bias_processes : dict, optional
        Sensor -> its bias processes, where measured separately.

    Returns
    -------
    Diagnosis

    Raises
    ------
    NotObservableError
        When there are too few windows to hold any out.

    """
    result = told(table, inquire(windows, table, model, bias_processes=bias_processes))
    return replace(result, traces=residual_traces(windows, table, result.baseline, after=result.solution))


def told(table: Table, found: Investigation, *, calibrated: Solution | None = None) -> Diagnosis:
    """
    Return the result of an investigation as a Diagnosis, without traces.

    Parameters
    ----------
    table : Table
        The reference.
    found : Investigation
    calibrated : Solution, optional
        Solution of a model with all findings, with the reported parameters; default: the solution of the investigation.

    """
    attempt, named, limits = found.attempt, found.named, found.limits
    rests = look_beyond(Examination.of(found, table))
    baseline = extended_solution(attempt.space, attempt.noise, attempt.baseline, chosen=[])
    solution = extended_solution(attempt.space, attempt.noise, attempt.baseline, chosen=named,
                                 saturations=limits) if named or limits else baseline

    def gain_of(place):
        return gain_of_findings(found, table, named[:place], after=named[:place + 1], sensors=sensors_of(named[place].effect))

    def shows(place, mate, gain):
        if gain.sensor not in sensors_of(mate.effect):
            return False
        own, other = (gain_in_turn(attempt, named[:place], [*named[:place], each], sensors=[gain.sensor]).reduction
                      for each in (named[place], mate))
        return MATE * own <= other

    def motion_of(question, mate):
        if len(table.joint_names) == 1:
            return motions_of_one_joint(question, mate)
        return separating_motion(solution, question, mate, gravity=table.gravity_value)

    told_by = calibrated or solution
    findings = [_clipping(limit, told_by) for limit in limits]
    strange = found.implausible
    findings += [finding(attempt.search, named, place, solution=solution if named[place] in strange else told_by,
                         share=found.explained.share, gain_of=gain_of, motion_of=motion_of,
                         shows=shows, rivals=_rivals(found, named[place]))
                 for place in range(len(named))]
    sensors = sorted({s for q in named for s in sensors_of(q.effect)}) or list(SENSORS)
    return Diagnosis(tuple(findings), rests, candidates_of(attempt.search, named, agree=attempt.windows_agree),
                     tuple(found.not_testable), baseline, solution, gain_of_findings(found, table, [], after=named, sensors=sensors),
                     len(found.used), int(np.sum(attempt.locked)), onset=found.onset)


def _rivals(found, question):
    """Return alternatives to a finding that fit nearly as well, and doubtful effects that would replace half of it."""
    near = [rival.other for rival in found.rivals if rival.question.name == question.name]
    values = dict(zip(found.attempt.space.names, found.attempt.values(found.named)))
    own = [found.attempt.space.names[k] for k in question.parameters]
    for other in found.doubtful:
        moved = found.search.moved_by(found.named, other, found.attempt.space.names)
        near += [other] if any(abs(moved.get(name, 0.0)) > HALF * abs(values[name]) for name in own) else []
    return near


def _clipping(limit, solution):
    effect = solution.model.find(limit.sensor, Role.LIMIT)
    parameters = parameters_of(solution, limit.sensor, effect.name)
    gain = Gain(limit.sensor, 'clipped samples', limit.rms_before, limit.rms_after, (float('nan'), float('nan')), 0)
    return Finding(effect.name, limit.sensor, sentence(effect, parameters, None, n_clipped=limit.n_clipped), parameters, limit.p_value,
                   limit.n_expected, 1.0, gain, (), '')


def look_beyond(found: Examination) -> dict[str, Unexplained]:
    """Return sensor -> the unexplained excess with its tones, and with regimes and a proposal where it is significant."""
    report('analysing the residual')
    tones = find_tones(found, found.table, [proposal for sensor in found.rests if (proposal := found.proposal(sensor)) is not None])
    looked = {sensor: replace(rest, tones=tones[sensor]) for sensor, rest in found.rests.items()}
    for sensor, rest in looked.items():
        proposal = found.proposal(sensor)
        regimes = found.regimes(sensor, formula=found.columns(sensor, proposal))
        first = {regime.axis: regime for regime in reversed(regimes)}
        if rest.significant or proposal is not None or first:
            axes = rest.axes or (found.fits(sensor).axes() if proposal is not None else tuple(first))
            looked[sensor] = replace(rest, regimes=tuple(first[axis] for axis in axes if axis in first), proposal=proposal,
                                     axes=axes if proposal is None else proposal.axes)
        if (proposal is not None or first) and not rest.significant:
            sizes = proposal.sizes if proposal is not None else [regime.size * np.sqrt(regime.inside.mean()) for regime in first.values()]
            looked[sensor] = replace(looked[sensor], significant=True, rms=float(np.hypot.reduce(sizes)))
        elif not rest.significant:
            looked[sensor] = _beyond_noise(found, sensor, looked[sensor])
    return looked


def _beyond_noise(found, sensor, rest):
    """Return the residual of a sensor, as significant if loud tones or the scatter in motion of one axis exceed the noise at rest."""
    scatter, noise = scatter_of_one_axis(found.attempt, sensor), found.attempt.noise[sensor].white_variance
    squares = np.array(scatter)
    for tone in rest.tones:
        axis, mean_square = AXES.index(tone.axis), 0.5 * tone.amplitude**2
        if mean_square > LOUD * noise[axis]:
            squares[axis] += mean_square
    if not squares.any():
        return rest
    return replace(rest, significant=True, rms=float(np.sqrt(squares.mean())), axes=largest_axes(squares, 0.0),
                   correlates_with=IN_MOTION if scatter.any() else None)
