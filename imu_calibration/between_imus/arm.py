"""
Position of one IMU relative to another on the same rigid body.

By a robust fit with Student-t errors and noisy columns.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from imu_calibration.between_imus.pair import (
    PairedImu,
    RelativeRotation,
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
from imu_calibration.references.gravity.hand_calibration import HandCalibration

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


def _lever_rows(alpha: np.ndarray, products: np.ndarray) -> np.ndarray:
    """
    Return ``W = [alpha x] + omega omega^T - |omega|^2``, shape (n, 3, 3): ``W r`` at the arm r.

    `products` has ``omega omega^T``.
    """
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
    """Twice the decrease of each weight per increase of its squared residual, shape (n,)."""
    noise_correction: np.ndarray
    """Correction of the normal matrix for the noise of the columns, shape (8, 8)."""
    signal_shares: np.ndarray
    """
    Shares of the arm's information that are not due to the noise of the columns, of three
    directions, shape (3,).
    """
    directions: np.ndarray
    """Arms of these directions, in the columns, shape (3, 3)."""

    @cached_property
    def hessian(self) -> np.ndarray:
        """Derivative of the score ``sum design' w r`` by the values, negated, shape (8, 8)."""
        return self.curvature(slice(None)) + self.noise_correction

    def score_slope(self, index: np.ndarray | slice) -> np.ndarray:
        """
        Return the derivative of the score by the residuals of windows, shape (n, p, 3).

        A window with the residual r and the weight w adds ``design' w r`` to the score. The weight
        depends on r too: the derivative is ``design' (w - weight_fall r r')``.
        """
        transposed = np.swapaxes(self.design[index], 1, 2)
        residual = self.residual[index]
        design_residual = np.einsum('npi,ni->np', transposed, residual)
        design_residual = design_residual * self.weight_fall[index, None]
        weighted_design = transposed * self.weights[index, None, None]
        return weighted_design - design_residual[:, :, None] * residual[:, None, :]

    def curvature(self, index: np.ndarray | slice) -> np.ndarray:
        """Return the contribution of the windows `index` to the Hessian, shape (p, p)."""
        rows = np.swapaxes(self.score_slope(index), 1, 2).reshape(-1, self.design.shape[2])
        return rows.T @ self.design[index].reshape(rows.shape)


def _fit_arm(rows: ArmRows) -> Fit:
    """
    Solve ``difference = W(alpha, rate) @ arm + bias + delay terms`` with Student-t errors.

    Raises
    ------
    NotObservableError
        When the motion is the same in all windows, or about one axis only and free of noise.

    """
    lever = _lever_rows(rows.alpha, rows.products)
    lever_slope = _lever_rows(rows.jerk, rows.products_slope)
    bias_columns = np.tile(np.eye(3), (len(lever), 1, 1))
    force_delay_column = -rows.force_slope[:, :, None]

    # The column of the rates' delay is proportional to the arm: the first fit is made without it,
    # each further one with the arm of the fit before.
    without_rate_delay = np.concatenate([lever, bias_columns, force_delay_column], axis=2)
    robust = _robust_fit(without_rate_delay, rows.difference, rows.alpha_noise)
    for _ in range(2):
        rate_delay_column = (lever_slope @ robust.values[:3])[:, :, None]
        design = np.concatenate([without_rate_delay, rate_delay_column], axis=2)
        robust = _robust_fit(design, rows.difference, rows.alpha_noise)

    # Information of the arm C with, and U without the correction for the noise of the columns. The
    # share x of a direction v that is not noise: C v = x U v.
    corrected = _normal(design, robust.weights, robust.excess)
    uncorrected = _normal(design, robust.weights, 0.0)
    try:
        shares, directions = scipy.linalg.eigh(_reduced(corrected), _reduced(uncorrected))
    except np.linalg.LinAlgError as error:
        raise NotObservableError(
            'the motion must show the whole arm, one direction has no signal; '
            'twist fast about all axes'
        ) from error
    return Fit(
        values=robust.values,
        design=design,
        residual=rows.difference - design @ robust.values,
        weights=robust.weights,
        weight_fall=robust.weight_fall,
        noise_correction=corrected - uncorrected,
        signal_shares=shares,
        directions=directions,
    )


