"""
The estimator.

Exactness without noise, and standard deviations that match the scatter over many sessions.
"""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core.errors import NotObservableError
from imu_calibration.effects.forward_equations import References, coefficients, columns, predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.accumulator import Accumulator, restrict
from imu_calibration.references.turntable.estimation.solver import solve

from worlds.scatter import (
    FULL,
    TABLE,
    accumulate,
    scatter,
    true_values,
    windows_of_a_short_session,
)


@pytest.fixture(scope='module')
def session():
    """Windows whose outputs each test replaces."""
    return windows_of_a_short_session()


def measured(windows, model, values, rng, force_sd=0.0, rate_sd=0.0, offset=0.0):
    """
    Return the windows with outputs of the model, white noise, and offsets.

    The offset of each window is in units of the mean's noise.
    """
    result = []
    for window in windows:
        force, rate = predict(model, values, TABLE, motion=window.motion)
        n = len(window.time)
        force, rate = (
            (
                output + rng.normal(0, sd, (n, 3)) + rng.normal(0, offset * sd, 3)
                if sd
                else np.broadcast_to(output, (n, 3)).copy()
            )
            for output, sd in ((force, force_sd), (rate, rate_sd))
        )
        result.append(Window(**{**vars(window), 'force_s': force, 'rate_s': rate}))
    return result


def test_noise_free_session_gives_the_truth(session):
    """
    Bilinear products, arms and gauge are exact.

    The tilt is linear to first order, 1e-7 of g at 5e-4 rad.
    """
    model = FULL.without('reference', 'table_tilt')
    truth = true_values(model, 3)
    solution = solve(
        accumulate(measured(session, model, truth, np.random.default_rng(0)), model), model
    )
    assert not solution.held.any()
    np.testing.assert_allclose(solution.values, truth, atol=2e-9)


def test_reported_standard_deviations_match_the_scatter(session):
    """
    Eight sessions with white noise and wandering biases; 120 are a section of `make validate`.

    The standard deviations over 24 groups of eight other seeds are 0.08 for the mean square and
    1.2 % for the coverage, about means of 0.96 and 95.5 %.
    """
    found = scatter(session, range(8))
    assert 0.8 <= found.mean_square <= 1.2
    assert 0.91 <= found.coverage <= 0.985
    assert found.widest_share < 0.05
    assert found.over_bound <= 1.10


def test_undetermined_parameters_are_held_and_carried(session):
    """
    Static windows say nothing of arms and gyroscope scale.

    They stay at their prior, with its standard deviation.
    """
    truth = true_values(FULL, 5)
    static = [
        w
        for w in measured(session, FULL, truth, np.random.default_rng(1), 0.01, 0.001)
        if w.kind == 'static'
    ]
    system = accumulate(static, FULL)
    solution = solve(system, FULL)
    prior = make_prior(FULL)
    held = solution.held
    for effect in (
        ('accelerometer', 'accel_size_effect'),
        ('accelerometer', 'lever_arm'),
        ('gyroscope', 'matrix'),
    ):
        assert held[FULL.slices[effect]].all()
    assert not held[FULL.slices['accelerometer', 'matrix']].any()
    np.testing.assert_array_equal(solution.values[held], prior.mean[held])
    np.testing.assert_allclose(solution.sd[held], prior.sd[held])


def test_nothing_to_solve_is_refused():
    """An empty system says what to do."""
    with refused(NotObservableError, 'no_windows'):
        solve(Accumulator(), FULL)


def test_order_of_windows_and_merging_do_not_matter(session):
    """One accumulator, or two merged, give the same solution."""
    windows = measured(session, FULL, true_values(FULL, 7), np.random.default_rng(2), 0.01, 0.001)
    first, second = accumulate(windows[:30], FULL), accumulate(windows[30:], FULL)
    first.merge(second)
    together, merged = solve(accumulate(windows, FULL), FULL), solve(first, FULL)
    assert np.max(np.abs(together.values - merged.values) / together.sd) < 1e-6


def test_fewer_columns_are_the_same_as_a_smaller_model(session):
    """Leaving columns out of a wide system gives what the narrow one would have gathered."""
    narrow = SensorModel()
    windows = measured(session, FULL, true_values(FULL, 8), np.random.default_rng(4), 0.01, 0.001)
    direct, cut = (
        solve(accumulate(windows, narrow), narrow),
        solve(restrict(accumulate(windows, FULL), FULL, narrow), narrow),
    )
    assert np.max(np.abs(direct.values - cut.values) / direct.sd) < 1e-6


@pytest.mark.parametrize(
    'name',
    [
        'accel_quadratic',
        'accel_cubic',
        'accel_scale_asymmetry',
        'accel_cross_product',
        'gyro_quadratic',
        'gyro_g_sensitivity',
        'gyro_rate_product',
        'gyro_scale_asymmetry',
        'accel_bandwidth',
        'gyro_bandwidth',
        'time_offset',
        'table_tilt',
        'axis_non_orthogonality',
        'encoder_zero',
        'encoder_harmonic',
        'earth_rate',
    ],
)
def test_columns_are_the_derivative_of_the_prediction(session, name):
    """
    Columns times the derivative of the coefficients equal finite differences.

    The finite differences are of the forward equations.
    """
    from imu_calibration.effects.catalogue import CATALOGUE

    owner = CATALOGUE.owner_of(name)
    model = FULL.with_effect(owner, name) if (owner, name) not in FULL.slices else FULL
    values = true_values(model, 11)
    part = model.slices[owner, name]
    effect = next(e for e in model.effects if (e.sensor, e.name) == (owner, name))
    rng = np.random.default_rng(5)
    start = (
        np.abs(rng.normal(0, 0.1 * effect.tolerance, effect.size))
        + (20 if effect.unit == 's' else 2) * effect.tolerance
    )
    values[part] = start
    model = model.at(values)
    windows = [w for w in session if w.kind == 'dynamic'][:3] + [
        w for w in session if w.kind == 'spin'
    ][:2]
    for window in windows:
        designs = {
            sensor: columns(References(model, TABLE, window.motion), sensor)
            for sensor in ('accelerometer', 'gyroscope')
        }
        for index in range(part.start, part.stop):
            step = np.zeros(len(values))
            step[index] = 0.02 * effect.tolerance
            high, low = (
                predict(model, values + s * step, TABLE, motion=window.motion) for s in (1, -1)
            )
            for (sensor, design), up, down in zip(designs.items(), high, low):
                derivative = design @ (
                    coefficients(model, sensor, values + step)
                    - coefficients(model, sensor, values - step)
                )
                scale = max(np.max(np.abs(up - down)), 1e-9)
                np.testing.assert_allclose(derivative, up - down, atol=0.01 * scale + 1e-10)


def test_a_warp_of_one_sensor_leaves_the_other_sensors_motion_alone(session):
    """
    The table's tilt concerns the accelerometer.

    Worked out together, the columns of both are those worked out apart (to the bit).
    """
    model = FULL.with_effect('gyroscope', 'gyro_bandwidth').with_effect('reference', 'time_offset')
    values = model.start()
    (
        values[model.slices['reference', 'table_tilt']],
        values[model.slices['gyroscope', 'gyro_bandwidth']],
    ) = (0.004, -0.003), 0.01
    model, window = model.at(values), next(w for w in session if w.kind == 'dynamic')
    together = References(model, TABLE, window.motion)
    for sensor in ('accelerometer', 'gyroscope'):
        np.testing.assert_array_equal(
            columns(together, sensor), columns(References(model, TABLE, window.motion), sensor)
        )
