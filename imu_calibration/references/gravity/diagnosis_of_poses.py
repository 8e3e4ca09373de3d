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
    """Return the HandCalibration with the rms residual of its poses, of each sensor."""
    rate_residual, _ = hand.rate_rows()
    norm_rms = np.sqrt(np.mean(hand.norm_residuals() ** 2))
    rate_rms = np.sqrt(np.mean(rate_residual**2))
    return replace(
        hand,
        residual_rms={'accelerometer': np.full(2, norm_rms), 'gyroscope': np.full(2, rate_rms)},
    )


def _errors(hand: HandCalibration) -> dict[str, np.ndarray]:
    """Return sensor -> residual of each pose, (k, 3), of the accelerometer along gravity."""
    along_gravity = hand.norm_residuals()[:, None] * hand.state.up
    rate_residual, _ = hand.rate_rows()
    return {'accelerometer': along_gravity, 'gyroscope': rate_residual}


def traces_of_poses(baseline: HandCalibration, hand: HandCalibration) -> Traces:
    """
    Return the `Traces` of two calibrations, with one point per pose.

    The residual of the accelerometer is along gravity.
    """
    poses = hand.poses
    count = len(poses)
    return Traces(
        time=poses.time,
        kind=np.full(count, 'static'),
        position=np.zeros((count, 0)),
        force_s=hand.gravity * hand.state.up,
        rate_s=np.zeros((count, 3)),
        temperature_c=poses.temperature_c,
        before=_errors(baseline),
        after=_errors(hand),
        samples=(poses.stop - poses.start).astype(float),
        dead_reckoning=None,
    )


def diagnosis_by_hand(search: HandInvestigation, hand: HandCalibration) -> Diagnosis:
    """
    Return the result of an investigation as a Diagnosis, without traces.

    `hand` is a calibration with all findings.
    """
    problem = search.problem
    named = list(search.named)
    after = _with_residuals(hand)

    def gain_of(place: int) -> Gain:
        """Return the gain of a finding over those before it."""
        return gain_by_hand(
            search, named[:place], after=named[: place + 1], sensor=named[place].sensor
        )

    findings = []
    for place in range(len(named)):
        findings.append(
            finding(
                problem.search,
                named,
                place,
                solution=after,
                share=problem.explained.share,
                gain_of=gain_of,
                motion_of=motions_of,
            )
        )
    gain = None
    if named:
        gain = gain_by_hand(search, [], after=named, sensor=named[0].sensor)
    count = len(search.baseline.poses)
    return Diagnosis(
        findings=tuple(findings),
        unexplained=search.unexplained,
        candidates=candidates_of(problem.search, named),
        not_testable=tuple(search.not_testable),
        baseline=_with_residuals(search.baseline),
        solution=after,
        gain=gain,
        windows=count,
        locked=count if named else 0,
    )
