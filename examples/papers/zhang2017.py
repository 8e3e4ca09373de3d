"""Zhang 2017 as printed: designs, results, and navigation claims as simulations."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.kinematics import strapdown
from imu_calibration.kinematics.rotations import lever_matrix
from papers.linear_least_squares import LinearSolution, solve_linear

TABLE_1_ANGLES_DEG = np.array(
    [[0.75997, 90.71425, 89.74038], [89.25516, 0.74486, 90.5630], [90.52202, 89.17706, 0.97456]]
)
"""Installation angles as printed, row i: sensor axis i to body x, y, z."""
TABLE_1_SCALE = np.array([0.39496, 0.39808, 0.40024])
"""Scale factors as printed, V/g."""
TABLE_1_BIAS = np.array([2.405098, 2.380978, 2.435503])
"""Zero-bias voltages as printed, V."""
TABLE_2_G = np.array(
    [
        [1.00043, 1.00041, -0.99956, -0.99958],
        [0.01299, 0.00098, -0.01100, 0.00098],
        [-0.00911, 0.00023, 0.00953, 0.00020],
    ]
)
"""
Readings at rest as printed, g, rows x, y, z; columns: x up before and after compensation, x down
before and after.
"""
TABLE_3_ARMS = -np.array(
    [[-0.00834, -0.00042, -0.00132], [-0.00256, -0.00893, -0.00026], [-0.00060, -0.00050, -0.00824]]
)
"""Lever arms, m, row i: reference point to sensor i (the printed numbers times -1)."""
TABLE_4_G = np.array(
    [
        [0.998078, 0.998060, -1.001924, -1.001939],
        [0.000289, 0.000253, -0.003359, 0.000253],
        [-0.014150, 0.002402, 0.0093985, 0.002402],
    ]
)
"""Readings in rotation as printed, g, laid out as `TABLE_2_G`."""


@dataclass(frozen=True, eq=False)
class StaticModel:
    """``outputs = scale * (cosines @ force) + bias`` (eq. 5)."""

    scale: np.ndarray
    """Output per unit force of each sensor, shape (3,)."""
    cosines: np.ndarray
    """Direction cosines, one sensor per row, shape (3, 3)."""
    bias: np.ndarray
    """Outputs at zero force, shape (3,)."""

    @property
    def matrix(self) -> np.ndarray:
        """K C' (eq. 7), shape (3, 3)."""
        return self.scale[:, None] * self.cosines

    @property
    def angles_deg(self) -> np.ndarray:
        """Installation angles in degrees, shape (3, 3)."""
        return np.rad2deg(np.arccos(np.clip(self.cosines, -1, 1)))

    def predict(self, force_b: np.ndarray) -> np.ndarray:
        """Return the outputs for specific forces in the body frame, shape (n, 3)."""
        return np.asarray(force_b) @ self.matrix.T + self.bias

    def invert(self, outputs: np.ndarray) -> np.ndarray:
        """Return specific forces in the body frame (eq. 6) by the true inverse, shape (n, 3)."""
        return np.linalg.solve(self.matrix, (np.asarray(outputs) - self.bias).T).T

    def invert_as_printed(self, outputs: np.ndarray) -> np.ndarray:
        """
        Return specific forces with the transpose taken for the inverse of the cosines.

        As eq. 3 and 4 claim.
        """
        return (np.asarray(outputs) - self.bias) / self.scale @ self.cosines


def printed_static_model() -> StaticModel:
    """Return Table 1 as printed; its second row is no unit vector."""
    return StaticModel(TABLE_1_SCALE, np.cos(np.deg2rad(TABLE_1_ANGLES_DEG)), TABLE_1_BIAS)


def static_model_from_matrix(matrix: np.ndarray, bias: np.ndarray) -> StaticModel:
    """Split a sensor matrix into scale factors and unit rows of direction cosines."""
    scale = np.linalg.norm(matrix, axis=1)
    return StaticModel(scale, matrix / scale[:, None], np.asarray(bias, float))


