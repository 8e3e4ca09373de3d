"""Errors of a table description that explain rates which the joints do not explain."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.rotations import (
    Reference,
    nearest_rotation,
    rotation,
    rpy_from_rotation,
)
from imu_calibration.kinematics.table import Table, axis_error_directions
from imu_calibration.preprocessing.recording_evidence import REFUSE, CheckFinding
from imu_calibration.preprocessing.window import MotionReadings, Window, motion_readings

MAX_SAMPLES = 2_000
"""Samples that are compared."""
LARGEST_UNEXPLAINED = 0.01
"""Largest unexplained share of the squared rates with a description that counts as correct."""
LEAST_IMPROVEMENT = 10.0
"""A correction of the description divides the unexplained share at least by this factor."""
LEAST_SPAN = 0.1
"""Rates span three directions from this ratio of their smallest to their largest rms on."""
SAME_AXIS = np.radians(0.5)
"""A fitted axis that is nearer to a coordinate axis is that coordinate axis, rad."""
FIRST_ANGLE = 1e-3
"""Start of a fit, rad: joints about coordinate axes have no derivative, they are simplified."""
MAX_EVALUATIONS = 20
"""Linearisations of one fit of zeros or axes."""
TIED_FACTOR = 2.0
"""
Corrections within this factor of the smallest unexplained share of the rates are separated by the
specific force: rates do not show which way is up, nor how the IMU is mounted.
"""


@dataclass(frozen=True, eq=False)
class Correction:
    """A change of the table description, with the squared readings that it does not explain."""

    words: str
    """The change."""
    rate_share: float
    """Unexplained share of the squared rates."""
    force_share: float
    """Unexplained share of the squared specific forces, with the mount of the table."""


def _rate_residual(readings: MotionReadings, table: Table, motion: JointMotion) -> np.ndarray:
    """Return the residual of the rates with a table and a motion, rad/s, shape (n, 3)."""
    return _residual(readings.rate_s, reference_motion(table, motion, attitude=False))


def _correction(
    words: str, readings: MotionReadings, table: Table, motion: JointMotion
) -> Correction:
    """Return a change of the table and of the motion with its unexplained shares."""
    reference = reference_motion(table, motion)
    return Correction(
        words,
        _share(_residual(readings.rate_s, reference), readings.rate_s),
        _share(readings.force_s - reference.force_s, readings.force_s),
    )


def _residual(rate: np.ndarray, reference: Reference) -> np.ndarray:
    """
    Return ``w - b - M r - D r'`` with b, M and D of least squares, rad/s, shape (n, 3).

    With the measured rates w, and rates r and accelerations r' of a `Reference`; D models a delay.
    """
    design = np.column_stack([np.ones(len(rate)), reference.rate_s, reference.alpha_s])
    return rate - design @ np.linalg.lstsq(design, rate, rcond=1e-6)[0]


def _share(residual: np.ndarray, measured: np.ndarray) -> float:
    """Return ``sum |residual|^2 / sum |measured - mean|^2``, the unexplained share."""
    return float((residual**2).sum() / ((measured - measured.mean(axis=0)) ** 2).sum())


def is_unexplained(windows: Sequence[Window], expected: Sequence[np.ndarray]) -> bool:
    """
    Return whether more of the rates is unexplained than with a correct description of the table.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    expected : sequence of arrays, shape (n, 3)
        Rates of the joints in each window, rad/s; the matrix and bias of the sensor are free.

    """
    measured, matrix, bias = _sensor_fit(windows, expected)
    residual = measured - np.concatenate(expected) @ matrix.T - bias
    return _share(residual, measured) > LARGEST_UNEXPLAINED


def unexplained_share(windows: Sequence[Window], table: Table) -> float:
    """
    Return the share of the squared rates in moving windows that the joints do not explain.

    Bias and matrix of the sensor and a small delay are free, as in `description_error`.
    """
    readings = motion_readings(windows, MAX_SAMPLES)
    return _share(_rate_residual(readings, table, readings.motion), readings.rate_s)


def _sensor_fit(
    windows: Sequence[Window], expected: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (measured rates, matrix, bias) of ``measured = M r + b`` with least squares."""
    measured = np.concatenate([window.rate_s for window in windows])
    design = np.insert(np.concatenate(expected), 0, 1.0, axis=1)
    solution = np.linalg.lstsq(design, measured, rcond=1e-6)[0]
    return measured, solution[1:].T, solution[0]