def _reduced(normal: np.ndarray) -> np.ndarray:
    """Return the normal matrix of the arm after elimination of the other parameters."""
    return normal[:3, :3] - normal[:3, 3:] @ np.linalg.solve(normal[3:, 3:], normal[3:, :3])


def _normal(design: np.ndarray, weights: np.ndarray, excess: float) -> np.ndarray:
    """
    Return the weighted normal matrix, corrected for errors in variables, shape (p, p).

    The contribution of the noise of the angular acceleration, `excess`, is subtracted from the
    diagonal of the arm.
    """
    flat = (design * np.sqrt(weights)[:, None, None]).reshape(-1, design.shape[2])
    normal = flat.T @ flat
    ridge = 1e-12 * np.maximum(np.diag(normal), 1e-12)
    normal[:3, :3] -= excess * np.eye(3)
    return normal + np.diag(ridge)


@dataclass(frozen=True, eq=False)
class _RobustFit:
    """Student-t regression."""

    values: np.ndarray
    """Parameters, shape (p,)."""
    weights: np.ndarray
    """Weight of each window, shape (n,)."""
    weight_fall: np.ndarray
    """Twice the decrease of each weight per increase of its squared residual, shape (n,)."""
    excess: float
    """Contribution of the noise of the angular acceleration to the normal matrix of the arm."""


def _robust_fit(design: np.ndarray, target: np.ndarray, alpha_noise: float) -> _RobustFit:
    """
    Return the Student-t regression of ``target = design @ values`` by reweighting.

    With s the sum of the three squared residuals of a window, and nu = `TAIL_DOF`::

        w           = (nu + 3) / (nu + s / scale)             weight
        weight_fall = -2 dw/ds = 2 w^2 / ((nu + 3) scale)
        excess      = 2 alpha_noise sum (w - weight_fall s / 3)

    The columns of the arm are ``[alpha x]``; noise of alpha with the variance `alpha_noise` on each
    axis increases ``[alpha x]' [alpha x]`` by ``2 alpha_noise I`` in the mean. It counts with the
    derivative of ``w r`` by the residual r, averaged over the three axes.

    Parameters
    ----------
    design : array, shape (n, 3, p)
    target : array, shape (n, 3)
    alpha_noise : float
        Variance of the angular acceleration in the columns of the arm.

    """
    weights = np.ones(len(design))
    weight_fall = np.zeros(len(design))
    squares = np.zeros(len(design))  # squared residual of each window
    flat = design.reshape(-1, design.shape[2])
    values = np.full(design.shape[2], np.inf)
    for _ in range(30):  # at most; mostly the values settle earlier
        excess = 2 * alpha_noise * np.sum(weights - weight_fall * squares / 3)
        right_side = flat.T @ (target * weights[:, None]).ravel()
        previous_values = values
        values = np.linalg.solve(_normal(design, weights, excess), right_side)
        squares = np.sum((target.ravel() - flat @ values).reshape(-1, 3) ** 2, axis=1)
        # The median of chi-square with three degrees of freedom.
        scale = np.median(squares) / 2.366 + 1e-300
        weights = (TAIL_DOF + 3) / (TAIL_DOF + squares / scale)
        weight_fall = 2 * weights**2 / ((TAIL_DOF + 3) * scale)
        if np.all(np.abs(values - previous_values) <= 1e-9 * np.abs(values)):
            break
    return _RobustFit(values, weights, weight_fall, excess)


