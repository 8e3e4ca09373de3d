"""
The joints' curve against known motions.

Without noise, with noise, with coarse encoders, odd stamps and odd velocities.
"""

import numpy as np
import pytest
from refusal import refused
from scipy.interpolate import BSpline

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.joint_curve import check_velocity, fit_joint_curve
from imu_calibration.kinematics.joint_motion import (
    JointMotion,
    encoder_step,
    with_encoder_harmonics,
)
from imu_calibration.kinematics.smoothing import (
    Knots,
    PenalisedSpline,
    design_matrix,
    design_values,
    evaluate_pieces,
    normal_bands,
    piece_coefficients,
)

STEP_0088 = np.radians(0.088)


def sine(time, amplitude, frequency, phase=0.3):
    """Position and its first three derivatives, shape (4, n)."""
    argument = 2 * np.pi * frequency * time + phase
    pulsation = 2 * np.pi * frequency
    sin, cos = np.sin(argument), np.cos(argument)
    return amplitude * np.array(
        [sin, pulsation * cos, -(pulsation**2) * sin, -(pulsation**3) * cos]
    )


def relative_errors(curve, truth, start=2.0, stop=18.0, rate=400.0):
    """
    Rms error over rms of position, rate, acceleration and jerk.

    It is away from the ends, at instants between the readings.
    """
    time = np.arange(start, stop, 1 / rate) + 0.123e-3
    motion, true = curve.at(time), truth(time)
    found = np.array(
        [motion.position[:, 0], motion.rate[:, 0], motion.acceleration[:, 0], motion.jerk[:, 0]]
    )
    return np.sqrt(np.mean((found - true) ** 2, axis=1) / np.mean(true**2, axis=1))


def test_spline_equals_scipys():
    rng = np.random.default_rng(0)
    knots = Knots(-1.0, 0.3, 12)
    coefficients = rng.normal(size=(knots.n_coefficients, 2))
    reference = BSpline(-1.0 + 0.3 * np.arange(-5, 18), coefficients, 5)
    time = rng.uniform(-1.0, 2.6, 100)
    values = evaluate_pieces(knots, piece_coefficients(coefficients), time, derivatives=3)
    for order in range(4):
        np.testing.assert_allclose(
            values[order],
            reference.derivative(order)(time) if order else reference(time),
            atol=1e-10,
        )
        if order < 2:
            design = design_matrix(knots, *design_values(knots, time, order))
            np.testing.assert_allclose(design @ coefficients, values[order], atol=1e-12)


def test_degrees_of_freedom_agree_with_the_trace():
    """The spectral formula against the trace of the hat matrix, for stamps with jitter."""
    rng = np.random.default_rng(1)
    time = np.arange(300) * 0.01 + rng.uniform(-2e-3, 2e-3, 300)
    knots = Knots(-0.03, 0.01, 305)
    interval, values = design_values(knots, time)
    spline = PenalisedSpline(
        design_matrix(knots, interval, values), normal_bands(knots, interval, values)
    )
    dense = spline.design.toarray()
    third = np.diff(np.eye(knots.n_coefficients), 3, axis=0)
    for penalty in (1.0, 1e3, 1e6):
        hat = dense @ np.linalg.solve(dense.T @ dense + penalty * third.T @ third, dense.T)
        # The ends take part in the trace but not in the formula: about one parameter.
        assert spline.gains(penalty)[0] * 300 == pytest.approx(np.trace(hat), rel=0.02, abs=1.5)


@pytest.mark.parametrize(
    ('rate', 'frequency', 'bound'),
    [(100, 2.0, 1e-6), (200, 1.0, 1e-8), (50, 2.0, 1e-5), (1000, 5.0, 1e-7)],
)
def test_readings_without_noise_are_interpolated(rate, frequency, bound):
    """A quintic spline's second derivative errs by about (omega h)^4 / 720."""
    time = np.arange(0, 20, 1 / rate)
    curve = fit_joint_curve(time, sine(time, 0.17, frequency)[0][:, None])
    position, speed, acceleration, _ = relative_errors(curve, lambda t: sine(t, 0.17, frequency))
    assert position < bound / 10
    assert speed < bound / 3
    assert acceleration < bound


