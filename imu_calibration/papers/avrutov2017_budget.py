"""
What the references do to Avrutov's calibration: levelling, encoder and Earth rate (section V, with correlated rows).

The paper sums errors of the matrix B and of the outputs as if they were independent, with sign. Output noise gives
``sigma^2 inv(G'G)``; wrong references give ``G^+ dG X``, where the rows of dG err together when the table is not level.
"""

from dataclasses import dataclass

import numpy as np

from imu_calibration.papers.avrutov2017 import COLUMNS, calibrate, design_matrix, gravity_readings, turn
from imu_calibration.papers.linear_least_squares import LinearSolution, solve_linear


@dataclass(frozen=True, eq=False)
class TiltedSolution:
    """Calibration of three accelerometers together with the levelling error of the table."""

    coefficients: np.ndarray
    """Bias and matrix, shape (4, 3), V and V/g."""
    tilt_rad: np.ndarray
    """Levelling error along the two base axes after `gravity_axis`, shape (2,)."""
    linear: LinearSolution
    """Last linear step; its `unit_covariance` holds for the names in `linear.param_names`."""


def calibrate_with_tilt(mat_bn: np.ndarray, outputs: np.ndarray, gravity_axis: str, *, iterations: int = 8) -> TiltedSolution:
    """
    Estimate bias, matrix (n x 4 model) and two tilt parameters from all three accelerometers jointly, by Gauss-Newton steps.

    Raises
    ------
    NotObservableError
        When the positions do not separate tilt from matrix.

    """
    names = tuple(f'{column}_{sensor}' for sensor in 'xyz' for column in COLUMNS['linear']) + ('tilt_1', 'tilt_2')
    tilt = np.zeros(2)
    coefficients = calibrate(gravity_readings(mat_bn, gravity_axis), outputs).values
    for _ in range(iterations):
        design = design_matrix(gravity_readings(mat_bn, gravity_axis, tilt), 'linear')
        slopes = mat_bn @ _tilt_derivative(gravity_axis, tilt)
        full = np.zeros((3, len(design), 14))
        for sensor in range(3):
            full[sensor, :, 4 * sensor:4 * sensor + 4] = design
            full[sensor, :, 12:] = np.einsum('i,nij->nj', coefficients[1:, sensor], slopes)
        step = solve_linear(full.reshape(-1, 14), (outputs - design @ coefficients).T.ravel(), names)
        coefficients = coefficients + step.values[:12].reshape(3, 4).T
        tilt = tilt + step.values[12:]
    return TiltedSolution(coefficients, tilt, step)


def reference_error(inputs: np.ndarray, input_changes: np.ndarray, coefficients: np.ndarray, *, model: str = 'linear') -> np.ndarray:
    """
    Return what wrong reference inputs do to the coefficients: ``G^+ dG X``, shape (n_params, 3).

    The true inputs are ``inputs + input_changes``, the fit uses `inputs`. Exact, and rows may err together (tilt, Earth rate),
    which the paper's section V cannot express.

    """
    true_outputs = design_matrix(np.asarray(inputs) + input_changes, model) @ coefficients
    return calibrate(inputs, true_outputs, model).values - coefficients


def estimation_operator(inputs: np.ndarray, model: str = 'linear') -> np.ndarray:
    """Return B with ``X = B @ U``, eq. 13: ``inv(G'G) G'``, by orthogonal factors, shape (n_params, n)."""
    return calibrate(inputs, np.zeros((len(inputs), 3)), model).unit_covariance @ design_matrix(inputs, model).T


def m_test_sd(errors: np.ndarray, as_printed: bool = True) -> np.ndarray:
    """
    Return the root-mean-square error over m tests, as at the end of section V: ``sqrt(sum(error^2) / (m - 1))``, shape (...).

    The errors are against known truth, so that nothing was estimated from them and m is right (`as_printed` False); m - 1 belongs to
    differences from their own mean.

    Parameters
    ----------
    errors : array, shape (m, ...)
        Estimate minus truth in each test.
    as_printed : bool

    """
    errors = np.asarray(errors, float)
    return np.sqrt((errors**2).sum(axis=0) / (len(errors) - as_printed))


def error_budget(inputs: np.ndarray, coefficients: np.ndarray, model: str = 'linear', *, noise_sd: float = 0.0,
                 common: dict[str, np.ndarray] | None = None, scattered: dict[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    """
    Split the sd of every coefficient into its causes, which is what section V of the paper is after.

    Parameters
    ----------
    inputs : array, shape (n, 3)
        Reference inputs.
    noise_sd : float
        Sd of the mean outputs, V: contributes ``noise_sd^2 inv(G'G)``.
    common : dict of str to array, shape (n, 3) or (k, n, 3)
        Change of the inputs by one sd of a cause that all runs share (tilt: k = 2 directions, gravity, Earth rate).
    scattered : dict of str to array, shape (n, 3) or (k, n, 3)
        Change of the inputs by one sd of a cause that is drawn anew in every run (encoder, rate resolution).

    Returns
    -------
    dict of str to array, shape (n_params, 3)
        Sd per cause, to first order, and 'total'.

    """
    inverse = estimation_operator(inputs, model)
    budget = {'output noise': np.repeat(noise_sd * np.linalg.norm(inverse, axis=1)[:, None], 3, axis=1)}
    slope = _design_slope(inputs, model)

    def output_change(changes):
        changes = np.asarray(changes, float).reshape(-1, len(inputs), 3)
        return np.einsum('npj,knj,ps->kns', slope, changes, coefficients)

    for cause, changes in (common or {}).items():
        budget[cause] = np.sqrt(np.sum((inverse @ output_change(changes)) ** 2, axis=0))
    for cause, changes in (scattered or {}).items():
        budget[cause] = np.sqrt(inverse**2 @ np.sum(output_change(changes) ** 2, axis=0))
    budget['total'] = np.sqrt(sum(part**2 for part in budget.values()))
    return budget


def tilt_changes(mat_bn: np.ndarray, gravity_axis: str, tilt_sd_rad: float) -> np.ndarray:
    """Return the change of the readings by one sd of each tilt component, g, shape (2, n, 3), for `error_budget`."""
    return tilt_sd_rad * np.moveaxis(mat_bn @ _tilt_derivative(gravity_axis, np.zeros(2)), 2, 0)


def encoder_changes(order: str, angles: np.ndarray, gravity_axis: str, *, encoder_sd_rad: float) -> np.ndarray:
    """Return the change of the readings by one sd of each gimbal angle, g, shape (3, n, 3), for `error_budget`."""
    changes = []
    for gimbal in range(3):
        shift = np.pi / 2 * np.eye(3)[gimbal][:, None]
        later, earlier = (gravity_readings(turn(order, np.asarray(angles) + sign * shift), gravity_axis) for sign in (1, -1))
        changes.append(encoder_sd_rad * (later - earlier) / 2)  # exact: every element is affine in the sine and cosine of one angle
    return np.array(changes)


def _tilt_derivative(gravity_axis, tilt_rad):
    up, first, second = np.roll(np.eye(3), -'xyz'.index(gravity_axis), axis=0)
    return np.column_stack([first, second]) - np.outer(up, tilt_rad) / np.sqrt(1 - np.dot(tilt_rad, tilt_rad))


def _design_slope(inputs, model):
    """Return the derivative of the design by the inputs, shape (n, n_params, 3); exact, as the columns are quadratic at most."""
    inputs = np.asarray(inputs, float)
    steps = np.eye(3)
    return np.stack([(design_matrix(inputs + step, model) - design_matrix(inputs - step, model)) / 2 for step in steps], axis=-1)
