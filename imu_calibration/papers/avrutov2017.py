"""
Avrutov's 3D calibration (ELNANO 2017) as named methods, in the paper's own units: V, g, deg/s.

Accelerometers: eq. 1-6, gyroscopes: eq. 7-12. Both are ``outputs = design(inputs) @ coefficients`` with three outputs that share the
design. Product columns are named (``xy``, ``yz``, ``xz``), never positional: the paper's own result of sample 4 has two rows exchanged.
The methods also run on means over windows of a real recording; then inputs are the reference specific force (or rate).
"""

import itertools
from collections.abc import Sequence

import numpy as np

from imu_calibration.errors import InputError
from imu_calibration.papers.linear_least_squares import LinearSolution, solve_linear
from imu_calibration.reference.reference_motion import skew

COLUMNS = {
    'linear': ('bias', 'x', 'y', 'z'),
    'products': ('bias', 'x', 'y', 'z', 'xy', 'yz', 'xz'),
    'quadratic': ('bias', 'x', 'y', 'z', 'xy', 'yz', 'xz', 'xx', 'yy', 'zz'),
}
"""Design columns of the axial model (eq. 2, 8), the pendulous or extended model (eq. 5, 11) and the full quadratic."""

GIMBAL_ORDERS = tuple(''.join(order) for order in itertools.product('XYZ', repeat=3) if order[0] != order[1] != order[2])
"""All 12 Euler and Tait-Bryan orders, the first rotation first."""


def nominal_accelerometers(model: str = 'products') -> np.ndarray:
    """Return the coefficients of samples 1 ('linear', V and V/g) and 2 ('products', also V/g^2), shape (n_params, 3)."""
    matrix = np.array([[1.0, 0.01, -0.01], [-0.01, 1.0, 0.01], [0.01, -0.01, 1.0]])
    return _stacked(2.5, matrix, model)


def nominal_gyroscopes(model: str = 'products', n11: float = 0.1) -> np.ndarray:
    """Return the coefficients of samples 3 and 4, V, V/(deg/s), V/(deg/s)^2; the paper prints 0.01 for n11 and means 0.1, it seems."""
    matrix = np.array([[n11, 0.01, -0.02], [-0.01, 0.1, 0.01], [0.03, -0.01, 0.1]])
    return _stacked(2.0, matrix, model)


def _stacked(bias, matrix, model):
    products = np.full((3, 3), 1e-3) - 2e-3 * np.eye(3)
    return np.vstack([np.full(3, bias), matrix.T, products.T])[:len(COLUMNS[model])]


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
    first, second, third = (_axis_turn('XYZ'.index(letter), angle) for letter, angle in zip(order, angles, strict=True))
    return third @ second @ first


