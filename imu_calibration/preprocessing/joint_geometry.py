"""Errors of a table description that explain rates which the joints do not explain."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import REFUSE, CheckFinding
from imu_calibration.preprocessing.window import Window

MAX_SAMPLES = 2_000
"""Samples that are compared."""
LARGEST_UNEXPLAINED = 0.01
"""Largest unexplained share of the squared rates with a description that counts as correct."""
LEAST_FACTOR = 10.0
"""A correction of the description divides the unexplained share at least by this factor."""
TIE = 2.0
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


@dataclass(frozen=True, eq=False)
class MovingReadings:
    """Readings of moving windows that are compared with descriptions of the table."""

    motion: JointMotion
    """Joints at n instants."""
    rate: np.ndarray
    """Measured angular rates, rad/s, shape (n, 3)."""
    force: np.ndarray
    """Measured specific forces, m/s^2, shape (n, 3)."""

    def rate_residual(self, table: Table, motion: JointMotion) -> np.ndarray:
        """Return the residual of the rates, shape (n, 3)."""
        return _residual(self.rate, reference_motion(table, motion, attitude=False).rate_s)

    def correction(self, words: str, table: Table, motion: JointMotion) -> Correction:
        """Return a change of the table and of the motion with its unexplained shares."""
        reference = reference_motion(table, motion)
        return Correction(
            words,
            _share(_residual(self.rate, reference.rate_s), self.rate),
            _share(self.force - reference.force_s, self.force),
        )


def _residual(measured, reference):
    """Return ``measured - b - M reference`` with the bias b and matrix M of least squares."""
    design = np.insert(reference, 0, 1.0, axis=1)
    return measured - design @ np.linalg.lstsq(design, measured, rcond=1e-6)[0]


def _share(residual, measured):
    """Return the unexplained share of the squares about the mean."""
    return float((residual**2).sum() / ((measured - measured.mean(axis=0)) ** 2).sum())


def description_error(windows: Sequence[Window], table: Table) -> CheckFinding | None:
    """
    Return the finding of a wrong zero or axis of a joint in the table description, or None.

    The rates w of the gyroscope are compared with those of the joints, r(p), for changes p of the
    description. Bias b and matrix M of the sensor, its mount included, are free::

        unexplained(p) = min over b, M of  sum |w - b - M r(p)|^2 / sum |w - mean w|^2

    A change is reported if almost nothing is unexplained with it, and much more without it. A joint
    that is frozen for a time is not explained by any change of the description.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    table : Table

    """
    windows = [window for window in windows if 2 < len(window) == len(window.motion)]
    if not windows:
        return None
    n_samples = sum(len(window) for window in windows)
    thinned = slice(None, None, max(1, n_samples // MAX_SAMPLES))
    readings = MovingReadings(
        JointMotion.concatenate(window.motion for window in windows).select(thinned),
        np.concatenate([window.rate_s for window in windows])[thinned],
        np.concatenate([window.force_s for window in windows])[thinned],
    )
    as_described = readings.correction('', table, readings.motion)
    corrections = list(_corrections(readings, table))
    smallest = min(correction.rate_share for correction in corrections)
    if smallest > LARGEST_UNEXPLAINED or smallest * LEAST_FACTOR > as_described.rate_share:
        return None
    best = min(
        (correction for correction in corrections if correction.rate_share <= TIE * smallest),
        key=lambda correction: correction.force_share,
    )
    return CheckFinding(
        'on_table',
        REFUSE,
        'zeros and axes of the joints must be those of the table description, the joints explain'
        f' {100 * (1 - as_described.rate_share):.1f} % of the rates as described and'
        f' {100 * (1 - best.rate_share):.1f} % if {best.words}; correct the table description, or'
        ' the zero in its driver',
        key='table',
    )


def _corrections(readings: MovingReadings, table: Table) -> Iterator[Correction]:
    """Yield the best change of the zeros, then each other axis of each joint."""
    from scipy.optimize import least_squares  # here, because its import is slow

    names = table.joint_names
    columns = [names.index(name) for name in names.zeros]

    def shifted(zeros):
        position = readings.motion.position.copy()
        position[:, columns] += zeros
        return replace(readings.motion, position=position)

    if columns:
        fit = least_squares(
            lambda zeros: readings.rate_residual(table, shifted(zeros)).ravel(),
            np.zeros(len(columns)),
        )
        words = ', '.join(
            f'{name} reads {np.degrees(-zero):.2f} deg too much'
            for name, zero in zip(names.zeros, fit.x)
        )
        yield readings.correction(words, table, shifted(fit.x))
    for k, name in enumerate(names):
        for axis in _other_axes(np.array(table.joints[k].axis)):
            shown = ', '.join(f'{value + 0.0:.0f}' for value in axis)
            yield readings.correction(
                f'the axis of {name} is [{shown}]', with_axis(table, k, axis), readings.motion
            )


def _other_axes(axis: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the coordinate axes of either sign that are more than 30 degrees from an axis."""
    for candidate in np.concatenate([np.eye(3), -np.eye(3)]):
        if candidate @ axis < np.cos(np.pi / 6):
            yield candidate


def with_axis(table: Table, joint: int, axis: np.ndarray) -> Table:
    """Return the table with another axis of one joint."""
    joints = list(table.joints)
    x, y, z = (float(value) for value in axis)
    joints[joint] = replace(joints[joint], axis=(x, y, z))
    return replace(table, joints=tuple(joints))
