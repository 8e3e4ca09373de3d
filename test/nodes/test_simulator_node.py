"""
The live simulator and the player.

The same physics block by block, trajectories, the clock, and their refusals.
"""

from dataclasses import fields

import numpy as np
import pytest

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.motion_limits import MotionLimits, TrajectoryPoints
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import (
    CAUSES,
    SensorMotion,
    SimulatedNoise,
    hidden_causes,
)
from imu_calibration.simulation.session import LiveSimulation, SimulationOptions, simulate_session
from imu_calibration.simulation.table_controller import (
    ControllerSettings,
    TableController,
    braking_from,
    trajectory_from,
)
from msg_adapters.write import write_session

from worlds.live_sessions import TABLE, make_session

pytest.importorskip('rclpy')
from refusal import refused

from ros.live_station import Station, taken

START = 1_800_000_000


def at_rest(position=(0.0, 0.0, 0.0), time=0.0):
    """Joints that do not move."""
    zero = np.zeros((1, len(position)))
    return JointMotion(np.array([time]), np.array([position]), zero, zero, zero)


NAMES = ('outer', 'middle', 'inner')
LIMITS = MotionLimits(
    np.full(3, -2.0), np.full(3, 2.0), np.full(3, 1.0), np.full(3, 2.0), np.ones(3, bool)
)


def points_to(position, duration=4.0, names=NAMES):
    """A move to a place, with velocity and acceleration zero there."""
    zero = np.zeros((1, len(names)))
    return TrajectoryPoints(names, np.array([duration]), np.array([position]), zero, zero)


@pytest.mark.parametrize('degree', [1, 3, 5])
def test_a_trajectory_is_the_spline_of_the_controller(degree):
    position, rate = (
        np.array([[0.5, -0.2, 0.1], [1.0, 0.3, -0.4]]),
        np.array([[0.2, 0.1, 0.0], [0.0, 0.0, 0.0]]),
    )
    given = {1: (), 3: (rate,), 5: (rate, np.array([[0.1, 0.0, -0.3], [0.0, 0.0, 0.0]]))}[degree]
    trajectory = trajectory_from(
        at_rest((0.1, 0.0, 0.0), 3.0),
        TrajectoryPoints(NAMES, np.array([1.0, 2.5]), position, *given),
    )
    motion = trajectory.at([3.0, 4.0, 5.5, 9.0])
    np.testing.assert_allclose(
        motion.position, [[0.1, 0.0, 0.0], *position, position[-1]], atol=1e-12
    )
    for name, values in zip(('rate', 'acceleration'), given):
        np.testing.assert_allclose(getattr(motion, name)[1], values[0], atol=1e-12)
    time, step = np.linspace(3.01, 5.49, 300), 1e-5
    inside = np.abs(time - 4.0) > 1e-3
    for name, derivative in (
        ('position', 'rate'),
        ('rate', 'acceleration'),
        ('acceleration', 'jerk'),
    ):
        slope = (
            getattr(trajectory.at(time + step), name) - getattr(trajectory.at(time - step), name)
        ) / (2 * step)
        np.testing.assert_allclose(
            slope[inside], getattr(trajectory.at(time), derivative)[inside], rtol=1e-6, atol=1e-6
        )
    # The highest derivative that a piece has jumps at the point, and none above it is left.
    jumps = [
        np.max(np.abs(np.diff(getattr(trajectory.at([4 - 1e-6, 4 + 1e-6]), name), axis=0)))
        for name in ('position', 'rate', 'acceleration')
    ]
    assert [jump > 1e-3 for jump in jumps] == [False, degree == 1, degree == 3]
    if degree == 1:
        assert not np.any(trajectory.at(time).acceleration)


@pytest.mark.parametrize(
    'change, code, values',
    [
        ({'position': np.zeros((1, 2))}, 'position_count', [3, '(1, 2)']),
        ({'time': np.array([0.0])}, 'times_not_rising', []),
        ({'position': np.full((1, 3), np.nan)}, 'not_finite', []),
        ({'rate': np.ones((1, 3))}, 'not_at_rest', []),
        ({'rate': None}, 'velocities_missing', []),
        ({'names': ('outer', 'middle')}, 'joint_names', ['outer, middle, inner']),
        ({'names': ('outer', 'middle', 'tool')}, 'joint_names', ['outer, middle, tool']),
        ({'names': (*NAMES, 'tool')}, 'joint_names', ['outer, middle, inner, tool']),
    ],
)
def test_a_trajectory_that_does_not_fit_is_refused(change, code, values):
    controller, names = TableController(None, NAMES), change.pop('names', NAMES)
    points = points_to((0.1,) * len(names), names=names)
    fields_of = {'joint_names': points.joint_names, 'time': points.time, **points.columns()}
    with refused(InputError, code, *values):
        controller.follow(0.0, TrajectoryPoints(**(fields_of | change)))
    assert not np.any(controller.at(np.array([2.0])).position)


