"""
Relative arm of two IMUs.

The windows' identities, exact recovery, honest sd, what is refused (boards: validation/boards.py).
"""

import numpy as np
import pytest
from refusal import refused
from scipy.spatial.transform import Rotation

from imu_calibration.between_imus.arm import RelativeArm, estimate_arm
from imu_calibration.between_imus.pair import clipped, make_windows
from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.kinematics.rotations import lever_matrix

ARM = np.array([0.012, -0.019, 0.004])
AXES = np.array([[4.1, 0.9], [3.6, 1.3], [3.9, 0.7]])


def motion(time, rng, axes=(1, 1, 1), size=15.0):
    """
    Rate and its exact derivative.

    For each axis a fast twist and a slow one, and the force at A, which may be anything.
    """
    phase = rng.uniform(0, 2 * np.pi, (3, 2))
    rate, alpha = np.zeros((len(time), 3)), np.zeros((len(time), 3))
    for axis in range(3):
        for k, share in enumerate((1.0, 0.4)):
            angular = 2 * np.pi * AXES[axis, k]
            rate[:, axis] += axes[axis] * size * share * np.sin(angular * time + phase[axis, k])
            alpha[:, axis] += (
                axes[axis] * size * share * angular * np.cos(angular * time + phase[axis, k])
            )
    force = 9.8 * np.stack([np.sin(1.1 * time), np.cos(1.1 * time), 0.3 * np.sin(7 * time)], axis=1)
    return rate, alpha, force


def pair(
    seed,
    period=0.016,
    period_b=None,
    duration=60.0,
    late=0.0,
    turn=(0, 0, 0),
    force_sd=0.0,
    rate_sd=0.0,
    limit=None,
    axes=(1, 1, 1),
):
    """
    Two IMUs on one body, twisted.

    B is turned by the rotation vector `turn` and its stamps are `late`.
    """
    rng = np.random.default_rng(seed)
    phases = rng.integers(2**31)
    mat_ab = Rotation.from_rotvec(turn).as_matrix()
    imus = []
    for which, step in (('a', period), ('b', period_b or period)):
        time = step * np.arange(int(duration / step))
        rate, alpha, force = motion(
            time - (late if which == 'b' else 0.0), np.random.default_rng(phases), axes
        )
        if which == 'b':
            force = (force + np.einsum('nij,j->ni', lever_matrix(rate, alpha), ARM)) @ mat_ab
            rate = rate @ mat_ab
        rate = rate + rng.normal(0, rate_sd, rate.shape)
        imus.append(
            ImuSamples(
                10**18 + np.round(1e9 * time).astype(np.int64),
                force + rng.normal(0, force_sd, force.shape),
                rate if limit is None else np.clip(rate, -limit, limit),
            )
        )
    return *imus, mat_ab


def naive_arm(imu_a, imu_b):
    """Plain least squares with central differences of the rate."""
    alpha = np.gradient(imu_a.rate_s, 1e-9 * (imu_a.stamp_ns - imu_a.stamp_ns[0]), axis=0)
    lever = lever_matrix(imu_a.rate_s, alpha)[1:-1]
    return np.linalg.lstsq(
        lever.reshape(-1, 3), (imu_b.force_s - imu_a.force_s)[1:-1].ravel(), rcond=None
    )[0]


def test_windows_integrate_by_parts():
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.0035, 0.0045, 2000))
    windows = make_windows(time, np.arange(1.0, 6.0, 0.1), 0.15)
    values = np.stack([np.ones_like(time), time, np.sin(20 * time)], axis=1)
    slopes = np.stack([np.zeros_like(time), np.ones_like(time), 20 * np.cos(20 * time)], axis=1)
    # Quadrature over uneven stamps.
    np.testing.assert_allclose(windows.mean(values)[:, 0], 1.0, atol=2e-3)
    np.testing.assert_allclose(windows.slope(values), windows.mean(slopes), atol=0.1)
    # Eight samples, anywhere in the window.
    even = make_windows(0.01 * np.arange(1000), np.arange(1.003, 8.0, 0.097), 0.08)
    np.testing.assert_allclose(even.mean(np.ones((1000, 1))), 1.0, rtol=1e-12)
    np.testing.assert_allclose(even.slope(0.01 * np.arange(1000)[:, None]), 1.0, rtol=2e-3)


def test_exact_where_a_central_difference_makes_the_arm_too_long():
    imu_a, imu_b, _ = pair(2)
    found = estimate_arm(imu_a, imu_b)
    np.testing.assert_allclose(found.arm, ARM, atol=2e-5)
    # sin(x)/x at 4 Hz and 16 ms is 0.973: the tangential half of the equation is that much too
    # small
    assert 1.01 < np.linalg.norm(naive_arm(imu_a, imu_b)) / np.linalg.norm(ARM) < 1.05


