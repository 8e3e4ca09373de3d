"""Diagnosis of a recording on a table: findings, their gains, and the unexplained residual."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis, Finding, parameters_of
from imu_calibration.calibration.diagnosis.findings import (
    candidates_of,
    finding,
    sentence,
)
from imu_calibration.effects.base import Role
from imu_calibration.estimation.solution import Solution
from imu_calibration.references.turntable.applied_gain_of_windows import (
    gain_of_findings,
    gains_of_formulas,
)
from imu_calibration.references.turntable.residuals.residual_analysis import ResidualAnalysis
from imu_calibration.references.turntable.selection.extended_solution import extended_solution
from imu_calibration.references.turntable.selection.investigation import Investigation
from imu_calibration.references.turntable.selection.saturation import Saturation
from imu_calibration.references.turntable.selection.window_gain import gain_in_turn
from imu_calibration.references.turntable.separating_motion import (
    motions_of_one_joint,
    separating_motion,
)
from imu_calibration.selection.gain import Gain
from imu_calibration.selection.questions import Question

MIN_SHARE_OF_MATE = 0.5
"""
Least reduction of the sensor's residual by an alternative to a finding, as a share of the finding's
reduction.
"""


MIN_SHARE_REPLACED = 0.5
"""
Least share of a parameter of a finding that a rejected effect replaces if it is added to the model;
the effect is then reported with the finding.
"""


def build_diagnosis(
    investigation: Investigation, *, calibrated: Solution | None = None
) -> Diagnosis:
    """
    Return the result of an investigation as a Diagnosis, without traces.

    Parameters
    ----------
    investigation : Investigation
    calibrated : Solution, optional
        Solution of a model with all findings, with the reported parameters; default: the solution
        of the investigation.

    """
    problem = investigation.problem
    named = investigation.named
    analysis = ResidualAnalysis.of(investigation)
    unexplained = analysis.unexplained
    baseline = extended_solution(problem, chosen=[])
    solution = baseline
    if named or investigation.limits:
        solution = extended_solution(problem, named, saturations=investigation.limits)

    # Findings are added in their order: the functions below compare the model with the findings
    # before `place` and that with the finding at `place` too.
    def gain_of(place: int) -> Gain:
        """Return the gain of a finding over the ones before it."""
        return gain_of_findings(
            investigation,
            named[:place],
            after=named[: place + 1],
            sensors=named[place].effect.sensors,
        )

    def shows(place: int, mate: Question, gain: Gain) -> bool:
        """Return whether a mate reduces the residual of a sensor nearly as the finding does."""
        if gain.sensor not in mate.effect.sensors:
            return False
        before = named[:place]
        by_finding = gain_in_turn(problem, before, [*before, named[place]], sensors=[gain.sensor])
        by_mate = gain_in_turn(problem, before, [*before, mate], sensors=[gain.sensor])
        return MIN_SHARE_OF_MATE * by_finding.reduction <= by_mate.reduction

    def motion_of(question: Question, mate: Question) -> str:
        """Return the motion that separates two effects."""
        table = investigation.table
        if len(table.joint_names) == 1:
            return motions_of_one_joint(question, mate)
        return separating_motion(solution, question, mate, gravity=table.gravity_value)

    def agree(chosen: Sequence[Question], question: Question) -> bool:
        """Return whether the windows and both halves agree on one of the chosen effects."""
        if not problem.windows_agree(chosen, question):
            return False
        return problem.search.agrees_in_halves(chosen, question)

    # Implausible findings are not in the calibration.
    reported = calibrated or solution
    implausible = investigation.implausible
    findings = [_clipping(limit, reported) for limit in investigation.limits]
    affected: set[str] = set()
    for place, question in enumerate(named):
        affected |= set(question.effect.sensors)
        findings.append(
            finding(
                problem.search,
                named,
                place,
                solution=solution if question in implausible else reported,
                share=investigation.explained.share,
                gain_of=gain_of,
                motion_of=motion_of,
                shows=shows,
                rivals=_rivals(investigation, question),
            )
        )
    sensors = sorted(affected) or list(unexplained)
    proposals = [rest.proposal for rest in unexplained.values() if rest.proposal is not None]
    candidates = candidates_of(
        problem.search,
        named,
        agree=agree,
        withdrawn=investigation.unstable,
        replaced=analysis.replaced,
    )
    return Diagnosis(
        findings=tuple(findings),
        unexplained=unexplained,
        candidates=candidates,
        not_testable=tuple(investigation.not_testable),
        baseline=baseline,
        solution=solution,
        gain=gain_of_findings(investigation, [], after=named, sensors=sensors),
        windows=len(investigation.used),
        locked=int(np.sum(problem.locked)),
        onset=investigation.onset,
        stamp_jitter=analysis.stamp_jitter,
        formula_gains=gains_of_formulas(investigation, proposals),
    )


def _rivals(investigation: Investigation, question: Question) -> list[Question]:
    """
    Return effects that may be the cause in place of a finding.

    Effects that fit nearly as well, and rejected effects that change a parameter of the finding by
    more than `MIN_SHARE_REPLACED` of its value when they are added to the model.
    """
    alternatives = [
        rival.other for rival in investigation.rivals if rival.question.name == question.name
    ]
    names = investigation.problem.space.names
    values = dict(zip(names, investigation.problem.values(investigation.named)))
    for other in investigation.rejected:
        # Parameter -> its change when the effect is added.
        moved = investigation.search.moved_by(investigation.named, other, names)
        for index in question.parameters:
            name = names[index]
            if abs(moved.get(name, 0.0)) > MIN_SHARE_REPLACED * abs(values[name]):
                alternatives.append(other)
                break
    return alternatives


def _clipping(limit: Saturation, solution: Solution) -> Finding:
    """Return the finding of a limited range, with the limit that a solution has."""
    effect = solution.model.effect_of(limit.sensor, Role.LIMIT)
    parameters = parameters_of(solution, limit.sensor, effect.name)
    gain = Gain(
        sensor=limit.sensor,
        measure='clipped samples',
        heldout_rms_before=limit.rms_before,
        heldout_rms_after=limit.rms_after,
        ci95=(float('nan'), float('nan')),
        windows=0,
    )
    return Finding(
        effect=effect.name,
        sensor=limit.sensor,
        explanation=sentence(effect, parameters, None, n_clipped=limit.n_clipped),
        parameters=parameters,
        p_value=limit.p_value,
        heldout_gain=limit.n_expected,
        share=1.0,
        gain=gain,
        indistinguishable_from=(),
        separating_motion='',
    )
