"""The function made for one calibration equals the catalogue's own compensation."""

import ast
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal import refused

from imu_calibration.compensation import kernel
from imu_calibration.compensation.compensate import Transfer, compensated_samples
from imu_calibration.compensation.kernel import (
    MAX_OPERATIONS,
    count_operations,
    kernel_text,
    make_kernel,
)
from imu_calibration.core.errors import InputError
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel

from worlds.compensation_cases import FURTHER, random_calibration, random_motion

some = {
    sensor: st.lists(st.sampled_from(names), unique=True).map(tuple)
    for sensor, names in FURTHER.items()
}
small = st.floats(-1.0, 1.0)
poses = st.none() | st.builds(
    lambda *n: Transfer.from_pose('base', n[:3], [3 * x for x in n[3:]]), *[small] * 6
)


def both(calibration, transfer, seed=0, n=12):
    force, rate, slope, temperature = random_motion(n, seed)
    alpha = slope @ np.linalg.inv(calibration.value('gyroscope', 'matrix')).T
    branch = np.random.default_rng([seed, 23]).uniform(-1.0, 1.0, n)
    vibration = np.random.default_rng([seed, 24]).uniform(0.0, 0.1, (n, 3))
    expected = compensated_samples(
        calibration,
        force,
        rate,
        alpha_s=alpha,
        temperature_c=temperature,
        thermal_branch=branch,
        vibration=vibration,
        transfer=transfer,
    )
    corrected = make_kernel(calibration, transfer)
    dt = temperature - calibration.model.temperature_ref_c
    got = np.array(
        [
            corrected(*row)
            for row in np.column_stack([force, rate, slope, dt, branch, vibration]).tolist()
        ]
    )
    return got, np.column_stack([expected.force, expected.rate])


@given(st.integers(0, 2**31), some['accelerometer'], some['gyroscope'], poses)
def test_the_kernel_equals_the_catalogue(seed, accelerometer, gyroscope, transfer):
    got, expected = both(random_calibration(seed, accelerometer, gyroscope), transfer, seed)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize('accelerometer', [(), ('accel_size_effect',)])
def test_the_usual_model_is_one_straight_line(accelerometer):
    calibration = random_calibration(2, accelerometer)
    text = kernel_text(calibration)
    assert 'for ' not in text and text.count('*') <= (66 if accelerometer else 18)
    assert ('ax' in text.split('\n', 1)[1]) is bool(accelerometer)
    got, expected = both(calibration, None)
    np.testing.assert_allclose(got, expected, atol=1e-13)


def test_zero_input_does_not_trip_the_asymmetry():
    calibration = random_calibration(2, ('accel_scale_asymmetry',), ('gyro_scale_asymmetry',))
    corrected = make_kernel(calibration)
    force, rate = (
        calibration.value(sensor, 'bias')[None] for sensor in ('accelerometer', 'gyroscope')
    )
    expected = compensated_samples(calibration, force, rate, alpha_s=np.zeros((1, 3)))
    got = corrected(*force[0].tolist(), *rate[0].tolist(), 0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(got, np.column_stack([expected.force, expected.rate])[0], atol=1e-15)


def with_own_effects(n_effects, n_functions):
    """Return a calibration with own effects, each a sum of functions of the force."""
    definitions = {}
    for k in range(n_effects):
        column = '+'.join(f'cos({k}.{j + 10}*f_y)' for j in range(n_functions))
        definitions[f'own_{k}'] = {
            'sensor': 'accelerometer',
            'column': column,
            'unit': 'm/s^2',
            'tolerance': 1e-3,
            'text': 'a sum of waves',
        }
    model = SensorModel(catalogue=CATALOGUE.with_definitions(definitions))
    for name in definitions:
        model = model.with_effect('accelerometer', name)
    values = model.start()
    for name in definitions:
        values[model.slices['accelerometer', name]] = 1e-3
    n_values = len(values)
    plain = random_calibration(0, ())
    return replace(
        plain,
        model=model,
        values=values,
        covariance=np.zeros((n_values, n_values)),
        status=('determined',) * n_values,
    )


def test_own_effects_have_a_limit_of_operations():
    """50 own effects of many functions needed 12.7 ms for one sample."""
    with refused(InputError, 'effects_cost', str(MAX_OPERATIONS)):
        make_kernel(with_own_effects(50, 22))
    few = with_own_effects(10, 22)
    assert MAX_OPERATIONS / 10 < count_operations(ast.parse(kernel_text(few))) < MAX_OPERATIONS
    assert np.all(np.isfinite(make_kernel(few)(*[1.0] * 10)))


@pytest.fixture
def usual_recursion():
    """The limit of a new interpreter; libraries of other tests raise it."""
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(1000)
    yield
    sys.setrecursionlimit(limit)


@pytest.mark.usefixtures('usual_recursion')
def test_a_sum_that_cannot_be_compiled_is_refused(monkeypatch):
    """The compiler recurses too deep: Python 3.11 at 3,000 terms, 3.13 above 9,000."""
    long = 'def kernel(*x):\n    return ' + ' + '.join(['1.5'] * 20_000)
    monkeypatch.setattr(kernel, 'kernel_text', lambda *_: long)
    with refused(InputError, 'effects_cost', str(MAX_OPERATIONS)):
        make_kernel(None)


def test_every_effect_of_the_catalogue_together_is_far_from_the_limit():
    every = random_calibration(0, FURTHER['accelerometer'], FURTHER['gyroscope'])
    assert count_operations(ast.parse(kernel_text(every))) < MAX_OPERATIONS / 4


def test_each_step_of_a_loop_counts():
    once = 'x = a * b + cos(c)\n'
    assert count_operations(ast.parse(once)) == 10
    loop = 'for _ in range(12):\n    x = a * b\n'
    assert count_operations(ast.parse(loop)) == 8 + 12 + 11 * 8