def simultaneous_turn(angle: np.ndarray, axis: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
    """Return body-from-base matrices of one turn by `angle` (rad, shape (n,)) about `axis`: "three axes simultaneously", literally."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = skew(axis)
    angle = np.asarray(angle, float)[:, None, None]
    return np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def equal_angles(step_deg: float = 10.0, stop_deg: float = 400.0) -> np.ndarray:
    """Return the paper's turn angles in rad: 0 to `stop_deg` with the end, 41 positions (the paper says 40)."""
    return np.deg2rad(np.arange(0.0, stop_deg + step_deg / 2, step_deg))


def gravity_readings(mat_bn: np.ndarray, gravity_axis: str, tilt_rad: Sequence[float] | np.ndarray = (0.0, 0.0)) -> np.ndarray:
    """
    Return the specific force in g in the body frame, shape (n, 3), for gravity along one axis of the table's base.

    Parameters
    ----------
    mat_bn : array, shape (n, 3, 3)
        Body-from-base matrices.
    gravity_axis : str
        'x', 'y' or 'z' of the base.
    tilt_rad : pair
        Levelling error: components of the unit gravity vector along the next two base axes.

    """
    return mat_bn @ tilted_gravity(gravity_axis, tilt_rad)


def series_3(rate_deg_s: float | None = None) -> np.ndarray:
    """Return the rates of sample 3, deg/s, shape (n, 3): w, w^(1/2), w^(1/3) for w = 0, 10 ... 100 (11 runs, the paper says 10)."""
    rate = np.arange(0.0, 101.0, 10.0) if rate_deg_s is None else np.asarray(rate_deg_s, float)
    return np.column_stack([rate, np.sqrt(rate), np.cbrt(rate)])


def series_4(rate_deg_s: float | None = None) -> np.ndarray:
    """Return the rates of sample 4, deg/s, shape (n, 3): w, exp(-w), w^2 for w = 0, 1 ... 10."""
    rate = np.arange(0.0, 11.0) if rate_deg_s is None else np.asarray(rate_deg_s, float)
    return np.column_stack([rate, np.exp(-rate), rate**2])


def factorial_rates(rate_deg_s: float = 10.0, n_static: int = 3) -> np.ndarray:
    """Return all eight sign combinations of one rate on each axis and `n_static` runs at rest, deg/s: the orthogonal design."""
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    return np.vstack([rate_deg_s * corners, np.zeros((n_static, 3))])


def add_earth_rate(rate_deg_s: np.ndarray, along_spin_axis_deg_s: float,
                   axis_at_rest: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> np.ndarray:
    """Return body rates that include Earth rate's component along the spin axis; the rest averages out over full turns."""
    size = np.linalg.norm(rate_deg_s, axis=1, keepdims=True)
    axis = np.where(size > 0, rate_deg_s / np.where(size > 0, size, 1.0), axis_at_rest)
    return rate_deg_s + along_spin_axis_deg_s * axis


def design_matrix(inputs: np.ndarray, model: str = 'linear') -> np.ndarray:
    """Return G (eq. 2, 5) or omega (eq. 8, 11), shape (n, n_params), columns as in `COLUMNS`."""
    if model not in COLUMNS:
        raise InputError(f"model must be one of {', '.join(COLUMNS)}, got '{model}'; choose one of them", code='model_unknown')
    x, y, z = np.asarray(inputs, float).T
    known = {'bias': np.ones_like(x), 'x': x, 'y': y, 'z': z, 'xy': x * y, 'yz': y * z, 'xz': x * z, 'xx': x * x, 'yy': y * y, 'zz': z * z}
    return np.column_stack([known[name] for name in COLUMNS[model]])


def calibrate(inputs: np.ndarray, outputs: np.ndarray, model: str = 'linear', *, weights: np.ndarray | None = None) -> LinearSolution:
    """
    Estimate bias, matrix and products of three sensors (eq. 3, 6, 9, 12), by orthogonal factors instead of normal equations.

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
    return solve_linear(design_matrix(inputs, model), outputs, COLUMNS[model], weights=weights)


def calibrate_as_printed(inputs: np.ndarray, outputs: np.ndarray, model: str = 'linear') -> np.ndarray:
    """Return X by the printed normal equations ``inv(G'G) G'U``, to show what they lose."""
    design = design_matrix(inputs, model)
    return np.linalg.inv(design.T @ design) @ design.T @ outputs


def calibrate_separate_sets(static: tuple[np.ndarray, np.ndarray], spinning: tuple[np.ndarray, np.ndarray],
                            accelerometer_model: str = 'linear', *,
                            gyroscope_model: str = 'linear') -> tuple[LinearSolution, LinearSolution]:
    """
    Calibrate the two sets apart, as the paper does: accelerometers from positions at rest, gyroscopes from constant-rate runs.

    Parameters
    ----------
    static : tuple of arrays (n, 3)
        Reference specific force and mean accelerometer outputs per position.
    spinning : tuple of arrays (m, 3)
        Reference rate (with Earth rate when it is known) and mean gyroscope outputs per run.

    Returns
    -------
    tuple of LinearSolution
        Accelerometers, gyroscopes.

    """
    return calibrate(*static, accelerometer_model), calibrate(*spinning, gyroscope_model)


def _axis_turn(axis, angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    matrix = np.zeros(np.shape(angle) + (3, 3))
    following, last = (axis + 1) % 3, (axis + 2) % 3
    matrix[..., axis, axis] = 1.0
    matrix[..., following, following] = matrix[..., last, last] = cosine
    matrix[..., following, last], matrix[..., last, following] = sine, -sine
    return matrix


def _base_axes(gravity_axis):
    index = 'xyz'.index(gravity_axis)
    return np.roll(np.eye(3), -index, axis=0)


def tilted_gravity(gravity_axis: str, tilt_rad: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the unit gravity reaction in the base frame, shape (3,); `tilt_rad` are its components along the next two axes."""
    up, first, second = _base_axes(gravity_axis)
    return np.sqrt(1 - np.dot(tilt_rad, tilt_rad)) * up + tilt_rad[0] * first + tilt_rad[1] * second