def test_a_profile_that_repeats_and_a_trajectory_that_takes_over_leave_no_jump():
    profile = make_profile('quick', 1, TABLE)
    motion = TableController(profile, NAMES, repeat=True)
    around = profile.duration + np.linspace(-1e-4, 1e-4, 11)
    assert np.max(np.abs(np.diff(motion.at(around).position, axis=0))) < 1e-6
    before = motion.at(np.array([40.0]))
    motion.follow(40.0, points_to((0.0, 0.0, 0.0), names=('middle', 'inner', 'outer')))
    after = motion.at(np.array([40.0]))
    for name in ('position', 'rate', 'acceleration'):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-12)
    assert motion.end == np.inf and np.max(np.abs(motion.at(np.array([50.0])).position)) < 1e-12


def test_an_empty_trajectory_brakes_within_the_limits_and_stays():
    controller = TableController(None, NAMES, limits=LIMITS)
    controller.follow(0.0, points_to((1.5, -1.0, 0.5), 4.0))
    controller.follow(2.0, TrajectoryPoints.stop(NAMES))
    motion = controller.at(np.linspace(1.9, 6.0, 2000))
    assert (
        np.max(np.abs(np.diff(motion.rate, axis=0))) < 0.01
        and np.max(np.abs(motion.acceleration)) <= 2.0 + 1e-9
    )
    assert not np.any(motion.rate[-100:]) and 0.1 < motion.position[-1, 0] < 1.4
    braking = braking_from(
        JointMotion(
            np.zeros(1), np.array([[1.99, 0, 0]]), np.array([[1.0, 0, 0]]), *np.zeros((2, 1, 3))
        ),
        LIMITS,
    )
    assert np.max(braking.at(np.linspace(0, 1, 100)).position) <= 2.0 + 1e-6


def test_limits_are_refused_or_make_it_slow_or_are_not_looked_at():
    far, fast = points_to((2.5, 0.0, 0.0), 9.0), points_to((1.0, 0.0, 0.0), 0.5)
    for settings in (ControllerSettings(), ControllerSettings('slow')):
        with refused(InputError, 'joint_range', '0.5'):
            TableController(None, NAMES, limits=LIMITS, settings=settings).follow(0.0, far)
    with refused(InputError, 'joint_limits', '3.75', '11.55'):  # 15/8 and 10/sqrt(3) of the quintic
        TableController(None, NAMES, limits=LIMITS).follow(0.0, fast)
    slow, free = (
        TableController(None, NAMES, limits=LIMITS, settings=ControllerSettings(choice))
        for choice in ('slow', 'none')
    )
    for controller in (slow, free):
        controller.follow(0.0, fast)
    time = np.linspace(0, 3, 3001)
    assert (
        np.max(np.abs(slow.at(time).rate)) <= 1.0 + 1e-5
        and np.max(np.abs(slow.at(time).acceleration)) <= 2.0 + 1e-5
    )
    assert (
        slow.at(np.array([0.5])).position[0, 0]
        < 0.5
        < slow.at(np.array([9.0])).position[0, 0]
        == free.at(np.array([0.5])).position[0, 0]
    )


def test_lag_speed_scaling_refusal_and_stall_do_what_they_say():
    plain, late, scaled = (
        TableController(None, NAMES, settings=settings)
        for settings in (
            ControllerSettings(),
            ControllerSettings(lag=0.25),
            ControllerSettings(speed_scaling=0.5),
        )
    )
    for controller in (plain, late, scaled):
        controller.follow(1.0, points_to((1.0, -0.5, 0.2), 2.0))
    time = np.linspace(1.0, 6.0, 501)
    np.testing.assert_allclose(late.at(time + 0.25).position, plain.at(time).position, atol=1e-12)
    np.testing.assert_allclose(
        scaled.at(1.0 + 2 * (time - 1.0)).position, plain.at(time).position, atol=1e-12
    )
    np.testing.assert_allclose(
        scaled.at(1.0 + 2 * (time - 1.0)).rate, 0.5 * plain.at(time).rate, atol=1e-12
    )
    once = TableController(None, NAMES, settings=ControllerSettings(refuse_after=1))
    once.follow(0.0, points_to((0.1, 0.0, 0.0)))
    with refused(InputError, 'trajectory_count', 1):
        once.follow(9.0, points_to((0.2, 0.0, 0.0)))
    once.follow(9.5, TrajectoryPoints.stop(NAMES))  # a stop is never refused
    stuck = TableController(
        None,
        NAMES,
        limits=LIMITS,
        settings=ControllerSettings(stall_joint='middle', stall_time=2.0),
    )
    stuck.follow(1.0, points_to((1.0, -0.5, 0.2), 3.0))
    motion = stuck.at(time)
    assert motion.position[-1, 0] == 1.0 and -0.3 < motion.position[-1, 1] < -0.1
    assert np.max(np.abs(np.diff(motion.position[:, 1]))) < 0.01 and not motion.rate[-1].any()
    with refused(InputError, 'joint_unknown', 'stall_joint', 'outer, middle, inner'):
        TableController(None, NAMES, settings=ControllerSettings(stall_joint='inne'))


