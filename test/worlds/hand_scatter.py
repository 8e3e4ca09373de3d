"""
Errors of calibrations by hand of simulated sessions, in reported standard deviations.
"""

from dataclasses import dataclass

import numpy as np

from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions

from worlds.hand_sessions import GRAVITY, PARAM_NAMES, simulate


@dataclass(frozen=True)
class HandScatter:
    """Errors over sessions of random sensors."""

    mean_square: float
    """Mean of the normalised squared errors ``e' C^-1 e / n``; 1 if the covariances are right."""
    coverage: float
    """Share of the errors within their 95 % interval."""


def differences(found, truth):
    """Return the errors of the parameters of a truth, shape (n,), and their covariance, (n, n)."""
    names = [name for name in found.param_names if name in PARAM_NAMES]
    index = [found.param_names.index(name) for name in names]
    error = found.values[index] - truth[[PARAM_NAMES.index(name) for name in names]]
    return error, found.covariance[np.ix_(index, index)]


def errors_by_hand(seed, **session):
    """Return the errors and their covariance of one simulated session."""
    imu, ranges, truth = simulate(seed, **session)
    return differences(calibrate_by_hand(imu, HandOptions(GRAVITY), ranges), truth)


def hand_scatter(seeds, sensitivity=0.0):
    """Return the HandScatter of sessions whose poses and rests scatter a little."""
    squares, inside = [], []
    for seed in seeds:
        error, covariance = errors_by_hand(
            seed, n_poses=14, pose_sd=0.003, drift_sd=3e-4, sensitivity=sensitivity
        )
        squares.append(error @ np.linalg.solve(covariance, error) / len(error))
        inside.append(np.abs(error) < 1.96 * np.sqrt(np.diag(covariance)))
    return HandScatter(float(np.mean(squares)), float(np.mean(np.concatenate(inside))))
