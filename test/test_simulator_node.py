"""The live simulator and the player: the same physics block by block, trajectories, the clock, and their refusals."""

import subprocess
from dataclasses import fields

import numpy as np
import pytest

from imu_calibration.errors import InputError
from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.simulation.joint_trajectory import TableMotion, trajectory_from
from imu_calibration.simulation.live import LiveSimulation
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import SimulatedNoise
from imu_calibration.simulation.session import SimulationOptions, simulate
from msg_adapters.write import write_session

from worlds.live_sessions import TABLE, make_session

pytest.importorskip('rclpy')
from imu_calibration.nodes.processes import node_command  # noqa: E402

from ros.live_station import Station, taken  # noqa: E402

START = 1_800_000_000


def at_rest(position=(0.0, 0.0, 0.0), time=0.0):
    """Joints that do not move."""
    zero = np.zeros((1, len(position)))
    return JointMotion(np.array([time]), np.array([position]), zero, zero, zero)


def test_a_trajectory_meets_its_points_and_is_smooth():
    position, rate = np.array([[0.5, -0.2, 0.1], [1.0, 0.3, -0.4]]), np.array([[0.2, 0.1, 0.0], [0.0, 0.0, 0.0]])
    trajectory = trajectory_from(at_rest((0.1, 0.0, 0.0), 3.0), [1.0, 2.5], position, rate=rate)
    motion = trajectory.at([3.0, 4.0, 5.5, 9.0])
    np.testing.assert_allclose(motion.position, [[0.1, 0.0, 0.0], *position, position[-1]], atol=1e-12)
    np.testing.assert_allclose(motion.rate, [[0, 0, 0], *rate, [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(motion.acceleration, 0.0, atol=1e-10)
    time = np.linspace(3.01, 5.49, 300)
    step = 1e-5
    for name, derivative in (('position', 'rate'), ('rate', 'acceleration'), ('acceleration', 'jerk')):
        slope = (getattr(trajectory.at(time + step), name) - getattr(trajectory.at(time - step), name)) / (2 * step)
        inside = np.abs(time - 4.0) > 1e-3   # the jerk jumps at a point
        np.testing.assert_allclose(slope[inside], getattr(trajectory.at(time), derivative)[inside], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize('time, position, match', [
    ([], np.zeros((0, 3)), 'must have points'), ([1.0], np.zeros((1, 2)), '3 positions'),
    ([1.0, 1.0], np.zeros((2, 3)), 'must rise'), ([1.0], np.full((1, 3), np.nan), 'finite')])
def test_a_trajectory_that_does_not_fit_is_refused(time, position, match):
    with pytest.raises(InputError, match=match):
        trajectory_from(at_rest(), time, position)


def test_a_profile_that_repeats_and_a_trajectory_that_takes_over_leave_no_jump():
    profile = make_profile('quick', 1, TABLE)
    motion = TableMotion(profile, 3, repeat=True)
    around = profile.duration + np.linspace(-1e-4, 1e-4, 11)
    assert np.max(np.abs(np.diff(motion.at(around).position, axis=0))) < 1e-6
    before = motion.at(np.array([40.0]))
    motion.follow(40.0, time=[2.0], position=np.zeros((1, 3)))
    after = motion.at(np.array([40.0]))
    for name in ('position', 'rate', 'acceleration'):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-12)
    assert motion.end == np.inf and np.max(np.abs(motion.at(np.array([50.0])).position)) < 1e-12


def test_blocks_without_noise_are_the_offline_simulation():
    _, _, values, model = make_session(2, 100.0, seconds=1.0)
    options = SimulationOptions(100.0, 50.0, SimulatedNoise(), temperature_start_c=20.0)
    profile = make_profile('quick', 1, TABLE)
    expected = simulate(model, values, TABLE, profile=profile, options=options)
    live = LiveSimulation(model, values, TABLE, motion=TableMotion(profile, 3), options=options, start_ns=int(expected[0].stamp_ns[0]))
    edges = np.sort(np.random.default_rng(0).uniform(0.0, 60.0, 40))
    blocks = [live.take(until) for until in [*edges, 60.0]]
    for name, whole in zip(('imu', 'joints', 'temperature'), expected):
        parts = [getattr(block, name) for block in blocks]
        joined = type(parts[0]).concatenate(parts)
        assert len(joined) == np.count_nonzero(whole.stamp_ns < expected[0].stamp_ns[0] + int(60e9))
        for field in fields(joined):
            if field.name not in ('frame_id', 'names'):
                np.testing.assert_allclose(getattr(joined, field.name), getattr(whole, field.name)[:len(joined)], rtol=0, atol=1e-12)


def test_the_wander_goes_on_from_block_to_block():
    _, _, values, model = make_session(2, 100.0, seconds=1.0)
    options = SimulationOptions(50.0, 1.0, SimulatedNoise(gyro_instability=1e-3, correlation_time=5.0))
    live = LiveSimulation(model, values, TABLE, motion=TableMotion(None, 3), options=options, seed=4)
    rate = np.concatenate([live.take(until).imu.rate_s for until in np.arange(5.0, 601.0, 5.0)])
    drift = rate - rate.mean(axis=0)
    lag = int(5.0 * 50)
    correlation = (drift[lag:] * drift[:-lag]).mean() / (drift**2).mean()
    # 120 correlation times and three axes: the sample correlation of exp(-1) scatters by some 0.05
    assert abs(drift.std() / 1e-3 - 1) < 0.25 and abs(correlation - np.exp(-1)) < 0.2
    assert np.max(np.abs(np.diff(rate, axis=0))) < 6 * 1e-3 * np.sqrt(2 / 250)


@pytest.mark.dds
def test_a_simulator_follows_a_trajectory_with_clock_and_truth():
    from builtin_interfaces.msg import Duration
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
    with Station() as station:
        truth, raw, clock, angles = station.watch_imu('imu/truth'), station.watch_imu('imu/data_raw'), [], []
        station.node.create_subscription(Clock, '/clock', lambda m: clock.append(m.clock.sec + m.clock.nanosec * 1e-9), 100)
        station.node.create_subscription(JointState, 'joint_states', lambda m: angles.append(list(m.position)), 1000)
        publisher = station.publisher(JointTrajectory, 'joint_trajectory')
        node = station.start('simulator_node', {'profile': 'none', 'clock': True, 'truth': True, 'time_factor': 5.0,
                                                'start_time': float(START), 'imu_rate': 100.0, 'joint_rate': 50.0, 'seed': 1})
        station.until(lambda: publisher.get_subscription_count() and angles, 'the simulator')
        point = JointTrajectoryPoint(positions=[0.5, 0.0, -0.25], time_from_start=Duration(sec=2))
        publisher.publish(JointTrajectory(joint_names=['inner', 'outer', 'middle'], points=[point]))
        station.until(lambda: np.allclose(angles[-1], [0.0, -0.25, 0.5], atol=1e-9), 'the end of the trajectory')
        assert station.processes.end(node) == 0
    assert np.all(np.diff(clock) > 0) and START <= clock[0] < START + 1e6
    measured, true = taken(raw), taken(truth)
    assert measured.stamp_ns[0] >= START * 10**9
    _, here, there = np.intersect1d(measured.stamp_ns, true.stamp_ns, return_indices=True)
    assert len(here) > 0.9 * len(measured) > 100
    # An industrial IMU: bias 5 mg and 0.2 deg/s, scale half a percent.
    assert np.max(np.abs(measured.force_s[here] - true.force_s[there])) < 1.0
    assert np.max(np.abs(true.rate_s)) > 0.2


@pytest.mark.dds
def test_the_player_plays_every_message_to_the_last_bit_and_refuses_what_it_cannot(tmp_path):
    imu, joints, _, _ = make_session(1, 100.0, seconds=20.0)
    write_session(tmp_path / 'bag', imu, joints)
    with Station() as station:
        gatherer = station.watch_imu('/left/imu/data_raw')
        player = station.play(tmp_path / 'bag', 10.0, topics='/imu/data_raw', namespace='/left')
        station.until(lambda: player.poll() is not None, 'the end of the recording')
        assert player.returncode == 0
        played = taken(gatherer)
        np.testing.assert_array_equal(played.stamp_ns, imu.stamp_ns)
        np.testing.assert_array_equal(played.force_s, imu.force_s)
        for parameters, message in (({}, "parameter 'bag' must name"), ({'bag': tmp_path / 'bag', 'topics': '/gps'}, 'it has no /gps')):
            command = node_command('bag_player_node', parameters)
            done = subprocess.run(command, env=station.processes.environment, capture_output=True, text=True, timeout=60)
            assert done.returncode == 1 and message in done.stderr and done.stderr.count('\n') == 1
