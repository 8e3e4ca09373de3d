"""From the result of a search to findings: the function that describes them."""


import numpy as np

from imu_calibration.calibration.by_evidence import extended_solution
from imu_calibration.calibration.diagnosis.applied_gain import gain_of_findings
from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis, Finding, parameters_of
from imu_calibration.calibration.diagnosis.sentences import candidates_of, finding, motions_of_one_joint, sentence, separating_motion
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.table import Table
from imu_calibration.selection.explained_share import sensors_of
from imu_calibration.selection.gain import Gain, gain_in_turn
from imu_calibration.selection.investigation import Investigation
from imu_calibration.selection.residual_analysis import ResidualAnalysis

MATE = 0.5
"""Least reduction of the sensor's residual by an alternative to a finding, as a share of the finding's reduction."""
HALF = 0.5
"""Share of a finding that an unnamed effect would replace, from which it is reported with the finding."""


def build_diagnosis(table: Table, found: Investigation, *, calibrated: Solution | None = None) -> Diagnosis:
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
    problem, named, limits = found.problem, found.named, found.limits
    analysis = ResidualAnalysis.of(found, table)
    rests = analysis.unexplained
    baseline = extended_solution(problem.space, problem.noise, problem.baseline, chosen=[])
    solution = extended_solution(problem.space, problem.noise, problem.baseline, chosen=named,
                                 saturations=limits) if named or limits else baseline

    def gain_of(place):
        return gain_of_findings(found, table, named[:place], after=named[:place + 1], sensors=sensors_of(named[place].effect))

    def shows(place, mate, gain):
        if gain.sensor not in sensors_of(mate.effect):
            return False
        own, other = (gain_in_turn(problem, named[:place], [*named[:place], each], sensors=[gain.sensor]).reduction
                      for each in (named[place], mate))
        return MATE * own <= other

    def motion_of(question, mate):
        if len(table.joint_names) == 1:
            return motions_of_one_joint(question, mate)
        return separating_motion(solution, question, mate, gravity=table.gravity_value)

    told_by = calibrated or solution
    findings = [_clipping(limit, told_by) for limit in limits]
    strange = found.implausible
    findings += [finding(problem.search, named, place, solution=solution if named[place] in strange else told_by,
                         share=found.explained.share, gain_of=gain_of, motion_of=motion_of,
                         shows=shows, rivals=_rivals(found, named[place]))
                 for place in range(len(named))]
    sensors = sorted({s for q in named for s in sensors_of(q.effect)}) or list(SENSORS)
    return Diagnosis(tuple(findings), rests, candidates_of(problem.search, named, agree=problem.windows_agree),
                     tuple(found.not_testable), baseline, solution, gain_of_findings(found, table, [], after=named, sensors=sensors),
                     len(found.used), int(np.sum(problem.locked)), onset=found.onset, stamp_jitter=analysis.stamp_jitter)


def _rivals(found, question):
    """Return alternatives to a finding that fit nearly as well, and doubtful effects that would replace half of it."""
    near = [rival.other for rival in found.rivals if rival.question.name == question.name]
    values = dict(zip(found.problem.space.names, found.problem.values(found.named)))
    own = [found.problem.space.names[k] for k in question.parameters]
    for other in found.rejected:
        moved = found.search.moved_by(found.named, other, found.problem.space.names)
        near += [other] if any(abs(moved.get(name, 0.0)) > HALF * abs(values[name]) for name in own) else []
    return near


def _clipping(limit, solution):
    effect = solution.model.find(limit.sensor, Role.LIMIT)
    parameters = parameters_of(solution, limit.sensor, effect.name)
    gain = Gain(limit.sensor, 'clipped samples', limit.rms_before, limit.rms_after, (float('nan'), float('nan')), 0)
    return Finding(effect.name, limit.sensor, sentence(effect, parameters, None, n_clipped=limit.n_clipped), parameters, limit.p_value,
                   limit.n_expected, 1.0, gain, (), '')
