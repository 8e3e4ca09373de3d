"""The mount of the table description against a turn that both sensors have in common."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.core.units import DEG
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.rotations import nearest_rotation, rotation_vector
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.joint_geometry import mount_rpy_deg
from imu_calibration.preprocessing.recording_evidence import NOTE, WARNING, CheckFinding

MOUNT_CHECK = 'mount'
LEAST_COMMON_TURN = 1.5 * DEG
"""Smallest common turn that is a warning, rad; the axes of a sensor are off by less."""
LARGEST_DIFFERENCE = 0.5
"""
Largest difference between the turns of two sensors, as a share of their mean, for a warning. Axes
that are off at random have a common turn too, which is as large as this allows in 3 of 100 units.
"""
LEAST_TURN_SD = 0.07 * DEG
"""
Smallest sd of the turn of a triad about one axis, rad. The axes of the best sensors are off by a
tenth of a degree, and a turn is the mean of two of these angles.
"""
NOTED_CHANCE = 0.025
"""Probability of a turn by usual axes below which a common turn is noted."""
ALONG = np.cos(10 * DEG)
"""Cosine of the angle between a turn and an axis from which the turn is about that axis."""


@dataclass(frozen=True, eq=False)
class CommonTurn:
    """The turn that the matrices of the sensors have in common, against the stated mount."""

    matrix: np.ndarray
    """True quantities in the axes of the stated mount to those of the sensors, shape (3, 3)."""
    vector: np.ndarray
    """The same as a rotation vector, rad, shape (3,)."""
    agreed: bool
    """Whether the turns of the sensors are nearly equal."""
    sd: np.ndarray
    """Sd of the vector by the estimate and by the spread of usual axes, rad, shape (3,)."""
    freedom: int
    """Number of independent angles from which the spread of the axes is estimated."""

    @property
    def angle(self) -> float:
        """Angle of the turn, rad."""
        return float(np.linalg.norm(self.vector))

    def noted(self, axis: np.ndarray) -> bool:
        """
        Return whether the turn is larger than usual axes allow, in total or about an axis.

        Parameters
        ----------
        axis : ndarray, shape (3,)
            Unit vector of the last joint in the axes of the stated mount.

        """
        # F ratios of the squared turn and its variance.
        total = np.sum((self.vector / self.sd) ** 2) / len(self.vector)
        about_axis = (axis @ self.vector) ** 2 / (axis**2 @ self.sd**2)
        p_value = min(f_sf(total, 3, self.freedom), f_sf(about_axis, 1, self.freedom))
        return bool(p_value < NOTED_CHANCE)


def common_turn(solution: Solution) -> CommonTurn | None:
    """
    Return the common turn of the matrices, or None without a matrix.

    The matrix of a sensor is that of its axes times the turn R of the IMU against its stated mount,
    ``M = E R``. E differs from sensor to sensor and is nearly the identity, R is common to both. A
    wrong zero of the last joint is such a turn, about its axis: no recording separates E from R,
    and the axes of the result are those of the mount as stated (`gauge`).

    Where each of the six angles of E has the variance e^2, a turn (the half difference of two
    angles) and an angle between axes (their half sum) both have e^2 / 2. The angles between axes,
    and the differences of the turns between sensors, do not depend on R: they give e.
    """
    # The axes of each triad: rows of its matrix, without their scales.
    triads = []
    variances = []
    for sensor in SENSORS:
        params = solution.model.part(sensor, Role.LINEAR)
        if params.stop > params.start and not solution.held[params].any():
            matrix = solution.values[params].reshape(3, 3)
            triads.append(matrix / np.linalg.norm(matrix, axis=1, keepdims=True))
            variances.append(np.diag(solution.covariance)[params].reshape(3, 3))
    if not triads:
        return None
    # R is the mean turn of the triads; it is common if their turns agree, relative to its angle.
    turns = [nearest_rotation(triad) for triad in triads]
    common = nearest_rotation(np.sum(turns, axis=0))
    vector = rotation_vector(common)
    differences = np.array([rotation_vector(turn @ common.T) for turn in turns])
    largest = np.max(np.linalg.norm(differences, axis=1))
    agreed = largest <= LARGEST_DIFFERENCE * np.linalg.norm(vector) / 2

    # Variance of the turn of one triad about one axis, from all angles that do not depend on R.
    squares = float(np.sum(differences**2))
    for triad in triads:
        axes = triad @ common.T
        half_sums = (axes + axes.T)[np.triu_indices(3, 1)] / 2
        squares += float(half_sums @ half_sums)
    # Of n triads 3 (n - 1) for the differences of their turns, and 3 n for the half sums.
    dof = 3 * (len(triads) - 1) + 3 * len(triads)
    turn_variance = max(squares / dof, LEAST_TURN_SD**2)

    # Variance of the mean of the turns: of the axes, and of their estimates.
    estimate_variance = np.zeros(3)
    for variance in variances:
        # A turn about x is half the difference of the elements yz and zy; so for y and z.
        off_diagonal = (variance + variance.T)[[1, 2, 0], [2, 0, 1]]
        estimate_variance += off_diagonal / 4 / len(triads) ** 2
    sd = np.sqrt(turn_variance / len(triads) + estimate_variance)
    return CommonTurn(common, vector, bool(agreed), sd, dof)


def common_turn_deg(solution: Solution) -> list[float] | None:
    """Return the rotation vector of the common turn for the statistics, deg; None without one."""
    turn = common_turn(solution)
    if turn is None:
        return None
    return [round(float(value), 4) for value in turn.vector / DEG]


def mount_findings(solution: Solution, table: Table) -> tuple[CheckFinding, ...]:
    """
    Return the finding of a turn of the IMU against the mount of the table, if there is one.

    A small turn is a note: it may be the mount, or how the triads lie in their case.

    Parameters
    ----------
    solution : Solution
        With the matrices of the sensors.
    table : Table

    """
    turn = common_turn(solution)
    if turn is None:
        return ()
    # The axis of the last joint is the same in both links that it connects.
    last_joint = table.joints[-1]
    last_axis = table.mat_sl @ np.array(last_joint.axis)
    severe = turn.agreed and turn.angle >= LEAST_COMMON_TURN
    if not severe and not turn.noted(last_axis):
        return ()
    zero = ''
    if last_joint.turns and abs(last_axis @ turn.vector) > ALONG * turn.angle:
        zero = f' (or the zero of {table.joint_names[-1]}, which has the same effect)'
    mount_angles = np.round(mount_rpy_deg(turn.matrix, table), 2)
    fits = ', '.join(f'{angle + 0.0:.2f}' for angle in mount_angles)  # + 0.0: no negative zero
    size = f'{turn.angle / DEG:.2f} deg'
    if severe:
        text = (
            'the IMU must be mounted as in the table description, its readings are turned by'
            f' {size} against it: mount.rpy_deg [{fits}] would fit; correct it{zero}, or'
            ' the matrices contain this turn'
        )
    else:
        text = (
            'the axes of the matrices are those of the mount as stated, they contain a common turn'
            f' of {size} against it: mount.rpy_deg [{fits}] would remove it; if the axes of the'
            f' sensors are wanted, state it{zero}'
        )
    return (CheckFinding(MOUNT_CHECK, WARNING if severe else NOTE, text, key='table'),)
