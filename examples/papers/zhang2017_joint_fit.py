"""
Static and dynamic runs of a turntable in one least-squares system for bias, matrix and lever arms.

Designs of runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.kinematics.rotations import lever_matrix
from papers.linear_least_squares import (
    RANK_TOLERANCE,
    ToleranceScaled,
    solve_linear,
    tolerance_scaled,
)

DESIGNS = ('Z0', 'Z60', 'O', 'M')
"""
Zhang's own runs, the same with the fixture skewed by 60 deg, oscillations, and a mixture with
two-axis turns.
"""


@dataclass(frozen=True, eq=False)
class Run:
    """True motion during one run; a run whose reading is constant is one row, the mean."""

    name: str
    """Motion of the table."""
    force: np.ndarray
    """Specific force at the reference point, m/s^2, shape (n, 3)."""
    rate: np.ndarray
    """Body rate, rad/s, shape (n, 3)."""
    alpha: np.ndarray
    """Angular acceleration, rad/s^2, shape (n, 3)."""
    noise_sd: float
    """Sd of one row, m/s^2."""


def face(up: np.ndarray, noise_sd: float, tilt: float = 0.0, *, azimuth: float = 0.0) -> Run:
    """
    Return one position at rest.

    The table is off level by `tilt` (rad) towards `azimuth` about the body's up axis.
    """
    up = _unit(up)
    level = _square_to(up)
    force = np.cos(tilt) * up + np.sin(tilt) * (
        np.cos(azimuth) * level + np.sin(azimuth) * np.cross(up, level)
    )
    return Run('face', STANDARD_GRAVITY * force[None], np.zeros((1, 3)), np.zeros((1, 3)), noise_sd)


def spin(axis: np.ndarray, rate_deg_s: float, noise_sd: float) -> Run:
    """
    Return a spin at constant rate about a vertical axis; gravity and arms give constant readings.
    """
    axis = _unit(axis)[None]
    return Run(
        'spin', STANDARD_GRAVITY * axis, np.deg2rad(rate_deg_s) * axis, np.zeros((1, 3)), noise_sd
    )


def oscillation(
    axis: np.ndarray,
    amplitude_deg: float,
    frequency_hz: float,
    *,
    noise_sd: float,
    n_samples: int = 100,
    delay: float = 0.0,
) -> Run:
    """
    Return one period of ``amplitude sin(2 pi f t)`` about a vertical axis.

    `delay` (s) is how late the samples are stamped.
    """
    axis, angular = _unit(axis), 2 * np.pi * frequency_hz
    phase = angular * (np.arange(n_samples) / n_samples / frequency_hz - delay)
    amplitude = np.deg2rad(amplitude_deg)
    return Run(
        'oscillation',
        np.tile(STANDARD_GRAVITY * axis, (n_samples, 1)),
        np.outer(amplitude * angular * np.cos(phase), axis),
        np.outer(-amplitude * angular**2 * np.sin(phase), axis),
        noise_sd,
    )


def two_axis(
    inner: np.ndarray,
    inner_deg_s: float,
    outer_deg_s: float,
    *,
    noise_sd: float,
    n_samples: int = 100,
    delay: float = 0.0,
) -> Run:
    """
    Return one turn of a horizontal body axis `inner` at constant rate.

    The vertical outer axis turns as well at the same time.
    """
    inner, (inner_rate, outer_rate) = _unit(inner), np.deg2rad([inner_deg_s, outer_deg_s])
    turned = inner_rate * (np.arange(n_samples) / n_samples * 2 * np.pi / abs(inner_rate) - delay)
    start = _square_to(inner)
    up = np.outer(np.cos(turned), start) - np.outer(np.sin(turned), np.cross(inner, start))
    rate, alpha = (
        inner_rate * inner + outer_rate * up,
        -inner_rate * outer_rate * np.cross(inner, up),
    )
    return Run('two-axis', STANDARD_GRAVITY * up, rate, alpha, noise_sd)


def design_runs(name: str) -> list[Run]:
    """
    Return the runs of one of `DESIGNS`: six faces and nine dynamic runs of 100 samples each.

    A sample has white noise of 1 mg; the mean of a run with constant readings a tenth of it.
    """
    if name not in DESIGNS:
        raise InputError(
            f"design must be one of {', '.join(DESIGNS)}, got '{name}'; choose one of them"
        )
    n_samples = 100
    sample_sd = 1e-3 * STANDARD_GRAVITY
    mean_sd = sample_sd / np.sqrt(n_samples)
    axes = np.eye(3)
    runs = [face(sign * axis, mean_sd) for sign in (1, -1) for axis in axes]
    if name in ('Z0', 'Z60'):
        skew_deg = {'Z0': 0.0, 'Z60': 60.0}[name]
        return runs + [
            spin(axis, rate, mean_sd) for axis in skewed_axes(skew_deg) for rate in (100, 150, 200)
        ]
    if name == 'O':
        kinds = ((10, 1.0), (5, 2.0), (90, 0.5))
        return runs + [
            oscillation(axis, *kind, noise_sd=sample_sd, n_samples=n_samples)
            for axis in axes
            for kind in kinds
        ]
    return (
        runs
        + [spin(axis, 200, mean_sd) for axis in axes]
        + [oscillation(axis, 10, 1.0, noise_sd=sample_sd, n_samples=n_samples) for axis in axes]
        + [two_axis(axis, 200, 200, noise_sd=sample_sd, n_samples=n_samples) for axis in axes]
    )


def skewed_axes(skew_deg: float) -> np.ndarray:
    """
    Return three orthonormal spin axes, one per row.

    For a fixture turned by `skew_deg` about the body diagonal (1, 1, 1).
    """
    return Rotation.from_rotvec(np.deg2rad(skew_deg) * np.ones(3) / np.sqrt(3)).as_matrix().T


def average_headings(tilt: float, up: np.ndarray, noise_sd: float) -> Run:
    """
    Return the mean of a tilted position over four equally spaced headings.

    The error of levelling cancels in this mean.
    """
    parts = [face(up, noise_sd, tilt, azimuth=2 * np.pi * k / 4) for k in range(4)]
    return replace(parts[0], force=np.mean([part.force for part in parts], axis=0))


def stack_runs(runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return forces, lever-arm matrices and noise of all rows of the runs in order.

    The shapes are (n, 3) for forces, (n, 3, 3) for lever-arm matrices and (n,) for the noise sd.
    """
    noise = np.concatenate([np.full(len(run.force), run.noise_sd) for run in runs])
    arm_matrix = np.concatenate([lever_matrix(run.rate, run.alpha) for run in runs])
    return np.concatenate([run.force for run in runs]), arm_matrix, noise