# Bounds are about twice the worst of thirty other seeds.
@pytest.mark.parametrize(
    ('rate', 'noise_sd', 'bounds'),
    [
        (200, 5e-6, (3e-5, 1.2e-4, 1e-3)),
        (200, 5e-5, (2e-4, 7e-4, 4e-3)),
        (50, 5e-6, (4e-5, 2e-4, 1.5e-3)),
        (1000, 5e-6, (1.5e-5, 7e-5, 5e-4)),
    ],
)
def test_noise_of_the_encoder_is_smoothed(rate, noise_sd, bounds):
    rng = np.random.default_rng(2)
    time = np.arange(0, 20, 1 / rate)
    position = sine(time, np.radians(10), 1.0)[0] + noise_sd * rng.normal(size=len(time))
    curve = fit_joint_curve(time, position[:, None])
    assert np.all(relative_errors(curve, lambda t: sine(t, np.radians(10), 1.0))[:3] < bounds)
    assert curve.noise_sd[0] == pytest.approx(noise_sd, rel=0.06)


@pytest.mark.parametrize(
    ('rate', 'amplitude', 'frequency', 'step', 'bound'),
    [
        (100, 0.17, 1.0, STEP_0088, 0.01),
        (100, 1.0, 0.3, STEP_0088, 0.01),
        (100, 0.1, 0.03, STEP_0088, 0.03),  # ten readings and more on each step
        (200, 0.17, 1.0, np.radians(0.01), 0.004),
    ],
)
def test_coarse_encoder_gives_sane_accelerations(rate, amplitude, frequency, step, bound):
    time = np.arange(0, 40, 1 / rate)
    position = step * np.round(sine(time, amplitude, frequency)[0] / step)
    curve = fit_joint_curve(time, position[:, None])
    _, speed, acceleration, _ = relative_errors(
        curve, lambda t: sine(t, amplitude, frequency), stop=38.0
    )
    assert speed < bound
    assert acceleration < bound


def test_step_of_the_encoder_is_found():
    time = np.arange(0, 20, 0.01)
    slow = sine(time, 0.05, 0.05)[0]
    assert encoder_step(STEP_0088 * np.round(slow / STEP_0088)) == pytest.approx(STEP_0088)
    assert encoder_step(slow) == 0
    assert encoder_step(3.0 * time) == 0
    assert encoder_step(np.zeros(100)) == 0


def test_one_flip_of_a_step_is_not_a_motion():
    time = np.arange(0, 20, 0.005)
    motion = fit_joint_curve(time, np.where(time > 11, 1e-3, 0.0)[:, None]).at(time)
    assert np.abs(motion.acceleration).max() < 0.02


def s_curve(time):
    """
    A move by jerk pulses of 0.1 s and back, still before, between and after.

    Shape (3, n): position, rate, acceleration.
    """
    corners = np.array(
        [3.0, 3.1, 3.5, 3.6, 5.0, 5.1, 5.5, 5.6, 12.0, 12.1, 12.5, 12.6, 14.0, 14.1, 14.5, 14.6]
    )
    signs = np.array([1, -1, -1, 1, -1, 1, 1, -1] + [-1, 1, 1, -1, 1, -1, -1, 1])
    since = np.maximum(time[:, None] - corners, 0.0)
    return 40.0 * np.array([since**3 / 6 @ signs, since**2 / 2 @ signs, since @ signs])


@pytest.mark.parametrize(
    ('noise_sd', 'moving', 'still'), [(0.0, 5e-3, 5e-6), (5e-6, 0.05, 0.03), (5e-5, 0.15, 0.05)]
)
def test_stillness_beside_ramps_does_not_ring(noise_sd, moving, still):
    """Without noise: rounding of the positions, 3e-11 rad here, over the square of the period."""
    rng = np.random.default_rng(3)
    time = np.arange(0, 24, 0.005)
    curve = fit_joint_curve(
        time, s_curve(time)[0][:, None] + noise_sd * rng.normal(size=(len(time), 1))
    )
    fine = np.arange(2, 22, 0.001)
    error = curve.at(fine).acceleration[:, 0] - s_curve(fine)[2]
    active = (fine > 2.9) & (fine < 5.7) | (fine > 11.9) & (fine < 14.7)
    quiet = (fine > 6.1) & (fine < 11.5) | (fine < 2.5) | (fine > 15.1)
    assert np.sqrt(np.mean(error[active] ** 2)) < moving
    assert np.sqrt(np.mean(error[quiet] ** 2)) < still


