"""Where one IMU sits relative to another on the same rigid body, from their readings in motion."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.by_hand import ByHandSettings, calibrate_by_hand
from imu_calibration.errors import InputError, NotObservableError
from imu_calibration.modulation import SAMPLES_LEAST, holes, make_windows
from imu_calibration.noise import STANDARD_GRAVITY
from imu_calibration.reference import skew
from imu_calibration.settings import setting
from imu_calibration.still_search import find_still

NUISANCE = ('bias.x', 'bias.y', 'bias.z', 'force_offset', 'rate_delay')
"""Differences of the accelerometers' biases and stamps, and the gyroscopes' lateness against the accelerometers."""
ARM_PRIOR = 1.0
"""m; an arm whose sd exceeds half of it counts as not seen."""
UNCALIBRATED_SCALE_SD = 0.03
"""Scale and misalignment of a consumer gyroscope that no poses calibrated."""
TAIL_DOF = 3
"""Student's t of the residuals: knocks make long tails."""


@dataclass(frozen=True)
class ArmSettings:
    """Numbers for the estimate of a relative arm."""

    window: float = setting(0.12, 's', 'length of the windows over which the motion is integrated; never below eight samples', (0.004, 5.0),
                            'too short: noise of the angular acceleration shortens the arm; too long: fast motion averages out')
    motion_share: float = setting(0.05, '1', 'windows with less lever-arm acceleration than this share of the strongest are left out', (0.0, 0.9),
                                  'too small: resting windows rule the noise estimate')
    cluster: float = setting(2.0, 's', 'errors are taken as independent between stretches of this length', (0.1, 100.0), 'too small: sd too small')
    gap: float = setting(0.1, 's', 'windows do not bridge longer holes; never below five periods', (0.001, 60.0), '')


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
    """How late B's stamps are against A's, s."""
    statuses: tuple
    """'determined' (sd within 1 mm) or 'weak' for x, y, z."""
    diagnostics: dict
    """Plain numbers: windows, clipped share, residuals, nuisances, what the calibration added to the sd."""

    @property
    def arm_sd(self):
        """Standard deviation of `arm`, m, shape (3,)."""
        return np.sqrt(np.diag(self.covariance))

    def lines(self):
        """Return the remarks for a person to read."""
        d = self.diagnostics
        turn = np.degrees(np.linalg.norm(_rotation_vector(self.mat_ab)))
        yield f'B is turned by {turn:.2f} deg against A; its stamps are {1e3 * self.time_offset:+.2f} ms late'
        yield (f'{d["windows"]} windows of {1e3 * d["window"]:.0f} ms, {100 * d["clipped_share"]:.0f} % of the moving time left out as clipped; '
               f'the arm explains the difference of the accelerometers from {d["signal_rms"]:.2f} down to {d["residual_rms"]:.2f} m/s^2')
        if not d['calibrated']:
            yield 'no poses at rest to calibrate the two IMUs with: scale errors of a consumer gyroscope are in the sd'
        for axis, status in zip('xyz', self.statuses):
            if status != 'determined':
                yield f'the arm along {axis} is weak; twist fast about the other two axes'


def estimate_arm(imu_a, imu_b, settings=ArmSettings(), gravity=STANDARD_GRAVITY, calibration_a=None, calibration_b=None):
    """
    Estimate the arm r of ``f_B - f_A = alpha x r + omega x (omega x r)`` between two IMUs on one rigid body.

    Both sides are integrated over short windows with the same smooth weight; alpha enters as minus the integral of the
    weight's derivative times the rate, so nothing is differentiated. Windows with clipped samples are left out. Biases,
    scales and axes come from a calibration by hand of each IMU, made from the poses in the same recording when not given.

    Parameters
    ----------
    imu_a, imu_b : ImuSamples
        Cleaned samples of the same recording, SI.
    settings : ArmSettings
    gravity : float
        m/s^2.
    calibration_a, calibration_b : HandCalibration, optional

    Returns
    -------
    RelativeArm

    Raises
    ------
    InputError
        When the recordings do not overlap.
    NotObservableError
        When the motion does not show the arm; the message names the component.

    """
    _require_overlap(imu_a, imu_b)
    start = int(imu_a.stamp_ns[0])
    a, b = (_Stream.make(imu, start, gravity, given, settings) for imu, given in ((imu_a, calibration_a), (imu_b, calibration_b)))
    mat_ab, offset = _relative_rotation(a, b, settings)
    rows = _build_rows(a, b, mat_ab, offset, settings)
    return _solve(rows, a, b, mat_ab, offset, settings)


