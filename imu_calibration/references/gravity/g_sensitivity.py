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
    # Columns of the bias: a parabola, or with few poses a line, and the temperature.
    count = len(poses.force)
    time = (poses.time - poses.time.mean()) / max(np.ptp(poses.time), 1e-9)
    bias_columns = [np.ones(count), time, time**2][: 3 if count >= 12 else 2]
    temperature_c = poses.temperature_c
    if temperature_c is not None and np.ptp(temperature_c) > 0:
        bias_columns.append((temperature_c - temperature_c.mean()) / np.ptp(temperature_c))
    bias_design = np.column_stack(bias_columns)

    # Columns of the sensitivity: the force in units of its mean length.
    up = poses.force / np.linalg.norm(poses.force, axis=1).mean()
    full_design = np.column_stack([bias_design, up])
    if count < full_design.shape[1] + MIN_PROCESS_FREEDOM:
        return dict(NO_EVIDENCE)

    # The Earth's rate is an equal response of every axis to the force along it.
    response = np.linalg.lstsq(full_design, poses.rate, rcond=None)[0][bias_design.shape[1] :]
    mean_response = np.trace(response) / 3
    earth_rate = np.clip(mean_response, -EARTH_RATE, EARTH_RATE)
    rate = poses.rate - earth_rate * up

    # Covariance of the errors with the likeliest bias process.
    elapsed = np.abs(time[:, None] - time)
    candidates = []
    for share, tau in product(SHARES, RELATIVE_TIMES):
        candidates.append((1 - share) * np.eye(count) + share * np.exp(-elapsed / tau))
    covariance = min(candidates, key=lambda candidate: _loss(candidate, full_design, rate))

    # F test of nine sensitivities, three on each axis, and errors of poses held out.
    full_squares, full_heldout = _squares_and_heldout(covariance, full_design, rate)
    bias_squares, bias_heldout = _squares_and_heldout(covariance, bias_design, rate)
    dof = count - full_design.shape[1] - CHOSEN
    variance = full_squares / dof + 1e-300
    ratio = float(np.mean((bias_squares - full_squares) / 3 / variance))
    full_loss = np.sum(full_heldout**2 / variance)
    bias_loss = np.sum(bias_heldout**2 / variance)
    return {
        'g_sensitivity_p_value': float(fdtrc(9, 3 * dof, max(ratio, 0.0))),
        'g_sensitivity_heldout_ratio': float(np.sqrt(full_loss / max(bias_loss, 1e-300))),
    }


def shown(evidence: dict) -> bool:
    """
    Return whether the `g_sensitivity_evidence` suffices for a g-sensitivity without a request.
    """
    return (
        evidence['g_sensitivity_p_value'] < G_SENSITIVITY_P_VALUE
        and evidence['g_sensitivity_heldout_ratio'] < 1
    )


def _loss(covariance: np.ndarray, design: np.ndarray, values: np.ndarray) -> float:
    """
    Return minus twice the restricted log likelihood, with the best scale of each axis.

    With the covariance C (k, k), the design A (k, p), the values y (k, 3) and their residuals r::

        sum over axes of  (k - p) log(r' C^-1 r) + log |C| + log |A' C^-1 A|
    """
    n_columns = design.shape[1]
    factor = np.linalg.cholesky(covariance)
    white = scipy.linalg.solve_triangular(factor, np.hstack([design, values]), lower=True)
    basis, triangle = np.linalg.qr(white[:, :n_columns])
    residual = white[:, n_columns:] - basis @ (basis.T @ white[:, n_columns:])

    # Determinants from the factors C = L L' and L^-1 A = Q R: products of squared diagonals.
    spare = len(values) - n_columns
    log_determinants = (
        2 * np.log(np.diag(factor)).sum() + 2 * np.log(np.abs(np.diag(triangle))).sum()
    )
    log_squares = np.log((residual**2).sum(axis=0) + 1e-300).sum()
    return spare * log_squares + values.shape[1] * log_determinants


def _squares_and_heldout(
    covariance: np.ndarray, design: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (weighted residual sum of squares, (3,); leave-one-out prediction errors, (k, 3)).

    With the covariance C, the design A and the values y, they are ``y' P y`` and ``P y / diag(P)``
    with ``P = C^-1 - C^-1 A (A' C^-1 A)^-1 A' C^-1``.
    """
    inverse = np.linalg.inv(covariance)
    weighted = inverse @ design
    projector = inverse - weighted @ np.linalg.solve(design.T @ weighted, weighted.T)
    weighted_residual = projector @ values
    squares = np.einsum('ki,ki->i', values, weighted_residual)
    return squares, weighted_residual / np.maximum(np.diag(projector), 1e-300)[:, None]