def six_positions() -> np.ndarray:
    """Return the specific forces of the six faces, shape (6, 3): x, y, z up, then x, y, z down."""
    return np.vstack([np.eye(3), -np.eye(3)])


def fit_static(force_b: np.ndarray, outputs: np.ndarray) -> tuple[StaticModel, LinearSolution]:
    """
    Estimate scale factors, nine installation angles and zero biases.

    The estimates are from means at rest (section 3.1, step 4).

    Parameters
    ----------
    force_b : array, shape (n, 3)
        Reference specific force in the body frame.
    outputs : array, shape (n, 3)
        Mean outputs; volts, or m/s^2 for a sensor that comes with a nominal scale.

    Returns
    -------
    StaticModel, LinearSolution
        The solution's rows are 'bias', 'x', 'y', 'z', its columns the sensors.

    """
    design = np.column_stack([np.ones(len(force_b)), force_b])
    solution = solve_linear(design, outputs, ('bias', 'x', 'y', 'z'))
    return static_model_from_matrix(solution.values[1:].T, solution.values[0]), solution


def closed_form(
    means_static: np.ndarray,
    means_spin: np.ndarray,
    rate: float,
    *,
    directions: np.ndarray,
    spin_axes: np.ndarray | None = None,
    as_printed: bool = False,
) -> np.ndarray | None:
    """
    Return the lever arms by eq. 24 from three spins about orthonormal axes that point up.

    Shape (..., 3, 3), one sensor per row.

    ``r_ik = (d_ik - d_il - d_im) / (2 rate^2 cos(axis_i, spin axis k))`` with ``d = spin mean -
    static mean`` of sensor i; the sensors' biases drop out.

    Parameters
    ----------
    means_static, means_spin : arrays, shape (..., 3, 3)
        Means of sensor i (column) at rest and spinning about axis k (row), m/s^2.
    rate : float
        Spin rate, rad/s.
    directions : array, shape (3, 3)
        Direction cosines, row i; a full sensor matrix does as well when the means are raw.
    spin_axes : array, shape (3, 3), optional
        Spin axes in the body frame, one per row; the body axes if not given. The arms are in the
        body frame.
    as_printed : bool
        Use the printed fourth term of r_jx (spin instead of static reading), to show its effect.

    Raises
    ------
    NotObservableError
        When a sensor axis is square to a spin axis.

    """
    axes = np.eye(3) if spin_axes is None else np.asarray(spin_axes, float)
    if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-6):
        raise InputError(
            'the three spin axes must be orthonormal for the closed form, got others; use the'
            ' joint fit',
            code='not_orthonormal',
        )
    cosines = np.asarray(directions, float) @ axes.T
    if np.any(np.abs(cosines) < 1e-12):
        sensor, spin = np.argwhere(np.abs(cosines) < 1e-12)[0]
        raise NotObservableError(
            f'sensor axis {"xyz"[sensor]} must not be square to spin axis {spin + 1} for the closed'
            ' form; skew the fixture, add oscillations, or use the joint fit',
            code='square_axes',
        )
    means_static, means_spin = np.asarray(means_static, float), np.asarray(means_spin, float)
    change = np.swapaxes(means_spin - means_static, -1, -2)
    numerator = 2 * change - np.sum(change, axis=-1, keepdims=True)
    if as_printed:
        numerator[..., 0] -= change[..., 0]
    return numerator / (2 * rate**2 * cosines) @ axes


def closed_form_sd(
    noise_sd: float, rate: float, directions: np.ndarray, *, spin_axes: np.ndarray | None = None
) -> np.ndarray:
    """
    Return the sd of each arm along the spin axes, ``sqrt(6) noise_sd / (2 rate^2 |cos|)``.

    Shape (3, 3), one sensor per row.
    """
    axes = np.eye(3) if spin_axes is None else np.asarray(spin_axes, float)
    return np.sqrt(6) * noise_sd / (2 * rate**2 * np.abs(np.asarray(directions, float) @ axes.T))


