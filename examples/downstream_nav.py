"""
Effect of a calibration on navigation.

Dead reckoning from /imu/data_raw and from /imu/data, over DDS from a bag.

The node integrates the rate and the specific force and sets its velocity to zero at rest
(zero-velocity update); it publishes nav_msgs/Odometry. The remaining nodes are those of a robot:
bag_player_node plays a drive, compensator_node corrects it with a calibration.

Run: ``python examples/downstream_nav.py [--picture FILE]``; it needs about half a minute.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from examples.processes import NodeProcesses  # noqa: E402
from imu_calibration.api.calibrate import calibrate_recordings  # noqa: E402
from imu_calibration.compensation.health import StopDetector  # noqa: E402
from imu_calibration.core.samples import ImuSamples  # noqa: E402
from imu_calibration.document import files  # noqa: E402
from imu_calibration.effects.forward_equations import sensor_output  # noqa: E402
from imu_calibration.kinematics.rotations import Reference, align  # noqa: E402
from msg_adapters.imu_stream import ImuStream  # noqa: E402
from msg_adapters.write import write_session  # noqa: E402

SESSION = ROOT / 'bags' / 'sample_session'
GRAVITY, RATE, LEG, STOP = 9.81, 100.0, 20.0, 4.0
FACTOR = 5.0
"""Simulated seconds per second."""
DEPTH = 20_000
"""
Queue length: larger than the number of messages of the drive, so that a busy machine loses none.
"""
MOST_LOST = 250
"""Of 12000; before levelling, one second after the start, no position is published."""
NOISE = {'accelerometer': 0.01, 'gyroscope': 0.001}
TOPICS = {'imu/data_raw': 'odom_raw', 'imu/data': 'odom'}
PATIENCE = 120.0


def drive(seed, seconds):
    """
    Return (time, true rate, true force, path) of a robot that drives on a floor.

    The robot drives curves and stops before each leg.
    """
    rng, time_ = np.random.default_rng(seed), np.arange(0, seconds, 1 / RATE)
    phase, leg = time_ % LEG, (time_ // LEG).astype(int)
    moving = np.clip(np.minimum(phase - STOP, LEG - phase), 0, 1)  # each leg begins at rest
    speed = moving * rng.uniform(0.5, 1.2, leg[-1] + 1)[leg]
    turn = moving * rng.uniform(-0.5, 0.5, leg[-1] + 1)[leg]
    heading = np.cumsum(turn) / RATE
    path = (
        np.cumsum(speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
        / RATE
    )
    force = np.stack(
        [np.gradient(speed, 1 / RATE), speed * turn, np.full(len(time_), GRAVITY)], axis=1
    )
    # Vibration that distinguishes a slow drive from rest.
    floor = moving[:, None] * rng.normal(0, 0.8, (len(time_), 3))
    return time_, np.stack([0 * turn, 0 * turn, turn], axis=1), force + floor, path


def measured(time_, rate, force, seed):
    """Return ImuSamples of the IMU with the errors of bags/sample_session/truth.yaml."""
    truth, rng = files.read_calibration(SESSION / 'truth.yaml'), np.random.default_rng(seed)
    alpha = np.gradient(rate, 1 / RATE, axis=0)
    temperature = np.full(len(time_), truth.model.temperature_ref_c)
    ref = Reference(
        time_,
        np.broadcast_to(np.eye(3), (len(time_), 3, 3)),
        force,
        rate,
        alpha,
        GRAVITY,
        temperature,
    )
    read = {
        sensor: (
            sensor_output(truth.model, sensor, truth.values, ref=ref)
            + rng.normal(0, sd, (len(time_), 3))
        )
        for sensor, sd in NOISE.items()
    }
    stamps = 1_800_000_000 * 10**9 + np.round(time_ * 1e9).astype(np.int64)
    return ImuSamples(stamps, read['accelerometer'], read['gyroscope'], 'imu_link')


class DeadReckoning:
    """
    Attitude, velocity and position from specific force and rate.

    Levelled at the first stop, velocity zero at every stop.
    """

    def __init__(self):
        self._stops = StopDetector(np.repeat(list(NOISE.values()), 3))
        self._first = self._before = None
        self.attitude: Rotation | None = None
        self.velocity, self.position = np.zeros(3), np.zeros(3)

    def step(self, stamp_ns, rate, force):
        """Process a sample; return whether the position is available."""
        self._first = stamp_ns if self._first is None else self._first
        now = (stamp_ns - self._first) * 1e-9
        stop = self._stops.push(np.array([[now, *force, *rate]]))
        if self.attitude is None:
            if stop is not None:
                up = stop.mean[:3] / np.linalg.norm(stop.mean[:3])
                self.attitude = Rotation.from_matrix(align(up))  # the heading is that of the start
        else:
            seconds = now - self._before
            self.attitude = self.attitude * Rotation.from_rotvec(np.array(rate) * seconds)
            self.velocity = self.velocity + (self.attitude.apply(force) - [0, 0, GRAVITY]) * seconds
            if stop is not None:
                self.velocity = np.zeros(3)
            self.position = self.position + self.velocity * seconds
        self._before = now
        return self.attitude is not None


class Navigator:
    """A node that navigates by one Imu topic and publishes nav_msgs/Odometry."""

    def __init__(self, imu_topic, odometry_topic):
        import rclpy
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import Imu

        from imu_calibration.nodes.inputs import BatchInput

        self.node = rclpy.create_node(f'navigate_by_{imu_topic.replace("/", "_")}')
        self._reckoning, self._stream, self._message = DeadReckoning(), ImuStream(), Odometry
        self.publisher = self.node.create_publisher(Odometry, odometry_topic, 10)
        self.input, self.path, self.last = (
            BatchInput(self.node, Imu, imu_topic, add=self._take, depth=DEPTH),
            [],
            time.monotonic(),
        )

    def _take(self, data, _):
        if not self._stream.heads(data):
            self._stream.open(data)
        stamp_ns, readings = self._stream.read(data)
        self.last = time.monotonic()
        if not self._reckoning.step(stamp_ns, readings[:3], readings[3:]):
            return
        found, message = self._reckoning, self._message()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        message.header.frame_id, message.child_frame_id = 'odom', 'imu_link'
        assert found.attitude is not None, 'a position is available only with an attitude'
        pose = message.pose.pose
        pose.position.x, pose.position.y, pose.position.z = found.position.tolist()
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = (
            found.attitude.as_quat().tolist()
        )
        self.publisher.publish(message)
        self.path.append((stamp_ns, *found.position))


def navigate(bag, calibration, domain_id):
    """
    Play the bag through a compensator and two navigators.

    Return {topic: path, rows of stamp and position}.
    """
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    os.environ |= {'ROS_DOMAIN_ID': str(domain_id), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with NodeProcesses(domain_id) as processes:
        processes.start(
            'compensator_node',
            {'calibration_file': calibration, 'anyway': True},
            remappings={'imu/data_corrected': 'imu/data'},
        )
        rclpy.init()
        try:
            navigators, executor = (
                [Navigator(*names) for names in TOPICS.items()],
                SingleThreadedExecutor(),
            )
            corrected = navigators[-1]
            for navigator in navigators:
                executor.add_node(navigator.node)
            end = time.monotonic() + PATIENCE
            while not corrected.node.count_publishers(corrected.input.topic_name):
                if time.monotonic() > end:
                    raise SystemExit(
                        'the compensator did not start within the time limit; run it again on an'
                        ' idle machine'
                    )
                # A subscriber that misses the first rest is levelled at the second.
                executor.spin_once(timeout_sec=0.1)
            player = processes.start(
                'bag_player_node', {'bag': bag, 'rate': FACTOR, 'wait_for_subscribers': 2}
            )
            while (
                player.poll() is None
                or time.monotonic() - max(navigator.last for navigator in navigators) < 2.0
            ):
                if time.monotonic() > end:
                    raise SystemExit(
                        'the drive did not end within the time limit; run it again on an idle'
                        ' machine'
                    )
                executor.spin_once(timeout_sec=0.1)
            return {
                name: np.array(navigator.path, dtype=object)
                for name, navigator in zip(TOPICS, navigators, strict=True)
            }
        finally:
            rclpy.try_shutdown()


def errors_of(paths, stamps, path):
    """
    Return {topic: (largest error, error at the end, m; path in the plane)}.

    With the true heading at the start.
    """
    found = {}
    for topic, rows in paths.items():
        index = np.searchsorted(stamps, rows[:, 0].astype(np.int64))
        positions = rows[:, 1:3].astype(float)
        off = np.linalg.norm(positions - (path[index] - path[index[0]]), axis=1)
        found[topic] = float(off.max()), float(off[-1]), positions
    return found


def draw(found, path, picture):
    """Draw the paths."""
    import matplotlib

    matplotlib.use('Agg')
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 3.2), layout='constrained')
    axes.plot(*(path - path[0]).T, color='0.3', linewidth=3, label='true')
    for (topic, (_, last, positions)), color in zip(
        found.items(), ('tab:red', 'tab:blue'), strict=True
    ):
        axes.plot(*positions.T, color=color, label=f'/{topic}: error {last:.1f} m at the end')
    axes.set(
        xlabel='x [m]',
        ylabel='y [m]',
        aspect='equal',
        title=f'Dead reckoning for {len(path) / RATE:.0f} s, at rest every {LEG:.0f} s',
    )
    axes.legend(loc='lower left', fontsize=8)
    figure.savefig(picture, dpi=90)


def run(domain_id, picture, seconds, folder):
    """Simulate, calibrate, play, navigate, compare."""
    time_, rate, force, path = drive(3, seconds)
    imu = measured(time_, rate, force, 4)
    write_session(folder / 'drive', imu)
    calibrate_recordings([str(SESSION)], str(SESSION / 'table.yaml')).save(folder, report=False)
    paths = navigate(folder / 'drive', folder / 'calibration.yaml', domain_id)
    lost = {topic: len(imu) - len(rows) for topic, rows in paths.items()}
    if max(lost.values()) > MOST_LOST:
        raise SystemExit(
            f'too many messages were lost for a comparison: {lost}; run it again on an idle machine'
        )
    found = errors_of(paths, imu.stamp_ns, path)
    for topic, (most, last, _) in found.items():
        print(f'/{topic}: error {last:.2f} m at the end, largest {most:.2f} m')
    (_, raw, _), (_, corrected, _) = found.values()
    print(
        f'the calibration reduces the position error after {seconds:.0f} s by'
        f' {raw - corrected:.2f} m'
    )
    if picture:
        draw(found, path, picture)
        print(f'written: {picture}')
    return 0 if corrected < raw else 1


def main(arguments=None):
    """Read the arguments and compare both paths; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument(
        '--domain-id',
        type=int,
        default=1 + os.getpid() % 100,
        help='ROS_DOMAIN_ID, default one of its own',
    )
    parser.add_argument(
        '--picture',
        metavar='FILE',
        default=str(ROOT / 'docs' / 'downstream_nav.png'),
        help='file of the figure',
    )
    parser.add_argument(
        '--seconds', type=float, default=120.0, help='length of the drive, default 120'
    )
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        return run(options.domain_id, options.picture, options.seconds, Path(temporary))


if __name__ == '__main__':
    sys.exit(main())
