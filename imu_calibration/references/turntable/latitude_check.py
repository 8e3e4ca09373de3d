"""The latitude of the table against the Earth's rate that the gyroscopes measured."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.units import DEG_H, significant
from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.rotations import EARTH_RATE, earth_rate_n
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import NOTE, WARNING, CheckFinding, Severity
from imu_calibration.references.turntable.session_data import SessionData

LATITUDE_CHECK = 'latitude'
CONTRADICTING_SDS = 5.0
"""Standard deviations beyond which the estimate contradicts the latitude."""
NAMED_SDS = 3.0
"""
The same where a g-sensitivity is in the model, which may be the effect of another latitude; without
one, a note from here on.
"""
LEAST_EARTH_SHARE = 0.1
"""
Least contradiction as a share of the Earth's rate: below, small errors of the model explain it.
"""
AGREEING_SDS = 4.0
"""Standard deviations within which an estimate agrees with a cause."""
AGREEING_SHARE = 0.15
"""Share of the effect of a cause within which an estimate agrees with it."""
LEAST_WINDOWS = 8
"""Windows, beyond the number of unknowns, from which a latitude is tested."""
WINDOWS_PER_COSINE = 20
"""
Windows for each cosine of a wandering bias. In 24 sessions of 2.5 and 8 of 10 minutes without an
error, z had rms 1.2 and 1.8 with a line and one variance for all windows; 1.0 and 0.9 now.
"""
LEAST_RATE = 0.01
"""Rate of the reference above which the matrix of the gyroscopes is one of the unknowns, rad/s."""
FARTHEST_SHARE = 0.5
"""An estimate farther than this share from an effect does not agree with it, however uncertain."""


@dataclass(frozen=True, eq=False)
class WindowRates:
    """Means of n windows: rates of the gyroscopes and of the reference, and the vertical."""

    measured: np.ndarray
    """Measured rates in the sensor frame, rad/s, shape (n, 3)."""
    reference: np.ndarray
    """Rates of the reference, rad/s, shape (n, 3)."""
    up: np.ndarray
    """Specific force of the reference over gravity, shape (n, 3): up where the IMU rests."""
    time: np.ndarray
    """Middle of the windows, s, shape (n,)."""
    session: np.ndarray
    """Recording of each window, shape (n,)."""
    kind: np.ndarray
    """Kind of each window, shape (n,)."""


def window_rates(gathered: SessionData, model: SensorModel, table: Table) -> WindowRates:
    """
    Return the means of the windows of a session.

    Parameters
    ----------
    gathered : SessionData
    model : SensorModel
        The model of the gathered columns.
    table : Table

    """
    rows = gathered.accumulator.rows
    rates = np.array([row.sensors['gyroscope'].mean for row in rows])
    forces = np.array([row.sensors['accelerometer'].mean for row in rows])
    return WindowRates(
        measured=rates[:, -3:],
        reference=rates[:, model.columns_of('gyroscope', Role.LINEAR)],
        up=forces[:, model.columns_of('accelerometer', Role.LINEAR)] / table.gravity_value,
        time=np.array([row.time for row in rows]),
        session=np.array([row.session for row in rows]),
        kind=np.array([str(row.kind) for row in rows]),
    )


def latitude_findings(
    solution: Solution, table: Table, windows: WindowRates | None = None
) -> tuple[CheckFinding, ...]:
    """
    Return the contradictions between the latitude and the estimates.

    ``omega_up = Omega sin(latitude)`` and ``|omega| = Omega`` do not depend on the azimuth. Where
    the table gives the azimuth, the reference contains the Earth's rate, and with another latitude
    the measured rate about the vertical is larger by ``Omega (sin(true) - sin(stated))``. Where the
    table gives no latitude, a rate ``|omega| > Omega`` has another cause.

    Parameters
    ----------
    solution : Solution
        With all allowances in its covariance.
    table : Table
    windows : WindowRates, optional
        For a table with an azimuth.

    Raises
    ------
    InputError
        When the latitude with the other sign explains the estimate.

    """
    model = solution.model
    # The Earth's rate is the effect of which the size is known.
    earth_rate = next((effect for effect in model.effects if effect.known_size), None)
    if earth_rate is not None:
        return _of_estimated_rate(solution, table, model.slices[earth_rate.key])
    if windows is None or table.azimuth_deg is None:
        return ()
    has_g_sensitivity = model.find('gyroscope', Role.CROSS) is not None
    return _of_windows(windows, table, NAMED_SDS if has_g_sensitivity else CONTRADICTING_SDS)


def _of_estimated_rate(
    solution: Solution, table: Table, rate_params: slice
) -> tuple[CheckFinding, ...]:
    """
    Return the contradiction of the estimated Earth's rate to the latitude, or none.

    The vertical component is compared first, then the magnitude. `rate_params` are the three
    parameters of the rate in the level frame.
    """
    if solution.held[rate_params].any():
        return ()
    rate = solution.values[rate_params]
    covariance = solution.covariance[rate_params, rate_params]

    # Without a latitude only the magnitude of the Earth's rate is known.
    if table.latitude is None:
        magnitude, sd = _magnitude(rate, covariance)
        return (_excess(magnitude, sd),) if _exceeds_earth_rate(magnitude, sd) else ()
    up_sd = float(np.sqrt(covariance[2, 2]))
    severity = _severity(rate[2] - _vertical_rate(table), up_sd)
    if severity is not None:
        return (_vertical_finding(table, rate[2], up_sd, severity),)
    magnitude, sd = _magnitude(rate, covariance)
    if _contradicts(magnitude - EARTH_RATE, sd):
        return (_finding('magnitude', magnitude, sd, expected=EARTH_RATE, severity=WARNING),)
    return ()


def _magnitude(rate: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Return the norm of an estimated rate, shape (3,), and its standard deviation."""
    magnitude = float(np.linalg.norm(rate))
    direction = rate / magnitude if magnitude > 0 else np.array([1.0, 0.0, 0.0])
    return magnitude, float(np.sqrt(direction @ covariance @ direction))


