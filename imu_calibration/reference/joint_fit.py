"""Least squares of the joints' curve: positions, accepted velocities, and the trend removed before."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import vstack

from imu_calibration.reference.quintic_spline import Knots, design_matrix, design_values, evaluate_pieces, normal_bands, piece_coefficients
from imu_calibration.reference.smoothing import PenalisedSpline, Smooth, smooth
from imu_calibration.settings import setting


class JointRows:
    """Rows of the design at the stamps, for positions and velocities."""

    def __init__(self, knots: Knots, time: np.ndarray):
        self.knots, self.time = knots, time
        self._position = self._make(0)

    def _make(self, derivative, weight=None):
        interval, values = design_values(self.knots, self.time, derivative)
        if weight is not None:
            values = values * weight
        return design_matrix(self.knots, interval, values), normal_bands(self.knots, interval, values)

    def positions(self) -> PenalisedSpline:
        """Return the least squares of positions only."""
        return PenalisedSpline(*self._position)

    def both(self, weight: np.ndarray) -> PenalisedSpline:
        """Return the least squares of positions, and below them velocities times `weight`."""
        design, bands = self._make(1, weight)
        return PenalisedSpline(vstack([self._position[0], design], format='csr'), self._position[1] + bands, n_kinds=2)


def fit_with_velocity(rows: JointRows, fit: Smooth, position: np.ndarray, *, velocity: np.ndarray, trend: 'Trend',
                      settings: 'JointSettings') -> tuple[bool, Smooth]:
    """Return whether the velocities agree with the fit to the positions, and a fit to both when it is better for them."""
    pieces = piece_coefficients(fit.coefficients[:, None])
    trend.add_to(pieces, rows.knots)
    _, rate, acceleration = evaluate_pieces(rows.knots, pieces, rows.time, derivatives=2)[:, :, 0]
    trusted, velocity_sd = check_velocity(velocity, rate, acceleration, dof=fit.dof, settings=settings)
    # Information of velocities at the edge of the band, relative to positions.
    if not trusted or fit.noise_sd * fit.bandwidth / rows.knots.step < 0.3 * velocity_sd:
        return trusted, fit
    weight = np.where(np.isfinite(velocity), fit.noise_sd / velocity_sd, 0.0)
    rest = position - trend.at(rows.time)[:, 0], weight * (np.nan_to_num(velocity) - trend.at(rows.time, 1)[:, 0])
    better, = smooth(rows.both(weight), np.concatenate(rest)[:, None], [fit.noise_sd], robustness=settings.robustness)
    return trusted, better


@dataclass(frozen=True, eq=False)
class Trend:
    """Parabolas, which the penalty does not constrain; removed first to reduce rounding."""

    centre: float
    """Origin of their time, s."""
    factors: np.ndarray
    """Coefficients of the powers of time, shape (3, n_joints)."""

    @classmethod
    def through(cls, time: np.ndarray, position: np.ndarray, still: np.ndarray) -> 'Trend':
        """Return the parabolas of least squares (of lower degree for few stamps); constants for joints that are `still`."""
        centre = 0.5 * (time[0] + time[-1])
        degree = min(2, len(np.unique(time)) - 1)
        scale = max(time[-1] - centre, 1e-9) ** np.arange(degree + 1)
        powers = np.vander(time - centre, degree + 1, increasing=True) / scale
        factors = np.zeros((3, position.shape[1]))
        factors[:degree + 1] = np.linalg.solve(powers.T @ powers, powers.T @ position) / scale[:, None]
        factors[:, still] = np.array([[1.0], [0.0], [0.0]]) * position[0, still]
        return cls(centre, factors)

    def column(self, joint: int) -> 'Trend':
        """Return the parabola of one joint."""
        return Trend(self.centre, self.factors[:, joint:joint + 1])

    def at(self, time: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Return values or rates, shape (n, n_joints)."""
        time = (time - self.centre)[:, None]
        if derivative:
            return self.factors[1] + 2 * time * self.factors[2]
        return self.factors[0] + time * (self.factors[1] + time * self.factors[2])

    def add_to(self, pieces: np.ndarray, knots: Knots) -> None:
        """Add the parabolas to the polynomials between the knots, in place."""
        starts = knots.start + knots.step * np.arange(knots.n_intervals)
        pieces[0] += self.at(starts)
        pieces[1] += knots.step * self.at(starts, 1)
        pieces[2] += knots.step ** 2 * self.factors[2]


@dataclass(frozen=True)
class JointSettings:
    """How the joints' motion is drawn from their readings."""

    robustness: float = setting(0.7, '1', 'guard against rough fits when the smoothing is chosen; 1 is plain cross-validation', (0.05, 1.0),
                                'too large: rough accelerations now and then; too small: sharp ramps are rounded')
    velocity_scale: float = setting(2e-3, '1', 'joint velocities are used when their scale agrees with the positions to this', (0.0, 0.1),
                                    'too large: filtered velocities distort the reference')
    velocity_lag: float = setting(2e-4, 's', 'joint velocities are used if their lag behind the positions is below this', (0.0, 0.1),
                                  'too large: late velocities imitate a time offset of the IMU')


def check_velocity(velocity: np.ndarray, rate: np.ndarray, acceleration: np.ndarray, *, dof: float,
                   settings: JointSettings) -> tuple[bool, float]:
    """
    Compare a joint's velocities with the derivative of its positions, ``velocity = offset + scale rate - lag acceleration + noise``.

    Parameters
    ----------
    velocity : array, shape (n,)
        Velocities of the joint states, rad/s; NaN where there is none.
    rate, acceleration : array, shape (n,)
        Derivatives of the smooth curve through the positions at the same stamps.
    dof : float
        Effective number of parameters of that curve: so many of its values are independent.
    settings : JointSettings
        Largest disagreement, which must be excluded by two standard errors.

    Returns
    -------
    trusted : bool
        Whether scale, lag and offset agree; false if the motion is too weak for the test.
    noise_sd : float
        Scatter of the velocities, rad/s, that of the curve included.

    """
    good = np.isfinite(velocity)
    if good.mean() < 0.9 or not np.any(velocity[good]):
        return False, np.inf
    columns = np.stack([np.ones(good.sum()), rate[good], -acceleration[good]], axis=1)
    size = np.sqrt(np.mean(columns ** 2, axis=0))
    if size.min() < 1e-12:
        return False, np.inf
    normal = np.linalg.pinv((columns / size).T @ (columns / size))
    estimate = normal @ ((columns / size).T @ velocity[good]) / size
    noise_sd = np.sqrt(np.mean((velocity[good] - columns @ estimate) ** 2))
    error = noise_sd * np.sqrt(np.diag(normal) * good.sum() / max(dof, 4.0)) / size
    limit = np.array([settings.velocity_scale * size[1], settings.velocity_scale, settings.velocity_lag])
    return bool(np.all(np.abs(estimate - [0.0, 1.0, 0.0]) + 2 * error < limit)), float(noise_sd)
