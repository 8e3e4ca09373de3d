"""Position of one IMU relative to another on the same rigid body, from their readings in motion."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.between_imus.fit import ArmRows, fit_arm, jackknife_covariance, lever_rows, response
from imu_calibration.between_imus.pair import (
    ArmSettings,
    PairedImu,
    relative_rotation,
    require_overlap,
    window_centres,
    window_length,
)
from imu_calibration.core.constants import STANDARD_GRAVITY
from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.effects.sensor_model import linear_names
from imu_calibration.kinematics.modulating_functions import make_windows
from imu_calibration.kinematics.reference_motion import skew
from imu_calibration.references.gravity.hand_calibration import HandCalibration

NUISANCE = ('bias.x', 'bias.y', 'bias.z', 'force_offset', 'rate_delay')
"""Differences of the accelerometers' biases and stamps, and the gyroscopes' delay relative to the accelerometers."""
ARM_PRIOR = 1.0
"""m; an arm whose sd exceeds half of it is not observable."""
ARM_TOLERANCE = 1e-3
"""m; the sufficient sd."""
UNCALIBRATED_SCALE_SD = 0.03
"""Scale and misalignment of a consumer gyroscope without calibration from poses."""
DELAY_ROUNDS = 5
"""Rounds in which the windows of the rates are shifted by the delay until the residual delay vanishes."""
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
    """Plain numbers: windows, clipped share, residuals, nuisances, contribution of the calibration to the sd."""

    @property
    def arm_sd(self) -> np.ndarray:
        """Standard deviation of `arm`, m, shape (3,)."""
        return np.sqrt(np.diag(self.covariance))

    def lines(self) -> Iterator[str]:
        """Return the remarks for the user."""
        d = self.diagnostics
        turn = np.degrees(Rotation.from_matrix(self.mat_ab).magnitude())
        yield f'B is turned by {turn:.2f} deg against A; its stamps are {1e3 * self.time_offset:+.2f} ms late'
        yield (f'{d["windows"]} windows of {1e3 * d["window"]:.0f} ms, {100 * d["clipped_share"]:.0f} % of the moving time left out '
               f'as clipped; the arm explains the difference of the accelerometers from {d["signal_rms"]:.2f} '
               f'down to {d["residual_rms"]:.2f} m/s^2')
        if not d['calibrated']:
            yield 'no poses at rest to calibrate the two IMUs with: scale errors of a consumer gyroscope are in the sd'
        for axis, status in zip('xyz', self.statuses):
            if status != 'determined':
                yield f'the arm along {axis} is weak; twist fast about the other two axes'


def estimate_arm(imu_a: ImuSamples, imu_b: ImuSamples, settings: ArmSettings = ArmSettings(), *, gravity: float = STANDARD_GRAVITY,
                 calibration_a: HandCalibration | None = None, calibration_b: HandCalibration | None = None) -> RelativeArm:
    """
    Estimate the arm r of ``f_B - f_A = alpha x r + omega x (omega x r)`` between two IMUs on one rigid body.

    Both sides are integrated over short windows with the same smooth weight; alpha enters as minus the integral of the
    weight's derivative times the rate, so no signal is differentiated. Windows with clipped samples are excluded. Biases,
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
        When the motion does not determine the arm; the message names the component.

    """
    require_overlap(imu_a, imu_b)
    start = int(imu_a.stamp_ns[0])
    a, b = (PairedImu.make(imu, start, gravity, calibration=given, settings=settings)
            for imu, given in ((imu_a, calibration_a), (imu_b, calibration_b)))
    rotation = relative_rotation(a, b, settings)
    delay = 0.0
    for _ in range(DELAY_ROUNDS):
        rows = _build_rows(a, b, rotation, delay, settings)
        fit = fit_arm(rows)
        delay += fit.values[-1]
        if abs(fit.values[-1]) < 1e-5:
            break
    return _result(rows, fit, delay, rotation, (a, b), settings)


def _build_rows(a, b, rotation, delay, settings):
    """Integrate both sides over windows without clipping, the rates `delay` seconds later on their clocks."""
    length, offset = window_length(a, b, settings), rotation.offset
    centres = window_centres(a, b, offset=offset, length=length)
    force_a, force_b = make_windows(a.time, centres, length), make_windows(b.time, centres + offset, length)
    rate_a, rate_b = make_windows(a.time, centres + delay, length), make_windows(b.time, centres + offset + delay, length)
    free = ~(force_a.touches(a.flagged) | force_b.touches(b.flagged) | rate_a.touches(a.flagged) | rate_b.touches(b.flagged))
    in_a = b.rate @ rotation.mat_ab.T
    alpha_a, alpha_b = rate_a.slope(a.rate), rate_b.slope(in_a)
    products = 0.5 * (_products(rate_a.mean, a.rate) + _products(rate_b.mean, in_a))
    strength = np.sqrt(0.25 * np.sum((alpha_a + alpha_b)**2, axis=1) + np.trace(products, axis1=1, axis2=2)**2)
    moving = strength > settings.motion_share * np.quantile(strength, 0.99)
    keep = free & moving
    if keep.sum() < WINDOWS_LEAST:
        raise NotObservableError(f'the arm needs {WINDOWS_LEAST} windows of fast twisting without clipping, got {keep.sum()}; '
                                 'twist both IMUs together about all axes for 20 s or more, below the range of the gyroscopes')
    lag = 0.1 * (centres[1] - centres[0])  # the second derivative, for the small delay column only
    later, sooner = (make_windows(a.time, centres[keep] + delay + s * lag, length).slope(a.rate) for s in (1, -1))
    # half of the difference of two gyroscopes is the error of their mean, if their errors are independent
    noise = np.mean((alpha_b - alpha_a)[keep]**2) / 4
    force = force_b.select(keep).mean(b.force @ rotation.mat_ab.T)
    return ArmRows(centres[keep], force - force_a.select(keep).mean(a.force), 0.5 * (alpha_a + alpha_b)[keep], products[keep],
                (later - sooner) / (2 * lag), _products(rate_a.select(keep).slope, a.rate), force_a.select(keep).slope(a.force),
                force, float(noise), float(np.mean(~free[moving])), length)


def _products(integrate, rate):
    """Return the integrals of ``rate rate^T``, shape (n_windows, 3, 3)."""
    return integrate((rate[:, :, None] * rate[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)


def _rotation_covariance(fit, rows, rotation):
    """Contribution of the uncertainty of the rotation between the IMUs."""
    shift = response(fit, -skew(rows.force))
    return (shift @ rotation.cov @ shift.T)[:3, :3]


def _calibration_covariance(fit, rows, a, b):
    """Contribution of the uncertainty of the gyroscopes' matrices: ``rate -> (1 - E) rate`` with the sd of E."""
    columns = []
    for p in range(3):
        for q in range(3):
            turn = np.zeros((3, 3))
            turn[p, q] = 1.0
            product = rows.products @ turn.T
            columns.append(-lever_rows(rows.alpha @ turn.T, product + np.swapaxes(product, 1, 2)) @ fit.values[:3])
    shift = response(fit, np.stack(columns, axis=2))
    spread = sum(_matrix_covariance(stream.calibration) for stream in (a, b)) / 4  # the mean of both rates is used
    return (shift @ spread @ shift.T)[:3, :3]


