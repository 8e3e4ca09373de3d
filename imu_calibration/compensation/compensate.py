"""Compensation: the calibration inverted, with the lever-arm correction from the measured rate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import SECTIONS, SENSORS, Role
from imu_calibration.effects.forward_equations import sensor_output
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import Reference, lever_matrix, rotation_from_rpy


class FittedErrors(Protocol):
    """
    A model of the errors of an IMU with the values of its parameters and how well they are known.
    """

    @property
    def model(self) -> SensorModel:
        """The effects."""

    @property
    def values(self) -> np.ndarray:
        """Parameters in the order of the model, SI, shape (n_params,)."""

    @property
    def covariance(self) -> np.ndarray:
        """Their covariance, shape (n_params, n_params)."""

    @property
    def status(self) -> tuple[str, ...]:
        """How well each parameter is known: 'determined', 'weak' or 'held'."""

    @property
    def uncertainty_known(self) -> bool:
        """Whether the values have a covariance."""

    @property
    def knows_density(self) -> bool:
        """Whether the noise of a sensor is known at any sampling rate."""

    @property
    def frame_id(self) -> str:
        """Frame of the messages that it was made from."""

    @property
    def conditions(self) -> dict[str, Any]:
        """Conditions of the recording: the range of temperature, the largest rate."""

    def of(self, sensor: str, role: Role) -> Any:
        """Return the value of the effect that plays a role for a sensor, or None."""

    def noise(self, sensor: str, period: float | None = None) -> tuple[Any, Any]:
        """
        Return (standard deviation of a sample, sd of window offsets and bias process).

        Each has shape (3,).
        """


MAX_INVERSION_STEPS = 12
"""Fixed-point steps at most; each gains the size of the non-linear effects, about three digits."""
CONVERGED = 1e-2
"""
Samples whose last step is larger (m/s^2, rad/s) lie outside the range in which the non-linear
effects can be inverted; they become NaN.