def _jackknife_covariance(fit: Fit, centres: np.ndarray) -> np.ndarray:
    """
    Return the covariance of the values by a delete-one-cluster jackknife, shape (p, p).

    Clusters are stretches of time: errors within a stretch may have any correlation.
    """
    stretch = np.floor((centres - centres[0]) / CLUSTER).astype(int)
    _, cluster = np.unique(stretch, return_inverse=True)
    changes = []  # of the values when a cluster is omitted
    for number in range(cluster.max() + 1):
        inside = cluster == number
        score = np.einsum(
            'nip,ni,n->p', fit.design[inside], fit.residual[inside], fit.weights[inside]
        )
        changes.append(np.linalg.solve(fit.hessian - fit.curvature(inside), score))
    changes = np.array(changes) - np.mean(changes, axis=0)
    return (len(changes) - 1) / len(changes) * changes.T @ changes


def response(fit: Fit, columns: np.ndarray) -> np.ndarray:
    """
    Return the derivative of the values by changes of the left-hand side, shape (p, k).

    `columns`: derivative of the left-hand side by k quantities, shape (n, 3, k). By the implicit
    function theorem it is ``hessian^-1 sum score_slope columns``.
    """
    score = np.einsum('npi,nik->pk', fit.score_slope(slice(None)), columns, optimize=True)
    return np.linalg.solve(fit.hessian, score)


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
    statuses: tuple[str, ...]
    """'determined' (sd within 1 mm) or 'weak' for x, y, z."""
    diagnostics: dict
    """
    Plain numbers by name: windows, clipped share, residuals, nuisances, parts of the sd.
    """

    @property
    def arm_sd(self) -> np.ndarray:
        """Standard deviation of `arm`, m, shape (3,)."""
        return np.sqrt(np.diag(self.covariance))

    def lines(self) -> Iterator[str]:
        """Yield the remarks for the user."""
        numbers = self.diagnostics
        turn = np.degrees(Rotation.from_matrix(self.mat_ab).magnitude())
        yield (
            f'B is turned by {turn:.2f} deg against A; its stamps are {1e3 * self.time_offset:+.2f}'
            ' ms late'
        )
        yield (
            f'{numbers["windows"]} windows of {1e3 * numbers["window"]:.0f} ms,'
            f' {100 * numbers["clipped_share"]:.0f} % of the moving time left out as clipped; the'
            ' arm explains the difference of the accelerometers from'
            f' {numbers["signal_rms"]:.2f} down to {numbers["residual_rms"]:.2f} m/s^2'
        )
        if not numbers['calibrated']:
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
    a = PairedImu.make(imu_a, start)
    b = PairedImu.make(imu_b, start)
    rotation = relative_rotation(a, b)
    delay = 0.0
    for _ in range(DELAY_ROUNDS):
        # Windows shifted by the delay so far; the fit then has the remaining one.
        rows = _build_rows(a, b, rotation, delay)
        fit = _fit_arm(rows)
        remaining_delay = fit.values[-1]
        delay += remaining_delay
        if abs(remaining_delay) < 1e-5:  # s
            break
    return _result(rows, fit, delay, rotation, (a, b))


