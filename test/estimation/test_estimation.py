"""
The estimator.

Exactness without noise, and standard deviations that match the scatter over many sessions.
"""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.forward_equations import References, coefficients, columns, predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation import noise_model
from imu_calibration.estimation.accumulator import Accumulator, restrict
from imu_calibration.estimation.solver import solve
from imu_calibration.estimation.weighted_system import make_prior
from imu_calibration.estimation.window_statistics import reduce_windows
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES, SimulatedNoise, gauss_markov
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate

TABLE = Table.from_mapping(
    {
        'joints': [
            {'name': 'outer', 'axis': [0, 0, 1]},
            {'name': 'middle', 'axis': [0, 1, 0]},
            {'name': 'inner', 'axis': [1, 0, 0]},
        ],
        'up': [0, 0, 1],
        'latitude': 48.8,
        'height': 150.0,
        'azimuth_deg': 0.0,
    }
)
INDUSTRIAL = GRADES['industrial'].noise
WHITE = (INDUSTRIAL.accel_density * 10.0, INDUSTRIAL.gyro_density * 10.0)
"""Standard deviation of single samples at 100 Hz."""
FULL = SensorModel(
    accelerometer=('bias', 'matrix', 'accel_size_effect', 'lever_arm'), reference=('table_tilt',)
)


@pytest.fixture(scope='module')
def session():
    """
    Windows of a short full session, as long as its noise allows.

    Their outputs are replaced by each test.
    """
    profile = make_profile('quick', 0, TABLE)
    white = SimulatedNoise(
        accel_density=INDUSTRIAL.accel_density, gyro_density=INDUSTRIAL.gyro_density
    )
    imu, joints, _ = simulate(
        SensorModel(),
        SensorModel().start(),
        TABLE,
        profile=profile,
        options=SimulationOptions(noise=white),
        seed=0,
    )
    gatherer = MotionGatherer(TABLE)
    return gatherer.push(SampleBlock(imu, joints)) + gatherer.finish()


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


def accumulate(windows, model, column_function=columns):
    """Return the least-squares system of windows."""
    accumulator = Accumulator()
    for window in windows:
        accumulator.add(reduce_windows([window], model, TABLE, column_function=column_function)[0])
    return accumulator


class SameMotion:
    """Columns of windows whose motion is the same in every trial, worked out once."""

    def __init__(self):
        self.known = {}

    def __call__(self, references, sensor):
        key = sensor, id(references.motion)
        if key not in self.known:
            self.known[key] = columns(references, sensor)
        return self.known[key]

    def outputs(self, session, values, rng):
        """
        Return the session's windows with outputs of FULL, white noise, and biases that wander.
        """
        found, times = [], np.arange(0.0, session[-1].time[-1] + 1.0, 0.5)
        wander = [
            gauss_markov(sd, 100.0, 0.5, shape=(len(times), 3), rng=rng)
            for sd in (INDUSTRIAL.accel_instability, INDUSTRIAL.gyro_instability)
        ]
        for window in session:
            n, near = len(window.time), np.rint(window.time / 0.5).astype(int)
            references = References(FULL, TABLE, window.motion)
            force, rate = (
                self(references, sensor) @ coefficients(FULL, sensor, values)
                + rng.normal(0, sd, (n, 3))
                + bias[near]
                for sensor, sd, bias in zip(('accelerometer', 'gyroscope'), WHITE, wander)
            )
            found.append(Window(**{**vars(window), 'force_s': force, 'rate_s': rate}))
        return found


def true_values(model, seed):
    """Return a random IMU on a slightly tilted table."""
    values = random_values(model, 'industrial', seed)
    if ('reference', 'table_tilt') in model.slices:
        values[model.slices['reference', 'table_tilt']] = np.random.default_rng(seed).normal(
            0, 5e-4, 2
        )
    values[model.slices['accelerometer', 'lever_arm']] = np.random.default_rng(seed + 1).normal(
        0, 0.02, 3
    )
    return values


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


@pytest.mark.long
def test_reported_standard_deviations_match_the_scatter(session):
    """
    A hundred and twenty sessions with white noise and wandering biases.

    Normalised errors, coverage, sd ratios, and efficiency.

    Bounds: mean square 0.95-1.05, coverage of the 95 % interval 93.5-96.5 %, sd ratio of each
    parameter 0.77-1.20: nothing is more than 1.3 times as wide as it scatters in the median session
    (biases allow for changes slower than the session), and fewer than one in twenty is half as wide
    again: where a parameter seems to drift.
    """
    normalised, errors, deviations, bounds, same = [], [], [], [], SameMotion()
    for seed in range(120):
        truth, rng = true_values(FULL, seed), np.random.default_rng([seed, 99])
        system = accumulate(same.outputs(session, truth, rng), FULL, same)
        solution = solve(system, FULL)
        error = solution.values - truth
        normalised.append(error / solution.sd)
        errors.append(error)
        deviations.append(solution.sd)
        if seed % 6 == 0:  # it depends on the values of the IMU by parts in a thousand
            bounds.append(cramer_rao(system, FULL))
    normalised, errors, deviations = (np.array(x) for x in (normalised, errors, deviations))
    mean_square, coverage = (normalised**2).mean(), (np.abs(normalised) < 1.96).mean()
    usual = np.median(deviations, axis=0)
    ratio, wide = errors.std(axis=0) / usual, (deviations > 1.5 * usual).mean()
    efficiency = np.sqrt((errors**2).mean(axis=0) / np.mean(bounds, axis=0))
    print(
        f'120 sessions: mean square {mean_square:.3f} wanted 0.95-1.05, coverage {coverage:.4f}'
        f' wanted 0.935-0.965, sd ratio {ratio.min():.2f}-{ratio.max():.2f} wanted 0.77-1.20, RMSE'
        f' over Cramer-Rao bound {np.sqrt((efficiency**2).mean()):.3f} wanted at most 1.05'
    )
    assert 0.95 <= mean_square <= 1.05
    assert 0.935 <= coverage <= 0.965
    assert ratio.min() >= 1 / 1.3 and ratio.max() <= 1.20
    assert wide < 0.05
    assert np.sqrt((efficiency**2).mean()) <= 1.05


def cramer_rao(system, model):
    """Return the variances that an estimator reaches which knows the noise exactly."""
    known = {
        sensor: noise_model.NoiseModel(
            np.full(3, sd**2), np.ones(3), bias_processes=(noise_model.BiasProcess(wander, 100.0),)
        )
        for sensor, sd, wander in zip(
            ('accelerometer', 'gyroscope'),
            WHITE,
            (INDUSTRIAL.accel_instability, INDUSTRIAL.gyro_instability),
        )
    }
    return np.diag(solve(system, model, noise=known).covariance)


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
    with refused(NotObservableError, 'undetermined', 'accel_size_effect'):
        solve(system, FULL, allow_holding=False)


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
        for index in range(part.start, part.stop):
            step = np.zeros(len(values))
            step[index] = 0.02 * effect.tolerance
            high, low = (
                predict(model, values + s * step, TABLE, motion=window.motion) for s in (1, -1)
            )
            for sensor, up, down in zip(('accelerometer', 'gyroscope'), high, low):
                design = columns(References(model, TABLE, window.motion), sensor)
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