def average_rates(arms: np.ndarray, rates: np.ndarray, weighted: bool = True) -> np.ndarray:
    """
    Average closed-form arms of several spin rates, shape (n_rates, 3, 3).

    With weights rate^4 (their inverse variances) or plainly.
    """
    rates = np.asarray(rates, float)
    return np.average(arms, axis=0, weights=rates**4 if weighted else None)


def static_navigation(
    model: StaticModel,
    drift_sd_g: float,
    rng: np.random.Generator,
    *,
    n_draws: int = 400,
) -> np.ndarray:
    """
    Return errors of navigation at rest with x up, attitude known.

    Medians of velocity (m/s) and position (m), before and after calibration.

    Before, the installation angles are ignored; after, the six-position calibration is used. Shape
    (4,).

    Parameters
    ----------
    model : StaticModel
        True sensor, V/g.
    drift_sd_g : float
        Sd of the bias, which is drawn for every run (six positions and the navigation), g.
    rng : numpy.random.Generator
    n_draws : int

    """
    seconds = 50.0  # of navigation
    position_seconds = 60.0  # in each of the six positions
    sample_rate = 100.0  # Hz
    noise_sd_g = 1e-3  # white noise of a sample, g
    true = static_model_from_matrix(model.matrix, model.bias)
    mean_sd = np.hypot(noise_sd_g / np.sqrt(sample_rate * position_seconds), drift_sd_g)
    noise = rng.normal(scale=mean_sd, size=(n_draws, 6, 3))
    readings = true.predict(six_positions()) + noise * true.scale
    _, solution = fit_static(six_positions(), np.moveaxis(readings, 0, 1).reshape(6, -1))
    fitted = solution.values.reshape(4, n_draws, 3)
    matrix, bias = np.moveaxis(fitted[1:], 0, -1), fitted[0]

    upright, drift = np.array([1.0, 0, 0]), rng.normal(scale=drift_sd_g, size=(n_draws, 3))
    steady = true.predict(upright) + drift * true.scale
    unscaled = np.broadcast_to(np.diag(model.scale), matrix.shape)
    ends = []
    wander = np.array(
        [_noise_at_end(rng, noise_sd_g * true.scale, seconds, sample_rate) for _ in range(n_draws)]
    )
    for used_matrix, used_bias in ((unscaled, model.bias), (matrix, bias)):
        error = np.linalg.solve(used_matrix, (steady - used_bias)[..., None])[..., 0] - upright
        constant = np.stack(constant_error_growth(STANDARD_GRAVITY * error, seconds))
        scatter = np.linalg.solve(used_matrix[:, None], wander[..., None])[..., 0]
        ends.append(
            np.linalg.norm(constant + STANDARD_GRAVITY * np.moveaxis(scatter, 1, 0), axis=-1)
        )
    return np.median(np.concatenate(ends), axis=1)


def _noise_at_end(rng, noise_sd, seconds, sample_rate):
    """Return white output noise summed once and twice over the time, shape (2, 3)."""
    time = np.arange(int(round(seconds * sample_rate)) + 1) / sample_rate
    velocity, position = error_growth(time, noise_sd * rng.standard_normal((len(time), 3)))
    return velocity[-1], position[-1]


