"""The candidates of a search: the effects under test, as chosen, and those of the user."""

import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.effects.catalogue import CATALOGUE, term
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.questions import sort_effects

MINE = term(
    'gyro_mine', sensor='gyroscope', column='f_x', unit='rad/s', tolerance=1e-5, text='Mine.'
)


@pytest.mark.parametrize(
    ('candidates', 'tested'),
    (
        ('gyro_g_sensitivity+time_offset', {'gyro_g_sensitivity', 'time_offset', 'gyro_mine'}),
        ('none', {'gyro_mine'}),
    ),
)
def test_only_candidates_and_effects_of_the_user_are_tested(candidates, tested):
    model = SensorModel(catalogue=CATALOGUE.with_effects(MINE).with_candidates(candidates))
    effects, not_testable = sort_effects(model, lambda effect: None)
    assert {effect.name for effect in effects} == tested and not not_testable


def test_without_a_choice_every_effect_is_tested():
    every = CATALOGUE.with_candidates('none').with_candidates(None)
    assert len(sort_effects(SensorModel(catalogue=every), lambda effect: None)[0]) > 30


def test_an_unknown_candidate_is_refused_with_the_closest_name():
    with refused(InputError, 'effect_unknown', 'gyro_g_sensitivity'):
        CATALOGUE.with_candidates('gyro_gsensitivity')
