"""
Strapdown dead reckoning near one place: effect of calibration errors after some seconds of navigation.

Attitude, velocity and position in the level frame ``n``; the table is at rest, so Coriolis terms and the change of gravity with
position are left out: over 50 s they are below 1e-3 of the errors that are compared. All sums over samples are array operations.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.reference_motion import Reference


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Navigation states at the samples."""

    time: np.ndarray
    """Seconds, shape (n,)."""
    mat_ns: np.ndarray
    """Attitude, sensor frame to level frame, shape (n, 3, 3)."""
    velocity_n: np.ndarray
    """m/s, shape (n, 3), zero at the start."""
    position_n: np.ndarray
    """m, shape (n, 3), zero at the start."""


@dataclass(frozen=True, eq=False)
class Drift:
    """Dead-reckoning errors at the end of each stretch of a recording."""

    start: np.ndarray
    """Start of each stretch, s, shape (k,)."""
    seconds: float
    """Length of a stretch, s."""
    velocity: np.ndarray
    """Size of the velocity error at the end, m/s, shape (k,)."""
    position: np.ndarray
    """Size of the position error at the end, m, shape (k,)."""
    attitude: np.ndarray
    """Angle of the attitude error at the end, rad, shape (k,)."""

    def median(self) -> tuple[float, float, float]:
        """Return the medians over the stretches: velocity (m/s), position (m), attitude (rad)."""
        return float(np.median(self.velocity)), float(np.median(self.position)), float(np.median(self.attitude))