def _unit(vector):
    vector = np.asarray(vector, float)
    return vector / np.linalg.norm(vector)


def _square_to(axis):
    """Return the unit vector square to `axis` that the next body axis comes closest to."""
    following = np.roll(np.eye(3), 1, axis=1)[np.argmax(np.abs(axis))]
    return _unit(following - (following @ axis) * axis)


PARAM_NAMES = ('bias', 'm_x', 'm_y', 'm_z', 'r_x', 'r_y', 'r_z')
"""Parameters of one accelerometer: m/s^2, 1, m."""
MAX_JOINT_FIT_STEPS = 30
"""Gauss-Newton steps, at most."""
TOLERANCES = np.array([1e-4 * STANDARD_GRAVITY, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
"""0.1 mg, 0.1 mg/g, 0.1 mm."""


def predict(runs: Sequence[Run], values: np.ndarray) -> np.ndarray:
    """
    Return the readings of one accelerometer, shape (n_rows,).

    For parameters in `PARAM_NAMES` order.
    """
    force, arm_matrix, _ = stack_runs(runs)
    return values[0] + (force + arm_matrix @ values[4:]) @ values[1:4]


def jacobian(runs: Sequence[Run], values: np.ndarray) -> np.ndarray:
    """
    Return the derivative of the readings by `PARAM_NAMES`, each row over its noise sd.

    Shape (n_rows, 7).
    """
    force, arm_matrix, noise = stack_runs(runs)
    columns = [
        np.ones(len(force)),
        force + arm_matrix @ values[4:],
        np.einsum('j,njk->nk', values[1:4], arm_matrix),
    ]
    return np.column_stack(columns) / noise[:, None]


def judge_design(
    runs: Sequence[Run],
    matrix: np.ndarray,
    arms: np.ndarray,
) -> list[ToleranceScaled]:
    """
    Predict the precision of a design, one `ToleranceScaled` per accelerometer.

    Sd over `TOLERANCES` and weak directions.

    An sd over tolerance above 1 means that the parameter must not be reported as a plain value.

    """
    return [
        tolerance_scaled(jacobian(runs, np.concatenate([[0.0], m, r])), TOLERANCES)
        for m, r in zip(matrix, arms)
    ]


def weak_arms(judged: Sequence[ToleranceScaled]) -> list[str]:
    """
    Return the names of arms with a predicted sd above the tolerance.

    The names have the form 'r_xy' (sensor x, component y).
    """
    return [
        f'r_{sensor}{PARAM_NAMES[k][-1]}'
        for sensor, one in zip('xyz', judged)
        for k in (4, 5, 6)
        if one.sd_over_tolerance[k] > 1
    ]


def arm_errors(
    runs: Sequence[Run],
    matrix_row: np.ndarray,
    arm: np.ndarray,
    *,
    rng: np.random.Generator,
    n_draws: int,
) -> np.ndarray:
    """
    Draw errors of one estimated arm from the covariance that the runs predict, m.

    Shape (n_draws, 3).
    """
    factor = np.linalg.qr(jacobian(runs, np.concatenate([[0.0], matrix_row, arm])), mode='r')
    return np.linalg.solve(factor, rng.normal(size=(len(PARAM_NAMES), n_draws))).T[:, 4:]


@dataclass(frozen=True, eq=False)
class JointFit:
    """Fit of one accelerometer for one or many draws of the readings."""

    values: np.ndarray
    """Parameters in `PARAM_NAMES` order, shape (n_draws, 7)."""
    covariance: np.ndarray
    """From the stated noise, at the solution, shape (n_draws, 7, 7)."""
    chi2: np.ndarray
    """Weighted residual sum of squares, shape (n_draws,)."""
    dof: int
    """Rows minus parameters."""

    @property
    def sd(self) -> np.ndarray:
        """Sd of the parameters, shape (n_draws, 7)."""
        return np.sqrt(np.einsum('nii->ni', self.covariance))


def fit_joint(
    runs: Sequence[Run], readings: np.ndarray, start: np.ndarray | None = None
) -> JointFit:
    """
    Fit bias, matrix row and arm of one accelerometer to static and dynamic runs jointly.

    Parameters
    ----------
    runs : list of Run
    readings : array, shape (n_rows,) or (n_rows, n_draws)
        Rows in the order of the runs, m/s^2.
    start : array, shape (7,), optional
        Start values; if not given, the static solution of the runs at rest with no arm.

    Returns
    -------
    JointFit

    Raises
    ------
    NotObservableError
        When the runs do not determine all parameters at an iterate; names the directions.

    """
    readings = np.asarray(readings, float).reshape(len(readings), -1)
    orthogonal, factor, target = _reduce(runs, readings)
    outside = np.sum((readings / stack_runs(runs)[2][:, None] - orthogonal @ target) ** 2, axis=0)
    values = (
        _static_start(runs, readings)
        if start is None
        else np.tile(np.asarray(start, float), (readings.shape[1], 1))
    )
    previous = np.inf
    for _ in range(MAX_JOINT_FIT_STEPS):
        slope, rest = _linearise(factor, target, values)
        step, inverse = _solve_stack(slope, rest)
        values = values + step
        size = np.max(np.abs(step) / np.sqrt(np.einsum('nij,nij->ni', inverse, inverse)))
        if size < 1e-9 and size >= 0.1 * previous or size == 0:
            break
        previous = size
    slope, rest = _linearise(factor, target, values)
    _, inverse = _solve_stack(slope, rest)
    covariance = inverse @ np.swapaxes(inverse, 1, 2)
    return JointFit(
        values, covariance, outside + np.sum(rest**2, axis=1), len(readings) - len(PARAM_NAMES)
    )


def fit_triad(
    runs: Sequence[Run], readings: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[JointFit]]:
    """
    Fit the three accelerometers of a recording, readings of shape (n_rows, 3).

    Return matrix (3, 3), arms (3, 3), bias (3,), fits.
    """
    fits = [fit_joint(runs, column) for column in np.asarray(readings, float).T]
    values = np.array([fit.values[0] for fit in fits])
    return values[:, 1:4], values[:, 4:], values[:, 0], fits


def _reduce(runs, readings):
    """
    Return Q, R and Q'y of the system with columns 1, f_j and W_jk.

    Products m_j r_k are its last nine unknowns.
    """
    force, arm_matrix, noise = stack_runs(runs)
    design = (
        np.column_stack([np.ones(len(force)), force, arm_matrix.reshape(len(force), 9)])
        / noise[:, None]
    )
    orthogonal, factor = np.linalg.qr(design)
    return orthogonal, factor, orthogonal.T @ (readings / noise[:, None])


def _linearise(factor, target, values):
    n_draws, matrix, arm = len(values), values[:, 1:4], values[:, 4:]
    linear = np.concatenate(
        [values[:, :4], np.einsum('nj,nk->njk', matrix, arm).reshape(n_draws, 9)], axis=1
    )
    slope = np.zeros((n_draws, 13, 7))
    slope[:, :4, :4] = np.eye(4)
    for j in range(3):
        rows = slice(4 + 3 * j, 7 + 3 * j)
        slope[:, rows, 1 + j] = arm
        slope[:, rows, 4:] = matrix[:, j, None, None] * np.eye(3)
    return factor @ slope, target.T - linear @ factor.T


def _solve_stack(slope, rest):
    """
    Solve a stack of small least-squares problems by QR with scaled columns.

    Return steps and inverse factors.
    """
    norms = np.linalg.norm(slope, axis=1)
    if np.any(norms == 0):
        _refuse(slope[np.argmax(np.any(norms == 0, axis=1))])
    orthogonal, triangle = np.linalg.qr(slope / norms[:, None, :])
    smallest = np.min(np.abs(np.einsum('nii->ni', triangle)), axis=1)
    if np.any(smallest < RANK_TOLERANCE):
        _refuse(slope[np.argmin(smallest)])
    inverse = np.linalg.inv(triangle) / norms[:, :, None]
    return np.einsum('nij,nkj,nk->ni', inverse, orthogonal, rest), inverse


def _refuse(slope):
    solve_linear(slope, np.zeros(len(slope)), PARAM_NAMES)
    raise NotObservableError(
        'the runs must determine bias, matrix row and arm, got a system singular to rounding; add'
        ' runs'
    )


def _static_start(runs, readings):
    force, _, noise = stack_runs(runs)
    still = np.concatenate(
        [np.full(len(run.force), not (np.any(run.rate) or np.any(run.alpha))) for run in runs]
    )
    design = np.column_stack([np.ones(np.sum(still)), force[still]])
    static = solve_linear(
        design, readings[still], PARAM_NAMES[:4], weights=1 / noise[still] ** 2
    ).values
    return np.concatenate([static.T, np.zeros((readings.shape[1], 3))], axis=1)
