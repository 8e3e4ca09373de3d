"""The largest IMU model of other programs: temperature-dependent offsets, matrices, response to specific force, lever arms."""

from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.calibration.document import Calibration
from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.exports.holdings import G_SENSITIVITY, MATRICES, OFFSETS, SCALES, THERMAL_OFFSETS, Holding
from imu_calibration.reference.reference_motion import lever_matrix


def _zeros(*shape):
    return field(default_factory=lambda: {sensor: np.zeros(shape) for sensor in SENSORS})


@dataclass(frozen=True, eq=False, kw_only=True)
class AffineImu:
    """
    ``readings_i = bias_i + thermal_i (T - T0) + matrix_i @ (input + lever_matrix @ arm_i) + cross_i @ force``.

    The input is true specific force or rate at an origin, in some frame; the readings may have different axes.
    """

    bias: dict[str, np.ndarray] = _zeros(3)
    """Sensor -> readings at zero input, SI, shape (3,)."""
    matrix: dict[str, np.ndarray] = field(default_factory=lambda: {sensor: np.eye(3) for sensor in SENSORS})
    """Sensor -> response to the input, shape (3, 3)."""
    thermal: dict[str, np.ndarray] = _zeros(3)
    """Sensor -> change of the bias with temperature, SI per K, shape (3,)."""
    cross: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Response of the gyroscope to specific force, (rad/s)/(m/s^2), shape (3, 3)."""
    arms: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Row i: from the origin to the sensitive point of accelerometer i, m, shape (3, 3)."""
    temperature_ref_c: float = 25.0
    """T0, degrees Celsius."""
    temperature_range_c: tuple[float, float] | None = None
    """Where the thermal part was measured, degrees Celsius; None: not known."""

    def value(self, holding: Holding) -> np.ndarray:
        """Return the values of the effects of one kind."""
        for kinds, part in ((OFFSETS, self.bias), (MATRICES + SCALES, self.matrix), (THERMAL_OFFSETS, self.thermal)):
            if holding in kinds:
                return part[holding.sensor]
        return self.cross if holding in G_SENSITIVITY else self.arms


def held_values(calibration: Calibration, effect: Effect, holding: Holding | None) -> np.ndarray:
    """Return the values of an effect as the target represents them: its prior where it is not represented, shape (size,)."""
    values = calibration.values[calibration.model.slices[effect.key]]
    return effect.prior_values() if holding is None else holding.held(values)


def affine_of(calibration: Calibration, holdings: tuple[Holding, ...]) -> AffineImu:
    """Return that part of a calibration which lies in `holdings`."""
    limits = calibration.conditions.get('temperature_range_c')
    found = AffineImu(temperature_ref_c=calibration.model.temperature_ref_c, temperature_range_c=tuple(limits) if limits else None)
    for holding in holdings:
        for effect in filter(holding.covers, calibration.model.effects):
            found.value(holding)[...] = held_values(calibration, effect, holding).reshape(effect.shape)
    return found


@dataclass(frozen=True, eq=False, kw_only=True)
class Placement:
    """Frame, origin and axes of readings of a program, against ours."""

    mat_ts: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Turns vectors of our sensor frame into the program's frame."""
    origin_s: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """From our origin to the program's, in our sensor frame, m."""
    mat_readings: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Turns our readings into the axes in which the program gets them."""

    def inverse(self) -> 'Placement':
        """Return the placement that undoes this one."""
        return Placement(mat_ts=self.mat_ts.T, origin_s=-self.mat_ts @ self.origin_s, mat_readings=self.mat_readings.T)

    def readings(self, force: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings in the program's axes, each shape (n, 3)."""
        return force @ self.mat_readings.T, rate @ self.mat_readings.T

    def truth(self, force: np.ndarray, rate: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return true specific force and rate at the program's origin in its frame, each shape (n, 3)."""
        return (force + lever_matrix(rate, alpha) @ self.origin_s) @ self.mat_ts.T, rate @ self.mat_ts.T


def moved(imu: AffineImu, to: Placement) -> AffineImu:
    """
    Return the same IMU in the frame, origin and axes of another program.

    With ``f = mat_ts' f_t - lever_matrix @ origin_s``; the effect of the change of origin on the gyroscope's response to specific force
    (a product of two small terms) is omitted.
    """
    turned = {sensor: to.mat_readings @ imu.matrix[sensor] @ to.mat_ts.T for sensor in SENSORS}
    arms = np.abs(to.mat_readings) @ ((imu.arms - to.origin_s) @ to.mat_ts.T) if np.any(imu.arms) else imu.arms
    bias, thermal = ({sensor: to.mat_readings @ part[sensor] for sensor in SENSORS} for part in (imu.bias, imu.thermal))
    return replace(imu, bias=bias, matrix=turned, thermal=thermal, arms=arms, cross=to.mat_readings @ imu.cross @ to.mat_ts.T)