def integrate_attitude(time: np.ndarray, rate_s: np.ndarray, mat_ns0: np.ndarray | None = None, *,
                       earth_rate_n: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """
    Integrate the rate against inertial space into the attitude against the level frame, shape (n, 3, 3).

    Each step turns by the mean of two neighbouring rates times the step, with the two-sample coning term ``rate_k x rate_(k+1) dt^2/12``.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds.
    rate_s : array, shape (n, 3)
        Rate against inertial space, rad/s, sensor frame.
    mat_ns0 : array, shape (3, 3), optional
        Attitude at the first sample, identity if not given.
    earth_rate_n : array, shape (3,)
        Turn of the level frame against inertial space, rad/s.

    """
    time, rate_s = _checked(time, rate_s)
    step = np.diff(time)[:, None]
    turns = 0.5 * (rate_s[1:] + rate_s[:-1]) * step + np.cross(rate_s[:-1], rate_s[1:]) * step**2 / 12
    start = np.eye(3) if mat_ns0 is None else np.asarray(mat_ns0, float)
    mat_is = _running_product(np.concatenate([start[None], Rotation.from_rotvec(turns).as_matrix()]))
    if not np.any(earth_rate_n):
        return mat_is
    return Rotation.from_rotvec(-np.multiply.outer(time - time[0], np.asarray(earth_rate_n, float))).as_matrix() @ mat_is


def dead_reckon(time: np.ndarray, force_n: np.ndarray, gravity: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Integrate specific force in the level frame (z up) twice by the trapezoid rule.

    Returns
    -------
    velocity_n, position_n : arrays, shape (n, 3)
        m/s and m, zero at the start; extra leading axes of `force_n` are kept.

    """
    acceleration = np.asarray(force_n, float) - np.array([0.0, 0.0, gravity])
    velocity = _running_integral(time, acceleration)
    return velocity, _running_integral(time, velocity)


def strapdown(time: np.ndarray, force_s: np.ndarray, rate_s: np.ndarray, *, gravity: float, mat_ns0: np.ndarray | None = None,
              earth_rate_n: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Trajectory:
    """
    Navigate by accelerometers and gyroscopes only, from rest at the origin.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds.
    force_s, rate_s : arrays, shape (n, 3)
        Specific force, m/s^2, and rate against inertial space, rad/s, sensor frame.
    gravity : float
        Local gravity, m/s^2.
    mat_ns0, earth_rate_n
        As in `integrate_attitude`.

    Returns
    -------
    Trajectory

    """
    mat_ns = integrate_attitude(time, rate_s, mat_ns0, earth_rate_n=earth_rate_n)
    velocity, position = dead_reckon(time, np.einsum('nij,nj->ni', mat_ns, force_s), gravity)
    return Trajectory(np.asarray(time, float), mat_ns, velocity, position)


def error_growth(time: np.ndarray, force_error_s: np.ndarray, mat_ns: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """
    Return velocity and position errors that a specific-force error causes, attitude being known, each of shape (n, 3).

    With ``mat_ns=None`` the components are summed in the turning body frame, which is no navigation: an error that turns with the body
    then appears as a steady drift (the reading behind Zhang's "3 m/s and 150 m").

    """
    force_error = np.asarray(force_error_s, float)
    if mat_ns is not None:
        force_error = np.einsum('nij,...nj->...ni', mat_ns, force_error)
    return dead_reckon(time, force_error, 0.0)


def constant_error_growth(force_error: np.ndarray | float, seconds: float) -> tuple[np.ndarray | float, np.ndarray | float]:
    """Return the velocity and position error, m/s and m, of a constant error in m/s^2 along one axis of a body that does not turn."""
    return force_error * seconds, force_error * seconds**2 / 2


def largest(vectors: np.ndarray) -> np.ndarray | float:
    """Return the largest norm of vectors along the time axis, shape (..., n, 3) to (...)."""
    return np.max(np.linalg.norm(vectors, axis=-1), axis=-1)


def drift_over(reference: Reference, force_s: np.ndarray, rate_s: np.ndarray, *, seconds: float = 50.0,
               earth_rate_n: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Drift:
    """
    Return the dead-reckoning error of measured or compensated samples over stretches of a recording.

    Each stretch starts at rest from the true attitude. The reference's own samples are integrated by the same rule and subtracted, so
    that only sensor errors remain.

    Parameters
    ----------
    reference : Reference
        True motion at the same stamps.
    force_s, rate_s : arrays, shape (n, 3)
        Samples to judge, m/s^2 and rad/s.
    seconds : float
        Length of a stretch; stretches follow one another without overlap.
    earth_rate_n : array, shape (3,)
        Must match the content of `reference.rate_s`.

    Returns
    -------
    Drift

    Raises
    ------
    InputError
        When the recording is shorter than one stretch.

    """
    edges = np.searchsorted(reference.time, np.arange(reference.time[0], reference.time[-1] + 1e-9, seconds))
    if len(edges) < 2:
        length = reference.time[-1] - reference.time[0]
        raise InputError(f'dead reckoning needs {seconds:g} s in one piece, got {length:.3g} s; request less', code='too_short')
    ends = []
    for first, last in zip(edges[:-1], edges[1:] + 1):
        cut = slice(first, last)
        start = reference.mat_sn[first].T
        measured = strapdown(reference.time[cut], force_s[cut], rate_s[cut], gravity=reference.gravity, mat_ns0=start,
                             earth_rate_n=earth_rate_n)
        true = strapdown(reference.time[cut], reference.force_s[cut], reference.rate_s[cut], gravity=reference.gravity, mat_ns0=start,
                         earth_rate_n=earth_rate_n)
        ends.append((np.linalg.norm(measured.velocity_n[-1] - true.velocity_n[-1]),
                     np.linalg.norm(measured.position_n[-1] - true.position_n[-1]),
                     Rotation.from_matrix(measured.mat_ns[-1] @ true.mat_ns[-1].T).magnitude()))
    velocity, position, attitude = np.array(ends).T
    return Drift(reference.time[edges[:-1]], float(seconds), velocity, position, attitude)


def _checked(time, rate_s):
    time, rate_s = np.asarray(time, float), np.asarray(rate_s, float)
    if rate_s.shape != (len(time), 3) or np.any(np.diff(time) <= 0):
        raise InputError(f'rates must have shape ({len(time)}, 3) at increasing times, got {rate_s.shape}; sort the samples',
                         code='shape_and_times')
    return time, rate_s


def _running_product(matrices):
    """Return M0, M0 M1, M0 M1 M2 ... in log2(n) array products."""
    product = np.array(matrices)
    shift = 1
    while shift < len(product):
        product[shift:] = product[:-shift] @ product[shift:]
        shift *= 2
    return product


def _running_integral(time, values):
    areas = 0.5 * (values[..., 1:, :] + values[..., :-1, :]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros_like(values[..., :1, :]), np.cumsum(areas, axis=-2)], axis=-2)