def error_growth(
    time: np.ndarray, force_error_s: np.ndarray, mat_ns: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the errors of velocity and position due to an error of specific force, each (n, 3).

    In m/s and m, with a correct attitude. With ``mat_ns=None`` the components are summed in the
    turning body frame, which is no navigation: an error that turns with the body then appears as a
    steady drift (the explanation of Zhang's "3 m/s and 150 m").

    """
    force_error = np.asarray(force_error_s, float)
    if mat_ns is not None:
        force_error = np.einsum('nij,...nj->...ni', mat_ns, force_error)
    return strapdown.dead_reckon(time, force_error, 0.0)


def constant_error_growth(
    force_error: np.ndarray | float, seconds: float
) -> tuple[np.ndarray | float, np.ndarray | float]:
    """
    Return the velocity and position error, m/s and m, of a constant acceleration error.

    The error, m/s^2, is along one axis of a body that does not turn.
    """
    return force_error * seconds, force_error * seconds**2 / 2


def largest(vectors: np.ndarray) -> np.ndarray | float:
    """Return the largest norm of vectors along the time axis, shape (..., n, 3) to (...)."""
    return np.max(np.linalg.norm(vectors, axis=-1), axis=-1)


def size_effect_error(
    cosines: np.ndarray, arms: np.ndarray, rate: np.ndarray, *, alpha: np.ndarray
) -> np.ndarray:
    """
    Return the error in the body frame, m/s^2.

    Shape (n, 3), of accelerometers that are taken to sit in one point (eq. 17).
    """
    along_axes = np.einsum('ij,njk,ik->ni', cosines, lever_matrix(rate, alpha), arms)
    return np.linalg.solve(cosines, along_axes.T).T


def spin_growth(
    cosines: np.ndarray,
    arms: np.ndarray,
    axis: tuple[float, float, float],
    *,
    seconds: float = 100.0,
) -> dict[str, Any]:
    """
    Return errors of an uncompensated size effect in a constant spin of 100 deg/s.

    (velocity, position) in n, the same summed in the body frame.

    The result is a dict with 'time', 'level' and 'body' (each a pair of (n, 3) arrays) and
    'axial_mg', the steady part along the axis.

    """
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    time = np.arange(int(round(seconds * 100.0)) + 1) / 100.0
    rate = np.tile(np.deg2rad(100.0) * axis, (len(time), 1))
    error = size_effect_error(cosines, arms, rate, alpha=np.zeros_like(rate))
    mat_ns = Rotation.from_rotvec(rate * time[:, None]).as_matrix()
    return {
        'time': time,
        'level': error_growth(time, error, mat_ns),
        'body': error_growth(time, error),
        'axial_mg': 1e3 * float(error[0] @ axis) / STANDARD_GRAVITY,
    }


@dataclass(frozen=True, eq=False)
class Tumbling:
    """
    Sinusoidal body rates about three axes.

    Amplitude * 2 pi f * cos(2 pi f t + phase), attitude integrated from them.
    """

    time: np.ndarray
    """s, shape (n,)."""
    mat_ns: np.ndarray
    """Attitude, shape (n, 3, 3)."""
    rate: np.ndarray
    """rad/s, shape (n, 3)."""
    alpha: np.ndarray
    """rad/s^2, shape (n, 3)."""


def tumble(
    amplitude_deg: tuple[float, float, float],
    frequency_hz: tuple[float, float, float],
    *,
    seconds: float = 60.0,
    sample_rate: float = 200.0,
) -> Tumbling:
    """Return a `Tumbling` motion; each argument has one value per body axis, or one for all."""
    time = np.arange(int(round(seconds * sample_rate)) + 1) / sample_rate
    angular = 2 * np.pi * np.asarray(frequency_hz, float)
    angle = np.multiply.outer(time, angular) + np.array([0.3, 1.1, 2.0])
    size = np.deg2rad(amplitude_deg) * angular
    rate, alpha = size * np.cos(angle), -size * angular * np.sin(angle)
    return Tumbling(time, strapdown.integrate_attitude(time, rate), rate, alpha)


def arm_responses(motion: Tumbling, cosines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return velocity and position histories per metre of each arm component (sensor, component).

    Shape (9, n, 3) each.
    """
    unit_arms = np.eye(9).reshape(9, 3, 3)
    errors = np.array(
        [size_effect_error(cosines, arms, motion.rate, alpha=motion.alpha) for arms in unit_arms]
    )
    return error_growth(motion.time, errors, motion.mat_ns)


def peaks(responses: tuple[np.ndarray, np.ndarray], arms: np.ndarray) -> np.ndarray:
    """
    Return the largest velocity and position error for arm errors of shape (n_draws, 3, 3).

    At every fifth time, shape (2, n_draws).
    """
    flat = np.asarray(arms, float).reshape(-1, 9)
    out = []
    for response in responses:
        thinned = response[:, ::5]
        histories = (flat @ thinned.reshape(9, -1)).reshape(len(flat), -1, 3)
        out.append(largest(histories))
    return np.array(out)
