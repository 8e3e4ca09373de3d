"""Dead reckoning: exact cases, and Zhang's navigation claims (targets N1-N3)."""

import numpy as np
import pytest
from papers import zhang2017 as zhang
from papers import zhang2017_joint_fit as zhang_designs
from refusal import refused
from scipy.spatial.transform import Rotation

from imu_calibration.core.errors import InputError
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.kinematics import strapdown
from imu_calibration.kinematics.rotations import Reference

from worlds.figures import show

G = STANDARD_GRAVITY
MODEL = zhang.printed_static_model()
COSINES = zhang.static_model_from_matrix(MODEL.matrix, MODEL.bias).cosines
ARMS = zhang.TABLE_3_ARMS


def reference_of(motion, gravity=G):
    mat_sn = np.swapaxes(motion.mat_ns, 1, 2)
    return Reference(
        motion.time, mat_sn, mat_sn @ np.array([0, 0, gravity]), motion.rate, motion.alpha, gravity
    )


def test_attitude_of_a_constant_turn_is_exact_and_stays_orthonormal():
    time = np.linspace(0, 20, 4001)
    rate = np.array([0.4, -1.1, 0.7])
    mat_ns = strapdown.integrate_attitude(time, np.tile(rate, (len(time), 1)))
    np.testing.assert_allclose(
        mat_ns, Rotation.from_rotvec(np.outer(time, rate)).as_matrix(), atol=1e-11
    )
    np.testing.assert_allclose(mat_ns[-1] @ mat_ns[-1].T, np.eye(3), atol=1e-11)


def test_attitude_of_coning_converges_with_the_square_of_the_step():
    """
    A cone of half angle 0.3 rad, known in closed form.

    The trapezoid's own error is (spin step)^2 / 12 = 4e-4.
    """

    def error(step):
        time = np.arange(0, 2 + step / 2, step)
        half, spin = 0.3, 7.0
        tip = np.column_stack([np.cos(spin * time), np.sin(spin * time), 0 * time])
        exact = Rotation.from_rotvec(half * tip).as_matrix()
        across = np.sin(half) * np.column_stack(
            [-np.sin(spin * time), np.cos(spin * time), 0 * time]
        )
        mat_ns = strapdown.integrate_attitude(
            time, spin * (across - [0, 0, 1 - np.cos(half)]), exact[0]
        )
        return np.max(np.abs(mat_ns - exact))

    coarse, fine = error(0.02), error(0.01)
    assert fine < 6e-4 and coarse / fine == pytest.approx(4, rel=0.05)


def test_dead_reckoning_of_constant_and_circular_motion():
    time = np.linspace(0, 10, 2001)
    velocity, position = strapdown.dead_reckon(time, np.tile([0.2, 0, G], (len(time), 1)), G)
    np.testing.assert_allclose(velocity[:, 0], 0.2 * time, atol=1e-12)
    np.testing.assert_allclose(position[-1], [10.0, 0, 0], atol=1e-9)
    assert zhang.constant_error_growth(0.2, 10.0) == pytest.approx((2.0, 10.0))
    swing = np.column_stack([np.sin(2 * time), 0 * time, np.full(len(time), G)])
    velocity, position = strapdown.dead_reckon(time, swing, G)
    np.testing.assert_allclose(velocity[:, 0], (1 - np.cos(2 * time)) / 2, atol=1e-5)
    np.testing.assert_allclose(position[:, 0], time / 2 - np.sin(2 * time) / 4, atol=1e-4)


def test_drift_is_zero_for_perfect_samples_and_follows_one_fault():
    motion = zhang.tumble((20, 20, 20), (0.3, 0.4, 0.5), seconds=20, sample_rate=100)
    reference = reference_of(motion)
    assert not np.any(
        strapdown.dead_reckoning_errors(reference, reference.force_s, reference.rate_s)
    )
    still = Reference(
        np.arange(0, 100.01, 0.01),
        np.tile(np.eye(3), (10001, 1, 1)),
        np.tile([0, 0, G], (10001, 1)),
        np.zeros((10001, 3)),
        np.zeros((10001, 3)),
        G,
    )
    velocity, position = strapdown.dead_reckoning_errors(
        still, still.force_s + [0.01, 0, 0], still.rate_s
    )
    np.testing.assert_allclose((velocity[-1], position[-1]), [[1.0, 0, 0], [50.0, 0, 0]], rtol=1e-9)
    turned = strapdown.dead_reckoning_errors(still, still.force_s, still.rate_s + [0, 1e-5, 0])[0]
    # g times the integral of the angle, small angles.
    np.testing.assert_allclose(turned[-1, 0], G * 1e-5 * 100**2 / 2, rtol=1e-6)


def test_wrong_times_are_refused():
    with refused(InputError, 'shape_and_times'):
        strapdown.integrate_attitude(np.array([0.0, 0.0]), np.zeros((2, 3)))