@dataclass(frozen=True, eq=False)
class _Stream:
    """One IMU, compensated."""

    time: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    flagged: np.ndarray
    calibration: object
    period: float
    rate_sd: float

    @classmethod
    def make(cls, imu, start_ns, gravity, calibration, settings):
        time = 1e-9 * (imu.stamp_ns - start_ns)
        keep = np.concatenate([[True], np.diff(time) > 0])  # repeated stamps carry no new moment
        imu, time = imu.select(keep), time[keep]
        period = float(np.median(np.diff(time)))
        calibration = _calibrate(imu, gravity) if calibration is None else calibration
        flagged = clipped(imu.force_s) | clipped(imu.rate_s) | holes(time, max(settings.gap, 5 * period))
        force, rate = _compensated(imu, calibration)
        noise = np.sqrt(np.mean(np.square(calibration.statistics['rate_noise_sd']))) if calibration else 0.0
        return cls(time, force, rate, flagged, calibration, period, float(noise))


def clipped(values):
    """
    Return which samples touch the end of the range, shape (n,).

    The end of the range shows as the largest reading of one sign, over all axes, coming up again and again; a largest reading
    that came twice or less is the motion's own. The two ends may differ by one count.
    """
    flagged = np.zeros(len(values), bool)
    for signed in (values, -values):
        at_end = signed >= signed.max() - 1e-9 * np.abs(signed).max()
        if np.sum(at_end) > 2:
            flagged |= np.any(at_end, axis=1)
    return flagged


def _calibrate(imu, gravity):
    try:
        return calibrate_by_hand(imu, gravity, find_still(imu), ByHandSettings())
    except NotObservableError:
        return None


def _compensated(imu, calibration):
    if calibration is not None:
        return calibration.compensate(imu.force_s, imu.rate_s)
    still = find_still(imu)
    bias = np.mean([imu.rate_s[s].mean(0) for s in still], axis=0) if still else np.zeros(3)
    return imu.force_s, imu.rate_s - bias


def _require_overlap(imu_a, imu_b):
    if len(imu_a) < 2 * SAMPLES_LEAST or len(imu_b) < 2 * SAMPLES_LEAST:
        raise InputError(f'both IMUs must have at least {2 * SAMPLES_LEAST} samples, got {len(imu_a)} and {len(imu_b)}; check the topics')
    overlap = min(imu_a.stamp_ns[-1], imu_b.stamp_ns[-1]) - max(imu_a.stamp_ns[0], imu_b.stamp_ns[0])
    if overlap <= 0:
        raise InputError(f'the two IMUs must have been recorded at the same time, their stamps are {-1e-9 * overlap:.1f} s apart; check the clocks')


def _windows(a, b, offset, settings):
    """Return (windows over A, windows over B, centres): the same moments in both streams, nothing clipped, no holes."""
    length = max(settings.window, SAMPLES_LEAST * max(a.period, b.period))
    step = max(a.period, length / SAMPLES_LEAST)
    begin = max(a.time[0], b.time[0] - offset) + 0.51 * length
    end = min(a.time[-1], b.time[-1] - offset) - 0.51 * length
    first = a.time[np.searchsorted(a.time, begin)]  # on A's samples where these are even
    centres = first + step * np.arange(max(0, int((end - first) / step) + 1))
    if len(centres) == 0:
        raise InputError(f'the two IMUs must overlap by more than a window of {length:.3f} s; record longer')
    over_a, over_b = make_windows(a.time, centres, length), make_windows(b.time, centres + offset, length)
    free = ~(over_a.touches(a.flagged) | over_b.touches(b.flagged))
    return over_a, over_b, centres, free


def _relative_rotation(a, b, settings, rounds=4):
    """Return (mat_ab, time offset): from the directions at rest where both were calibrated, else from the rates."""
    offset, mat_ab = 0.0, np.eye(3)
    for _ in range(rounds):
        over_a, over_b, _, free = _windows(a, b, offset, settings)
        over_a, over_b = over_a.select(free), over_b.select(free)
        rate_a, rate_b, alpha = over_a.mean(a.rate), over_b.mean(b.rate), over_a.slope(a.rate)
        mat_ab = _align(rate_a, rate_b)
        difference = rate_b @ mat_ab.T - rate_a
        offset += -float(np.sum(difference * alpha) / np.sum(alpha * alpha)) if np.any(alpha) else 0.0
    at_rest = _directions_at_rest(a, b, offset)
    return (mat_ab if at_rest is None else _align(*at_rest)), offset


