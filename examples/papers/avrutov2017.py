"""
Avrutov's 3D calibration (ELNANO 2017) as named methods.

The methods use the paper's units (V, g, deg/s). The effect of the references is included.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.errors import InputError
from papers.linear_least_squares import LinearSolution, solve_linear

MODEL_COLUMNS = {
    'linear': ('bias', 'x', 'y', 'z'),
    'products': ('bias', 'x', 'y', 'z', 'xy', 'yz', 'xz'),
    'quadratic': ('bias', 'x', 'y', 'z', 'xy', 'yz', 'xz', 'xx', 'yy', 'zz'),
}
"""
Design columns of the axial model (eq. 2, 8), the pendulous or extended model (eq. 5, 11) and the
full quadratic.
"""

GIMBAL_ORDERS = tuple(
    ''.join(order)
    for order in itertools.product('XYZ', repeat=3)
    if order[0] != order[1] != order[2]
)
"""All 12 Euler and Tait-Bryan orders, the first rotation first."""


def nominal_accelerometers(model: str = 'products') -> np.ndarray:
    """
    Return the coefficients of samples 1 ('linear', V and V/g) and 2 ('products', also V/g^2).

    Shape (n_params, 3).
    """
    matrix = np.array([[1.0, 0.01, -0.01], [-0.01, 1.0, 0.01], [0.01, -0.01, 1.0]])
    return _stacked(2.5, matrix, model)


def nominal_gyroscopes(model: str = 'products', n11: float = 0.1) -> np.ndarray:
    """
    Return the coefficients of samples 3 and 4, V, V/(deg/s), V/(deg/s)^2.

    The paper prints 0.01 for n11 and means 0.1, it seems.
    """
    matrix = np.array([[n11, 0.01, -0.02], [-0.01, 0.1, 0.01], [0.03, -0.01, 0.1]])
    return _stacked(2.0, matrix, model)


def _stacked(bias, matrix, model):
    products = np.full((3, 3), 1e-3) - 2e-3 * np.eye(3)
    return np.vstack([np.full(3, bias), matrix.T, products.T])[: len(MODEL_COLUMNS[model])]


def turn(order: str, angles: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    """
    Return body-from-base matrices of three gimbal turns, shape (n, 3, 3).

    Parameters
    ----------
    order : str
        One of `GIMBAL_ORDERS`; the first letter is the axis of the first turn, next to the base.
    angles : three arrays, shape (n,)
        Turns in rad, right-handed, each about the axis as the previous turns left it.

    """
    return Rotation.from_euler(order, np.transpose(angles)).inv().as_matrix()


def simultaneous_turn(
    angle: np.ndarray, axis: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> np.ndarray:
    """
    Return body-from-base matrices of one turn by `angle` (rad, shape (n,)) about `axis`.

    "three axes simultaneously", literally.
    """
    return Rotation.from_rotvec(np.outer(angle, axis) / np.linalg.norm(axis)).inv().as_matrix()


def equal_angles(step_deg: float = 10.0) -> np.ndarray:
    """
    Return the paper's turn angles in rad.

    0 to 400 deg with the end, 41 positions (40 in the paper).
    """
    return np.deg2rad(np.arange(0.0, 400.0 + step_deg / 2, step_deg))


def gravity_readings(
    mat_bn: np.ndarray, gravity_axis: str, tilt_rad: Sequence[float] | np.ndarray = (0.0, 0.0)
) -> np.ndarray:
    """
    Return the specific force in g in the body frame, shape (n, 3).

    For gravity along one axis of the table's base.

    Parameters
    ----------
    mat_bn : array, shape (n, 3, 3)
        Body-from-base matrices.
    gravity_axis : str
        'x', 'y' or 'z' of the base.
    tilt_rad : pair
        Levelling error: components of the unit gravity vector along the next two base axes.

    """
    up, *level = np.roll(np.eye(3), -'xyz'.index(gravity_axis), axis=0)
    return mat_bn @ (np.sqrt(1 - np.dot(tilt_rad, tilt_rad)) * up + np.dot(tilt_rad, level))


def series_3() -> np.ndarray:
    """
    Return the rates of sample 3, deg/s, shape (n, 3).

    W, w^(1/2), w^(1/3) for w = 0, 10 ... 100 (11 runs, 10 in the paper).
    """
    rate = np.arange(0.0, 101.0, 10.0)
    return np.column_stack([rate, np.sqrt(rate), np.cbrt(rate)])


def series_4() -> np.ndarray:
    """Return the rates of sample 4, deg/s, shape (n, 3): w, exp(-w), w^2 for w = 0, 1 ... 10."""
    rate = np.arange(0.0, 11.0)
    return np.column_stack([rate, np.exp(-rate), rate**2])


def factorial_rates(rate_deg_s: float = 10.0) -> np.ndarray:
    """
    Return all eight sign combinations of one rate on each axis and three runs at rest, deg/s.

    The orthogonal design.
    """
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    return np.vstack([rate_deg_s * corners, np.zeros((3, 3))])


def add_earth_rate(rate_deg_s: np.ndarray, along_spin_axis_deg_s: float) -> np.ndarray:
    """
    Return body rates that include Earth rate's component along the spin axis.

    The rest averages out over full turns.
    """
    size = np.linalg.norm(rate_deg_s, axis=1, keepdims=True)
    axis = np.where(size > 0, rate_deg_s / np.where(size > 0, size, 1.0), (1.0, 0.0, 0.0))
    return rate_deg_s + along_spin_axis_deg_s * axis


def design_matrix(inputs: np.ndarray, model: str = 'linear') -> np.ndarray:
    """
    Return G (eq. 2, 5) or omega (eq. 8, 11), shape (n, n_params), columns as in `MODEL_COLUMNS`.
    """
    if model not in MODEL_COLUMNS:
        raise InputError(
            f"model must be one of {', '.join(MODEL_COLUMNS)}, got '{model}'; choose one of them",
            code='model_unknown',
        )
    x, y, z = np.asarray(inputs, float).T
    known = {
        'bias': np.ones_like(x),
        'x': x,
        'y': y,
        'z': z,
        'xy': x * y,
        'yz': y * z,
        'xz': x * z,
        'xx': x * x,
        'yy': y * y,
        'zz': z * z,
    }
    return np.column_stack([known[name] for name in MODEL_COLUMNS[model]])


def calibrate(
    inputs: np.ndarray,
    outputs: np.ndarray,
    model: str = 'linear',
    *,
    weights: np.ndarray | None = None,
) -> LinearSolution:
    """
    Estimate bias, matrix and products of three sensors (eq. 3, 6, 9, 12).

    By orthogonal factors instead of normal equations.

    Parameters
    ----------
    inputs : array, shape (n, 3)
        Reference specific force in g, or rate in deg/s (any unit: the coefficients follow).
    outputs : array, shape (n, 3)
        Mean sensor outputs, V.
    weights : array, shape (n,), optional
        Inverse variances of the means.

    Returns
    -------
    LinearSolution
        `values` has shape (n_params, 3): one column per sensor, as the paper's X.

    Raises
    ------
    NotObservableError
        When the turns do not determine every column.

    """
    return solve_linear(
        design_matrix(inputs, model), outputs, MODEL_COLUMNS[model], weights=weights
    )


def calibrate_as_printed(
    inputs: np.ndarray, outputs: np.ndarray, model: str = 'linear'
) -> np.ndarray:
    """
    Return X by the printed normal equations ``inv(G'G) G'U``, for a comparison of their accuracy.
    """
    design = design_matrix(inputs, model)
    return np.linalg.inv(design.T @ design) @ design.T @ outputs


@dataclass(frozen=True, eq=False)
class TiltedSolution:
    """Calibration of three accelerometers together with the levelling error of the table."""

    coefficients: np.ndarray
    """Bias and matrix, shape (4, 3), V and V/g."""
    tilt_rad: np.ndarray
    """Levelling error along the two base axes after `gravity_axis`, shape (2,)."""
    linear: LinearSolution
    """Last linear step; its `unit_covariance` holds for the names in `linear.param_names`."""


TILT_STEPS = 8
"""Gauss-Newton steps of `calibrate_with_tilt`."""


def calibrate_with_tilt(
    mat_bn: np.ndarray, outputs: np.ndarray, gravity_axis: str
) -> TiltedSolution:
    """
    Estimate the parameters of all three accelerometers jointly.

    The parameters are bias, matrix (n x 4 model) and two tilt parameters, estimated by Gauss-Newton
    steps.

    Raises
    ------
    NotObservableError
        When the positions do not separate tilt from matrix.

    """
    names = tuple(
        f'{column}_{sensor}' for sensor in 'xyz' for column in MODEL_COLUMNS['linear']
    ) + ('tilt_1', 'tilt_2')
    tilt = np.zeros(2)
    coefficients = calibrate(gravity_readings(mat_bn, gravity_axis), outputs).values
    for _ in range(TILT_STEPS):
        design = design_matrix(gravity_readings(mat_bn, gravity_axis, tilt), 'linear')
        slopes = mat_bn @ _tilt_derivative(gravity_axis, tilt)
        full = np.zeros((3, len(design), 14))
        for sensor in range(3):
            full[sensor, :, 4 * sensor : 4 * sensor + 4] = design
            full[sensor, :, 12:] = np.einsum('i,nij->nj', coefficients[1:, sensor], slopes)
        step = solve_linear(
            full.reshape(-1, 14), (outputs - design @ coefficients).T.ravel(), names
        )
        coefficients = coefficients + step.values[:12].reshape(3, 4).T
        tilt = tilt + step.values[12:]
    return TiltedSolution(coefficients, tilt, step)


def reference_error(
    inputs: np.ndarray, input_changes: np.ndarray, coefficients: np.ndarray
) -> np.ndarray:
    """
    Return the errors of the coefficients from errors of the reference inputs.

    ``G^+ dG X``, shape (n_params, 3).

    The true inputs are ``inputs + input_changes``, the fit uses `inputs`. Exact, and rows may err
    together (tilt, Earth rate), which the paper's section V cannot express.

    """
    true_outputs = design_matrix(np.asarray(inputs) + input_changes) @ coefficients
    return calibrate(inputs, true_outputs).values - coefficients


def estimation_operator(inputs: np.ndarray, model: str = 'linear') -> np.ndarray:
    """
    Return B with ``X = B @ U``, eq. 13.

    ``inv(G'G) G'``, by orthogonal factors, shape (n_params, n).
    """
    return (
        calibrate(inputs, np.zeros((len(inputs), 3)), model).unit_covariance
        @ design_matrix(inputs, model).T
    )


def m_test_sd(errors: np.ndarray, as_printed: bool = True) -> np.ndarray:
    """
    Return the root-mean-square error over m tests, as at the end of section V.

    ``sqrt(sum(error^2) / (m - 1))``, shape (...).

    The errors are against known truth, without an estimate from them, so that m is right
    (`as_printed` False); m - 1 belongs to differences from their own mean.

    Parameters
    ----------
    errors : array, shape (m, ...)
        Estimate minus truth in each test.
    as_printed : bool

    """
    errors = np.asarray(errors, float)
    return np.sqrt((errors**2).sum(axis=0) / (len(errors) - as_printed))


def error_budget(
    inputs: np.ndarray,
    coefficients: np.ndarray,
    model: str = 'linear',
    *,
    noise_sd: float = 0.0,
    common: dict[str, np.ndarray] | None = None,
    scattered: dict[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """
    Split the sd of every coefficient into its causes (section V of the paper).

    Parameters
    ----------
    inputs : array, shape (n, 3)
        Reference inputs.
    noise_sd : float
        Sd of the mean outputs, V: contributes ``noise_sd^2 inv(G'G)``.
    common : dict of str to array, shape (n, 3) or (k, n, 3)
        Change of the inputs by one sd of a cause that all runs share (tilt: k = 2 directions,
        gravity, Earth rate).
    scattered : dict of str to array, shape (n, 3) or (k, n, 3)
        Change of the inputs by one sd of a cause that is drawn independently in every run (encoder,
        rate resolution).

    Returns
    -------
    dict of str to array, shape (n_params, 3)
        Sd per cause, to first order, and 'total'.

    """
    inverse = estimation_operator(inputs, model)
    budget = {
        'output noise': np.repeat(noise_sd * np.linalg.norm(inverse, axis=1)[:, None], 3, axis=1)
    }
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
    """
    Return the change of the readings by one sd of each tilt component, g, shape (2, n, 3).

    For `error_budget`.
    """
    return tilt_sd_rad * np.moveaxis(mat_bn @ _tilt_derivative(gravity_axis, np.zeros(2)), 2, 0)


def encoder_changes(
    order: str, angles: np.ndarray, gravity_axis: str, *, encoder_sd_rad: float
) -> np.ndarray:
    """
    Return the change of the readings by one sd of each gimbal angle, g, shape (3, n, 3).

    For `error_budget`.
    """
    changes = []
    for gimbal in range(3):
        shift = np.pi / 2 * np.eye(3)[gimbal][:, None]
        later, earlier = (
            gravity_readings(turn(order, np.asarray(angles) + sign * shift), gravity_axis)
            for sign in (1, -1)
        )
        # Exact: every element is affine in the sine and cosine of one angle.
        changes.append(encoder_sd_rad * (later - earlier) / 2)
    return np.array(changes)


def _tilt_derivative(gravity_axis, tilt_rad):
    up, *level = np.roll(np.eye(3), -'xyz'.index(gravity_axis), axis=0)
    return np.column_stack(level) - np.outer(up, tilt_rad) / np.sqrt(1 - np.dot(tilt_rad, tilt_rad))


def _design_slope(inputs, model):
    """
    Return the derivative of the design by the inputs, shape (n, n_params, 3).

    Exact, as the columns are quadratic at most.
    """
    inputs = np.asarray(inputs, float)
    steps = np.eye(3)
    return np.stack(
        [
            (design_matrix(inputs + step, model) - design_matrix(inputs - step, model)) / 2
            for step in steps
        ],
        axis=-1,
    )