def _of_windows(windows: WindowRates, table: Table, sds: float) -> tuple[CheckFinding, ...]:
    """
    Return the contradiction of the rate about the vertical in windows to the latitude, or none.

    The reference contains the Earth's rate at the stated latitude. The difference to the true one
    is a rate k about the vertical: K = k I in the regression ``measured = K up + M reference +
    bias(time)``. `sds`: standard deviations from which k is a contradiction.
    """
    dependence = _dependence_on_up(windows)
    if dependence is None:
        return ()
    # A rate about the vertical is K = k I: the weighted mean of the diagonal.
    precision = 1.0 / np.maximum(dependence.sd.diagonal() ** 2, 1e-300)
    vertical = float(precision @ dependence.matrix.diagonal() / precision.sum())
    vertical_sd = float(1.0 / np.sqrt(precision.sum()))
    severity = _severity(vertical, vertical_sd, sds)
    if severity is None:
        return ()
    # A K with other entries is a g-sensitivity, and no error of the latitude.
    remaining = np.abs(dependence.matrix - vertical * np.eye(3))
    tolerated = np.maximum(AGREEING_SDS * dependence.sd, AGREEING_SHARE * abs(vertical))
    if np.any(remaining > tolerated):
        return ()
    # At no latitude the vertical component is larger than the Earth's rate.
    measured_up = _vertical_rate(table) + vertical
    if _exceeds_earth_rate(measured_up, vertical_sd):
        return ()
    return (_vertical_finding(table, measured_up, vertical_sd, severity),)


def _vertical_finding(table: Table, measured: float, sd: float, severity: Severity) -> CheckFinding:
    """
    Return the finding of a vertical component that contradicts the latitude, rad/s.

    Raises an InputError where the latitude with the other sign explains it.
    """
    expected = _vertical_rate(table)
    # The latitude with the other sign expects the vertical component `-expected`.
    if severity == WARNING and _agrees(measured + expected, sd, expected):
        raise _wrong_sign(table, measured, expected)
    return _finding('vertical component', measured, sd, expected=expected, severity=severity)


@dataclass(frozen=True, eq=False)
class _Dependence:
    """Linear dependence of measured rates on the vertical, ``measured = matrix @ up + ...``."""

    matrix: np.ndarray
    """rad/s, shape (3, 3)."""
    sd: np.ndarray
    """Standard deviation of each entry, shape (3, 3)."""


def _dependence_on_up(windows: WindowRates) -> _Dependence | None:
    """Return the dependence of the measured rates on the vertical; None if not determined."""
    # Unknowns: K of up, bias and its wandering, M of the reference where it turns.
    design = np.column_stack([windows.up, *_bias_columns(windows)])
    if np.abs(windows.reference).max(initial=0.0) > LEAST_RATE:
        design = np.column_stack([design, windows.reference])
    if len(design) < design.shape[1] + LEAST_WINDOWS:
        return None
    weight = _weights_of_kinds(windows, design)
    design = design * weight[:, None]
    measured = windows.measured * weight[:, None]
    left, singular, right = np.linalg.svd(design, full_matrices=False)
    if singular[-1] <= 1e-6 * singular[0]:
        return None
    # The windows differ in length and motion, so that their variances are not equal. With the
    # solution K = G w, sd(K)^2 = sum_k G_k^2 (e_k / (1 - h_k))^2, h_k the leverage (HC3 of
    # MacKinnon and White 1985).
    gain = (right.T / singular) @ left.T
    solved = gain @ measured
    leverage = (left**2).sum(axis=1)
    residual = (measured - design @ solved) / np.maximum(1.0 - leverage, 1e-3)[:, None]
    return _Dependence(solved[:3].T, np.sqrt(gain[:3] ** 2 @ residual**2).T)