def _build_rows(a: PairedImu, b: PairedImu, rotation: RelativeRotation, delay: float) -> ArmRows:
    """
    Return both sides of the equation of the arm, as means over windows of strong motion.

    The equation is ``f_B - f_A = alpha x r + omega x (omega x r)`` with the arm r. Windows with
    clipped samples are excluded.

    Parameters
    ----------
    a, b : PairedImu
        Readings of both IMUs.
    rotation : RelativeRotation
        Rotation and time offset of B relative to A.
    delay : float
        Delay of the rates relative to the specific forces, s: windows of rates are later by it.

    Raises
    ------
    NotObservableError
        With too few windows.

    """
    # 1. Windows at the same true times, on the clock of each sensor.
    length = window_length(a, b)
    offset = rotation.offset
    centres = window_centres(a, b, offset=offset, length=length)
    force_a = make_windows(a.time, centres, length)
    force_b = make_windows(b.time, centres + offset, length)
    rate_a = make_windows(a.time, centres + delay, length)
    rate_b = make_windows(b.time, centres + offset + delay, length)
    clipped = force_a.touches(a.flagged) | force_b.touches(b.flagged)
    clipped |= rate_a.touches(a.flagged) | rate_b.touches(b.flagged)

    # 2. Angular acceleration alpha, and products omega omega': from the mean of both gyroscopes in
    #    the axes of A.
    rate_b_in_a = b.rate @ rotation.mat_ab.T
    alpha_a = rate_a.slope(a.rate)
    alpha_b = rate_b.slope(rate_b_in_a)
    products = 0.5 * (_products(rate_a.mean, a.rate) + _products(rate_b.mean, rate_b_in_a))
    alpha = 0.5 * (alpha_a + alpha_b)

    # 3. Windows of strong motion without clipping. The acceleration of one metre of arm is about
    #    sqrt(|alpha|^2 + |omega|^4).
    rate_squared = np.trace(products, axis1=1, axis2=2)
    strength = np.sqrt(np.sum(alpha**2, axis=1) + rate_squared**2)
    moving = strength > MOTION_SHARE * np.quantile(strength, 0.99)
    used = ~clipped & moving
    if used.sum() < WINDOWS_LEAST:
        raise NotObservableError(
            f'the arm needs {WINDOWS_LEAST} windows of fast twisting without clipping, got'
            f' {used.sum()}; twist both IMUs together about all axes for 20 s or more, below the'
            ' range of the gyroscopes'
        )

    # 4. The derivative of alpha, by differences of windows: accurate enough, because only the small
    #    column of the delay has it.
    lag = 0.1 * (centres[1] - centres[0])
    used_centres = centres[used] + delay
    alpha_later = make_windows(a.time, used_centres + lag, length).slope(a.rate)
    alpha_sooner = make_windows(a.time, used_centres - lag, length).slope(a.rate)

    # 5. Half of the difference of two gyroscopes has the variance of the error of their mean, if
    #    their errors are independent.
    alpha_noise = np.mean((alpha_b - alpha_a)[used] ** 2) / 4
    force = force_b.select(used).mean(b.force @ rotation.mat_ab.T)
    return ArmRows(
        centres=centres[used],
        difference=force - force_a.select(used).mean(a.force),
        alpha=alpha[used],
        products=products[used],
        jerk=(alpha_later - alpha_sooner) / (2 * lag),
        products_slope=_products(rate_a.select(used).slope, a.rate),
        force_slope=force_a.select(used).slope(a.force),
        force=force,
        alpha_noise=float(alpha_noise),
        clipped_share=float(np.mean(clipped[moving])),
        length=length,
    )