@pytest.mark.parametrize(
    'turn',
    [
        (np.pi, 0, 0),
        (0, np.pi - 1e-9, 0),
        (0, 0, np.pi - 1e-4),
        (np.pi / np.sqrt(2), 0, np.pi / np.sqrt(2)),
        (0, 0, 0),
        (0, 0, 1e-5),
    ],
)
def test_the_angle_holds_for_imus_mounted_upside_down(turn):
    found = RelativeArm(
        ARM,
        np.eye(3),
        Rotation.from_rotvec(turn).as_matrix(),
        0.0,
        ('determined',) * 3,
        {
            'windows': 1,
            'window': 0.1,
            'clipped_share': 0.0,
            'signal_rms': 1.0,
            'residual_rms': 1.0,
            'calibrated': True,
        },
    )
    assert next(iter(found.lines())).startswith(
        f'B is turned by {np.degrees(np.linalg.norm(turn)):.2f} deg against A'
    )


def test_stamps_rates_and_axes_of_the_two_need_not_agree():
    imu_a, imu_b, mat_ab = pair(3, period=0.01, period_b=0.0113, late=0.0037, turn=(0.4, -1.2, 0.3))
    found = estimate_arm(imu_a, imu_b)
    assert found.time_offset == pytest.approx(0.0037, abs=2e-5)
    np.testing.assert_allclose(found.mat_ab, mat_ab, atol=2e-4)
    np.testing.assert_allclose(found.arm, ARM, atol=1e-4)


def test_a_gyroscope_that_lags_its_accelerometer_is_seen_and_does_no_harm():
    imu_a, imu_b, _ = pair(4, period=0.01)
    lagging = [
        ImuSamples(imu.stamp_ns[1:], imu.force_s[1:], imu.rate_s[:-1]) for imu in (imu_a, imu_b)
    ]
    found = estimate_arm(*lagging)
    assert found.diagnostics['rate_delay'] == pytest.approx(0.01, abs=1e-3)
    np.testing.assert_allclose(found.arm, ARM, atol=3e-4)


def test_clipped_stretches_are_left_out():
    """
    Half of the clipped samples kept (one sign only) would make the arm several percent too long.
    """
    imu_a, imu_b, _ = pair(5, limit=16.0)
    assert np.mean(clipped(imu_a.rate_s)) > 0.1
    found = estimate_arm(imu_a, imu_b)
    np.testing.assert_allclose(found.arm, ARM, atol=5e-5)
    assert found.diagnostics['clipped_share'] > 0.2
    assert np.linalg.norm(naive_arm(imu_a, imu_b)) > 1.04 * np.linalg.norm(ARM)


def test_clipping_needs_the_same_extreme_again_and_again():
    rng = np.random.default_rng(6)
    assert not np.any(clipped(rng.normal(size=(1000, 3))))
    values = np.clip(rng.normal(size=(1000, 3)), -9.0, 1.5)
    np.testing.assert_array_equal(clipped(values), np.any(values == 1.5, axis=1))


def test_sd_are_honest():
    """
    z scores of 10 seeds x 3 axes.

    Their mean square scatters by 0.26 around 1, more for the 15 stretches that each sd comes from.
    """
    scores = []
    for seed in range(10):
        imu_a, imu_b, _ = pair(100 + seed, force_sd=0.5, rate_sd=0.02, duration=30.0)
        found = estimate_arm(imu_a, imu_b)
        scores.append((found.arm - ARM) / found.diagnostics['motion_sd'])
        assert not found.diagnostics['calibrated'] and np.all(
            found.diagnostics['calibration_sd'] > np.zeros(3)
        )
    # 1.33 for these seeds, 1.15 for 40: an sd wrong by a factor of 1.5 gives 0.59 or 3.0.
    assert 0.7 < np.mean(np.square(scores)) < 1.9


@pytest.mark.slow
def test_noise_of_the_gyroscopes_does_not_shorten_the_arm():
    """
    Errors in variables.

    At this noise least squares on the same windows without the correction is some 3 % short.
    """
    arms, attenuation = [], []
    for seed in range(3):
        imu_a, imu_b, _ = pair(200 + seed, axes=(0.1, 0.1, 0.1), rate_sd=0.3, force_sd=0.5)
        found = estimate_arm(imu_a, imu_b)
        arms.append(found.arm)
        attenuation.append(found.diagnostics['attenuation'])
    length = np.mean(arms, axis=0) @ ARM / (ARM @ ARM)
    assert np.mean(attenuation) > 0.01
    assert length == pytest.approx(1.0, abs=0.012)


def test_one_axis_of_rotation_does_not_show_the_arm_along_it():
    imu_a, imu_b, _ = pair(7, axes=(0, 0, 1), force_sd=0.05, rate_sd=0.002)
    with refused(NotObservableError, 'arm_not_observable'):
        estimate_arm(imu_a, imu_b)


def test_no_motion_and_no_overlap_are_refused():
    imu_a, imu_b, _ = pair(8, duration=10.0)
    with refused(InputError, 'no_overlap'):
        estimate_arm(imu_a, ImuSamples(imu_b.stamp_ns + 10**12, imu_b.force_s, imu_b.rate_s))
    with refused(InputError, 'too_few_samples', 16):
        estimate_arm(imu_a, imu_b.select(slice(0, 5)))