def _align(vectors_a, vectors_b):
    """Return the rotation closest to ``vectors_a = mat_ab @ vectors_b`` (Kabsch)."""
    left, _, right = np.linalg.svd(vectors_a.T @ vectors_b)
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right


def _directions_at_rest(a, b, offset):
    """Return mean forces of both over the times when both rest, or None when there are too few directions."""
    if a.calibration is None or b.calibration is None:
        return None
    pairs = []
    for first, last in zip(a.calibration.poses.start, a.calibration.poses.stop):
        begin, end = a.time[first], a.time[last - 1]
        in_b = slice(*np.searchsorted(b.time, (begin + offset, end + offset)))
        if in_b.stop - in_b.start >= 2:
            pairs.append((a.force[first:last].mean(0), b.force[in_b].mean(0)))
    return tuple(np.array(pairs).swapaxes(0, 1)) if len(pairs) >= 4 else None


@dataclass(frozen=True, eq=False)
class _Rows:
    """Integrated equations of the windows that show the arm."""

    centres: np.ndarray
    difference: np.ndarray
    alpha: np.ndarray
    products: np.ndarray
    jerk: np.ndarray
    products_slope: np.ndarray
    force_slope: np.ndarray
    clipped_share: float
    length: float
    alpha_noise: float


def _build_rows(a, b, mat_ab, offset, settings):
    over_a, over_b, centres, free = _windows(a, b, offset, settings)
    rate_b, force_b = b.rate @ mat_ab.T, b.force @ mat_ab.T
    alpha = 0.5 * (over_a.slope(a.rate) + over_b.slope(rate_b))
    products = 0.5 * (_products(over_a.mean, a.rate) + _products(over_b.mean, rate_b))
    strength = np.sqrt(np.sum(alpha**2, axis=1) + np.trace(products, axis1=1, axis2=2)**2)
    moving = strength > settings.motion_share * np.quantile(strength, 0.99)
    keep = free & moving
    if keep.sum() < 20:
        raise NotObservableError(f'the arm needs fast twisting of both IMUs together, got {keep.sum()} windows of motion without clipping; '
                                 'twist the body about all axes for 20 s or more')
    over_a, over_b = over_a.select(keep), over_b.select(keep)
    # second derivative by central difference of the windows' slope: only the small delay column uses it
    lag = 0.1 * (centres[1] - centres[0])
    later, sooner = (make_windows(a.time, centres[keep] + s * lag, _length(a, b, settings)) for s in (1, -1))
    jerk = (later.slope(a.rate) - sooner.slope(a.rate)) / (2 * lag)
    noise = 0.25 * (a.rate_sd**2 * np.mean(np.sum(over_a.weight_slope**2, axis=1)) + b.rate_sd**2 * np.mean(np.sum(over_b.weight_slope**2, axis=1)))
    return _Rows(centres[keep], over_b.mean(force_b) - over_a.mean(a.force), alpha[keep], products[keep], jerk, _products(over_a.slope, a.rate),
                 over_a.slope(a.force), float(np.mean(~free[moving])), _length(a, b, settings), float(noise))


def _length(a, b, settings):
    return max(settings.window, SAMPLES_LEAST * max(a.period, b.period))


