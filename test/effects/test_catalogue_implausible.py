"""A size beyond what is known of any instrument: said, marked, and in no model unless asked for."""

import numpy as np
import pytest

import imu_calibration as imu
from imu_calibration.core.units import STANDARD_GRAVITY as G
from imu_calibration.document.calibration import beyond_known
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.live_diagnosis import live_state_of

from worlds import physics
from worlds.candidates import FEW

CUBIC = np.array([8e-3, -6e-3, 7e-3]) / G**2
"""8 mg at 1 g: what saturates looks like that, and no accelerometer is."""
NAMES = [f'accelerometer.accel_cubic.{axis}' for axis in 'xyz']


@pytest.fixture(scope='module')
def strange():
    """A session with such a cubic term, and its table."""
    session = physics.make_session(
        41, {'accel_cubic': CUBIC}, profile='six_faces', imu_rate=50.0, joint_rate=50.0
    )
    return session.block, Table.from_mapping(session.table)


@pytest.fixture(scope='module')
def diagnosed(strange):
    return imu.diagnose(*strange, candidates=FEW)


def test_it_is_named_with_its_size_and_a_mark(diagnosed):
    first, *more = diagnosed.document['findings']
    assert (
        not more
        and (first['effect'], first['implausible']) == ('accel_cubic', True)
        and first['share_of_unexplained'] > 0.9
    )
    for name, true in zip(NAMES, CUBIC):
        assert (
            abs(first['parameters'][name]['value'] - true)
            < 4.5 * first['parameters'][name]['sd']
            < 0.2 * abs(true)
        )
    line = str(diagnosed).splitlines()[0]
    assert all(part in line for part in ('accel_cubic', 'implausible', '100 %', 'saturation'))
    assert 'implausible</span>' in diagnosed.report


def test_live_it_is_said_too(diagnosed):
    state = live_state_of(diagnosed.result.diagnosis)
    assert (
        state.message.startswith('accel_cubic (implausible): ')
        and state.values['implausible'] == 'accel_cubic'
    )


@pytest.fixture(scope='module')
def asked_for(strange):
    return imu.calibrate(
        *strange, accelerometer_model='bias+matrix+accel_cubic', candidates=FEW
    ).calibration


def test_it_is_in_no_model_and_widens(diagnosed, strange, asked_for):
    """
    The calibration says what is known, and errs by no more than it says.

    A cubic term is half a scale factor.
    """
    calibration = diagnosed.calibration
    assert not set(NAMES) & set(calibration.param_names) and 'added' not in calibration.statistics
    assert list(calibration.statistics['implausible']) == ['accel_cubic']
    assert any('accel_cubic' in line for line in calibration.notes)
    asked = imu.calibrate(
        *strange, accelerometer_model='bias+matrix', model_as_asked=True
    ).calibration
    scale, place = (
        'accelerometer.matrix.xx',
        calibration.param_names.index('accelerometer.matrix.xx'),
    )
    error = abs(calibration.values[place] - asked_for.values[asked_for.param_names.index(scale)])
    assert (
        calibration.sd[place] > 5 * asked.sd[place]
        and asked.sd[place] < error < 2 * calibration.sd[place]
    )


def test_who_asks_for_it_gets_it(asked_for):
    value = asked_for.values[[asked_for.param_names.index(name) for name in NAMES]]
    np.testing.assert_allclose(value, CUBIC, rtol=0.05)


@pytest.mark.parametrize(
    ('size', 'sd', 'beyond'), ((9.0, 0.0, False), (11.0, 0.0, True), (11.0, 0.5, False))
)
def test_beyond_is_ten_times_the_largest_known_for_sure(size, sd, beyond):
    effect = CATALOGUE.find('accelerometer', 'accel_cubic')
    assert (
        effect.surpasses(np.array([0.0, -size, 0.0]) * effect.largest, sd * effect.largest)
        == beyond
    )


def test_a_table_is_not_told_to_look_for_saturation():
    assert 'saturation' in beyond_known(0.9, 'accelerometer') and 'table' in beyond_known(
        0.9, 'reference'
    )