def test_joints_that_stand_still_have_no_rate():
    time = np.arange(0, 20, 0.01)
    position = np.stack([np.full(len(time), 0.7), sine(time, 0.2, 1.0)[0]], axis=1)
    curve = fit_joint_curve(time, position)
    motion = curve.at(time + 0.003)
    np.testing.assert_array_equal(motion.position[:, 0], 0.7)
    for values in (motion.rate, motion.acceleration, motion.jerk):
        assert not values[:, 0].any()
    alone = fit_joint_curve(time, position[:, 1:]).at(time + 0.003)
    np.testing.assert_allclose(motion.rate[:, 1], alone.rate[:, 0], rtol=1e-9)


def test_constant_spin_over_many_turns():
    time = np.arange(0, 24, 0.005)
    wrapped = (3.0 * time + np.pi) % (2 * np.pi) - np.pi
    motion = fit_joint_curve(time, wrapped[:, None]).at(time)
    np.testing.assert_allclose(motion.rate, 3.0, rtol=1e-12)
    np.testing.assert_allclose(motion.acceleration, 0.0, atol=1e-10)
    np.testing.assert_allclose(np.sin(motion.position), np.sin(3.0 * time)[:, None], atol=1e-12)


def test_odd_stamps():
    """
    Sampling that jitters, messages lost and repeated, a hole.

    The stamps are true, so nothing is lost but readings.
    """
    rng = np.random.default_rng(4)
    time = np.arange(0, 20, 0.005) + rng.uniform(-1e-3, 1e-3, 4000)
    time = np.sort(np.concatenate([time[rng.random(4000) > 0.1], time[::50]]))
    time = time[(time < 8.0) | (time > 8.15)]
    position = sine(time, 0.17, 1.0)[0] + 5e-6 * rng.normal(size=len(time))
    errors = relative_errors(
        fit_joint_curve(time, position[:, None]), lambda t: sine(t, 0.17, 1.0), start=9.0
    )
    assert np.all(errors[:3] < (3e-5, 1.2e-4, 1e-3))


def test_noise_of_the_stamps_counts_as_noise():
    rng = np.random.default_rng(5)
    time = np.arange(0, 20, 0.005)
    stamps = time + 50e-6 * rng.normal(size=len(time))
    curve = fit_joint_curve(stamps, sine(time, 0.17, 1.0)[0][:, None], noise_sd=1e-6)
    assert curve.noise_sd[0] == pytest.approx(50e-6 * 0.17 * 2 * np.pi / np.sqrt(2), rel=0.1)
    assert relative_errors(curve, lambda t: sine(t, 0.17, 1.0))[2] < 3e-3


def test_noise_that_is_known_bounds_the_bandwidth():
    time = np.arange(0, 20, 0.005)
    position = sine(time, 0.17, 1.0)[0][:, None]
    assert (
        fit_joint_curve(time, position, noise_sd=[1e-4]).bandwidth
        < 0.3 * fit_joint_curve(time, position).bandwidth
    )


def velocity_case(kind, time, rng):
    true = sine(time, 0.17, 1.0)[1]
    lagged = {'lag': 1e-3, 'small lag': 3e-4}
    if kind in lagged:
        true = sine(time - lagged[kind], 0.17, 1.0)[1]
    scale = {'zeros': 0.0, 'scale': 0.99}.get(kind, 1.0)
    return (
        scale * true
        + {'zeros': 0.0, 'noisy': 0.1}.get(kind, 1e-4) * rng.normal(size=len(time))
        + (kind == 'offset') * 0.01
    )