def description_error(windows: Sequence[Window], table: Table) -> CheckFinding | None:
    """
    Return the finding of a wrong zero or axis of a joint in the table description, or None.

    The rates w of the gyroscope are compared with those of the joints, r(p), for changes p of the
    description. Bias b and matrix M of the sensor, its mount included, and a small delay D are
    free::

        unexplained(p) = min over b, M, D of  sum |w - b - M r(p) - D r'(p)|^2 / sum |w - mean w|^2

    A change is reported if almost nothing is unexplained with it, and much more without it; changes
    of several zeros and axes together only where no single one suffices. A joint that is frozen for
    a time is not explained by any change of the description.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    table : Table

    """
    windows = [window for window in windows if 2 < len(window) == len(window.motion)]
    if not windows:
        return None
    readings = motion_readings(windows, MAX_SAMPLES)
    if not _spans_three(readings.rate_s):  # many descriptions have the same rates about one axis
        return None
    as_described = _correction('', readings, table, readings.motion)
    largest_share = min(LARGEST_UNEXPLAINED, as_described.rate_share / LEAST_IMPROVEMENT)
    corrections = list(_corrections(readings, table))
    smallest = min(correction.rate_share for correction in corrections)
    if smallest > largest_share:
        corrections = [_correction_of_several(readings, table)]
        smallest = corrections[0].rate_share
    if smallest > largest_share:
        return None
    tied = [
        correction for correction in corrections if correction.rate_share <= TIED_FACTOR * smallest
    ]
    best = min(tied, key=lambda correction: correction.force_share)
    return CheckFinding(
        'on_table',
        REFUSE,
        'zeros and axes of the joints must be those of the table description, the joints explain'
        f' {100 * (1 - as_described.rate_share):.1f} % of the rates as described and'
        f' {100 * (1 - best.rate_share):.1f} % if {best.words}; correct the table description, or'
        ' the zero in its driver',
        key='table',
    )


def _corrections(readings: MotionReadings, table: Table) -> Iterator[Correction]:
    """Yield the best change of the zeros, then another axis of each joint."""
    zero_names = table.joint_names.zeros
    if zero_names:
        zeros = _fit_angles(
            lambda zeros: _rate_residual(readings, table, _shifted(readings.motion, table, zeros)),
            len(zero_names),
        )
        words = ', '.join(
            f'{name} reads {np.degrees(-zero):.2f} deg too much'
            for name, zero in zip(zero_names, zeros)
        )
        yield _correction(words, readings, table, _shifted(readings.motion, table, zeros))
    for k, name in enumerate(table.joint_names):
        axes = [*_other_axes(np.array(table.joints[k].axis)), _fit_axis(readings, table, k)]
        for axis in axes:
            decimals = 0 if _is_coordinate_axis(axis) else 3
            shown = ', '.join(f'{value + 0.0:.{decimals}f}' for value in axis)
            yield _correction(
                f'the axis of {name} is [{shown}]',
                readings,
                with_axis(table, k, axis),
                readings.motion,
            )


def _correction_of_several(readings: MotionReadings, table: Table) -> Correction:
    """Return the change of all zeros and axes together that explains most of the rates."""
    n_zeros = len(table.joint_names.zeros)

    def changed(angles: np.ndarray) -> tuple[Table, JointMotion]:
        """Return table and motion with changed zeros, then two angles of each axis, rad."""
        changed_table = table
        for k, axis_angles in enumerate(angles[n_zeros:].reshape(-1, 2)):
            changed_table = with_axis(changed_table, k, _turned_axis(table, k, axis_angles))
        return changed_table, _shifted(readings.motion, table, angles[:n_zeros])

    angles = _fit_angles(
        lambda angles: _rate_residual(readings, *changed(angles)),
        n_zeros + 2 * len(table.joints),
    )
    return _correction('several of them are changed', readings, *changed(angles))


