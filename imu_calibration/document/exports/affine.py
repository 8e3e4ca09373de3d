"""
The largest IMU model of other programs.

Temperature-dependent offsets, matrices, response to specific force, lever arms.
"""

import re
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects import base
from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.expressions import ColumnGroup
from imu_calibration.kinematics.rotations import lever_matrix, rotations_from_quaternions


@dataclass(frozen=True)
class Capability:
    """One kind of effect of one sensor that a program can represent."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    role: Role = Role.TERM
    """Place of the effects in the sensor's equation."""
    groups: tuple[ColumnGroup, ...] = ()
    """Columns of the effects, for `Role.TERM`: one role has terms of many kinds."""
    own_axis: bool = False
    """Whether the program has only the diagonal of a matrix."""

    def covers(self, effect: Effect) -> bool:
        """Return whether an effect is of this kind."""
        if effect.sensor != self.sensor or effect.role is not self.role:
            return False
        return self.role is not Role.TERM or effect.groups == self.groups

    def represented(self, values: np.ndarray) -> np.ndarray:
        """Return the values of an effect that the program has: off-diagonal ones may be zero."""
        if not self.own_axis:
            return values
        diagonal = np.diag(values.reshape(3, 3))
        return np.diag(diagonal).reshape(values.shape)

    @property
    def effect(self) -> Effect:
        """The catalogue's effect of this kind."""
        return next(effect for effect in CATALOGUE.effects().values() if self.covers(effect))


def _both(**kind: Any) -> tuple[Capability, ...]:
    """Return the capability of this kind for each sensor."""
    return tuple(Capability(sensor, **kind) for sensor in SENSORS)


OFFSETS = _both(role=Role.OFFSET)
MATRICES = _both(role=Role.LINEAR)
SCALES = _both(role=Role.LINEAR, own_axis=True)
THERMAL_OFFSETS = _both(groups=(base.TEMPERATURE,))
G_SENSITIVITY = (Capability('gyroscope', Role.CROSS),)
ARMS = (Capability('accelerometer', Role.ARMS),)
SLOW_OFFSETS = OFFSETS + THERMAL_OFFSETS
"""Effects that an estimator with biases in its state estimates itself."""


def of(sensor: str, capabilities: Iterable[Capability]) -> tuple[Capability, ...]:
    """Return the capabilities of one sensor."""
    return tuple(capability for capability in capabilities if capability.sensor == sensor)


def capability_of(effect: Effect, capabilities: tuple[Capability, ...]) -> Capability | None:
    """Return the first capability that covers an effect, or None."""
    return next((capability for capability in capabilities if capability.covers(effect)), None)


def _zeros(*shape: int) -> Any:
    """Return a dataclass field with the default {sensor: zeros of this shape}."""
    return field(default_factory=lambda: {sensor: np.zeros(shape) for sensor in SENSORS})


@dataclass(frozen=True, eq=False, kw_only=True)
class AffineImu:
    """
    Sensor equation with bias, matrix, lever arms and cross terms.

    It is ``readings_i = bias_i + thermal_i (T - T0) + matrix_i @ (input + lever_matrix @ arm_i) +
    cross_i @ force``.

    The input is true specific force or rate at an origin, in some frame; the readings may have
    different axes.
    """

    bias: dict[str, np.ndarray] = _zeros(3)
    """Sensor -> readings at zero input, SI, shape (3,)."""
    matrix: dict[str, np.ndarray] = field(
        default_factory=lambda: {sensor: np.eye(3) for sensor in SENSORS}
    )
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

    def value(self, capability: Capability) -> np.ndarray:
        """Return the array of this IMU (no copy) with the values of one kind of effect."""
        for kinds, part in (
            (OFFSETS, self.bias),
            (MATRICES + SCALES, self.matrix),
            (THERMAL_OFFSETS, self.thermal),
        ):
            if capability in kinds:
                return part[capability.sensor]
        return self.cross if capability in G_SENSITIVITY else self.arms