def test_hidden_causes_change_what_their_physics_changes():
    rng = np.random.default_rng(3)
    force, rate = rng.normal(0, 9.8, (50, 3)), rng.normal(0, 4.0, (50, 3))
    for name in CAUSES:
        (cause,) = hidden_causes([name], 1)
        felt, mirrored = (
            cause(SensorMotion(sign * force, sign * rate, sign * force, sign * rate))
            for sign in (1, -1)
        )
        at_rest_turned = cause(SensorMotion(force, 0 * rate, force, 0 * rate)).rate
        changed = {'force': np.any(felt.force != force), 'rate': np.any(felt.rate != rate)}
        assert list(changed.values()) == [
            name in ('soft_spring', 'gain_by_sense'),
            name not in ('soft_spring', 'gain_by_sense'),
        ]
        assert np.any(at_rest_turned) == (name == 'unbalanced_mass')
        odd = np.allclose(felt.rate, -mirrored.rate) and np.allclose(felt.force, -mirrored.force)
        # The others do not change sign with what is felt.
        assert odd == (name in ('unbalanced_mass', 'narrow_range'))
        (half,) = hidden_causes([name], 1, 0.5)
        np.testing.assert_allclose(
            half(SensorMotion(force, rate, force, rate)).rate - rate,
            0.5 * (felt.rate - rate),
            atol=1e-12,
        )
    with refused(InputError, 'cause_unknown', 'two_half_ranges'):
        hidden_causes(['gremlins'], 0)


def test_blocks_without_noise_are_the_offline_simulation():
    _, _, values, model = make_session(2, 100.0, seconds=1.0)
    options = SimulationOptions(100.0, 50.0, SimulatedNoise(), temperature_start_c=20.0)
    profile = make_profile('quick', 1, TABLE)
    expected = simulate_session(model, values, TABLE, profile=profile, options=options)
    live = LiveSimulation(
        model,
        values,
        TABLE,
        motion=TableController(profile, NAMES),
        options=options,
        start_ns=int(expected[0].stamp_ns[0]),
    )
    edges = np.sort(np.random.default_rng(0).uniform(0.0, 60.0, 40))
    blocks = [live.take(until) for until in [*edges, 60.0]]
    for name, whole in zip(('imu', 'joints', 'temperature'), expected):
        parts = [getattr(block, name) for block in blocks]
        joined = type(parts[0]).concatenate(parts)
        assert len(joined) == np.count_nonzero(whole.stamp_ns < expected[0].stamp_ns[0] + int(60e9))
        for field in fields(joined):
            if getattr(whole, field.name) is None:
                assert getattr(joined, field.name) is None
            elif field.name not in ('frame_id', 'names'):
                np.testing.assert_allclose(
                    getattr(joined, field.name),
                    getattr(whole, field.name)[: len(joined)],
                    rtol=0,
                    atol=1e-12,
                )


def test_the_wander_goes_on_from_block_to_block():
    _, _, values, model = make_session(2, 100.0, seconds=1.0)
    options = SimulationOptions(
        50.0, 1.0, SimulatedNoise(gyro_instability=1e-3, correlation_time=5.0)
    )
    live = LiveSimulation(
        model, values, TABLE, motion=TableController(None, NAMES), options=options, seed=4
    )
    rate = np.concatenate([live.take(until).imu.rate_s for until in np.arange(5.0, 601.0, 5.0)])
    drift = rate - rate.mean(axis=0)
    lag = int(5.0 * 50)
    correlation = (drift[lag:] * drift[:-lag]).mean() / (drift**2).mean()
    # 120 correlation times and three axes: the sample correlation of exp(-1) scatters by some 0.05
    assert abs(drift.std() / 1e-3 - 1) < 0.25 and abs(correlation - np.exp(-1)) < 0.2
    assert np.max(np.abs(np.diff(rate, axis=0))) < 6 * 1e-3 * np.sqrt(2 / 250)


