"""Checks of the joints, and of joints that stand still while the IMU turns."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from imu_calibration.core.samples import runs_of, smallest_step
from imu_calibration.core.scales import IMPOSSIBLE, scale_range
from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import refuse, span_words
from imu_calibration.preprocessing.joint_geometry import (
    description_error,
    is_unexplained,
    mount_rpy_deg,
    turned_rates,
)
from imu_calibration.preprocessing.on_table import (
    TESTED_RATE,
    AxisMatch,
    ProductSums,
    a_period_late,
    exchanged,
    find_exchange,
    match_axes,
    same_motion,
    signs_or_delay,
)
from imu_calibration.preprocessing.recording_evidence import REFUSE, CheckFinding
from imu_calibration.preprocessing.scan import MIN_TURN_RATE
from imu_calibration.preprocessing.value_checks import force_error, wrong_rate_unit
from imu_calibration.preprocessing.window import Window

LASTING = 1.0
"""Least duration of a standstill, s; shorter ones are handled by other checks."""
MAX_REPEATED_RATE = 1e-6
"""Largest rate of a joint with a repeated state after smoothing of the positions, rad/s."""
FROZEN_SHARE = 0.8
"""
Share of the unexplained rate that lies along the axis of a joint that is frozen, as a mean square.
"""
LEAST_GAIN_ERROR = 0.3
"""
The unexplained rate along that axis is at least this share of the measured rate along it: a wrong
gain causes less.
"""
SATURATED_SAMPLES = 50
"""Equal largest readings of one axis above which they are an end of its range."""
OFTEN = 0.25
"""
Share of repeated readings of one axis from which the steps of a gyroscope are coarser than its
noise.
"""


def standing_still(windows: Sequence[Window], table: Table) -> CheckFinding | None:
    """
    Return the finding of a joint or gyroscope that is frozen for a second in motion, or None.

    A joint is frozen when its state is constant while the gyroscope measures a rate about its axis
    that the other joints do not explain; a delay between the clocks or a wrong zero or axis in the
    table description that explains the rates of all windows is reported instead. A gyroscope with
    steps coarser than its noise may repeat a reading while the reference rate stays within one
    step.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    table : Table

    """
    windows = [
        window for window in windows if len(window) > 2 and len(window.motion) == len(window)
    ]
    if not windows:
        return None
    # 1. A frozen gyroscope.
    expected = _expected_rates(windows, table)
    differences = [window.rate_s - rate for window, rate in zip(windows, expected)]
    bias = np.median(np.concatenate(differences), axis=0)
    spans = _repeating_spans(windows, expected, bias)
    if spans:
        return CheckFinding(
            'frozen',
            REFUSE,
            f'the gyroscope must measure all the time, it repeats one reading {span_words(spans)} '
            'while the joints turn; check the sensor and its driver, and exclude that time',
        )
    # 2. A frozen joint.
    windows = _unsaturated(windows)
    if not windows:
        return None
    expected = _expected_rates(windows, table)
    as_described = [rate + bias for rate in expected]
    for k, name in enumerate(table.joint_names):
        spans = _frozen_spans(windows, table, as_described, joint=k)
        if not spans:
            continue
        other_cause = a_period_late(windows, table) or description_error(windows, table)
        if other_cause:
            return other_cause
        # An IMU that is turned against its mount measures the rates of other joints about this
        # axis too.
        turned = turned_rates(windows, expected)
        if turned is not None:
            spans = _frozen_spans(windows, table, turned, joint=k)
        if spans:
            return CheckFinding(
                'frozen',
                REFUSE,
                f'joint states must follow the table, {name} is constant {span_words(spans)} while'
                ' the IMU turns about its axis; check the driver of the table, and exclude that'
                ' time',
            )
    # 3. An error of the table description without a frozen joint.
    return description_error(windows, table) if is_unexplained(windows, expected) else None


def _repeating_spans(
    windows: Sequence[Window], expected: Sequence[np.ndarray], bias: np.ndarray
) -> list[tuple[float, float]]:
    """
    Return (start, stop) in which the gyroscope repeats one reading while the joints turn, s.

    Not where the reading is the expected rate of the joints, rad/s, plus the bias, rounded to the
    steps of a coarse gyroscope.
    """
    is_repeated = [np.diff(window.rate_s, axis=0) == 0 for window in windows]
    # A gyroscope that often repeats readings is coarse, and has the smallest step between them.
    step = np.zeros(3)
    if np.concatenate(is_repeated).mean() > OFTEN:
        step = np.min([smallest_step(window.rate_s) for window in windows], axis=0)
        known = np.isfinite(step)  # an axis without motion has the steps of the other axes
        step = np.where(known, step, step[known].max(initial=0.0))
    spans = []
    for window, repeated, rate in zip(windows, is_repeated, expected):
        turns = np.linalg.norm(rate, axis=1) > MIN_TURN_RATE
        # Samples `start` to `stop` - 1 are equal to the sample after them.
        for start, stop in runs_of(np.append(repeated.all(axis=1), False)):
            first = float(window.time[start])
            last = float(window.time[stop - 1])
            if last - first < LASTING or turns[start:stop].mean() <= 0.5:
                continue
            if not _is_rounded(window.rate_s[start], rate[start:stop], bias, step):
                spans.append((first, last))
    return _joined(spans)


def _expected_rates(windows: Sequence[Window], table: Table) -> list[np.ndarray]:
    """Return the rates of the sensor by the joints in each window, rad/s, shape (n, 3)."""
    return [reference_motion(table, window.motion, attitude=False).rate_s for window in windows]


def _unsaturated(windows: Sequence[Window]) -> list[Window]:
    """
    Return the windows in which no rate is at an end of its range.

    The missing part of a saturated rate may lie along the axis of a joint that rests.
    """
    rates = np.concatenate([window.rate_s for window in windows])
    # Whether each reading is the smallest, or the largest, of its axis, shape (2, n, 3).
    ends = np.stack([rates.min(axis=0), rates.max(axis=0)])
    at_end = rates == ends[:, None]
    # Of noisy readings one is the largest; an end of the range is reached again and again.
    is_limit = at_end.sum(axis=1) > SATURATED_SAMPLES
    saturated = (at_end & is_limit[:, None]).any(axis=(0, 2))
    parts = np.split(saturated, np.cumsum([len(window) for window in windows])[:-1])
    return [window for window, part in zip(windows, parts) if not part.any()]


def _frozen_spans(
    windows: Sequence[Window], table: Table, expected: Sequence[np.ndarray], *, joint: int
) -> list[tuple[float, float]]:
    """Return the joined spans of all windows in which a joint is frozen."""
    spans = []
    for window, rate in zip(windows, expected):
        spans += _frozen(window, table, rate, joint=joint)
    return _joined(spans)


def _frozen(
    window: Window, table: Table, expected: np.ndarray, *, joint: int
) -> Iterator[tuple[float, float]]:
    """
    Yield (start, stop) in which a joint's state is constant while the IMU turns about its axis, s.

    The residual, measured minus expected rates, (n, 3), rad/s, is along the axis in that time.
    """
    for start, stop in runs_of(np.abs(window.motion.rate[:, joint]) < MAX_REPEATED_RATE):
        if window.time[stop - 1] - window.time[start] < LASTING:
            continue
        # The axis of the joint in the sensor frame: change of the rates for 1 rad/s more.
        motion = window.motion.select(slice(start, stop))
        joint_rates = motion.rate.copy()
        joint_rates[:, joint] += 1.0
        faster = replace(motion, rate=joint_rates)
        axis = (
            reference_motion(table, faster, attitude=False).rate_s
            - reference_motion(table, motion, attitude=False).rate_s
        )
        # A late clock turns the rates of the other joints about this axis too: without the lag.
        residual = (window.rate_s - expected)[start:stop]
        slope = np.gradient(expected[start:stop], window.time[start:stop], axis=0)
        lag = (residual * slope).sum() / max((slope**2).sum(), 1e-300)
        residual = residual - lag * slope

        residual_along = (residual * axis).sum(axis=1)
        measured_along = (window.rate_s[start:stop] * axis).sum(axis=1)
        square_along = float(residual_along @ residual_along)
        if (
            square_along > len(residual_along) * MIN_TURN_RATE**2
            and square_along > FROZEN_SHARE * (residual**2).sum()
            and square_along > LEAST_GAIN_ERROR**2 * (measured_along @ measured_along)
        ):
            yield float(window.time[start]), float(window.time[stop - 1])


def _is_rounded(
    reading: np.ndarray, expected: np.ndarray, bias: np.ndarray, step: np.ndarray
) -> bool:
    """
    Return whether one reading, (3,), is that of all expected rates, (n, 3), with a coarse step.

    The rates vary by at most one step per axis, (3,). The reading differs from rate plus bias by at
    most one step, and by the share of the rates that wrong gains and axes cause.
    """
    error = np.linalg.norm(reading - expected - bias, axis=1)
    allowed = np.linalg.norm(step) + LEAST_GAIN_ERROR * np.linalg.norm(expected, axis=1)
    return bool((np.ptp(expected, axis=0) <= step).all() and (error <= allowed).all())


def _joined(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return spans in order, merged where the gap is below a second."""
    joined: list[tuple[float, float]] = []
    for start, stop in sorted(spans):
        if joined and start - joined[-1][1] < LASTING:
            joined[-1] = (joined[-1][0], max(stop, joined[-1][1]))
        else:
            joined.append((start, stop))
    return joined


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
                findings += _rate_findings(sums, gathered.moving, table)
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


def _rate_findings(sums: ProductSums, windows: list[Window], table: Table) -> list[CheckFinding]:
    """Return the finding of rates that are not those of the joints, apart from the IMU axes."""
    unit_findings = list(_rate_units(sums))
    if unit_findings:
        return unit_findings
    exchange = find_exchange(windows, table)
    if exchange and not exchange.joints and exchange.span is None:
        return []  # `_axis_findings` reports turned or exchanged axes, with the mount that fits
    finding = exchanged(exchange, windows, table) if exchange else None
    finding = finding or standing_still(windows, table) or same_motion(sums, windows, table)
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
