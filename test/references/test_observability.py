"""What a recording can determine, in tolerances, and what a standard motion would add to it."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.core.units import DEG
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.motions import SENSOR_MOTIONS, TABLE_MOTIONS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.estimation.solution import Solution
from imu_calibration.references.turntable import observability
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.observability import (
    MotionInformation,
    needed_motions,
    tolerance_scaled_singular_values,
    weak_directions,
)
from imu_calibration.references.turntable.standard_motions import MOTIONS

GRAVITY = 9.81
MODEL = SensorModel()
NAMES = list(MODEL.param_names)
NOISE = {
    sensor: NoiseModel(
        np.array([1.0, 4.0, 9.0]) * variance,
        np.full(3, 2.0),
        1e-4,
        (BiasProcess(2e-4, 100.0), BiasProcess(1e-4, 10.0)),
    )
    for sensor, variance in (('accelerometer', 1e-4), ('gyroscope', 1e-6))
}
BY_NAME = {motion.name: motion for motion in MOTIONS}


def added(name, model=MODEL, noise=NOISE):
    return MotionInformation(model, model.start(), noise, GRAVITY).added_by(BY_NAME[name])


def test_a_rest_adds_what_means_of_five_seconds_say():
    """
    Information is one over the variance of the mean: noise within, offset, and all bias processes.
    """
    information, pieces = added('static_poses'), BY_NAME['static_poses'].make(GRAVITY)
    for axis in range(3):
        noise = NOISE['accelerometer']
        variance = 2.0 * noise.white_variance[axis] / 500 + 1e-8 + 4e-8 + 1e-8
        bias, scale = (
            NAMES.index(f'accelerometer.bias.{"xyz"[axis]}'),
            NAMES.index(f'accelerometer.matrix.{"xyz"[axis] * 2}'),
        )
        forces = np.array([piece.force_s[0, axis] for piece in pieces])
        np.testing.assert_allclose(information[bias, bias], len(pieces) / variance, rtol=1e-9)
        np.testing.assert_allclose(
            information[scale, scale], (forces**2).sum() / variance, rtol=1e-9
        )
        np.testing.assert_allclose(
            information[bias, scale], forces.sum() / variance, rtol=1e-9, atol=1e-3
        )


def test_a_rest_says_nothing_of_the_gyroscopes_scale_and_a_spin_about_an_axis_that_of_its_column():
    scale = [NAMES.index(f'gyroscope.matrix.{axis}z') for axis in 'xyz']
    other = NAMES.index('gyroscope.matrix.xx')
    assert np.all(np.diag(added('static_poses'))[scale] < 1e-12)
    spin = np.diag(added('spin_z'))
    assert np.all(spin[scale] > 1e3) and spin[other] < 1e-9 * spin[scale[0]]


def test_samples_in_motion_count_beside_their_mean():
    """An oscillation has a mean rate near zero: all that it says of the scale comes from within."""
    noise = {s: replace(n, offset_sd=1e3) for s, n in NOISE.items()}
    place = NAMES.index('gyroscope.matrix.zz')
    pieces = BY_NAME['oscillate_z'].make(GRAVITY)
    within = (
        sum(2.0 * ((piece.rate_s[:, 2] - piece.rate_s[:, 2].mean()) ** 2).sum() for piece in pieces)
        / NOISE['gyroscope'].low_variance[2]
    )
    np.testing.assert_allclose(added('oscillate_z', noise=noise)[place, place], within, rtol=1e-6)
    assert within > 0.5 * added('oscillate_z')[place, place]


def test_singular_values_are_tolerances_over_standard_deviations():
    sd, tolerances = np.array([1e-3, 2.0, 5.0]), np.array([1e-2, 2.0, 1.0])
    found = tolerance_scaled_singular_values(np.diag(sd**-2.0), tolerances)
    np.testing.assert_allclose(found, [10.0, 1.0, 0.2], rtol=1e-12)


def test_a_weak_direction_names_its_members_although_each_information_entry_is_large():
    """Two parameters whose difference is unknown: full rank, each sd three tolerances."""
    tolerances, sum_, difference = (
        np.array([1e-3, 1e-2, 1.0]),
        np.array([1, 1, 0]) / np.sqrt(2),
        np.array([1, -1, 0]) / np.sqrt(2),
    )
    scaled = (
        0.01 * np.outer(sum_, sum_) + 9.0 * np.outer(difference, difference) + np.diag([0, 0, 0.5])
    )
    found = weak_directions(scaled * np.outer(tolerances, tolerances), tolerances, ('a', 'b', 'c'))
    assert len(found) == 1 and set(found[0]) == {'a', 'b'}
    assert found[0]['a'] == pytest.approx(-found[0]['b'], abs=1e-3) and abs(
        found[0]['a']
    ) == pytest.approx(np.sqrt(0.5), abs=1e-3)
    assert (
        weak_directions(
            0.1 * scaled * np.outer(tolerances, tolerances), tolerances, ('a', 'b', 'c')
        )
        == []
    )


def solution(information, model=MODEL):
    """Return a Solution with this information of the data and the prior's."""
    sd = make_prior(model).sd
    covariance = np.linalg.inv(information + np.diag(sd**-2.0))
    return Solution(
        model,
        model.start(),
        {'noise': covariance},
        np.zeros(len(sd), bool),
        NOISE,
        {},
        information,
        {},
    )


