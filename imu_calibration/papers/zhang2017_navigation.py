"""Zhang's navigation claims as simulations: at rest with drift between runs, in constant spins, and while tumbling."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.constants import STANDARD_GRAVITY
from imu_calibration.kinematics import strapdown
from imu_calibration.kinematics.reference_motion import lever_matrix
from imu_calibration.papers.zhang2017 import StaticModel, fit_static, six_positions, static_model_from_matrix


@dataclass(frozen=True, eq=False)
class StaticNavigation:
    """Sizes of the 3D errors after navigating at rest, one entry per draw."""

    velocity_before: np.ndarray
    """m/s, installation angles ignored, shape (n_draws,)."""
    position_before: np.ndarray
    """m, shape (n_draws,)."""
    velocity_after: np.ndarray
    """m/s, after six-position calibration, shape (n_draws,)."""
    position_after: np.ndarray
    """m, shape (n_draws,)."""

    def medians(self) -> tuple[float, ...]:
        """Return medians: velocity before, position before, velocity after, position after."""
        return tuple(float(np.median(values)) for values in
                     (self.velocity_before, self.position_before, self.velocity_after, self.position_after))


def static_navigation(model: StaticModel, drift_sd_g: float, rng: np.random.Generator, *, n_draws: int = 400, seconds: float = 50.0,
                      noise_sd_g: float = 1e-3, sample_rate: float = 100.0, calibration_seconds: float = 60.0) -> StaticNavigation:
    """
    Calibrate in six positions, then navigate at rest with x up, attitude known.

    Parameters
    ----------
    model : StaticModel
        True sensor, V/g.
    drift_sd_g : float
        Bias drawn anew for every run (six positions and the navigation), g.
    rng : numpy.random.Generator
    n_draws : int
    seconds, noise_sd_g, sample_rate, calibration_seconds : float
        Navigation time, white noise per sample, samples per second, time per position.

    """
    true = static_model_from_matrix(model.matrix, model.bias)
    mean_sd = np.hypot(noise_sd_g / np.sqrt(sample_rate * calibration_seconds), drift_sd_g)
    noise = rng.normal(scale=mean_sd, size=(n_draws, 6, 3))
    readings = true.predict(six_positions()) + noise * true.scale
    _, solution = fit_static(six_positions(), np.moveaxis(readings, 0, 1).reshape(6, -1))
    fitted = solution.values.reshape(4, n_draws, 3)
    matrix, bias = np.moveaxis(fitted[1:], 0, -1), fitted[0]

    upright, drift = np.array([1.0, 0, 0]), rng.normal(scale=drift_sd_g, size=(n_draws, 3))
    steady = true.predict(upright) + drift * true.scale
    unscaled = np.broadcast_to(np.diag(model.scale), matrix.shape)
    ends = []
    wander = np.array([_noise_at_end(rng, noise_sd_g * true.scale, seconds, sample_rate) for _ in range(n_draws)])
    for used_matrix, used_bias in ((unscaled, model.bias), (matrix, bias)):
        error = np.linalg.solve(used_matrix, (steady - used_bias)[..., None])[..., 0] - upright
        constant = np.stack(strapdown.constant_error_growth(STANDARD_GRAVITY * error, seconds))
        scatter = np.linalg.solve(used_matrix[:, None], wander[..., None])[..., 0]
        ends.append(np.linalg.norm(constant + STANDARD_GRAVITY * np.moveaxis(scatter, 1, 0), axis=-1))
    return StaticNavigation(*ends[0], *ends[1])


def _noise_at_end(rng, noise_sd, seconds, sample_rate):
    """Return white output noise summed once and twice over the time, shape (2, 3)."""
    time = np.arange(int(round(seconds * sample_rate)) + 1) / sample_rate
    velocity, position = strapdown.error_growth(time, noise_sd * rng.standard_normal((len(time), 3)))
    return velocity[-1], position[-1]


def size_effect_error(cosines: np.ndarray, arms: np.ndarray, rate: np.ndarray, *, alpha: np.ndarray) -> np.ndarray:
    """Return the error in the body frame, m/s^2, shape (n, 3), of accelerometers that are taken to sit in one point (eq. 17)."""
    along_axes = np.einsum('ij,njk,ik->ni', cosines, lever_matrix(rate, alpha), arms)
    return np.linalg.solve(cosines, along_axes.T).T


def spin_growth(cosines: np.ndarray, arms: np.ndarray, axis: tuple[float, float, float], *, rate_deg_s: float = 100.0,
                seconds: float = 100.0, sample_rate: float = 100.0) -> dict[str, Any]:
    """
    Return errors of an uncompensated size effect in a constant spin: (velocity, position) in n, the same summed in the body frame.

    The result is a dict with 'time', 'level' and 'body' (each a pair of (n, 3) arrays) and 'axial_mg', the steady part along the axis.

    """
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    time = np.arange(int(round(seconds * sample_rate)) + 1) / sample_rate
    rate = np.tile(np.deg2rad(rate_deg_s) * axis, (len(time), 1))
    error = size_effect_error(cosines, arms, rate, alpha=np.zeros_like(rate))
    mat_ns = Rotation.from_rotvec(rate * time[:, None]).as_matrix()
    return {'time': time, 'level': strapdown.error_growth(time, error, mat_ns), 'body': strapdown.error_growth(time, error),
            'axial_mg': 1e3 * float(error[0] @ axis) / STANDARD_GRAVITY}


@dataclass(frozen=True, eq=False)
class Tumbling:
    """Sinusoidal body rates about three axes: amplitude * 2 pi f * cos(2 pi f t + phase), attitude integrated from them."""

    time: np.ndarray
    """s, shape (n,)."""
    mat_ns: np.ndarray
    """Attitude, shape (n, 3, 3)."""
    rate: np.ndarray
    """rad/s, shape (n, 3)."""
    alpha: np.ndarray
    """rad/s^2, shape (n, 3)."""


def tumble(amplitude_deg: tuple[float, float, float], frequency_hz: tuple[float, float, float],
           phase: tuple[float, float, float] = (0.3, 1.1, 2.0), *, seconds: float = 60.0, sample_rate: float = 200.0) -> Tumbling:
    """Return a `Tumbling` motion; each argument has one value per body axis, or one for all."""
    time = np.arange(int(round(seconds * sample_rate)) + 1) / sample_rate
    angular = 2 * np.pi * np.asarray(frequency_hz, float)
    angle = np.multiply.outer(time, angular) + np.asarray(phase)
    size = np.deg2rad(amplitude_deg) * angular
    rate, alpha = size * np.cos(angle), -size * angular * np.sin(angle)
    return Tumbling(time, strapdown.integrate_attitude(time, rate), rate, alpha)


def arm_responses(motion: Tumbling, cosines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return velocity and position histories per metre of each arm component (sensor, component), shape (9, n, 3) each."""
    unit_arms = np.eye(9).reshape(9, 3, 3)
    errors = np.array([size_effect_error(cosines, arms, motion.rate, alpha=motion.alpha) for arms in unit_arms])
    return strapdown.error_growth(motion.time, errors, motion.mat_ns)


def peaks(responses: tuple[np.ndarray, np.ndarray], arms: np.ndarray, every: int = 5) -> np.ndarray:
    """Return the largest velocity and position error for arm errors of shape (n_draws, 3, 3), shape (2, n_draws)."""
    flat = np.asarray(arms, float).reshape(-1, 9)
    out = []
    for response in responses:
        thinned = response[:, ::every]
        histories = (flat @ thinned.reshape(9, -1)).reshape(len(flat), -1, 3)
        out.append(strapdown.largest(histories))
    return np.array(out)
