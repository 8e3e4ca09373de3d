"""
Test of the gyroscope's g-sensitivity at rest, given a drift in time.

The order of the attitudes may correlate with a warm-up.
"""

from itertools import product

import numpy as np
import scipy.linalg
from scipy.special import fdtrc

from imu_calibration.kinematics.rotations import EARTH_RATE
from imu_calibration.references.gravity.equations import Poses

MIN_PROCESS_FREEDOM = 8
"""With fewer poses beyond the columns the choice of the bias process explains too much."""
CHOSEN = 2
"""Share and correlation time are estimated from the data as well."""
SHARES = (0.0, 0.5, 0.8, 0.95, 0.99)
"""Candidate shares of the bias process in the scatter between poses."""
RELATIVE_TIMES = (0.1, 0.3, 1.0, 3.0)
"""
Candidate correlation times of the bias process, in units of the time from the first pose to the
last.
"""
NO_EVIDENCE = {'g_sensitivity_p_value': 1.0, 'g_sensitivity_heldout_ratio': 1.0}
G_SENSITIVITY_P_VALUE = 1e-3
"""The g-sensitivity enters the model below this p-value."""
EARTH_UPWARDS_SD = EARTH_RATE / np.sqrt(3)
"""
The Earth's rate about the vertical is its rate times the sine of the latitude, equivalent to an
equal response of every axis to gravity. For an unknown latitude it is anything up to the full rate,
rad/s.
"""


def g_sensitivity_evidence(poses: Poses) -> dict:
    """
    Test whether the gyroscope's readings at rest correlate with gravity.

    The test is on the direction of gravity, given drift in time and with temperature.

    ``rate = bias(time, temperature) + sensitivity @ force + earth * up + error``: the Earth's rate
    about the vertical is subtracted first, as estimated from the readings within its physical
    limits; the bias is a parabola in time, with a term in temperature if it was recorded, and the
    error contains a bias process whose share and correlation time are estimated by restricted
    likelihood.

    Returns
    -------
    dict
        `g_sensitivity_p_value` of the F test against the bias model, and
        `g_sensitivity_heldout_ratio`, the rms with over that without it for poses held out one at a
        time.

    """
    count = len(poses.force)
    time = (poses.time - poses.time.mean()) / max(np.ptp(poses.time), 1e-9)
    course = np.column_stack([np.ones(count), time, time**2][: 3 if count >= 12 else 2])
    if poses.temperature_c is not None and np.ptp(poses.temperature_c) > 0:
        course = np.column_stack(
            [
                course,
                (poses.temperature_c - poses.temperature_c.mean()) / np.ptp(poses.temperature_c),
            ]
        )
    full = np.column_stack([course, poses.force / np.linalg.norm(poses.force, axis=1).mean()])
    if count < full.shape[1] + MIN_PROCESS_FREEDOM:
        return dict(NO_EVIDENCE)
    up = full[:, course.shape[1] :]
    first = course.shape[1]
    upwards = np.trace(np.linalg.lstsq(full, poses.rate, rcond=None)[0][first:]) / 3
    rate = poses.rate - np.clip(upwards, -EARTH_RATE, EARTH_RATE) * up
    apart = np.abs(time[:, None] - time)
    candidates = (
        (1 - share) * np.eye(count) + share * np.exp(-apart / tau)
        for share, tau in product(SHARES, RELATIVE_TIMES)
    )
    covariance = min(candidates, key=lambda candidate: _loss(candidate, full, rate))
    (least, kept_out), (rest, rest_out) = (
        _left(covariance, design, rate) for design in (full, course)
    )
    dof = count - full.shape[1] - CHOSEN
    scale = least / dof + 1e-300
    ratio = float(np.mean((rest - least) / 3 / scale))
    heldout = np.sqrt(np.sum(kept_out**2 / scale) / max(np.sum(rest_out**2 / scale), 1e-300))
    return {
        'g_sensitivity_p_value': float(fdtrc(9, 3 * dof, max(ratio, 0.0))),
        'g_sensitivity_heldout_ratio': float(heldout),
    }


def shown(evidence: dict) -> bool:
    """
    Return whether the g-sensitivity is significant enough to enter the model without a request.
    """
    return (
        evidence['g_sensitivity_p_value'] < G_SENSITIVITY_P_VALUE
        and evidence['g_sensitivity_heldout_ratio'] < 1
    )


def _loss(covariance: np.ndarray, design: np.ndarray, values: np.ndarray) -> float:
    """Return minus twice the restricted log likelihood, with the best scale of each axis."""
    factor = np.linalg.cholesky(covariance)
    white = scipy.linalg.solve_triangular(factor, np.hstack([design, values]), lower=True)
    orthogonal, triangle = np.linalg.qr(white[:, : design.shape[1]])
    rest = white[:, design.shape[1] :] - orthogonal @ (orthogonal.T @ white[:, design.shape[1] :])
    spare = len(values) - design.shape[1]
    logs = 2 * np.log(np.diag(factor)).sum() + 2 * np.log(np.abs(np.diag(triangle))).sum()
    return spare * np.log((rest**2).sum(axis=0) + 1e-300).sum() + values.shape[1] * logs


def _left(
    covariance: np.ndarray, design: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the weighted residual sum of squares of a fit.

    Shape (3,), and the leave-one-out prediction errors, shape (k, 3).
    """
    inverse = np.linalg.inv(covariance)
    weighted = inverse @ design
    projector = inverse - weighted @ np.linalg.solve(design.T @ weighted, weighted.T)
    left = projector @ values
    return (
        np.einsum('ki,ki->i', values, left),
        left / np.maximum(np.diag(projector), 1e-300)[:, None],
    )
