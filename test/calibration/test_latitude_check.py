"""The latitude of a table against the estimated Earth's rate."""

from types import SimpleNamespace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.calibration.latitude_check import latitude_findings
from imu_calibration.core.errors import InputError
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.joint import Joint
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.session import turning_world

OMEGA = 7.292115e-5
"""rad/s, WGS 84."""
LATITUDE = 37.0


def table(latitude=LATITUDE, azimuth_deg=None):
    return Table([Joint('a', (0, 0, 1))], latitude=latitude, azimuth_deg=azimuth_deg)


def solution(sensor, name, values, sd):
    """Estimates of one effect, uncorrelated."""
    values, effect = np.asarray(values, float), CATALOGUE.find(sensor, name)
    part = slice(0, len(values))

    def find(of_sensor, role):
        return effect if (of_sensor, role) == (effect.sensor, effect.role) else None

    return SimpleNamespace(
        model=SimpleNamespace(
            effects=[effect],
            slices={effect.key: part},
            find=find,
            part=lambda of_sensor, role: part if find(of_sensor, role) else slice(0, 0),
        ),
        values=values,
        held=np.zeros(len(values), bool),
        covariance=np.diag(np.full(len(values), sd**2)),
    )


def earth(latitude, heading=0.7, sd=1e-6):
    up, level = np.sin(np.radians(latitude)), np.cos(np.radians(latitude))
    vector = OMEGA * np.array([level * np.cos(heading), level * np.sin(heading), up])
    return solution('reference', 'earth_rate', vector, sd)


@pytest.mark.parametrize('heading', (0.0, 2.0, -1.1))
def test_an_estimate_of_any_azimuth_agrees_with_its_latitude(heading):
    assert latitude_findings(earth(LATITUDE, heading), table()) == ()
    assert latitude_findings(earth(-LATITUDE, heading), table(-LATITUDE)) == ()


def test_the_sign_of_the_latitude_is_refused():
    with refused(InputError, 'latitude_sign', 37):
        latitude_findings(earth(-LATITUDE), table())


def test_another_latitude_and_a_missing_rotation_are_named():
    for estimate in (earth(60.0), solution('reference', 'earth_rate', np.zeros(3), 1e-6)):
        (finding,) = latitude_findings(estimate, table())
        assert finding.key == 'latitude'
    # About the vertical the estimate agrees; its length is that of another planet.
    vector = [0.2 * OMEGA, 0.0, OMEGA * np.sin(np.radians(LATITUDE))]
    (finding,) = latitude_findings(solution('reference', 'earth_rate', vector, 1e-6), table())
    assert finding.check == 'latitude'


def test_an_uncertain_estimate_contradicts_nothing():
    assert latitude_findings(earth(-LATITUDE, sd=5e-5), table()) == ()


def test_a_vertical_rate_of_twice_the_earth_is_no_g_sensitivity():
    """The reference contains Omega sin(latitude) with the wrong sign: at rest that is k f."""
    known = table(azimuth_deg=20.0)
    left = -2 * OMEGA * np.sin(np.radians(LATITUDE)) / known.gravity_value
    matrix = left * np.eye(3)
    matrix[0, 1] = 0.05 * left
    sign = solution('gyroscope', 'gyro_g_sensitivity', matrix.ravel(), abs(left) / 30)
    with refused(InputError, 'latitude_sign', 37):
        latitude_findings(sign, known)
    for other in (-matrix, matrix + np.diag([0, 0, left]), 4 * matrix):
        real = solution('gyroscope', 'gyro_g_sensitivity', other.ravel(), abs(left) / 30)
        assert latitude_findings(real, known) == ()


def test_a_simulated_world_turns_wherever_a_latitude_is_given():
    plain = SensorModel()
    assert turning_world(table(), plain).azimuth_deg == 0.0
    assert turning_world(table(azimuth_deg=30.0), plain).azimuth_deg == 30.0
    free = Table([Joint('a', (0, 0, 1))], gravity=9.8)
    assert turning_world(free, plain) is free
