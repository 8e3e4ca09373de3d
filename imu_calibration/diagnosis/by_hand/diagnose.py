"""Diagnosis of a calibration by hand: the same search, on poses and turns instead of windows on a table."""

from collections.abc import Callable
from dataclasses import dataclass

from imu_calibration.by_hand.by_evidence import extended_by_hand
from imu_calibration.by_hand.calibrate import HandCalibration, HandData
from imu_calibration.by_hand.inquiry import HandInvestigation, investigate_by_hand
from imu_calibration.by_hand.options import HandOptions
from imu_calibration.diagnosis.by_hand.result import as_solution, rest_of, traces_of
from imu_calibration.diagnosis.findings import finding
from imu_calibration.diagnosis.result import Diagnosis
from imu_calibration.diagnosis.sentences import candidates_of
from imu_calibration.diagnosis.separating_motion import motions_of
from imu_calibration.effects.base import SENSORS


@dataclass(frozen=True, eq=False)
class HandDiagnosis:
    """A diagnosis of a recording without a table."""

    diagnosis: Diagnosis
    """Findings."""
    hand: HandCalibration
    """The extended calibration; the baseline's without findings."""


def diagnose_by_hand(data: HandData, options: HandOptions = HandOptions(), progress: Callable | None = None) -> HandDiagnosis:
    """
    Diagnose the errors of a calibration by hand and their causes; arguments and errors as in `investigate_by_hand`.

    Returns
    -------
    HandDiagnosis

    """
    found = investigate_by_hand(data, options, progress)
    hand = extended_by_hand(data, found, options)
    result = told_by_hand(found, hand)
    if progress:
        progress(1.0)
    return HandDiagnosis(result, hand)


def told_by_hand(found: HandInvestigation, hand: HandCalibration) -> Diagnosis:
    """Return the result of an investigation as a Diagnosis; `hand` is a calibration with all findings."""
    inquiry, named = found.inquiry, list(found.named)
    before, after = as_solution(found.baseline), as_solution(hand)

    def gain_of(place):
        return found.gain(named[:place], named[:place + 1], named[place].sensor)

    findings = tuple(finding(inquiry.search, named, place, solution=after, share=inquiry.share, gain_of=gain_of, motion_of=motions_of)
                     for place in range(len(named)))
    gain = found.gain([], named, named[0].sensor) if named else None
    count = len(found.baseline.poses.start)
    return Diagnosis(findings, {s: rest_of(found.baseline, inquiry, named, sensor=s) for s in SENSORS},
                     candidates_of(inquiry.search, named),
                     tuple(found.not_testable), before, after, gain, count, count if named else 0, traces_of(found.baseline, hand))
