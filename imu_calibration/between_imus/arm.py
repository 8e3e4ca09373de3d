"""
Position of one IMU relative to another on the same rigid body.

By a robust fit with Student-t errors and noisy columns.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from imu_calibration.between_imus.pair import (
    PairedImu,
    make_windows,
    relative_rotation,
    require_overlap,
    window_centres,
    window_length,
)
from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.effects.sensor_model import linear_names
from imu_calibration.kinematics.rotations import skew

TAIL_DOF = 3
"""Degrees of freedom of Student's t of the residuals: knocks cause long tails."""
MOTION_SHARE = 0.05
"""
Windows with less lever-arm acceleration than this share of the strongest are left out: the noise
estimate is that of motion.
"""
CLUSTER = 2.0
"""Errors are independent between segments of this length, s."""


@dataclass(frozen=True, eq=False)
class ArmRows:
    """Integrated equations of the windows with information about the arm."""

    centres: np.ndarray
    """Middles of the windows, s, shape (n,)."""
    difference: np.ndarray
    """Mean force of B, in A's axes, less that of A, m/s^2, shape (n, 3)."""
    alpha: np.ndarray
    """Mean angular acceleration, rad/s^2, shape (n, 3)."""
    products: np.ndarray
    """Mean of rate rate', rad^2/s^2, shape (n, 3, 3)."""
    jerk: np.ndarray
    """Mean slope of the angular acceleration, rad/s^3, shape (n, 3)."""
    products_slope: np.ndarray
    """Mean slope of rate rate', shape (n, 3, 3)."""
    force_slope: np.ndarray
    """Mean slope of A's force, m/s^3, shape (n, 3)."""
    force: np.ndarray
    """Mean force of B in A's axes, m/s^2, shape (n, 3)."""
    alpha_noise: float
    """Variance of `alpha` per axis, rad^2/s^4."""
    clipped_share: float
    """Share of the moving windows that were left out."""
    length: float
    """Length of the windows, s."""


def _lever_rows(alpha, products):
    """``[alpha x] + omega omega^T - |omega|^2``, shape (n, 3, 3)."""
    return skew(alpha) + products - np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(3)


@dataclass(frozen=True, eq=False)
class Fit:
    """Robust solution of the rows."""

    values: np.ndarray
    """Arm, difference of biases, delay of B's force, remaining delay of the rates, shape (8,)."""
    design: np.ndarray
    """Columns, shape (n, 3, 8)."""
    residual: np.ndarray
    """Left-hand side minus prediction, m/s^2, shape (n, 3)."""
    weights: np.ndarray
    """Weight of each window, shape (n,)."""
    weight_fall: np.ndarray
    """Derivative of each weight by the square of its residual, negated, shape (n,)."""
    hessian: np.ndarray
    """Derivative of the estimating equations by the values, shape (8, 8)."""
    seen: tuple
    """
    Signal shares of the arm's information without the noise of the columns, with their directions.
    """

    def weighted(self, index: np.ndarray | slice) -> np.ndarray:
        """
        Return design' times the derivative of the weighted residual by the residual.

        For some windows, shape (n, p, 3).
        """
        turned = np.swapaxes(self.design[index], 1, 2)
        residual = self.residual[index]
        along = np.einsum('npi,ni->np', turned, residual) * self.weight_fall[index, None]
        return turned * self.weights[index, None, None] - along[:, :, None] * residual[:, None, :]

    def curvature(self, index: np.ndarray | slice) -> np.ndarray:
        """Return the contribution of some windows to the Hessian, shape (p, p)."""
        rows = np.swapaxes(self.weighted(index), 1, 2).reshape(-1, self.design.shape[2])
        return rows.T @ self.design[index].reshape(rows.shape)


def _fit_arm(rows):
    """
    Solve ``difference = W(alpha, rate) @ arm + bias + delay terms`` with Student-t errors.

    Parameters
    ----------
    rows : ArmRows

    Returns
    -------
    Fit

    Raises
    ------
    NotObservableError
        When the motion is the same in all windows, or about one axis only and free of noise.

    """
    lever = _lever_rows(rows.alpha, rows.products)
    lever_slope = _lever_rows(rows.jerk, rows.products_slope)
    count = len(lever)
    arm = np.zeros(3)
    for number in range(3):  # the delay column needs the arm
        clocks = [-rows.force_slope[:, :, None], (lever_slope @ arm)[:, :, None]]
        design = np.concatenate([lever, np.tile(np.eye(3), (count, 1, 1)), *clocks], axis=2)
        used = design if number else design[:, :, :-1]
        values, weights, weight_fall, excess = _robust_fit(used, rows.difference, rows.alpha_noise)
        arm = values[:3]
    normal = _normal(design, weights, excess)
    raw = _normal(design, weights, 0.0)
    try:
        seen = scipy.linalg.eigh(_reduced(normal), _reduced(raw))
    except np.linalg.LinAlgError as error:
        raise NotObservableError(
            'the motion must show the whole arm, one direction has no signal; '
            'twist fast about all axes'
        ) from error
    partial = Fit(
        values, design, rows.difference - design @ values, weights, weight_fall, normal, seen
    )
    hessian = partial.curvature(slice(None)) + (normal - raw)
    return replace(partial, hessian=hessian)