@pytest.mark.parametrize(
    'kind', ['zeros', 'scale', 'lag', 'small lag', 'offset', 'noisy', 'nan', 'none']
)
def test_velocities_that_disagree_or_cannot_be_judged_are_left_out(kind):
    rng = np.random.default_rng(6)
    time = np.arange(0, 20, 0.005)
    position = (sine(time, 0.17, 1.0)[0] + 5e-5 * rng.normal(size=len(time)))[:, None]
    velocity = {'nan': np.full_like(position, np.nan), 'none': None}.get(
        kind, velocity_case(kind, time, rng)[:, None]
    )
    np.testing.assert_array_equal(
        fit_joint_curve(time, position, velocity).pieces, fit_joint_curve(time, position).pieces
    )


def test_low_pass_filtered_velocities_are_left_out():
    rng = np.random.default_rng(7)
    time = np.arange(0, 20, 0.005)
    phase = np.arctan(2 * np.pi * 0.004)
    filtered = sine(time, 0.17 * np.cos(phase), 1.0, 0.3 - phase)[1]
    position = (sine(time, 0.17, 1.0)[0] + 5e-6 * rng.normal(size=len(time)))[:, None]
    np.testing.assert_array_equal(
        fit_joint_curve(time, position, filtered[:, None]).pieces,
        fit_joint_curve(time, position).pieces,
    )


def test_velocities_that_agree_make_the_curve_better():
    rng = np.random.default_rng(8)
    time = np.arange(0, 20, 0.005)
    position = (sine(time, 0.17, 1.0)[0] + 5e-5 * rng.normal(size=len(time)))[:, None]
    velocity = velocity_case('good', time, rng)[:, None]
    velocity[100:110] = np.nan
    plain, better = fit_joint_curve(time, position), fit_joint_curve(time, position, velocity)
    before, after = (
        relative_errors(curve, lambda t: sine(t, 0.17, 1.0)) for curve in (plain, better)
    )
    assert np.all(after[1:3] < 0.5 * before[1:3])


def test_a_joint_at_rest_does_not_vouch_for_its_velocities():
    rng = np.random.default_rng(9)
    noise = 1e-5 * rng.normal(size=(3, 1000))
    assert not check_velocity(noise[0], noise[1], noise[2], dof=100.0)[0]


@pytest.mark.parametrize('count', [1, 2, 3, 5, 8, 12])
def test_few_readings(count):
    time = 0.01 * np.arange(count)
    motion = fit_joint_curve(time, 0.5 + 0.2 * time[:, None]).at(time)
    np.testing.assert_allclose(motion.position[:, 0], 0.5 + 0.2 * time, atol=1e-14)
    np.testing.assert_allclose(motion.rate, 0.2 if count > 1 else 0.0, atol=1e-11)


def test_readings_of_one_instant_give_their_mean():
    rng = np.random.default_rng(10)
    position = rng.normal(size=(10, 1))
    motion = fit_joint_curve(np.zeros(10), position).at(np.zeros(1))
    np.testing.assert_allclose(motion.position[0], position.mean(axis=0))
    assert motion.rate[0, 0] == 0


def test_outside_the_readings_there_is_nothing():
    time = np.arange(0, 5, 0.01)
    curve = fit_joint_curve(time, np.sin(time)[:, None])
    assert np.isfinite(curve.at([-0.02, 5.01]).position).all()
    assert np.isnan(curve.at([-0.1, 5.1]).rate).all()


@pytest.mark.parametrize(
    ('time', 'position', 'code', 'values'),
    [
        ([], np.zeros((0, 1)), 'not_finite', [0]),
        ([0.0, 1.0], [[0.0], [np.nan]], 'not_finite', [2]),
        ([0.0, 1.0, 0.5], np.zeros((3, 1)), 'stamps_backwards', []),
        (
            np.concatenate([np.arange(0, 1, 0.01), np.arange(9, 10, 0.01)]),
            np.zeros((200, 1)),
            'gap',
            [300, 8.01],
        ),
    ],
)
def test_unusable_readings_are_refused(time, position, code, values):
    with refused(InputError, code, *values):
        fit_joint_curve(time, position)