def _bias_columns(windows: WindowRates) -> list[np.ndarray]:
    """
    Return the columns of bias and its slow wandering in each recording, each shape (n, k).

    ``c + d x + sum_k a_k cos(pi k x)``, with x from 0 to 1 in the recording and zeros outside it.
    Without them, wandering passes for a dependence on the vertical where attitudes follow each
    other slowly.
    """
    columns_of_sessions = [np.zeros((len(windows.time), 0))]
    for session in np.unique(windows.session):
        inside = windows.session == session
        time = windows.time[inside]
        x = (time - time.min()) / max(np.ptp(time), 1e-9)
        orders = np.arange(2, round(len(time) / WINDOWS_PER_COSINE) + 1)
        columns = np.zeros((len(windows.time), 2 + len(orders)))
        cosines = np.cos(np.pi * np.outer(x, orders))
        columns[inside] = np.column_stack([np.ones_like(x), x, cosines])
        columns_of_sessions.append(columns)
    return columns_of_sessions


def _weights_of_kinds(windows: WindowRates, design: np.ndarray) -> np.ndarray:
    """
    Return the weight of each window, the inverse rms residual of its kind, shape (n,).

    The residual is that of the measured rates after unweighted least squares.
    """
    solved = np.linalg.lstsq(design, windows.measured, rcond=1e-6)[0]
    squares = ((windows.measured - design @ solved) ** 2).mean(axis=1)
    weight = np.ones(len(design))
    for kind in np.unique(windows.kind):
        of_kind = windows.kind == kind
        weight[of_kind] = 1.0 / np.sqrt(max(squares[of_kind].mean(), 1e-30))
    return weight


def _exceeds_earth_rate(rate: float, sd: float) -> bool:
    """Return whether a rate, rad/s, is significantly larger than the Earth's rate."""
    return abs(rate) > EARTH_RATE and _contradicts(abs(rate) - EARTH_RATE, sd)


def _vertical_rate(table: Table) -> float:
    """Return the vertical component of the Earth's rate at the latitude, rad/s."""
    assert table.latitude is not None, 'the latitude was given'
    return float(earth_rate_n(table.latitude, 0.0)[2])


def _contradicts(difference: float, sd: float, sds: float = CONTRADICTING_SDS) -> bool:
    """Return whether a difference exceeds `sds` standard deviations and a share of the rate."""
    return abs(difference) > max(sds * sd, LEAST_EARTH_SHARE * EARTH_RATE)


def _severity(difference: float, sd: float, sds: float = CONTRADICTING_SDS) -> Severity | None:
    """Return WARNING beyond `sds` standard deviations, NOTE beyond `NAMED_SDS`, otherwise None."""
    if _contradicts(difference, sd, sds):
        return WARNING
    return NOTE if _contradicts(difference, sd, NAMED_SDS) else None


def _agrees(difference: float, sd: float, size: float) -> bool:
    """Return whether a difference is small in standard deviations or relative to an effect."""
    tolerated = max(AGREEING_SDS * sd, AGREEING_SHARE * abs(size))
    return abs(difference) < min(tolerated, FARTHEST_SHARE * abs(size))


def _wrong_sign(table: Table, measured: float, expected: float) -> InputError:
    """Return the error of a latitude with the wrong sign; rates of the vertical in rad/s."""
    return InputError(
        f"the latitude must give the vertical component of the Earth's rate, {table.latitude:g} deg"
        f' gives {_hourly(expected)} deg/h and the gyroscopes measured {_hourly(measured)} deg/h:'
        ' its sign is wrong; correct the latitude in the table (south is negative), and look at the'
        ' g-sensitivity of the gyroscopes afterwards',
        key='latitude',
        code='latitude_sign',
    )


def _finding(
    name: str, measured: float, sd: float, *, expected: float, severity: Severity
) -> CheckFinding:
    """Return the finding that a quantity of the Earth's rate differs from its value, rad/s."""
    return CheckFinding(
        LATITUDE_CHECK,
        severity,
        f"the latitude must give the {name} of the Earth's rate: {_hourly(expected)} deg/h, the"
        f' gyroscopes measured {_hourly(measured)} ± {_hourly(sd)} deg/h; correct the latitude in'
        ' the table; if it is right, gyro_g_sensitivity or a drift can be the cause',
        key='latitude',
    )


def _excess(measured: float, sd: float) -> CheckFinding:
    """Return the finding of a rate that is larger than the Earth's, rad/s."""
    return CheckFinding(
        LATITUDE_CHECK,
        WARNING,
        f"the Earth's rate must be {_hourly(EARTH_RATE)} deg/h at most, the gyroscopes measured"
        f' {_hourly(measured)} ± {_hourly(sd)} deg/h that no bias explains; state latitude and'
        ' azimuth_deg in the table: the remainder is gyro_g_sensitivity or a drift',
        key='latitude',
    )


def _hourly(rate: float) -> str:
    """Return a rate in deg/h with three digits."""
    return significant(rate / DEG_H, 3)