def test_n1_static_navigation_without_drift():
    v0, p0, v1, p1 = zhang.static_navigation(MODEL, 0.0, np.random.default_rng(11))
    show('N1', '50 s, no drift: before m/s, m', [v0, p0], '7.78 195')
    show('N1', 'after m/s, m', [v1, p1], '<= 0.016 0.45')
    show('N1', 'ratio', [v0 / v1, p0 / p1], '>= 450 (592/540)')
    assert (v0, p0) == (pytest.approx(7.78, rel=0.01), pytest.approx(195, rel=0.01))
    assert v1 <= 0.016 and p1 <= 0.45 and v0 / v1 >= 450 and p0 / p1 >= 450


def test_n1_static_navigation_with_the_sensors_own_drift():
    v0, p0, v1, p1 = zhang.static_navigation(MODEL, 0.75e-3, np.random.default_rng(12))
    show('N1', '50 s, 0.75 mg drift: after m/s, m, ratio', [v1, p1, v0 / v1], '0.73 18 8-14')
    assert 8 <= v0 / v1 <= 14 and 8 <= p0 / p1 <= 14


def test_n1_table_2_explains_the_printed_curve():
    """The printed 4 m/s and 100 m are the z channel before compensation after 47.4 s."""
    velocity, position = zhang.constant_error_growth(abs(zhang.TABLE_2_G[2, 0]) * G, 47.4)
    show('N1', 'Table 2 z before, 47.4 s: m/s, m', [velocity, position], '4.23 100.4')
    assert (velocity, position) == (pytest.approx(4.23, abs=0.01), pytest.approx(100.4, abs=0.1))


def test_n2_a_spin_about_a_body_axis_does_not_drift():
    growth = zhang.spin_growth(COSINES, ARMS, (1, 0, 0))
    level, body = zhang.largest(growth['level'][0]), zhang.largest(growth['body'][0])
    show(
        'N2',
        'x spin 100 deg/s, 100 s: level frame, body sum, m/s',
        [level, body],
        '0.048 3.69 (+-2 %)',
    )
    show(
        'N2',
        'positions, m',
        [zhang.largest(growth['level'][1]), zhang.largest(growth['body'][1])],
        '2.4 185',
    )
    assert (level, body) == (pytest.approx(0.048, rel=0.02), pytest.approx(3.69, rel=0.02))


def test_n2_a_spin_about_the_diagonal_does():
    growth = zhang.spin_growth(COSINES, ARMS, (1, 1, 1), seconds=60.0)
    end = [float(np.linalg.norm(part[-1])) for part in growth['level']]
    show('N2', '(1,1,1) spin 60 s: axial mg, m/s, m', [growth['axial_mg'], *end], '2.717 1.60 48.0')
    assert abs(growth['axial_mg']) == pytest.approx(2.717, abs=2e-3)
    assert end == [pytest.approx(1.60, abs=0.005), pytest.approx(48.0, abs=0.1)]


def test_n3_tumbling_uncompensated_and_with_arms_estimated_without_noise():
    responses = zhang.arm_responses(zhang.tumble((60, 45, 30), (0.7, 0.9, 1.1)), COSINES)
    velocity, position = zhang.peaks(responses, ARMS)[:, 0]
    runs, sensors = zhang_designs.design_runs('M'), np.column_stack([np.zeros(3), COSINES, ARMS])
    estimated = zhang_designs.fit_triad(
        runs, np.column_stack([zhang_designs.predict(runs, sensor) for sensor in sensors])
    )[1]
    exact = zhang.peaks(responses, estimated - ARMS)[0, 0]
    nearly = zhang.peaks(responses, estimated - ARMS * (1 + 1e-6))[0, 0]
    show('N3', 'uncompensated m/s, m', [velocity, position], '5.256 179.6 (+-0.5 %)')
    show('N3', 'arms estimated without noise, m/s', exact, '< 1e-9')
    assert (velocity, position) == (pytest.approx(5.256, rel=5e-3), pytest.approx(179.6, rel=5e-3))
    assert exact < 1e-9 < nearly


@pytest.mark.parametrize(
    'design, wanted',
    [('M', '>= 100 (146/152)'), ('O', '>= 80 (115)'), ('Z60', '(41)'), ('Z0', '<= 3 (1.0)')],
)
def test_n3_tumbling_with_estimated_arms(design, wanted):
    """300 draws of the arms from the design's full covariance, 0.1 mg means."""
    rng = np.random.default_rng(13)
    runs = zhang_designs.design_runs(design)
    responses = zhang.arm_responses(zhang.tumble((60, 45, 30), (0.7, 0.9, 1.1)), COSINES)
    wrong = np.stack(
        [
            zhang_designs.arm_errors(runs, COSINES[i], ARMS[i], rng=rng, n_draws=300)
            for i in range(3)
        ],
        axis=1,
    )
    gains = zhang.peaks(responses, ARMS)[:, :1] / zhang.peaks(responses, wrong)
    velocity, position = np.median(gains, axis=1)
    show('N3', f'{design}: median improvement, velocity, position', [velocity, position], wanted)
    low, high = {'M': (100, 200), 'O': (80, 160), 'Z60': (25, 60), 'Z0': (0, 3)}[design]
    assert low <= velocity <= high and low <= position <= high