def _fit_angles(residual: Callable[[np.ndarray], np.ndarray], n_parameters: int) -> np.ndarray:
    """Return the angles x, rad, with the least ``sum |residual(x)|^2``, from almost zero."""
    from scipy.optimize import least_squares  # here, because its import is slow

    start = np.full(n_parameters, FIRST_ANGLE)
    return least_squares(lambda x: residual(x).ravel(), start, max_nfev=MAX_EVALUATIONS).x


def _shifted(motion: JointMotion, table: Table, zeros: np.ndarray) -> JointMotion:
    """Return the motion with `zeros`, rad, added to the angles of the joints that have one."""
    position = motion.position.copy()
    position[:, [table.joint_names.index(name) for name in table.joint_names.zeros]] += zeros
    return replace(motion, position=position)


def _turned_axis(table: Table, joint: int, angles: np.ndarray) -> np.ndarray:
    """Return the axis of a joint, turned by two angles about the directions across it, rad."""
    axis = np.array(table.joints[joint].axis)
    return rotation(angles @ axis_error_directions(axis)) @ axis


def _fit_axis(readings: MotionReadings, table: Table, joint: int) -> np.ndarray:
    """Return the axis of one joint that explains most of the rates, any unit vector."""

    def residual(angles: np.ndarray) -> np.ndarray:
        turned_table = with_axis(table, joint, _turned_axis(table, joint, angles))
        return _rate_residual(readings, turned_table, readings.motion)

    axis = _turned_axis(table, joint, _fit_angles(residual, 2))
    return np.round(axis) if _is_coordinate_axis(axis) else axis


def _is_coordinate_axis(axis: np.ndarray) -> bool:
    """Return whether a unit vector is a coordinate axis, or the fit of one."""
    return np.linalg.norm(axis - np.round(axis)) < SAME_AXIS


def _other_axes(axis: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the coordinate axes of either sign that are more than 30 degrees from an axis."""
    for candidate in np.concatenate([np.eye(3), -np.eye(3)]):
        if candidate @ axis < np.cos(np.pi / 6):
            yield candidate


def _spans_three(rates: np.ndarray) -> bool:
    """Return whether rates, shape (n, 3), span three directions."""
    sizes = np.linalg.svd(rates - rates.mean(axis=0), compute_uv=False)
    return bool(sizes[-1] > LEAST_SPAN * sizes[0])


def turned_rates(
    windows: Sequence[Window], expected: Sequence[np.ndarray]
) -> list[np.ndarray] | None:
    """
    Return the rates of the joints as an IMU measures them that is turned against its mount.

    ``R r + b`` with the rotation R nearest to the matrix of least squares, and its bias b. None
    where such a turn does not explain much more than the mount of the table, or where the rates of
    the joints do not span three directions.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    expected : sequence of arrays, shape (n, 3)
        Rates of the joints in each window for the mount of the table, rad/s.

    """
    reference = np.concatenate(expected)
    if not _spans_three(reference):
        return None
    measured, matrix, _ = _sensor_fit(windows, expected)
    turn = nearest_rotation(matrix)
    bias = np.mean(measured - reference @ turn.T, axis=0)
    share_turned = _share(measured - reference @ turn.T - bias, measured)
    difference = measured - reference
    share_as_described = _share(difference - difference.mean(axis=0), measured)
    if share_turned > min(LARGEST_UNEXPLAINED, share_as_described / LEAST_IMPROVEMENT):
        return None
    return [rates @ turn.T + bias for rates in expected]


def with_axis(table: Table, joint: int, axis: np.ndarray) -> Table:
    """Return the table with another axis of one joint."""
    joints = list(table.joints)
    x, y, z = (float(value) for value in axis)
    joints[joint] = replace(joints[joint], axis=(x, y, z))
    return replace(table, joints=tuple(joints))


def mount_rpy_deg(matrix: np.ndarray, table: Table) -> np.ndarray:
    """
    Return roll, pitch, yaw of the rotation nearest to the measured matrix.

    The convention is that of `mount.rpy_deg`.
    """
    return np.degrees(rpy_from_rotation((nearest_rotation(matrix) @ table.mat_sl).T))