def _reduced(normal):
    """Return the normal matrix of the arm after elimination of the other parameters."""
    return normal[:3, :3] - normal[:3, 3:] @ np.linalg.solve(normal[3:, 3:], normal[3:, :3])


def _normal(design, weights, excess):
    """
    Weighted normal matrix, corrected for errors in variables.

    The contribution of the noise of the angular acceleration is subtracted (errors in variables).
    """
    flat = (design * np.sqrt(weights)[:, None, None]).reshape(-1, design.shape[2])
    normal = flat.T @ flat
    ridge = 1e-12 * np.maximum(np.diag(normal), 1e-12)
    normal[:3, :3] -= excess * np.eye(3)
    return normal + np.diag(ridge)


def _robust_fit(design, target, alpha_noise):
    """
    Student-t regression by reweighting.

    Returns (values, weights, negated derivative of the weights, excess of the normal matrix).

    The weight decreases with the residual, so the derivative of a weighted residual is smaller than
    its weight: ``weight - weight_fall residual^2``. The noise in the columns biases the values in
    this proportion.
    """
    weights = np.ones(len(design))
    weight_fall = np.zeros(len(design))
    size = np.zeros(len(design))
    flat = design.reshape(-1, design.shape[2])
    values = np.full(design.shape[2], np.inf)
    for _ in range(30):
        excess = 2 * alpha_noise * np.sum(weights - weight_fall * size / 3)
        right = flat.T @ (target * weights[:, None]).ravel()
        before = values
        values = np.linalg.solve(_normal(design, weights, excess), right)
        size = np.sum((target.ravel() - flat @ values).reshape(-1, 3) ** 2, axis=1)
        # The median of chi-square with three degrees of freedom.
        scale = np.median(size) / 2.366 + 1e-300
        weights = (TAIL_DOF + 3) / (TAIL_DOF + size / scale)
        weight_fall = 2 * weights**2 / ((TAIL_DOF + 3) * scale)
        if np.all(np.abs(values - before) <= 1e-9 * np.abs(values)):
            break
    return values, weights, weight_fall, excess


def _jackknife_covariance(fit, centres):
    """
    Delete-one-cluster jackknife over stretches of time.

    Errors within a stretch may have any correlation.
    """
    label = np.unique(np.floor((centres - centres[0]) / CLUSTER).astype(int), return_inverse=True)[
        1
    ]
    shifts = []
    for group in range(label.max() + 1):
        inside = label == group
        score = np.einsum(
            'nip,ni,n->p', fit.design[inside], fit.residual[inside], fit.weights[inside]
        )
        shifts.append(np.linalg.solve(fit.hessian - fit.curvature(inside), score))
    shifts = np.array(shifts) - np.mean(shifts, axis=0)
    return (len(shifts) - 1) / len(shifts) * shifts.T @ shifts


def response(fit: Fit, columns: np.ndarray) -> np.ndarray:
    """
    Return the derivative of the values by small changes of the left-hand side, columns (n, 3, k).
    """
    return np.linalg.solve(
        fit.hessian, np.einsum('npi,nik->pk', fit.weighted(slice(None)), columns, optimize=True)
    )


NUISANCE = ('bias.x', 'bias.y', 'bias.z', 'force_offset', 'rate_delay')
"""
Differences of the accelerometers' biases and stamps, and the gyroscopes' delay relative to the
accelerometers.
"""
ARM_PRIOR = 1.0
"""m; an arm whose sd exceeds half of it is not observable."""
ARM_TOLERANCE = 1e-3
"""m; the sufficient sd."""
UNCALIBRATED_SCALE_SD = 0.03
"""Scale and misalignment of a consumer gyroscope without calibration from poses."""
DELAY_ROUNDS = 5
"""
Rounds in which the windows of the rates are shifted by the delay until the residual delay vanishes.
"""
WINDOWS_LEAST = 40
"""With fewer windows eight parameters and their scatter are not determined."""


