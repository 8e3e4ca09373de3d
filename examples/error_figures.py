"""Errors of the raw and the compensated samples of a session on a table."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.compensation.compensate import FittedErrors
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.core.samples import ImuSamples
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.strapdown import dead_reckoning_errors


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


def error_figures(
    reference: Reference, force_s: np.ndarray, rate_s: np.ndarray, *, seconds: float = 50.0
) -> ErrorFigures:
    """
    Return the ErrorFigures of a version of the samples.

    Noise averages out over one second, so that the figures show the effect of calibration.
    """
    period = float(np.median(np.diff(reference.time)))
    length = max(int(round(1.0 / period)), 1)
    edges = np.searchsorted(
        reference.time, np.arange(reference.time[0], reference.time[-1] + 1e-9, seconds)
    )
    ends = [
        [
            np.linalg.norm(errors[-1])
            for errors in dead_reckoning_errors(reference.select(part), force_s[part], rate_s[part])
        ]
        for part in map(slice, edges[:-1], edges[1:] + 1)
    ]
    velocity, position = np.median(ends, axis=0)
    return ErrorFigures(
        _rms_of_means(force_s - reference.force_s, length),
        _rms_of_means(rate_s - reference.rate_s, length),
        float(velocity),
        float(position),
    )


def _rms_of_means(error, length):
    count = len(error) // length
    means = error[: count * length].reshape(count, length, 3).mean(axis=1)
    return float(np.sqrt((means**2).mean()))


def before_and_after(
    imu: ImuSamples, reference: Reference, calibration: FittedErrors, *, seconds: float = 50.0
) -> tuple[ErrorFigures, ErrorFigures]:
    """Return ErrorFigures of the raw and of the compensated samples."""
    corrected = CompensationStream(calibration).correct(imu)
    return (
        error_figures(reference, imu.force_s, imu.rate_s, seconds=seconds),
        error_figures(reference, corrected.force, corrected.rate, seconds=seconds),
    )
