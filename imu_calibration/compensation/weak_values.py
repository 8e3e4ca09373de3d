"""Weak values are applied where that lowers the expected error, else the prior's, with what follows for all others."""

import numpy as np

from imu_calibration.compensation.fitted import FittedErrors

WEAK = 'weak'


def applied_values(calibration: FittedErrors) -> np.ndarray:
    """
    Return the parameters that compensation uses, shape (n_params,).

    A value v with standard deviation s is nearer to the truth than the prior's p where ``(v - p)^2 > s^2``. The weakest of those that are
    not goes to its prior first, and everything that is correlated with it to what it is there; then the rest are looked at again.

    Parameters
    ----------
    calibration : Calibration
        With statuses; only weak parameters are touched, and none where nobody knows how certain the values are (imported ones).

    """
    weak = [k for k, status in enumerate(calibration.status) if status == WEAK]
    if not weak or not calibration.uncertainty_known:
        return calibration.values
    values, covariance = calibration.values.copy(), calibration.covariance.copy()
    prior = np.concatenate([effect.prior_values() for effect in calibration.model.effects])
    weak = [k for k in weak if np.isfinite(prior[k]) and covariance[k, k] > 0]
    while weak:
        excess = [(values[k] - prior[k])**2 / covariance[k, k] for k in weak]
        least = int(np.argmin(excess))
        if excess[least] >= 1.0:
            break
        k = weak.pop(least)
        slope = covariance[:, k] / covariance[k, k]
        values += slope * (prior[k] - values[k])
        covariance -= np.outer(slope, covariance[k])
        weak = [other for other in weak if covariance[other, other] > 1e-12 * calibration.covariance[other, other]]
    return values