@dataclass(frozen=True, eq=False)
class RelativeArm:
    """Position and attitude of IMU B in the frame of IMU A."""

    arm: np.ndarray
    """From A's sensitive point to B's, in A's frame, m, shape (3,)."""
    covariance: np.ndarray
    """Covariance of `arm`, shape (3, 3)."""
    mat_ab: np.ndarray
    """Rotation, B's frame to A's, shape (3, 3)."""
    time_offset: float
    """Delay of B's stamps relative to A's, s."""
    statuses: tuple
    """'determined' (sd within 1 mm) or 'weak' for x, y, z."""
    diagnostics: dict
    """
    Plain numbers: windows, clipped share, residuals, nuisances, contribution of the calibration to
    the sd.
    """

    @property
    def arm_sd(self) -> np.ndarray:
        """Standard deviation of `arm`, m, shape (3,)."""
        return np.sqrt(np.diag(self.covariance))

    def lines(self) -> Iterator[str]:
        """Return the remarks for the user."""
        d = self.diagnostics
        turn = np.degrees(Rotation.from_matrix(self.mat_ab).magnitude())
        yield (
            f'B is turned by {turn:.2f} deg against A; its stamps are {1e3 * self.time_offset:+.2f}'
            ' ms late'
        )
        yield (
            f'{d["windows"]} windows of {1e3 * d["window"]:.0f} ms, {100 * d["clipped_share"]:.0f}'
            ' % of the moving time left out as clipped; the arm explains the difference of the'
            f' accelerometers from {d["signal_rms"]:.2f} down to {d["residual_rms"]:.2f} m/s^2'
        )
        if not d['calibrated']:
            yield (
                'no poses at rest to calibrate the two IMUs with: scale errors of a consumer'
                ' gyroscope are in the sd'
            )
        for axis, status in zip('xyz', self.statuses):
            if status != 'determined':
                yield f'the arm along {axis} is weak; twist fast about the other two axes'


def estimate_arm(imu_a: ImuSamples, imu_b: ImuSamples) -> RelativeArm:
    """
    Estimate the arm r between two IMUs on one rigid body.

    The arm satisfies ``f_B - f_A = alpha x r + omega x (omega x r)``.

    Both sides are integrated over short windows with the same smooth weight; alpha enters as minus
    the integral of the weight's derivative times the rate, so no signal is differentiated. Windows
    with clipped samples are excluded. Biases, scales and axes come from a calibration by hand of
    each IMU, from the poses in the same recording.

    Parameters
    ----------
    imu_a, imu_b : ImuSamples
        Cleaned samples of the same recording, SI.

    Returns
    -------
    RelativeArm

    Raises
    ------
    InputError
        When the recordings do not overlap.
    NotObservableError
        When the motion does not determine the arm; the message names the component.

    """
    require_overlap(imu_a, imu_b)
    start = int(imu_a.stamp_ns[0])
    a, b = (PairedImu.make(imu, start) for imu in (imu_a, imu_b))
    rotation = relative_rotation(a, b)
    delay = 0.0
    for _ in range(DELAY_ROUNDS):
        rows = _build_rows(a, b, rotation, delay)
        fit = _fit_arm(rows)
        delay += fit.values[-1]
        if abs(fit.values[-1]) < 1e-5:
            break
    return _result(rows, fit, delay, rotation, (a, b))


def _build_rows(a, b, rotation, delay):
    """
    Integrate both sides over windows without clipping.

    The rates are `delay` seconds later on their clocks.
    """
    # Windows at the same true times on the clocks of both.
    length = window_length(a, b)
    offset = rotation.offset
    centres = window_centres(a, b, offset=offset, length=length)
    force_a = make_windows(a.time, centres, length)
    force_b = make_windows(b.time, centres + offset, length)
    rate_a = make_windows(a.time, centres + delay, length)
    rate_b = make_windows(b.time, centres + offset + delay, length)
    clipped = force_a.touches(a.flagged) | force_b.touches(b.flagged)
    clipped |= rate_a.touches(a.flagged) | rate_b.touches(b.flagged)
    free = ~clipped

    # Windows of strong motion: angular acceleration alpha and products omega omega', from the mean
    # of both gyroscopes in the axes of a.
    rate_b_in_a = b.rate @ rotation.mat_ab.T
    alpha_a = rate_a.slope(a.rate)
    alpha_b = rate_b.slope(rate_b_in_a)
    products = 0.5 * (_products(rate_a.mean, a.rate) + _products(rate_b.mean, rate_b_in_a))
    alpha_squared = 0.25 * np.sum((alpha_a + alpha_b) ** 2, axis=1)
    rate_squared = np.trace(products, axis1=1, axis2=2)
    strength = np.sqrt(alpha_squared + rate_squared**2)
    moving = strength > MOTION_SHARE * np.quantile(strength, 0.99)
    keep = free & moving
    if keep.sum() < WINDOWS_LEAST:
        raise NotObservableError(
            f'the arm needs {WINDOWS_LEAST} windows of fast twisting without clipping, got'
            f' {keep.sum()}; twist both IMUs together about all axes for 20 s or more, below the'
            ' range of the gyroscopes'
        )

    # The derivative of alpha, for the small column of the delay only.
    lag = 0.1 * (centres[1] - centres[0])
    kept = centres[keep] + delay
    alpha_later = make_windows(a.time, kept + lag, length).slope(a.rate)
    alpha_sooner = make_windows(a.time, kept - lag, length).slope(a.rate)

    # Half of the difference of two gyroscopes is the error of their mean, if their errors are
    # independent.
    noise = np.mean((alpha_b - alpha_a)[keep] ** 2) / 4
    force = force_b.select(keep).mean(b.force @ rotation.mat_ab.T)
    return ArmRows(
        centres[keep],
        force - force_a.select(keep).mean(a.force),
        0.5 * (alpha_a + alpha_b)[keep],
        products[keep],
        (alpha_later - alpha_sooner) / (2 * lag),
        _products(rate_a.select(keep).slope, a.rate),
        force_a.select(keep).slope(a.force),
        force,
        float(noise),
        float(np.mean(~free[moving])),
        length,
    )


