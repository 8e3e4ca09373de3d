"""The verdict on a calibration: each thing that makes it weak or bad alone, on a calibration that is good without it."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.reasons import BAD, GOOD, NOTE
from imu_calibration.calibration.status import DETERMINED, HELD, WEAK, tolerances_of
from imu_calibration.calibration.verdict import judge
from imu_calibration.constants import STANDARD_GRAVITY
from imu_calibration.effects.sensor_model import SensorModel

MODEL = SensorModel(reference=('table_tilt',))
NAMES = list(MODEL.param_names)
TOLERANCES = tolerances_of(MODEL, {})
SPIN = 'spin about the z axis'


def calibration(**changes):
    """Return a calibration with nothing against it: every sd a third of its tolerance, residuals as at rest."""
    sensor = {'noise_sd': [1e-3] * 3, 'between_window_sd': 0.0, 'wander_sd': 0.0, 'chi2_per_dof': {'means': 50.0, 'spin': 1.0}}
    statistics = {'accelerometer': dict(sensor), 'gyroscope': dict(sensor), 'windows': {'static': 9, 'spin': 3}, 'dropped': {}, 'samples_used': {'all': 1000}}
    whole = Calibration(MODEL, MODEL.start(), np.diag((TOLERANCES / 3)**2), (DETERMINED,) * len(NAMES), statistics=statistics)
    return replace(whole, **changes)


def with_status(status, *names, **changes):
    return calibration(status=tuple(status if name in names else DETERMINED for name in NAMES), **changes)


def with_statistics(sensor=None, **changes):
    base = calibration().statistics
    return calibration(statistics=base | (changes if sensor is None else {sensor: base[sensor] | changes}))


def test_nothing_against_it_is_good_and_names_the_closest_parameter():
    covariance = calibration().covariance.copy()
    place = NAMES.index('gyroscope.bias.y')
    covariance[place, place] = (0.9 * TOLERANCES[place])**2
    found = judge(calibration(covariance=covariance), TOLERANCES)
    assert found.word == GOOD and [reason.word for reason in found.reasons] == [GOOD]
    assert 'gyroscope.bias.y, at 90 % of it' in found.lines()[0] and 'all 24 parameters' in found.lines()[0]


@pytest.mark.parametrize('status', [WEAK, HELD])
def test_a_parameter_that_is_not_determined_makes_it_weak_with_the_motion_of_its_weak_direction(status):
    weak = ({'parameters': {'gyroscope.matrix.xx': 0.2, 'gyroscope.matrix.zz': 1.0}, 'needs': SPIN},
            {'parameters': {'gyroscope.matrix.zz': 0.3}, 'needs': 'something else'})
    found = judge(with_status(status, 'gyroscope.matrix.zz', undetermined=weak), TOLERANCES)
    assert found.word == WEAK
    assert [(reason.word, reason.next) for reason in found.reasons] == [(WEAK, SPIN)]
    assert found.reasons[0].what.startswith('gyroscope.matrix.zz: ')


def test_what_belongs_to_the_table_does_not_count():
    assert judge(with_status(HELD, 'reference.table_tilt.x', 'reference.table_tilt.y'), TOLERANCES).word == GOOD


@pytest.mark.parametrize(('factor', 'word', 'reason'), [(10.1, BAD, BAD), (9.9, GOOD, NOTE), (2.1, GOOD, NOTE), (1.9, GOOD, None)])
def test_residuals_in_motion_against_the_noise_at_rest(factor, word, reason):
    found = judge(with_statistics('gyroscope', chi2_per_dof={'means': 1e3, 'spin': factor}), TOLERANCES)
    words = [r.word for r in found.reasons if f'{np.sqrt(factor):.1f} times the noise at rest' in r.what and r.word != GOOD]
    assert found.word == word and words == ([reason] if reason else [])


@pytest.mark.parametrize(('interval', 'regime', 'word'), [((0.1, 0.2), (0.3, 0.4), WEAK), ((0.1, 0.2), (0.9, 1.01), BAD), ((0.9, 1.01), (0.3, 0.4), BAD)])
def test_residuals_far_above_the_noise_are_weak_beside_a_proof_of_help_in_every_motion(interval, regime, word):
    base = with_statistics('gyroscope', chi2_per_dof={'spin': 20.0})
    entry = {'before': 2.0, 'after': 1.0, 'unit': 'rad/s', 'windows': 9, 'ci95': interval}
    proof = {'gyroscope': entry | {'regimes': {'turns': {'before': 2.0, 'after': 1.0, 'ci95': regime}}}}
    found = judge(replace(base, proof=proof), TOLERANCES)
    if interval[1] < 1:
        assert found.word == word and 'residuals of spin windows are 4.5 times' in found.lines()[0]
        assert ('helps in every motion' in found.lines()[0]) == (word == WEAK)
    assert judge(base, TOLERANCES).word == BAD and (found.word == BAD) == (word == BAD)
    restless = replace(base, proof=proof, statistics=base.statistics | {'windows': {'spin': 3}})
    assert judge(restless, TOLERANCES).word == BAD   # late by a period of the motion


def test_without_rest_residuals_are_compared_with_their_slow_part():
    base = with_statistics('gyroscope', chi2_per_dof={'spin': 20.0})
    text = judge(replace(base, statistics=base.statistics | {'windows': {'spin': 3}}), TOLERANCES).lines()[0]
    assert 'times their slow part' in text


def test_a_sensor_of_which_nothing_is_determined_is_bad():
    gyroscope = [name for name in NAMES if name.startswith('gyroscope')]
    found = judge(with_status(HELD, *gyroscope), TOLERANCES)
    assert found.word == BAD and found.reasons[0].what == 'the recording says nothing about the gyroscope'
    assert judge(with_status(HELD, *gyroscope[1:]), TOLERANCES).word == WEAK


def test_a_value_that_no_instrument_has_is_bad():
    values = MODEL.start()
    values[NAMES.index('accelerometer.bias.y')] = 1000.0
    found = judge(calibration(values=values), TOLERANCES)
    assert found.word == BAD and 'check the units' in found.reasons[0].next


def test_the_gravest_reason_comes_first():
    base = with_status(WEAK, 'accelerometer.bias.x')
    found = judge(replace(base, statistics=with_statistics('gyroscope', chi2_per_dof={'spin': 20.0}).statistics), TOLERANCES)
    assert [reason.word for reason in found.reasons] == [BAD, WEAK]
    assert found.lines()[-2].startswith('weak: ')


def test_a_gravity_that_was_not_given_is_asked_for_once_and_by_hand_only():
    scales = [f'accelerometer.matrix.{axis}{axis}' for axis in 'xyz']
    gauge, conditions = {'axes': 'accelerometer_lower_triangular'}, {'gravity': STANDARD_GRAVITY}
    found = judge(with_status(WEAK, *scales, gauge=gauge, conditions=conditions), TOLERANCES)
    assert [reason.key for reason in found.reasons] == ['gravity', None] and 'not proven: too few attitudes' in found.reasons[1].what
    assert judge(with_status(WEAK, *scales, conditions=conditions), TOLERANCES).reasons[0].key is None


def test_a_bias_that_moves_more_than_its_tolerance_is_a_note():
    tolerance = TOLERANCES[NAMES.index('gyroscope.bias.x')]
    for share, words in ((1.1, [NOTE]), (0.9, [])):
        found = judge(with_statistics('gyroscope', between_window_sd=0.8 * share * tolerance, wander_sd=0.6 * share * tolerance), TOLERANCES)
        assert found.word == GOOD and [reason.word for reason in found.reasons[1:]] == words


def test_many_lost_samples_are_worth_a_look():
    for share, looks in ((0.06, True), (0.04, False)):
        note = judge(with_statistics(dropped={'imu late': int(1000 * share)}), TOLERANCES).reasons[-1]
        assert note.word == NOTE and f'{int(1000 * share)} imu late' in note.what and bool(note.next) == looks
