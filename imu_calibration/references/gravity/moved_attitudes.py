"""Attitudes in which an IMU was to be still and swayed."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.estimation.solution import MOVED_REMEDY
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.references.gravity.poses import distinct_attitudes
from imu_calibration.references.gravity.sway import sway_at_rest

KEPT_PIECE = 0.5
"""Duration of the means of the force that show which attitude is kept, s."""
KEPT_ANGLE = 0.15
"""rad: a sway stays within this angle of one attitude, a turn to another attitude does not."""
KEPT_SECONDS = 1.0
"""Shortest stretch in one attitude, s, without the ends of the turns before and after it."""


def require_no_sway(
    imu: ImuSamples, rest_force: np.ndarray, rests: Sequence[tuple[int, int]], *, least: int
) -> None:
    """
    Refuse a recording in which a sway leaves fewer than the needed attitudes at rest.

    Parameters
    ----------
    imu : ImuSamples
    rest_force : ndarray, shape (k, 3)
        Mean force of the intervals at rest, m/s^2.
    rests : sequence of (start, stop)
        Their ranges of samples.
    least : int
        Number of attitudes that are needed.

    Raises
    ------
    NotObservableError
        With the tilt, where the attitudes in which the IMU swayed would be enough.

    """
    if imu.absent:
        return

    # Stretches in one attitude without a rest.
    at_rest = np.zeros(len(imu), bool)
    for start, stop in rests:
        at_rest[start:stop] = True
    forces = []
    rates = []
    length = []
    for start, stop in _kept_attitudes(imu):
        if not at_rest[start:stop].any():
            forces.append(imu.force_s[start:stop])
            rates.append(imu.rate_s[start:stop])
            length.append(1e-9 * (imu.stamp_ns[stop - 1] - imu.stamp_ns[start]))

    # With them there must be enough attitudes, and both sensors must measure the sway.
    means = [force.mean(axis=0) for force in forces]
    if distinct_attitudes(np.array([*rest_force, *means]).reshape(-1, 3)) < least:
        return
    tilt = sway_at_rest(forces, rates, np.array(length))
    if tilt > 0.0:
        raise NotObservableError(
            f'calibration by hand needs at least {least} different attitudes held still, got'
            f' {distinct_attitudes(rest_force)}; in {len(forces)} further intervals the attitude'
            f' was kept, but the IMU tilted by {1e3 * tilt:.2g} mrad (rms), as both sensors'
            f' measure: it moved; {MOVED_REMEDY}, or describe the table or arm that moved it',
            key='table',
            code='moved_at_rest',
        )


def _kept_attitudes(imu: ImuSamples) -> list[tuple[int, int]]:
    """
    Return the ranges of samples (start, stop) in which an attitude is kept, at rest or swaying.

    Means of the force over `KEPT_PIECE` stay within `KEPT_ANGLE` of the first one.
    """
    period = float(np.median(np.diff(imu.stamp_ns))) * 1e-9
    width = max(1, round(KEPT_PIECE / period))
    count = len(imu) // width
    pieces = imu.force_s[: count * width].reshape(count, width, 3)
    up = unit_rows(pieces.mean(axis=1))
    ranges = []
    first = 0
    for piece in range(1, count + 1):
        if piece < count and up[first] @ up[piece] > np.cos(KEPT_ANGLE):
            continue
        # The first and the last piece may hold the end of a turn.
        start = (first + 1) * width
        stop = (piece - 1) * width
        if (stop - start) * period >= KEPT_SECONDS:
            ranges.append((start, stop))
        first = piece
    return ranges
