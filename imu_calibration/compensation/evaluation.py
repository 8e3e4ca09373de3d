"""How good a calibration is on another session of the same IMU: errors against the table before and after compensation."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from imu_calibration.compensation.compensate import FittedErrors
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.reference_motion import Reference
from imu_calibration.kinematics.strapdown import drift_over
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import WindowSettings
from imu_calibration.preprocessing.window_finder import MotionGatherer


@dataclass(frozen=True, eq=False)
class SessionTruth:
    """Measured samples with their reference from the table."""

    imu: ImuSamples
    """Samples with a reference."""
    reference: Reference
    """True motion at their stamps."""


@dataclass(frozen=True)
class ErrorFigures:
    """Errors of one version of the samples."""

    force: float
    """Root mean square error of specific force over one-second means, per axis, m/s^2."""
    rate: float
    """The same of the rate, rad/s."""
    velocity: float
    """Median velocity error after dead reckoning, m/s."""
    position: float
    """Median position error after dead reckoning, m."""


def session_truth(blocks: Iterable[SampleBlock], table: Table, settings: WindowSettings = WindowSettings()) -> SessionTruth:
    """Return the samples of a session with their reference, where joints and IMU are both present."""
    windows = MotionGatherer(table, settings, keep_unused=True).all_of(blocks)
    references = [_reference(window, table) for window in windows]
    stamp_ns, force_s, rate_s = (np.concatenate([getattr(w, name) for w in windows]) for name in ('stamp_ns', 'force_s', 'rate_s'))
    names = ('time', 'mat_sn', 'force_s', 'rate_s', 'alpha_s')
    joined = {name: np.concatenate([getattr(r, name) for r in references]) for name in names}
    return SessionTruth(ImuSamples(stamp_ns, force_s, rate_s), Reference(**joined, gravity=table.gravity_value))


def _reference(window, table):
    """Return the reference at every sample; the motion of a static window is one row for all samples."""
    motion = window.motion
    if len(motion) != len(window.time):
        motion = motion.select(np.zeros(len(window.time), int))
    reference = reference_motion(table, motion)
    return Reference(window.time, reference.mat_sn, reference.force_s, reference.rate_s, reference.alpha_s, reference.gravity)


def error_figures(truth: SessionTruth, force_s: np.ndarray, rate_s: np.ndarray, *, seconds: float = 50.0) -> ErrorFigures:
    """
    Return the ErrorFigures of a version of the samples.

    Noise averages out over one second, so that the figures show the effect of calibration.
    """
    reference = truth.reference
    period = float(np.median(np.diff(reference.time)))
    length = max(int(round(1.0 / period)), 1)
    drift = drift_over(reference, force_s, rate_s, seconds=seconds)
    return ErrorFigures(_rms_of_means(force_s - reference.force_s, length), _rms_of_means(rate_s - reference.rate_s, length),
                        float(np.median(drift.velocity)), float(np.median(drift.position)))


def _rms_of_means(error, length):
    count = len(error) // length
    means = error[:count * length].reshape(count, length, 3).mean(axis=1)
    return float(np.sqrt((means**2).mean()))


def before_and_after(truth: SessionTruth, calibration: FittedErrors, seconds: float = 50.0) -> tuple[ErrorFigures, ErrorFigures]:
    """Return ErrorFigures of the raw and of the compensated samples."""
    corrected = CompensationStream(calibration).correct(truth.imu)
    return (error_figures(truth, truth.imu.force_s, truth.imu.rate_s, seconds=seconds),
            error_figures(truth, corrected.force, corrected.rate, seconds=seconds))