@pytest.mark.long
@pytest.mark.live
def test_a_simulator_follows_a_trajectory_with_clock_and_truth():
    from builtin_interfaces.msg import Duration
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    with Station() as station:
        truth, raw, clock, angles = (
            station.watch_imu('imu/truth'),
            station.watch_imu('imu/data_raw'),
            [],
            [],
        )
        station.node.create_subscription(
            Clock, '/clock', lambda m: clock.append(m.clock.sec + m.clock.nanosec * 1e-9), 100
        )
        station.node.create_subscription(
            JointState, 'joint_states', lambda m: angles.append(list(m.position)), 1000
        )
        publisher = station.publisher(JointTrajectory, 'joint_trajectory')
        node = station.start(
            'simulator_node',
            {
                'profile': 'none',
                'clock': True,
                'truth': True,
                'time_factor': 5.0,
                'start_time': float(START),
                'imu_rate': 50.0,
                'joint_rate': 25.0,
                'seed': 1,
            },
        )
        station.until(lambda: publisher.get_subscription_count() and angles, 'the simulator')
        point = JointTrajectoryPoint(
            positions=[0.5, 0.0, -0.25],
            velocities=[0.0] * 3,
            accelerations=[0.0] * 3,
            time_from_start=Duration(sec=2),
        )
        publisher.publish(JointTrajectory(joint_names=['inner', 'outer', 'middle'], points=[point]))
        station.until(
            lambda: np.allclose(angles[-1], [0.0, -0.25, 0.5], atol=1e-9),
            'the end of the trajectory',
        )
        # Another one, stopped before its end; one with a joint that the table does not have is
        # refused, and told.
        publisher.publish(
            JointTrajectory(
                joint_names=['inner', 'outer', 'middle'],
                points=[
                    JointTrajectoryPoint(
                        positions=[3.0, 0.0, 0.0],
                        velocities=[0.0] * 3,
                        accelerations=[0.0] * 3,
                        time_from_start=Duration(sec=60),
                    )
                ],
            )
        )
        station.until(lambda: angles[-1][2] > 0.6, 'the second trajectory')
        publisher.publish(JointTrajectory(joint_names=['outer', 'middle', 'inner']))
        station.until(lambda: len(angles) > 250 and angles[-1] == angles[-50], 'the stop')
        assert angles[-1][2] < 2.9
        station.watch_diagnostics()
        publisher.publish(
            JointTrajectory(
                joint_names=['inner', 'tool'],
                points=[
                    JointTrajectoryPoint(positions=[0.0, 0.0], time_from_start=Duration(sec=1))
                ],
            )
        )
        station.until(
            lambda: (
                'inner, tool' in getattr(station.status.get('simulator_node: table'), 'message', '')
            ),
            'the refusal',
        )
        assert station.processes.end(node) == 0
    assert np.all(np.diff(clock) > 0) and START <= clock[0] < START + 1e6
    measured, true = taken(raw), taken(truth)
    assert measured.stamp_ns[0] >= START * 10**9
    _, here, there = np.intersect1d(measured.stamp_ns, true.stamp_ns, return_indices=True)
    assert len(here) > 0.9 * len(measured) > 100
    # An industrial IMU: bias 5 mg and 0.2 deg/s, scale half a percent.
    assert np.max(np.abs(measured.force_s[here] - true.force_s[there])) < 1.0
    assert np.max(np.abs(true.rate_s)) > 0.2


@pytest.mark.live
def test_the_player_plays_every_message_to_the_last_bit_and_refuses_what_it_cannot(tmp_path):
    imu, joints, _, _ = make_session(1, 50.0, seconds=20.0)
    write_session(tmp_path / 'bag', imu, joints)
    with Station() as station:
        gatherer = station.watch_imu('/left/imu/data_raw')
        player = station.play(tmp_path / 'bag', 10.0, topics='/imu/data_raw', namespace='/left')
        station.until(lambda: player.poll() is not None, 'the end of the recording')
        assert player.returncode == 0
        played = taken(gatherer)
        np.testing.assert_array_equal(played.stamp_ns, imu.stamp_ns)
        np.testing.assert_array_equal(played.force_s, imu.force_s)
        for parameters, message in (
            ({}, "'bag'"),
            ({'bag': tmp_path / 'bag', 'topics': '/gps'}, '/gps'),
        ):
            with open(tmp_path / 'said.txt', 'w+') as said:
                refusing = station.processes.start('bag_player_node', parameters, output=said)
                assert refusing.wait(60) == 1
                text = said.read()
            assert message in text and text.count('\n') == 1
