"""Rates and specific forces compared with those of the joints."""

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np

from imu_calibration.core.scales import IMPOSSIBLE, scale_range
from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import refuse
from imu_calibration.preprocessing.frozen_joints import (
    BESIDE_JUMP,
    JointRest,
    find_jumps,
    jump_finding,
    outside_of,
    standing_still,
)
from imu_calibration.preprocessing.joint_geometry import mount_rpy_deg
from imu_calibration.preprocessing.on_table import (
    TESTED_RATE,
    AxisMatch,
    ProductSums,
    exchanged,
    find_exchange,
    match_axes,
    same_motion,
    signs_or_delay,
)
from imu_calibration.preprocessing.recording_evidence import REFUSE, CheckFinding
from imu_calibration.preprocessing.value_checks import force_error, wrong_rate_unit
from imu_calibration.preprocessing.window import Window

LEAST_POWER_SHARE = {'accelerometer': 0.03, 'gyroscope': 0.01}
"""Directions in which the reference has less than this share of its largest power are not used."""
RELATED = 0.5
"""Smallest squared correlation for a check of factors and axes."""
WORDS = {
    'accelerometer': ('specific force at rest', 'gravity in the attitudes of the joints'),
    'gyroscope': ('angular rates', 'the rates of the joints'),
}
"""Sensor -> its readings and their reference in messages."""


NO_EXCHANGE = 'no exchange of axes makes them so'


class Reduced(Protocol):
    """Reduced data of a recording: `SessionData`."""

    @property
    def accumulator(self) -> Any:
        """The `references.turntable.accumulator.Accumulator` of its windows."""

    @property
    def absent(self) -> tuple[str, ...]:
        """Sensors without readings."""

    @property
    def moving(self) -> list:
        """Moving windows with kept samples."""

    @property
    def poses(self) -> list:
        """(time, session, joint positions) of windows at rest."""


def against_joints(gathered: Reduced, model: SensorModel, table: Table) -> tuple[CheckFinding, ...]:
    """
    Return the findings of a comparison of measured rates and forces with those of the joints.

    Parameters
    ----------
    gathered : Reduced
        Windows of a recording.
    model : SensorModel
        Defines the columns.
    table : Table
        Gives the mount that would fit.

    """
    findings: list[CheckFinding] = []
    for sensor in ('gyroscope', 'accelerometer'):
        if sensor in gathered.absent:
            continue
        sums = _product_sums(gathered.accumulator, model, sensor)
        if sums is not None:
            if sensor == 'gyroscope':
                rests = _rests(gathered)
                findings += _rate_findings(sums, gathered.moving, table, rests=rests)
            findings += _axis_findings(sensor, sums, table, gathered.moving)
    return tuple(findings)


def _product_sums(accumulator: Any, model: SensorModel, sensor: str) -> ProductSums | None:
    """
    Return the sums of products of rates, or of specific forces at rest; None without motion.

    The rates are without their mean in windows, weighted by samples; those of the samples within
    windows are added.
    """
    # Columns of a row: those of the model, of which `part` are the reference; then the readings.
    part = model.columns_of(sensor, Role.LINEAR)
    is_gyroscope = sensor == 'gyroscope'
    rows = [row for row in accumulator.rows if is_gyroscope or row.kind == 'static']
    if not rows:
        return None
    weight = np.array([row.count if is_gyroscope else 1.0 for row in rows])
    means = np.array([row.sensors[sensor].mean for row in rows])
    if is_gyroscope:
        means = means - weight @ means / weight.sum()  # the bias
    # Sums of products of all columns. Within windows they follow from triangular factors.
    total = (means * weight[:, None]).T @ means
    if is_gyroscope:
        for (name, _), factor in accumulator.within.items():
            if name == 'gyroscope':
                total = total + factor.T @ factor
        samples = sum(accumulator.samples.values())
        if np.trace(total[part, part]) < TESTED_RATE**2 * max(samples, 1):
            return None
    return ProductSums(
        cross=total[-3:, part], reference=total[part, part], measured=total[-3:, -3:]
    )