def _products(integrate, rate):
    """Return the integrals of ``rate rate^T``, shape (n_windows, 3, 3)."""
    return integrate((rate[:, :, None] * rate[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)


def _lever(alpha, products):
    """``[alpha x] + omega omega^T - |omega|^2``, shape (n, 3, 3)."""
    return skew(alpha) + products - np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(3)


def _solve(rows, a, b, mat_ab, offset, settings):
    lever = _lever(rows.alpha, rows.products)
    lever_slope = _lever(rows.jerk, rows.products_slope)
    count, arm = len(lever), np.zeros(3)
    for _ in range(3):  # the delay column needs the arm
        design = np.concatenate([lever, np.tile(np.eye(3), (count, 1, 1)), -rows.force_slope[:, :, None], (-lever_slope @ arm)[:, :, None]], axis=2)
        values, weights = _robust_fit(design, rows.difference, rows.alpha_noise, use_delay=np.any(arm))
        arm = values[:3]
    residual = rows.difference - design @ values
    inverse = np.linalg.pinv(_normal(design, weights, rows.alpha_noise), hermitian=True)
    cov = _cluster_covariance(design, residual, weights, inverse, rows.centres, settings.cluster)[:3, :3]
    added = _calibration_covariance(design, weights, inverse, rows, arm, a, b)
    return _result(arm, cov, added, values, residual, weights, rows, (a, b), mat_ab, offset, inverse)


def _normal(design, weights, alpha_noise):
    """Weighted normal matrix, less what the noise of the angular acceleration adds to it (errors in variables)."""
    flat = design * np.sqrt(weights)[:, None, None]
    normal = np.einsum('nip,niq->pq', flat, flat)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    normal[:3, :3] -= 2 * alpha_noise * weights.sum() * np.eye(3)
    return normal + 1e-12 * np.diag(scale**2)


def _robust_fit(design, target, alpha_noise, use_delay):
    """Student-t regression by reweighting; returns (values, weights of the windows)."""
    if not use_delay:
        design = design[:, :, :-1]
    weights = np.ones(len(design))
    for _ in range(20):
        right = np.einsum('nip,ni,n->p', design, target, weights)
        values = np.linalg.solve(_normal(design, weights, alpha_noise), right)
        size = np.sum((target - design @ values)**2, axis=1)
        scale = np.median(size) / 2.366 + 1e-300  # the median of chi-square with three degrees of freedom
        weights = (TAIL_DOF + 3) / (TAIL_DOF + size / scale)
    return (values if use_delay else np.append(values, 0.0)), weights


def _cluster_covariance(design, residual, weights, inverse, centres, cluster):
    """Sandwich over stretches of time: errors within one may be anything."""
    score = np.einsum('nip,ni,n->np', design, residual, weights)
    label = np.unique(np.floor((centres - centres[0]) / cluster).astype(int), return_inverse=True)[1]
    sums = np.zeros((label.max() + 1, design.shape[2]))
    np.add.at(sums, label, score)
    groups = len(sums)
    return inverse @ (sums.T @ sums) @ inverse * groups / max(groups - 1, 1)


def _calibration_covariance(design, weights, inverse, rows, arm, a, b):
    """What the uncertainty of the gyroscopes' matrices adds: ``rate -> (1 - E) rate`` with the sd of E."""
    columns = []
    for p in range(3):
        for q in range(3):
            turn = np.zeros((3, 3))
            turn[p, q] = 1.0
            product = rows.products @ turn.T
            columns.append(-_lever(rows.alpha @ turn.T, product + np.swapaxes(product, 1, 2)) @ arm)
    shift = inverse @ np.einsum('nip,nic,n->pc', design, np.stack(columns, axis=2), weights)
    spread = sum(_matrix_covariance(stream.calibration) for stream in (a, b)) / 4  # the mean of both rates is used
    return (shift @ spread @ shift.T)[:3, :3]


def _matrix_covariance(calibration):
    if calibration is None:
        return UNCALIBRATED_SCALE_SD**2 * np.eye(9)
    index = [calibration.param_names.index(f'gyroscope.matrix.{p}{q}') for p in 'xyz' for q in 'xyz']
    return calibration.covariance[np.ix_(index, index)]


def _result(arm, cov, added, values, residual, weights, rows, streams, mat_ab, offset, inverse):
    total = cov + added
    sd = np.sqrt(np.diag(total))
    if np.max(sd) > 0.5 * ARM_PRIOR or not np.all(np.isfinite(sd)):
        worst = 'xyz'[int(np.argmax(np.where(np.isfinite(sd), sd, np.inf)))]
        raise NotObservableError(f'the motion must show the whole arm, along {worst} it leaves an sd of {np.max(sd):.2g} m; '
                                 f'twist fast about the axes other than {worst} too')
    diagnostics = {
        'windows': len(rows.centres), 'window': rows.length, 'clipped_share': rows.clipped_share, 'calibrated': all(s.calibration for s in streams),
        'signal_rms': float(np.sqrt(np.mean(rows.difference**2))), 'residual_rms': float(np.sqrt(np.mean(residual**2))),
        'residual_median': float(np.sqrt(np.median(np.sum(residual**2, axis=1)))), 'mean_weight': float(np.mean(weights)),
        'calibration_sd': np.sqrt(np.diag(added)).tolist(), 'motion_sd': np.sqrt(np.diag(cov)).tolist(),
        'attenuation': float(2 * rows.alpha_noise / np.mean(np.sum(rows.alpha**2, axis=1))), 'largest_rate': float(np.sqrt(np.max(np.trace(rows.products, axis1=1, axis2=2)))),
        **{name: float(value) for name, value in zip(NUISANCE, values[3:])}}
    return RelativeArm(arm, total, mat_ab, offset, tuple('determined' if s <= 1e-3 else 'weak' for s in sd), diagnostics)


def _rotation_vector(matrix):
    angle = np.arccos(np.clip((np.trace(matrix) - 1) / 2, -1, 1))
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    return axis / 2 if angle < 1e-6 else axis * angle / (2 * np.sin(angle))