def _products(integrate: Callable[[np.ndarray], np.ndarray], rate: np.ndarray) -> np.ndarray:
    """
    Return the integrals of ``rate rate^T`` over windows, shape (n_windows, 3, 3).

    `integrate`: `Windows.mean` or `Windows.slope` of the windows.
    """
    return integrate((rate[:, :, None] * rate[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)


def _calibration_covariance(fit: Fit, rows: ArmRows, a: PairedImu, b: PairedImu) -> np.ndarray:
    """
    Return the covariance of the arm due to errors of the gyroscopes' matrices, (3, 3).

    An error E of the matrix changes ``rate -> (1 - E) rate``, and with it the columns of the arm.
    """
    columns = []  # change of the left-hand side by each element of E
    for p in range(3):
        for q in range(3):
            error = np.zeros((3, 3))
            error[p, q] = 1.0
            product = rows.products @ error.T
            lever_change = _lever_rows(rows.alpha @ error.T, product + np.swapaxes(product, 1, 2))
            columns.append(-lever_change @ fit.values[:3])
    by_error = response(fit, np.stack(columns, axis=2))
    # The mean of both rates is used.
    error_cov = sum(_matrix_covariance(imu.calibration) for imu in (a, b)) / 4
    return (by_error @ error_cov @ by_error.T)[:3, :3]


def _matrix_covariance(calibration: HandCalibration | None) -> np.ndarray:
    """Return the covariance of the matrix of a gyroscope, row by row, shape (9, 9)."""
    if calibration is None:
        return UNCALIBRATED_SCALE_SD**2 * np.eye(9)
    index = [calibration.param_names.index(name) for name in linear_names('gyroscope').ravel()]
    return calibration.covariance[np.ix_(index, index)]


def _result(
    rows: ArmRows,
    fit: Fit,
    delay: float,
    rotation: RelativeRotation,
    imus: tuple[PairedImu, PairedImu],
) -> RelativeArm:
    """
    Return the arm with its covariance: from the motion, the calibrations and the relative rotation.

    Raises
    ------
    NotObservableError
        When a direction of the arm is not determined.

    """
    # Independent errors: of the motion, of the gyroscopes' calibrations, of the relative rotation.
    motion_cov = _jackknife_covariance(fit, rows.centres)[:3, :3]
    calibration_cov = _calibration_covariance(fit, rows, *imus)
    # A small turn e of B changes its force in A's axes by e x force = -[force x] e.
    by_rotation = response(fit, -skew(rows.force))
    rotation_cov = (by_rotation @ rotation.cov @ by_rotation.T)[:3, :3]
    covariance = motion_cov + calibration_cov + rotation_cov
    sd = np.sqrt(np.diag(covariance))
    _require_signal(fit, sd)

    # The last fitted value is the remaining delay of the rates, of which `delay` is the sum.
    nuisances = {}
    for name, value in zip(NUISANCE, [*fit.values[3:7], delay]):
        nuisances[name] = float(value)
    diagnostics = {
        'windows': len(rows.centres),
        'window': rows.length,
        'clipped_share': rows.clipped_share,
        'calibrated': all(imu.calibration is not None for imu in imus),
        'largest_rate': float(np.sqrt(np.max(np.trace(rows.products, axis1=1, axis2=2)))),
        'signal_rms': float(np.sqrt(np.mean(rows.difference**2))),
        'residual_rms': float(np.sqrt(np.mean(fit.residual**2))),
        'residual_median': float(np.sqrt(np.median(np.sum(fit.residual**2, axis=1)))),
        'attenuation': float(1 - fit.signal_shares.min()),
        'motion_sd': np.sqrt(np.diag(motion_cov)).tolist(),
        'calibration_sd': np.sqrt(np.diag(calibration_cov)).tolist(),
        'rotation_sd': np.sqrt(np.diag(rotation_cov)).tolist(),
        **nuisances,
    }
    return RelativeArm(
        arm=fit.values[:3],
        covariance=covariance,
        mat_ab=rotation.mat_ab,
        time_offset=rotation.offset,
        statuses=tuple('determined' if s <= ARM_TOLERANCE else 'weak' for s in sd),
        diagnostics=diagnostics,
    )


def _require_signal(fit: Fit, sd: np.ndarray) -> None:
    """Refuse an arm of which a direction has less signal than noise, or too large an sd."""
    least_share = fit.signal_shares.min()
    if least_share < 0.5:
        # Mostly noise of the gyroscopes: the axis that contributes most to the direction.
        direction = fit.directions[:, np.argmin(fit.signal_shares)]
        axis = 'xyz'[int(np.argmax(np.abs(direction)))]
    elif not np.all(sd < 0.5 * ARM_PRIOR):
        axis = 'xyz'[int(np.argmax(np.where(np.isfinite(sd), sd, np.inf)))]
    else:
        return
    raise NotObservableError(
        f'the motion must show the whole arm, along {axis} only'
        f' {max(least_share, 0):.0%} of the signal is not noise and the sd is {np.max(sd):.2g}'
        f' m; rotate fast also about the axes perpendicular to {axis}',
        code='arm_not_observable',
    )
