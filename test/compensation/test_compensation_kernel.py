"""The function made for one calibration equals the catalogue's own compensation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imu_calibration.compensation.compensate import Transfer, compensate
from imu_calibration.compensation.kernel import kernel_text, make_kernel

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
    expected = compensate(
        calibration,
        force,
        rate,
        alpha_s=alpha,
        temperature_c=temperature,
        thermal_branch=branch,
        vibration=vibration,
        transfer=transfer,
    )
    kernel = make_kernel(calibration, transfer)
    dt = temperature - calibration.model.temperature_ref_c
    got = np.array(
        [
            kernel(*row)
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
    kernel = make_kernel(calibration)
    force, rate = (
        calibration.value(sensor, 'bias')[None] for sensor in ('accelerometer', 'gyroscope')
    )
    expected = compensate(calibration, force, rate, alpha_s=np.zeros((1, 3)))
    got = kernel(*force[0].tolist(), *rate[0].tolist(), 0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(got, np.column_stack([expected.force, expected.rate])[0], atol=1e-15)
