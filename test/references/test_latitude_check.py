"""The latitude of a table against the estimated Earth's rate."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from refusal import refused

from imu_calibration import calibrate
from imu_calibration.core.errors import InputError
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import AZIMUTH_REMEDY, PLACE_REMEDY
from imu_calibration.kinematics.joint import Joint
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import NOTE
from imu_calibration.references.turntable.latitude_check import WindowRates, latitude_findings
from imu_calibration.references.turntable.needs import motions_needed
from imu_calibration.simulation.session import turning_world

from worlds.candidates import FEW
from worlds.physics import make_session

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


def test_without_a_latitude_only_more_than_the_rate_of_the_earth_is_named():
    """A length below Omega may be the rate of the Earth in an unknown direction."""
    nowhere = Table([Joint('a', (0, 0, 1))], gravity=9.8)
    assert latitude_findings(earth(LATITUDE), nowhere) == ()
    assert latitude_findings(solution('reference', 'earth_rate', np.zeros(3), 1e-6), nowhere) == ()
    twice = solution('reference', 'earth_rate', [0.0, 0.0, 2 * OMEGA], 1e-6)
    (finding,) = latitude_findings(twice, nowhere)
    assert finding.key == 'latitude'
    assert re.search(r'measured ([\d.]+)', finding.text)[1] == '30.1'
    uncertain = solution('reference', 'earth_rate', [0.0, 0.0, 2 * OMEGA], 3e-5)
    assert latitude_findings(uncertain, nowhere) == ()


KNOWN = 20.0
"""deg, azimuth."""


def windows_of(latitude, *, g_sensitivity=np.zeros((3, 3)), noise=1e-6, seed=4, stay=1, wave=0.0):
    """
    Return windows at a latitude with a description that states `LATITUDE`.

    An attitude is that of `stay` windows; `wave` is the amplitude of a slow wave of the biases.

    The vertical part of the Earth's rate only: the azimuth is known, and its error is not tested.
    """
    rng = np.random.default_rng(seed)
    up = np.repeat(rng.normal(size=(60 // stay, 3)), stay, axis=0)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    stated, true = (OMEGA * np.sin(np.radians(each)) * up for each in (LATITUDE, latitude))
    turns = np.where(np.arange(60)[:, None] < 25, 0.0, rng.normal(0.0, 0.5, (60, 3)))
    time = np.linspace(0.0, 500.0, 60)
    drift = np.outer(time, [1e-7, 2e-7, -1e-7])
    measured = (true + turns) @ (np.eye(3) + rng.normal(0, 0.01, (3, 3))).T + drift + 0.002
    measured += up @ g_sensitivity.T + rng.normal(0.0, noise, (60, 3))
    measured += wave * np.cos(np.linspace(0.0, 2 * np.pi, 60))[:, None]
    kind = np.where(np.arange(60) < 25, 'static', 'dynamic')
    return WindowRates(measured, stated + turns, up, time, np.zeros(60, int), kind)


def of_windows(windows, latitude=LATITUDE):
    bias = solution('gyroscope', 'bias', np.zeros(3), 1e-6)
    return latitude_findings(bias, table(latitude, KNOWN), windows)


def test_another_sign_or_latitude_is_no_g_sensitivity():
    """The reference contains Omega sin(stated): at rest, the difference is that of k f."""
    assert of_windows(windows_of(LATITUDE)) == ()
    with refused(InputError, 'latitude_sign', 37):
        of_windows(windows_of(-LATITUDE))
    for latitude in (5.0, 75.0):
        (finding,) = of_windows(windows_of(latitude))
        assert finding.check == 'latitude' and finding.key == 'latitude'
        shown = float(re.search(r'measured ([\d.]+)', finding.text)[1]) * np.radians(1 / 3600)
        assert shown == pytest.approx(OMEGA * np.sin(np.radians(latitude)), rel=0.1, abs=1e-6)
    assert of_windows(windows_of(-LATITUDE, noise=1e-3)) == ()


def test_a_latitude_of_the_same_sign_is_noted_where_the_data_show_it():
    """25 for 37 deg at 3 to 5 sds; the right latitude is noted as often as 3 sds are exceeded."""
    severities = []
    n_false = 0
    for seed in range(60):
        found = of_windows(windows_of(25.0, noise=2e-5, seed=seed))
        severities.append([finding.severity for finding in found])
        n_false += len(of_windows(windows_of(LATITUDE, noise=2e-5, seed=seed)))
    assert severities.count([NOTE]) > 20 and severities.count([]) < 6
    assert n_false <= 1
    # Without an azimuth the estimated rate is compared: 4 sds.
    (finding,) = latitude_findings(earth(25.0, sd=3.4e-6), table())
    assert finding.severity == NOTE


def test_a_g_sensitivity_is_no_latitude():
    size = 2 * OMEGA * np.sin(np.radians(LATITUDE))
    for matrix in (size * np.diag([-1, -1, 2]), size * np.eye(3), -4 * size * np.eye(3)):
        assert of_windows(windows_of(LATITUDE, g_sensitivity=matrix)) == ()


def test_a_simulated_world_turns_wherever_a_latitude_is_given():
    plain = SensorModel()
    assert turning_world(table(), plain).azimuth_deg == 0.0
    assert turning_world(table(azimuth_deg=30.0), plain).azimuth_deg == 30.0
    free = Table([Joint('a', (0, 0, 1))], gravity=9.8)
    assert turning_world(free, plain) is free


@pytest.mark.long
def test_the_earth_below_a_table_without_latitude_is_no_g_sensitivity():
    session = make_session(8101, {'earth_rate': None}, imu_rate=25.0, joint_rate=25.0)
    nowhere = Table.from_mapping(
        session.table
        | {
            'gravity': Table.from_mapping(session.table).gravity_value,
            'latitude': None,
            'azimuth_deg': None,
        }
    )
    result = calibrate(session.block, nowhere, candidates=FEW).result
    found = result.calibration
    assert found.model.gyroscope == ('bias', 'matrix')
    part = found.model.slices['reference', 'earth_rate']
    rate, sd = found.values[part], found.sd[part]
    np.testing.assert_allclose(rate, session.truth['values']['earth_rate'], atol=4 * sd.max())
    assert sd.max() < 0.2 * OMEGA

    # What would determine it better is the place; where that is given, the azimuth.
    none_suffices = np.full(len(found.values), 1e-12)
    for latitude, wanted in ((None, PLACE_REMEDY), (LATITUDE, AZIMUTH_REMEDY)):
        somewhere = replace(nowhere, latitude=latitude)
        needed = motions_needed(result.solution, none_suffices, somewhere, quality=found.statistics)
        assert needed['reference.earth_rate.x'][0] == wanted


def test_a_bias_that_wanders_slowly_neither_shows_nor_hides_another_latitude():
    """With a line for the biases 2 of 20 are noted without a reason, and 5 of 20 are found."""
    slow = {'noise': 1e-5, 'stay': 3, 'wave': 8e-5}
    n_false = n_found = 0
    for seed in range(20):
        n_false += len(of_windows(windows_of(LATITUDE, seed=seed, **slow)))
        n_found += len(of_windows(windows_of(15.0, seed=seed, **slow)))
    assert n_false == 0 and n_found == 20
