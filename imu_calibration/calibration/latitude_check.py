"""The latitude of the table against the Earth's rate that the gyroscopes measured."""

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.units import DEG_H, significant
from imu_calibration.effects.base import Role
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.rotations import EARTH_RATE, earth_rate_n
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import WARNING, CheckFinding

CHECK = 'latitude'
CONTRADICTING_SDS = 5.0
"""Standard deviations beyond which the estimate contradicts the latitude."""
LEAST_SHARE = 0.1
"""The same as a share of the Earth's rate: below, small errors of the model explain it."""
AGREEING_SDS = 4.0
"""Standard deviations within which an estimate agrees with a cause."""
AGREEING_SHARE = 0.15
"""The same as a share of the effect of the cause."""
FARTHEST_SHARE = 0.5
"""An estimate farther than this share from an effect does not agree with it, however uncertain."""


def latitude_findings(solution: Solution, table: Table) -> tuple[CheckFinding, ...]:
    """
    Return the contradictions between the latitude and the estimates.

    ``omega_up = Omega sin(latitude)`` and ``|omega| = Omega`` do not depend on the azimuth. Where
    the table gives the azimuth, the reference contains the Earth's rate, and a latitude with the
    wrong sign leaves ``-2 Omega sin(latitude)`` about the vertical: at rest that is a g-sensitivity
    ``k f`` with the same k for each axis.

    Parameters
    ----------
    solution : Solution
        With all allowances in its covariance.
    table : Table

    Raises
    ------
    InputError
        When the latitude with the other sign explains the estimate.

    """
    if table.latitude is None:
        return ()
    model = solution.model
    # The Earth's rate is the effect of which the size is known.
    free = next((effect for effect in model.effects if effect.known_size), None)
    if free is not None:
        return _of_free_rate(solution, table, model.slices[free.key])
    if model.find('gyroscope', Role.CROSS) is not None:
        _refuse_vertical_rate(solution, table, model.part('gyroscope', Role.CROSS))
    return ()


def _of_free_rate(solution, table, part):
    """Compare the vertical component and the length of the estimated Earth's rate."""
    if solution.held[part].any():
        return ()
    rate = solution.values[part]
    covariance = solution.covariance[part, part]
    expected_up = _vertical_rate(table)
    up_sd = float(np.sqrt(covariance[2, 2]))
    if _contradicts(rate[2] - expected_up, up_sd):
        if _agrees(rate[2] + expected_up, up_sd, expected_up):
            raise _wrong_sign(table, rate[2], expected_up)
        return (_finding('vertical component', rate[2], up_sd, expected=expected_up),)
    length = float(np.linalg.norm(rate))
    direction = rate / length if length > 0 else np.array([1.0, 0.0, 0.0])
    length_sd = float(np.sqrt(direction @ covariance @ direction))
    if _contradicts(length - EARTH_RATE, length_sd):
        return (_finding('magnitude', length, length_sd, expected=EARTH_RATE),)
    return ()


def _refuse_vertical_rate(solution, table, part):
    """Refuse a g-sensitivity that is the vertical rate of a latitude with the wrong sign."""
    values = solution.values[part]
    if len(values) != 9 or solution.held[part].any():
        return
    matrix = values.reshape(3, 3)
    matrix_sd = np.sqrt(np.diag(solution.covariance[part, part])).reshape(3, 3)
    # Common to the three axes: k = trace(K) / 3, the sds as if they were fully correlated.
    common = float(np.trace(matrix)) / 3.0
    common_sd = float(matrix_sd.diagonal().mean())
    if abs(common) < CONTRADICTING_SDS * common_sd:
        return
    expected_up = _vertical_rate(table)
    # Of a latitude with the wrong sign: k g = -2 Omega sin(latitude), and no other entry.
    of_wrong_sign = -2.0 * expected_up / table.gravity_value
    if not _agrees(common - of_wrong_sign, common_sd, of_wrong_sign):
        return
    remaining = np.abs(matrix - common * np.eye(3))
    tolerated = np.maximum(AGREEING_SDS * matrix_sd, AGREEING_SHARE * abs(of_wrong_sign))
    if np.any(remaining > tolerated):
        return
    raise _wrong_sign(table, expected_up + common * table.gravity_value, expected_up)


def _vertical_rate(table):
    """Return the vertical component of the Earth's rate at the latitude, rad/s."""
    return float(earth_rate_n(table.latitude, 0.0)[2])


def _contradicts(difference, sd):
    return abs(difference) > max(CONTRADICTING_SDS * sd, LEAST_SHARE * EARTH_RATE)


def _agrees(difference, sd, size):
    tolerated = max(AGREEING_SDS * sd, AGREEING_SHARE * abs(size))
    return abs(difference) < min(tolerated, FARTHEST_SHARE * abs(size))


def _wrong_sign(table, measured, expected):
    return InputError(
        f"the latitude must give the vertical component of the Earth's rate, {table.latitude:g} deg"
        f' gives {_hourly(expected)} deg/h and the gyroscopes measured {_hourly(measured)} deg/h:'
        ' its sign is wrong; correct the latitude in the table (south is negative), and look at the'
        ' g-sensitivity of the gyroscopes afterwards',
        key='latitude',
        code='latitude_sign',
    )


def _finding(name, measured, sd, *, expected):
    return CheckFinding(
        CHECK,
        WARNING,
        f"the latitude must give the {name} of the Earth's rate: {_hourly(expected)} deg/h, the"
        f' gyroscopes measured {_hourly(measured)} ± {_hourly(sd)} deg/h; correct the latitude in'
        ' the table; if it is right, gyro_g_sensitivity or a drift can be the cause',
        key='latitude',
    )


def _hourly(rate):
    return significant(rate / DEG_H, 3)


def with_latitude_findings(
    findings: tuple[CheckFinding, ...], solution: Solution, table: Table
) -> tuple[CheckFinding, ...]:
    """Return the findings of a recording, those on the latitude first."""
    earlier = tuple(finding for finding in findings if finding.check != CHECK)
    return (*latitude_findings(solution, table), *earlier)