Close to zero input, where the sign of the asymmetry is open, the steps alternate by up to 1e-3,
which is no failure.
"""


@dataclass(frozen=True, eq=False)
class Corrected:
    """
    Samples after compensation.

    They are in the sensor frame and at the gauge's origin, or in the target frame and point.
    """

    force: np.ndarray
    """Specific force, m/s^2, shape (n, 3)."""
    rate: np.ndarray
    """Angular rate, rad/s, shape (n, 3)."""
    flagged: np.ndarray
    """
    True where the output cannot be trusted: the input was saturated, or too large for the
    inversion, shape (n,).
    """
    marks: np.ndarray
    """
    Variance of saturated (force, rate): the square of the range, the only information on the true
    value; otherwise 0. Shape (n, 2).
    """


@dataclass(frozen=True, eq=False)
class Transfer:
    """Another point and frame of the same rigid body."""

    frame_id: str
    """Name of the target frame."""
    mat_ts: np.ndarray
    """Turns sensor vectors into target vectors, shape (3, 3)."""
    arm_t: np.ndarray
    """From the target's origin to the sensor, in the target frame, m, shape (3,)."""

    @classmethod
    def from_pose(
        cls,
        frame_id: str,
        xyz: Sequence[float] = (0.0, 0.0, 0.0),
        rpy: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> 'Transfer':
        """
        Return the transfer to a frame in which the sensor sits at `xyz` (m), turned by `rpy`.

        Parameters
        ----------
        xyz, rpy : sequence of 3 floats
            Pose of the sensor in the target frame, as in a static transform or a URDF joint from
            target to sensor: roll, pitch, yaw in rad about the fixed axes x, y, z.

        """
        if len(xyz) != 3 or len(rpy) != 3 or not np.all(np.isfinite([*xyz, *rpy])):
            raise InputError(
                f'the pose of the sensor must be three finite numbers each, got xyz {list(xyz)} and'
                f' rpy {list(rpy)}; correct it',
                code='pose_numbers',
            )
        return cls(frame_id, rotation_from_rpy(np.asarray(rpy)), np.asarray(xyz, float))

    def is_close(self, other: 'Transfer | None') -> bool:
        """
        Return whether another transfer has the same frames and the same pose.

        The pose is compared within a micrometre and a microradian.
        """
        return (
            other is not None
            and self.frame_id == other.frame_id
            and np.allclose(self.mat_ts, other.mat_ts, rtol=0, atol=1e-6)
            and np.allclose(self.arm_t, other.arm_t, rtol=0, atol=1e-6)
        )

    @cached_property
    def _quaternion_st(self) -> tuple[float, ...]:
        """Rotation from the target frame to the sensor frame, (x, y, z, w)."""
        from scipy.spatial.transform import Rotation  # here, because its import is slow

        return tuple(Rotation.from_matrix(self.mat_ts.T).as_quat().tolist())

    def turned_quaternion(self, quaternion: Sequence[float]) -> tuple[float, ...]:
        """
        Return the orientation of the target frame for that of the sensor, both (x, y, z, w).

        Zeros remain zeros.
        """
        px, py, pz, pw = quaternion
        qx, qy, qz, qw = self._quaternion_st
        # The product p q of quaternions.
        return (
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        )

    def turned_covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Return a covariance in the target frame, shape (3, 3)."""
        return self.mat_ts @ covariance @ self.mat_ts.T


def invertible(model: SensorModel) -> SensorModel:
    """Return the model with only those effects that compensation inverts."""
    exact: dict[str, tuple[str, ...]] = {section: () for section in SECTIONS}
    for effect in model.effects:
        if effect.compensation == 'exact':
            exact[effect.sensor] += (effect.name,)
    return replace(
        model, accelerometer=exact['accelerometer'], gyroscope=exact['gyroscope'], reference=()
    )


def invertible_values(calibration: FittedErrors) -> tuple[SensorModel, np.ndarray]:
    """Return (model, values) of the part of a calibration that compensation applies."""
    model = invertible(calibration.model)
    slices = calibration.model.slices
    values = np.concatenate([calibration.values[slices[effect.key]] for effect in model.effects])
    return model, values


def compensated_samples(
    calibration: FittedErrors,
    force_s: np.ndarray,
    rate_s: np.ndarray,
    *,
    alpha_s: np.ndarray,
    temperature_c: np.ndarray | None = None,
    thermal_branch: np.ndarray | None = None,
    vibration: np.ndarray | None = None,
    transfer: Transfer | None = None,
) -> Corrected:
    """
    Return corrected samples.

    Solves ``measured = output(true)`` for both sensors together by fixed-point steps
    ``x <- x + matrix^-1 (measured - output(x))``: gyroscope and accelerometer depend on one another
    through g-sensitivity and lever arms.

    Parameters
    ----------
    calibration : Calibration
        Effects to invert; effects of the table and of the session are ignored.
    force_s, rate_s : ndarray, shape (n, 3)
        Measured specific force (m/s^2) and rate (rad/s) in the sensor frame.
    alpha_s : ndarray, shape (n, 3)
        Angular acceleration in the sensor frame, rad/s^2 (see `angular_acceleration`).
    temperature_c : ndarray, shape (n,), optional
        Needed when the calibration has thermal effects.
    thermal_branch : ndarray, shape (n,), optional
        Thermal branch (`kinematics.signal_history`); zero if not given.
    vibration : ndarray, shape (n, 3), optional
        How much it vibrates (`kinematics.signal_history`), (m/s^2)^2; zero where not given.
    transfer : Transfer, optional
        Point and frame to move to: ``f_target = f_s - (alpha x r + omega x (omega x r))``.

    """
    model, values = invertible_values(calibration)
    if temperature_c is None and model.needs_temperature:
        raise InputError(
            'the calibration has thermal effects and needs temperatures, none were received;'
            ' provide imu/temperature',
            code='temperature_missing',
        )
    readings = Reference(
        time=np.zeros(len(force_s)),
        mat_sn=np.broadcast_to(np.eye(3), (len(force_s), 3, 3)),
        force_s=force_s,
        rate_s=rate_s,
        alpha_s=alpha_s,
        gravity=0.0,
        temperature_c=temperature_c,
        branch=thermal_branch,
        shaking=vibration,
    )
    with np.errstate(over='ignore', invalid='ignore'):
        force, rate, last_step = _invert(model, values, readings)
    is_diverged = last_step > CONVERGED
    force[is_diverged] = np.nan
    rate[is_diverged] = np.nan
    marks = saturation_marks(calibration, force_s, rate_s)
    flagged = marks.any(axis=1) | is_diverged
    if transfer is not None:
        force, rate = at_target(transfer, force, rate, alpha_s=alpha_s)
    return Corrected(force, rate, flagged, marks)


def _invert(
    model: SensorModel, values: np.ndarray, readings: Reference
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return true force, true rate, and the size of the last fixed-point step of each sample.

    Shapes (n, 3), (n, 3), (n,). The step is infinite where it overflows, and NaN for a reading that
    is not finite. `readings` has the measured force and rate in place of the true ones.
    """
    measured = {'accelerometer': readings.force_s, 'gyroscope': readings.rate_s}
    # First guess: bias and matrix inverted, without the other effects.
    inverse = {}
    true = {}
    for sensor in SENSORS:
        bias = model.value(sensor, Role.OFFSET, values)
        matrix = model.value(sensor, Role.LINEAR, values)
        assert matrix is not None and bias is not None, 'every model has both'
        inverse[sensor] = np.linalg.inv(matrix)
        true[sensor] = (measured[sensor] - bias) @ inverse[sensor].T
    for _ in range(MAX_INVERSION_STEPS):
        change = np.zeros(len(readings))
        for sensor in ('gyroscope', 'accelerometer'):
            motion = replace(readings, force_s=true['accelerometer'], rate_s=true['gyroscope'])
            residual = measured[sensor] - sensor_output(model, sensor, values, ref=motion)
            step = residual @ inverse[sensor].T
            true[sensor] = true[sensor] + step
            change = np.maximum(change, np.max(np.abs(step), axis=1, initial=0.0))
        # No more than rounding.
        if np.max(change, initial=0.0) < 1e-14:
            break
    # Finite readings have no finite step where the iteration overflowed.
    is_finite = np.isfinite(np.hstack([readings.force_s, readings.rate_s])).all(axis=1)
    change = np.where(np.isnan(change) & is_finite, np.inf, change)
    return true['accelerometer'], true['gyroscope'], change


def at_target(
    transfer: Transfer, force_s: np.ndarray, rate_s: np.ndarray, *, alpha_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (force, rate) at the target point in the target frame, each shape (n, 3).

    ``force = mat_ts f - (alpha x r + omega x (omega x r))`` with r = `Transfer.arm_t`, and omega
    and alpha in the target frame.
    """
    force_t = force_s @ transfer.mat_ts.T
    rate_t = rate_s @ transfer.mat_ts.T
    alpha_t = alpha_s @ transfer.mat_ts.T
    return force_t - lever_matrix(rate_t, alpha_t) @ transfer.arm_t, rate_t


def saturation_level(calibration: FittedErrors, sensor: str) -> float:
    """
    Return the reading from which a sensor counts as saturated.

    It is infinite without a saturation in the calibration.
    """
    level = calibration.of(sensor, Role.LIMIT)
    return np.inf if level is None else float(level) * (1 - 1e-6)


def saturation_marks(
    calibration: FittedErrors, force_s: np.ndarray, rate_s: np.ndarray
) -> np.ndarray:
    """
    Return the variances of `Corrected.marks` for measured force and rate, shape (n, 2).

    Of a sample of which a component reaches the saturation level, it is the square of this level:
    the true value may lie anywhere beyond. Of other samples it is 0.
    """
    marks = np.zeros((len(force_s), 2))
    for k, (sensor, measured) in enumerate(zip(SENSORS, (force_s, rate_s))):
        level = saturation_level(calibration, sensor)
        if np.isfinite(level):
            marks[np.any(np.abs(measured) >= level, axis=1), k] = level**2
    return marks


def arms_of(calibration: FittedErrors) -> np.ndarray:
    """Return the corrected arms, shape (3, 3), zero without a size effect."""
    arms = calibration.of('accelerometer', Role.ARMS)
    return np.zeros((3, 3)) if arms is None else arms


def outside_conditions(
    calibration: FittedErrors, fastest: float = 0.0, temperature_c: Sequence[float] | None = None
) -> list[str]:
    """
    Return lines on a largest rate (rad/s) and temperatures outside the range of the calibration.
    """
    # A tenth and 0.1 rad/s above the largest calibrated rate are tolerated, and 5 K outside the
    # calibrated temperatures.
    lines = []
    calibrated_rate = calibration.conditions.get('largest_rate')
    if calibrated_rate is not None and fastest > 1.1 * calibrated_rate + 0.1:
        lines.append(
            f'the rate reaches {fastest:.2f} rad/s, the calibration saw {calibrated_rate:.2f};'
            ' calibrate up to the rates of use'
        )
    limits = calibration.conditions.get('temperature_range_c')
    if limits and temperature_c:
        low = min(temperature_c)
        high = max(temperature_c)
        if low < limits[0] - 5 or high > limits[1] + 5:
            lines.append(
                f'the temperature runs from {low:.1f} to {high:.1f} C, the calibration saw'
                f' {limits[0]:.1f} to {limits[1]:.1f} C; calibrate there'
            )
    return lines