def _products(integrate, rate):
    """Return the integrals of ``rate rate^T``, shape (n_windows, 3, 3)."""
    return integrate((rate[:, :, None] * rate[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)


def _calibration_covariance(fit, rows, a, b):
    """
    Contribution of the uncertainty of the gyroscopes' matrices.

    ``rate -> (1 - E) rate`` with the sd of E.
    """
    columns = []
    for p in range(3):
        for q in range(3):
            turn = np.zeros((3, 3))
            turn[p, q] = 1.0
            product = rows.products @ turn.T
            columns.append(
                -_lever_rows(rows.alpha @ turn.T, product + np.swapaxes(product, 1, 2))
                @ fit.values[:3]
            )
    shift = response(fit, np.stack(columns, axis=2))
    # The mean of both rates is used.
    spread = sum(_matrix_covariance(stream.calibration) for stream in (a, b)) / 4
    return (shift @ spread @ shift.T)[:3, :3]


def _matrix_covariance(calibration):
    if calibration is None:
        return UNCALIBRATED_SCALE_SD**2 * np.eye(9)
    index = [calibration.param_names.index(name) for name in linear_names('gyroscope').ravel()]
    return calibration.covariance[np.ix_(index, index)]


def _result(rows, fit, delay, rotation, streams):
    motion = _jackknife_covariance(fit, rows.centres)[:3, :3]
    shift = response(fit, -skew(rows.force))
    calibration = _calibration_covariance(fit, rows, *streams)
    turned = (shift @ rotation.cov @ shift.T)[:3, :3]
    total = motion + calibration + turned
    sd = np.sqrt(np.diag(total))
    _require_seen(fit.seen, sd)
    diagnostics = {
        'windows': len(rows.centres),
        'window': rows.length,
        'clipped_share': rows.clipped_share,
        'calibrated': all(s.calibration is not None for s in streams),
        'largest_rate': float(np.sqrt(np.max(np.trace(rows.products, axis1=1, axis2=2)))),
        'signal_rms': float(np.sqrt(np.mean(rows.difference**2))),
        'residual_rms': float(np.sqrt(np.mean(fit.residual**2))),
        'residual_median': float(np.sqrt(np.median(np.sum(fit.residual**2, axis=1)))),
        'attenuation': float(1 - fit.seen[0].min()),
        'motion_sd': np.sqrt(np.diag(motion)).tolist(),
        'calibration_sd': np.sqrt(np.diag(calibration)).tolist(),
        'rotation_sd': np.sqrt(np.diag(turned)).tolist(),
        **{name: float(v) for name, v in zip(NUISANCE, [*fit.values[3:7], delay])},
    }
    statuses = tuple('determined' if s <= ARM_TOLERANCE else 'weak' for s in sd)
    return RelativeArm(
        fit.values[:3], total, rotation.mat_ab, rotation.offset, statuses, diagnostics
    )


def _require_seen(seen, sd):
    """
    Refuse when the signal of a direction of the arm is the gyroscopes' noise, or hardly above it.
    """
    shares, directions = seen
    direction = directions[:, np.argmin(shares)]
    worst = (
        int(np.argmax(np.abs(direction)))
        if shares.min() < 0.5
        else int(np.argmax(np.where(np.isfinite(sd), sd, np.inf)))
    )
    if shares.min() < 0.5 or not np.all(sd < 0.5 * ARM_PRIOR):
        raise NotObservableError(
            f'the motion must show the whole arm, along {"xyz"[worst]} only'
            f' {max(shares.min(), 0):.0%} of the signal is not noise and the sd is {np.max(sd):.2g}'
            f' m; rotate fast also about the axes perpendicular to {"xyz"[worst]}',
            code='arm_not_observable',
        )