def _matrix_covariance(calibration):
    if calibration is None:
        return UNCALIBRATED_SCALE_SD**2 * np.eye(9)
    index = [calibration.param_names.index(name) for name in linear_names('gyroscope').ravel()]
    return calibration.covariance[np.ix_(index, index)]


def _result(rows, fit, delay, rotation, streams, settings):
    motion = jackknife_covariance(fit, rows.centres, settings.cluster)[:3, :3]
    calibration, turned = _calibration_covariance(fit, rows, *streams), _rotation_covariance(fit, rows, rotation)
    total = motion + calibration + turned
    sd = np.sqrt(np.diag(total))
    _require_seen(fit.seen, sd)
    diagnostics = {
        'windows': len(rows.centres), 'window': rows.length, 'clipped_share': rows.clipped_share,
        'calibrated': all(s.calibration is not None for s in streams),
        'largest_rate': float(np.sqrt(np.max(np.trace(rows.products, axis1=1, axis2=2)))),
        'signal_rms': float(np.sqrt(np.mean(rows.difference**2))), 'residual_rms': float(np.sqrt(np.mean(fit.residual**2))),
        'residual_median': float(np.sqrt(np.median(np.sum(fit.residual**2, axis=1)))), 'attenuation': float(1 - fit.seen[0].min()),
        'motion_sd': np.sqrt(np.diag(motion)).tolist(), 'calibration_sd': np.sqrt(np.diag(calibration)).tolist(),
        'rotation_sd': np.sqrt(np.diag(turned)).tolist(), **{name: float(v) for name, v in zip(NUISANCE, [*fit.values[3:7], delay])}}
    statuses = tuple('determined' if s <= ARM_TOLERANCE else 'weak' for s in sd)
    return RelativeArm(fit.values[:3], total, rotation.mat_ab, rotation.offset, statuses, diagnostics)


def _require_seen(seen, sd):
    """Refuse when the signal of a direction of the arm is the gyroscopes' noise, or hardly above it."""
    shares, directions = seen
    direction = directions[:, np.argmin(shares)]
    worst = int(np.argmax(np.abs(direction))) if shares.min() < 0.5 else int(np.argmax(np.where(np.isfinite(sd), sd, np.inf)))
    if shares.min() < 0.5 or not np.all(sd < 0.5 * ARM_PRIOR):
        raise NotObservableError(f'the motion must show the whole arm, along {"xyz"[worst]} only {max(shares.min(), 0):.0%} of the '
                                 f'signal is not noise and the sd is {np.max(sd):.2g} m; '
                                 f'rotate fast also about the axes perpendicular to {"xyz"[worst]}', code='arm_not_observable')