def represented_values(
    calibration: Calibration, effect: Effect, capability: Capability | None
) -> np.ndarray:
    """
    Return the values of an effect as a program represents them, shape (size,).

    Without a capability the program has no such effect: the values are its prior.
    """
    values = calibration.values[calibration.model.slices[effect.key]]
    return effect.prior_values() if capability is None else capability.represented(values)


def imu_of_corrections(corrections: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> AffineImu:
    """
    Return the IMU of a program that computes ``corrected = C @ readings - d``.

    The inverse is ``readings = C^-1 @ corrected + C^-1 @ d``: matrix C^-1, bias C^-1 d.

    Parameters
    ----------
    corrections : dict
        Sensor -> (C, d), shapes (3, 3) and (3,). A sensor without an entry is perfect.

    Raises
    ------
    InputError
        When a matrix has no inverse (code `matrix_singular`).

    """
    matrix = {}
    bias = {}
    for sensor, (correction, offset) in corrections.items():
        try:
            inverse = np.linalg.inv(correction)
        except np.linalg.LinAlgError as error:
            raise InputError(
                f'the correction matrix of the {sensor} must have an inverse, got'
                f' {np.asarray(correction).tolist()}; calibrate again',
                code='matrix_singular',
            ) from error
        matrix[sensor] = inverse
        bias[sensor] = inverse @ offset
    perfect = AffineImu()
    return replace(perfect, matrix=perfect.matrix | matrix, bias=perfect.bias | bias)


def affine_of(calibration: Calibration, capabilities: tuple[Capability, ...]) -> AffineImu:
    """Return the IMU with those effects of a calibration that `capabilities` cover."""
    limits = calibration.conditions.get('temperature_range_c')
    imu = AffineImu(
        temperature_ref_c=calibration.model.temperature_ref_c,
        temperature_range_c=tuple(limits) if limits else None,
    )
    for capability in capabilities:
        for effect in filter(capability.covers, calibration.model.effects):
            values = represented_values(calibration, effect, capability)
            imu.value(capability)[...] = values.reshape(effect.shape)
    return imu


@dataclass(frozen=True, eq=False, kw_only=True)
class Placement:
    """Frame, origin and axes of readings of a program, relative to those of the calibration."""

    mat_ts: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Turns vectors of our sensor frame into the program's frame."""
    origin_s: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """From our origin to the program's, in our sensor frame, m."""
    mat_readings: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Turns our readings into the axes in which the program gets them."""

    def inverse(self) -> 'Placement':
        """Return the placement of the calibration relative to the program."""
        return Placement(
            mat_ts=self.mat_ts.T,
            origin_s=-self.mat_ts @ self.origin_s,
            mat_readings=self.mat_readings.T,
        )

    def readings(self, force: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings in the program's axes, each shape (n, 3)."""
        return force @ self.mat_readings.T, rate @ self.mat_readings.T

    def truth(
        self, force: np.ndarray, rate: np.ndarray, alpha: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return true specific force and rate at the program's origin in its frame, each shape (n, 3).
        """
        force_at_origin = force + lever_matrix(rate, alpha) @ self.origin_s
        return force_at_origin @ self.mat_ts.T, rate @ self.mat_ts.T


def calibration_moved(imu: AffineImu, to: Placement) -> AffineImu:
    """
    Return the same IMU in the frame, origin and axes of another program.

    With A = mat_readings, R = mat_ts, and ``f = R' f_t - lever_matrix @ origin_s``::

        bias_t = A bias,  matrix_t = A matrix R',  arms_t = |A| (arms - origin_s) R'

    |A| permutes the axes without their signs: an arm belongs to an axis of either sign. The effect
    of the change of origin on the gyroscope's response to specific force (a product of two small
    terms) is omitted.
    """
    bias = {}
    thermal = {}
    matrix = {}
    for sensor in SENSORS:
        bias[sensor] = to.mat_readings @ imu.bias[sensor]
        thermal[sensor] = to.mat_readings @ imu.thermal[sensor]
        matrix[sensor] = to.mat_readings @ imu.matrix[sensor] @ to.mat_ts.T
    arms = imu.arms
    if np.any(arms):  # zero arms are an effect that the model does not have
        arms = np.abs(to.mat_readings) @ ((arms - to.origin_s) @ to.mat_ts.T)
    return replace(
        imu,
        bias=bias,
        matrix=matrix,
        thermal=thermal,
        arms=arms,
        cross=to.mat_readings @ imu.cross @ to.mat_ts.T,
    )


PUBLISHER = 'static_transform_publisher'
POSE_NUMBERS = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
PARENT, CHILD = 'frame-id', 'child-frame-id'
UNNAMED = 'sensor_frame'
"""Name of the sensor frame where the calibration has none."""


def pose_line(placement: Placement, parent: str, child: str) -> str:
    """Return the command of tf2_ros that publishes the placement as a transform, all digits."""
    from scipy.spatial.transform import Rotation  # here, because its import is slow

    values = [*placement.origin_s, *Rotation.from_matrix(placement.mat_ts.T).as_quat()]
    arguments = {name: repr(float(value)) for name, value in zip(POSE_NUMBERS, values)}
    arguments[PARENT] = parent
    arguments[CHILD] = child
    words = [PUBLISHER]
    for name, argument in arguments.items():
        words.append(f'--{name} {shlex.quote(argument)}')
    return ' '.join(words)


def find_pose(content: bytes) -> tuple[Placement, str] | None:
    """
    Return (placement, name of our frame) from the first `pose_line` of a file.

    None without such a line, or if it cannot be read.
    """
    line = re.search(rf'{PUBLISHER} (.*)', content.decode(errors='replace'))
    try:
        # In a JSON file a quotation mark ends the line.
        words = shlex.split(line.group(1).partition('"')[0]) if line else []
        options = {}
        for name, value in zip(words, words[1:], strict=False):
            if name.startswith('--'):
                options[name.removeprefix('--')] = value
        values = np.array([float(options[name]) for name in POSE_NUMBERS])
        parent = options[PARENT]
    except (KeyError, ValueError):
        return None
    origin = values[:3]
    quaternion = values[3:]
    # Not a unit quaternion within 1 %: no pose.
    if not np.all(np.isfinite(values)) or not 0.99 < np.linalg.norm(quaternion) < 1.01:
        return None
    if parent == UNNAMED:
        parent = ''
    placement = Placement(mat_ts=rotations_from_quaternions(quaternion).T, origin_s=origin)
    return placement, parent


FRD = np.diag([1.0, -1.0, -1.0])
"""From forward-left-up, as in ROS, to forward-right-down, as in autopilots; its own inverse."""


def lower_times_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (L, Q) with ``matrix = L @ Q``: L lower triangular with positive diagonal, Q a rotation.

    Raises
    ------
    InputError
        When the axes of the matrix are left-handed.

    """
    if np.linalg.det(matrix) <= 0:
        raise InputError(
            'the axes of a sensor must be right-handed, the matrix of this calibration turns them'
            ' into their mirror image; check for an exchanged axis',
            code='left_handed',
        )
    # With matrix' = Q_0 R: L = R', Q = Q_0'; the signs make the diagonal of L positive.
    q, r = np.linalg.qr(matrix.T)
    signs = np.sign(np.diag(r))
    return np.tril((r * signs[:, None]).T), (q * signs).T


def as_mounted(_imu: AffineImu) -> Placement:
    """Return the placement of a program with unchanged axes."""
    return Placement()


def forward_right_down(readings: RawReadings) -> Placement:
    """
    Return the placement of an autopilot: readings and frame forward-right-down.

    With the matrix A of the source (forward-left-up = A source): ``diag(1, -1, -1) @ A``, the
    identity for readings that are forward-right-down already.

    Raises
    ------
    InputError
        When the axes of the readings are not stated.

    """
    mat_flu_source = readings.mat_flu_source()
    if mat_flu_source is None:
        raise InputError(
            'an export with forward-right-down axes needs the axes of the readings, the calibration'
            ' states none; state flu (forward-left-up, the convention of ROS) or frd'
            ' (forward-right-down, most autopilots)',
            key='axes',
            code='axes_missing',
        )
    mat_frd_source = FRD @ mat_flu_source
    return Placement(mat_ts=mat_frd_source, mat_readings=mat_frd_source)