def test_the_motion_that_is_needed_is_the_one_that_helps_most_with_the_sd_it_will_have():
    have = added('static_poses')
    tolerances = np.where(['gyroscope.matrix' in name for name in NAMES], 1e-3, np.inf)
    prior_sd = make_prior(MODEL).sd
    needed = needed_motions(solution(have), tolerances, GRAVITY, prior_sd=prior_sd)
    assert set(needed) == {name for name in NAMES if 'gyroscope.matrix' in name}
    after = {motion.text: solution(have + added(motion.name)).sd for motion in MOTIONS}
    for name, (text, sd) in needed.items():
        place = NAMES.index(name)
        assert sd == pytest.approx(after[text][place], rel=1e-6)
        assert sd == pytest.approx(min(sds[place] for sds in after.values()), rel=1e-6)
        assert sd < 1e-3 < prior_sd[place]


def test_nothing_is_needed_where_everything_is_determined():
    assert (
        needed_motions(
            solution(added('three_speeds') + added('static_poses')),
            np.full(len(NAMES), np.inf),
            GRAVITY,
            prior_sd=make_prior(MODEL).sd,
        )
        == {}
    )


def test_where_no_motion_of_the_sensor_helps_that_of_the_table_is_named():
    model = SensorModel(reference=('table_tilt',))
    tolerances = np.where(['table_tilt' in name for name in model.param_names], 1e-9, np.inf)
    needed = needed_motions(
        solution(added('static_poses', model), model),
        tolerances,
        GRAVITY,
        prior_sd=make_prior(model).sd,
    )
    assert {text for text, _ in needed.values()} == {TABLE_MOTIONS['turn_about_vertical']}
    assert all(np.isnan(sd) for _, sd in needed.values())


def test_every_motion_of_the_sensor_has_its_instruction():
    assert [motion.name for motion in MOTIONS] == list(SENSOR_MOTIONS)


def test_standard_motions_are_what_they_say():
    spin = BY_NAME['spin_z'].make(GRAVITY)
    assert sorted({round(float(piece.rate_s[0, 2] / DEG)) for piece in spin}) == [
        -200,
        -100,
        100,
        200,
    ]
    assert all(
        np.linalg.norm(piece.force_s[0]) == pytest.approx(GRAVITY)
        for piece in BY_NAME['static_dense'].make(GRAVITY)
    )


def _own_effect(column):
    """Return a model with an effect `mine` of one column."""
    definition = {
        'sensor': 'accelerometer',
        'column': column,
        'unit': 's^2/m',
        'tolerance': 1e-3,
        'text': 'mine',
        'tolerance_reason': 'a guess',
        'prior_sd': 1.0,
        'largest': 2.0,
    }
    catalogue = CATALOGUE.with_definitions({'mine': definition})
    return SensorModel(accelerometer=('bias', 'matrix', 'mine'), catalogue=catalogue)


def _at_time_constant(constant):
    """Return a model whose columns of a drift have this time constant."""
    model = SensorModel(gyroscope=('bias', 'matrix', 'gyro_bias_drift'))
    values = model.effects[-1].at_time_constant(constant)
    return replace(model, point={'gyro_bias_drift': values})


@pytest.mark.parametrize(
    ('first', 'second'),
    [
        (_own_effect('f_x * abs(f_x)'), _own_effect('f_y * abs(f_y)')),
        (_at_time_constant(30.0), _at_time_constant(300.0)),
    ],
)
def test_columns_of_a_motion_are_known_from_models_with_the_same_columns(first, second):
    known = [added('static_poses', model) for model in (first, second)]
    observability._motion_columns.cache_clear()
    fresh = [added('static_poses', model) for model in (second, first)]
    np.testing.assert_array_equal(known, fresh[::-1])
    assert not np.allclose(*known)
    n_computed = observability._motion_columns.cache_info().misses
    added('static_poses', replace(second))
    assert observability._motion_columns.cache_info().misses == n_computed