def _seen_directions(sensor: str, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the projector on the directions with enough reference power, and the inverse there.

    `reference`: sums of products of the reference with itself; all of shape (3, 3).
    """
    values, vectors = np.linalg.eigh(reference)
    is_seen = values > LEAST_POWER_SHARE[sensor] * values.max()
    vectors = vectors[:, is_seen]
    return vectors @ vectors.T, vectors @ np.diag(1.0 / values[is_seen]) @ vectors.T


def _rests(gathered: Reduced) -> list[JointRest]:
    """Return the windows at rest of which the joint positions are kept."""
    positions = {(time, session): position for time, session, position in gathered.poses}
    rests = []
    for row in gathered.accumulator.rows:
        position = positions.get((row.time, row.session))
        if row.kind == 'static' and position is not None:
            half = 0.5 * row.duration
            rate_s = row.sensors['gyroscope'].mean[-3:]
            rests.append(JointRest(row.time - half, row.time + half, row.count, position, rate_s))
    return rests


def _rate_findings(
    sums: ProductSums, windows: list[Window], table: Table, *, rests: Sequence[JointRest] = ()
) -> list[CheckFinding]:
    """Return the finding of rates that are not those of the joints, apart from the IMU axes."""
    # A jump adds rates of no motion, which the other checks must not see.
    jumps = find_jumps(windows, table)
    if jumps:
        spans = [(jump.start, jump.stop) for jump in jumps]
        windows = outside_of(windows, spans, margin=BESIDE_JUMP)
    else:
        unit_findings = list(_rate_units(sums))
        if unit_findings:
            return unit_findings

    exchange = find_exchange(windows, table)
    if exchange and not exchange.joints and exchange.span is None:
        return []  # `_axis_findings` reports turned or exchanged axes, with the mount that fits
    finding = exchanged(exchange, windows, table) if exchange else None
    finding = finding or standing_still(windows, table, rests=rests)
    if finding is None and jumps:
        finding = jump_finding(jumps)
    finding = finding or same_motion(sums, windows, table)
    return [] if finding is None else [finding]


def _rate_units(sums: ProductSums) -> Iterator[CheckFinding]:
    """Yield the finding of rates or joint positions in another unit, by the ratio of their rms."""
    measured_power = np.trace(sums.measured)
    reference_power = np.trace(sums.reference)
    ratio = np.sqrt(measured_power / reference_power)
    if not ratio > 0:
        return
    if 40 < ratio < 80:
        yield wrong_rate_unit(
            f'angular rates must be in rad/s, they are {ratio:.1f} times those of the joints:'
            ' probably deg/s; convert them in the driver',
            'deg/s',
        )
    elif 1 / 80 < ratio < 1 / 40:
        yield CheckFinding(
            'rate_unit',
            REFUSE,
            f'joint positions must be in radians, the joints turn {1 / ratio:.1f} times as fast as '
            'the IMU: probably degrees; convert them in the driver of the table',
        )
    elif (
        scale_range(ratio) is IMPOSSIBLE
        and np.linalg.norm(sums.cross) ** 2 > RELATED * measured_power * reference_power / 3
    ):
        yield wrong_rate_unit(
            f'angular rates must be in rad/s, they are {ratio:.4g} times the rates of the joints:'
            ' counts or volts?; convert them in the driver'
        )


def _axis_findings(
    sensor: str, sums: ProductSums, table: Table, windows: list[Window]
) -> Iterator[CheckFinding]:
    """Yield the finding of a sensor with other axes than the table, from a fit by least squares."""
    seen, inverse = _seen_directions(sensor, sums.reference)
    matrix = sums.cross @ inverse
    if np.trace(matrix @ sums.reference @ matrix.T) < RELATED * np.trace(sums.measured):
        return  # a different fault dominates the readings and is reported by other checks
    match = match_axes(matrix, seen)
    if not match.wrong:
        return
    # Rates of the opposite sign may be half a period late.
    delay = None
    if sensor == 'gyroscope' and match.turned and match.mirrored:
        delay = signs_or_delay(windows, table)
    if delay and delay.sure:
        yield CheckFinding('on_table', REFUSE, f'both streams must share one clock: {delay.words}')
        return
    readings, reference_readings = WORDS[sensor]
    yield CheckFinding(
        'handedness',
        REFUSE,
        f'{readings} must be {reference_readings}, {match.words(seen) or NO_EXCHANGE}:'
        f' {_cause(match, matrix, seen, table)}' + (f'; or {delay.words}' if delay else ''),
    )


def _cause(match: AxisMatch, matrix: np.ndarray, seen: np.ndarray, table: Table) -> str:
    """Return the cause of wrong axes and the remedy; `matrix`: measured per reference."""
    if match.turned and match.mirrored:
        return (
            'this recording does not separate a rotated sensor from a wrong sign; correct'
            ' mount.rpy_deg or the sign of a joint axis in the table, or the signs in the driver'
        )
    if match.mirrored:
        return (
            'left-handed axes, which no mounting explains; correct signs and order in the driver,'
            ' or the joint axes in the table'
        )
    fits = ''
    if np.trace(seen) > 2.5:
        # Rounded, then plus zero: no -0.
        angles_deg = np.round(mount_rpy_deg(matrix, table)) + 0.0
        listed = ', '.join(f'{angle:.0f}' for angle in angles_deg)
        fits = f', [{listed}] would fit'
    return f'the sensor is turned against the table; correct mount.rpy_deg in the table{fits}'


def check_units(gathered: Reduced, model: SensorModel, table: Table) -> None:
    """
    Refuse recordings with units other than SI, or with axes other than those of the table.

    Compares the length of the specific force at rest with gravity, and rates and forces with the
    values implied by the joints.

    Raises
    ------
    InputError
        With the likely unit, or the assignment of the axes.

    """
    rows = gathered.accumulator.rows
    static = [row for row in rows if row.kind == 'static']
    if static and 'accelerometer' not in gathered.absent:
        lengths = [np.linalg.norm(row.sensors['accelerometer'].mean[-3:]) for row in static]
        check_force(float(np.median(lengths)))
    refuse(against_joints(gathered, model, table))


def check_force(length: float) -> None:
    """Refuse a median length of the specific force at rest that is not gravity in m/s^2."""
    error = force_error(length)
    if error is not None:
        raise error