def smooth_motion(time):
    return JointMotion(
        time,
        *(
            np.stack([a, b], axis=1)
            for a, b in zip(sine(time, 0.8, 0.5), sine(time, 0.3, 0.9, 1.0), strict=True)
        ),
    )


@pytest.mark.parametrize('order', [1, 2])
def test_encoder_harmonics_and_their_derivatives(order):
    cos, sin, step = np.array([0.02, 0.0]), np.array([-0.01, 0.03]), 1e-3
    time = 0.4 + step * np.arange(-2, 3)
    motion = with_encoder_harmonics(smooth_motion(time), order, cos, sin_amplitude=sin)
    position = smooth_motion(time).position
    np.testing.assert_allclose(
        motion.position,
        position + cos * np.cos(order * position) + sin * np.sin(order * position),
        atol=1e-15,
    )
    first = np.array([1, -8, 0, 8, -1]) / (12 * step)
    for lower, upper in (('position', 'rate'), ('rate', 'acceleration'), ('acceleration', 'jerk')):
        # Truncation step^4 / 30 times the fifth derivative further up, some 1e3.
        np.testing.assert_allclose(
            first @ getattr(motion, lower), getattr(motion, upper)[2], atol=1e-9
        )


def test_select_keeps_rows_together():
    motion = smooth_motion(np.linspace(0, 1, 10)).select(slice(2, 4))
    assert len(motion) == 2
    np.testing.assert_array_equal(motion.jerk, smooth_motion(np.linspace(0, 1, 10)).jerk[2:4])


def read_shaft(folder, component, seconds):
    """
    Stamps and one gyro component of the moving IMU, stamps and angle of the shaft.

    They are from the first seconds.
    """
    from rosbags.highlevel import AnyReader

    rows = {'/imu/data_raw': [], '/joint_states': []}
    with AnyReader([folder]) as reader:
        connections = [one for one in reader.connections if one.topic in rows]
        for connection, _, raw in reader.messages(
            connections, stop=reader.start_time + int(seconds * 1e9)
        ):
            message = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            value = (
                getattr(message.angular_velocity, component)
                if connection.topic == '/imu/data_raw'
                else message.position[0]
            )
            rows[connection.topic].append((stamp, value))
    origin = rows['/imu/data_raw'][0][0]
    return [
        (
            np.array([stamp - origin for stamp, _ in one]) / 1e9,
            np.array([value for _, value in one]),
        )
        for one in rows.values()
    ]


@pytest.mark.parametrize(
    ('name', 'component', 'sense', 'scale'),
    [
        ('shaft_pitch_slow', 'y', 1, 0.985),
        ('shaft_yaw_medium', 'z', -1, 1.005),
    ],
)
def test_encoder_with_coarse_steps_agrees_with_the_gyro(recordings, name, component, sense, scale):
    """
    Shaft with torque ripple, 0.088 deg steps and stamps in whole milliseconds; some of them repeat.

    Means over 0.25 s, since the ripple reaches Nyquist's frequency; the gyro lags by 12 to 14 ms.
    """
    (time, gyro), (joint_time, angle) = read_shaft(recordings / name, component, 24.0)
    order = np.argsort(joint_time, kind='stable')
    curve = fit_joint_curve(joint_time[order], angle[order, None])
    inside = (time > 2.0) & (time < 22.0)
    measured = np.convolve(sense * gyro[inside], np.ones(25) / 25, 'valid')
    fits = []
    for lag in np.arange(0.006, 0.0201, 0.001):
        rate = np.convolve(curve.at(time[inside] - lag).rate[:, 0], np.ones(25) / 25, 'valid')
        slope, _ = np.polyfit(rate, measured, 1)
        fits.append(
            (np.std(measured - np.polyval(np.polyfit(rate, measured, 1), rate)), lag, slope)
        )
    scatter, lag, slope = min(fits)
    assert slope == pytest.approx(scale, abs=2e-3)
    assert 0.0105 < lag < 0.0145
    assert scatter < 0.025 * np.std(measured)
