"""Diagnosis of a calibration by hand: findings, their gains, residuals of poses."""

from dataclasses import replace

import numpy as np

from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis
from imu_calibration.calibration.diagnosis.findings import candidates_of, finding, motions_of
from imu_calibration.calibration.diagnosis.traces import Traces
from imu_calibration.references.gravity.applied_gain_by_hand import gain_by_hand
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.model_selection import HandInvestigation
from imu_calibration.selection.gain import Gain


def _with_residuals(hand: HandCalibration) -> HandCalibration:
    """Return the HandCalibration with the rms residual of its poses."""
    residuals = {'accelerometer': hand.norm_residuals(), 'gyroscope': hand.rate_rows()[0]}
    return replace(
        hand,
        residual_rms={
            sensor: np.full(2, np.sqrt(np.mean(residual**2)))
            for sensor, residual in residuals.items()
        },
    )


def traces_of_poses(baseline: HandCalibration, hand: HandCalibration) -> Traces:
    """
    Return the `Traces` of two calibrations.

    One point per pose, the accelerometer's residual along gravity.
    """
    poses = hand.poses
    true = hand.gravity * hand.state.up
    errors = [
        {'accelerometer': h.norm_residuals()[:, None] * h.state.up, 'gyroscope': h.rate_rows()[0]}
        for h in (baseline, hand)
    ]
    count = len(poses)
    return Traces(
        poses.time,
        np.full(count, 'static'),
        np.zeros((count, 0)),
        true,
        np.zeros((count, 3)),
        poses.temperature_c,
        errors[0],
        errors[1],
        (poses.stop - poses.start).astype(float),
        None,
    )


def diagnosis_by_hand(found: HandInvestigation, hand: HandCalibration) -> Diagnosis:
    """
    Return the result of an investigation as a Diagnosis, without traces.

    `hand` is a calibration with all findings.
    """
    problem = found.problem
    named = list(found.named)
    before = _with_residuals(found.baseline)
    after = _with_residuals(hand)

    def gain_of(place: int) -> Gain:
        return gain_by_hand(
            found, named[:place], after=named[: place + 1], sensor=named[place].sensor
        )

    findings = tuple(
        finding(
            problem.search,
            named,
            place,
            solution=after,
            share=problem.explained.share,
            gain_of=gain_of,
            motion_of=motions_of,
        )
        for place in range(len(named))
    )
    gain = None
    if named:
        gain = gain_by_hand(found, [], after=named, sensor=named[0].sensor)
    count = len(found.baseline.poses)
    return Diagnosis(
        findings,
        found.unexplained,
        candidates_of(problem.search, named),
        tuple(found.not_testable),
        before,
        after,
        gain,
        count,
        count if named else 0,
    )
