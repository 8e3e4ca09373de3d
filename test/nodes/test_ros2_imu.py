"""
`ros2 imu VERB` beside the plain command, and `ros2 doctor` on Imu topics.

With the real `ros2` in a workspace.
"""

import os
import re
import signal
import subprocess
import sys

import pytest

from imu_calibration.cli.main import main
from imu_calibration.cli.parser import VERBS

pytest.importorskip('rclpy')
from ros.live_station import STAY_LOCAL, free_domain
from ros.workspace import ROOT, sourced

pytestmark = [pytest.mark.slow, pytest.mark.live]
TRUTH = ROOT / 'bags/sample_session/truth.yaml'
FAULTY = """
import sys, rclpy
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import Imu, MagneticField
rclpy.init()
node = rclpy.create_node('driver')
good = node.create_publisher(Imu, 'good/imu/data_raw', 10)
bad = node.create_publisher(Imu, 'bad/imu/data_raw', qos_profile_sensor_data)
other = node.create_publisher(MagneticField, 'strange/imu/data', 10)
depth = QoSProfile(depth=5)
listener = node.create_subscription(Imu, 'bad/imu/data_raw', lambda message: None, depth)
counter, STEP_NS = [0], 20_000_000
start_ns = node.get_clock().now().nanoseconds
def publish_due():   # a sensor's clock runs on while a busy machine lets its driver wait
    while start_ns + counter[0] * STEP_NS <= node.get_clock().now().nanoseconds:
        publish()
def publish():
    counter[0] += 1
    wobble = 1e-3 * ((counter[0] * 37) % 11 - 5)
    for publisher, unit, frame, variance in ((good, 9.81, 'imu_link', 1e-4), (bad, 1.0, '', -1e-4)):
        message = Imu()
        message.header.stamp = Time(nanoseconds=start_ns + (counter[0] - 1) * STEP_NS).to_msg()
        message.header.frame_id = frame
        force, rate = message.linear_acceleration, message.angular_velocity
        force.x, force.y, force.z = wobble, -wobble, unit + wobble
        rate.x, rate.y, rate.z = wobble, -wobble, 2 * wobble
        for element in (0, 4, 8):
            message.linear_acceleration_covariance[element] = 1e-4
        message.angular_velocity_covariance[0] = message.angular_velocity_covariance[4] = 1e-4
        message.angular_velocity_covariance[8] = variance
        message.orientation_covariance[0] = -1.0
        publisher.publish(message)
node.create_timer(0.02, publish_due)
print('ready', flush=True)
rclpy.spin(node)
"""


@pytest.fixture(scope='module')
def place(tmp_path_factory, built, with_ros2):
    """(a folder to work in, what runs a line of shell there with `ros2` on PATH)."""
    folder = tmp_path_factory.mktemp('ros2_imu')
    (folder / 'install').symlink_to(built / 'install')
    domain_id, lock = free_domain()
    environment = with_ros2 | STAY_LOCAL | {'ROS_DOMAIN_ID': str(domain_id)}

    def shell(line):
        return subprocess.run(
            sourced(folder, line),
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=180,
            stdin=subprocess.DEVNULL,
        )

    yield folder, shell, environment
    shell('ros2 daemon stop')
    lock.close()


def test_every_verb_of_the_plain_command_is_offered(place):
    _, shell, _ = place
    found = re.findall(r'^    ([a-z]+)(?: |$)', shell('ros2 imu --help').stdout, re.MULTILINE)
    assert tuple(found) == tuple(VERBS)
    assert re.search(
        r'^ +imu +Calibrate, compensate and diagnose', shell('ros2 --help').stdout, re.MULTILINE
    )
    assert shell('ros2 imu').returncode == 0


@pytest.mark.long
@pytest.mark.parametrize(
    'line',
    [
        f'export {TRUTH} --to json --output result.json --force',
        f'compare {TRUTH} nowhere.yaml',
        'calibrat session',
    ],
)
def test_output_and_exit_code_are_those_of_the_plain_command(place, line, monkeypatch, capfd):
    folder, shell, _ = place
    for path in folder.glob('result*'):  # of another command
        path.unlink()
    monkeypatch.chdir(folder)
    try:
        code = main(line.split())
    except SystemExit as end:
        code = end.code
    plain = capfd.readouterr()
    written = {path: path.read_bytes() for path in folder.glob('result*')}
    for path in written:
        path.unlink()
    by_ros2 = shell('ros2 imu ' + line)
    assert (by_ros2.returncode, by_ros2.stdout) == (code, plain.out)
    assert by_ros2.stderr.replace('ros2 imu', 'imu_calibration') == plain.err
    assert written == {path: path.read_bytes() for path in folder.glob('result*')}


@pytest.mark.long
def test_the_doctor_names_what_is_wrong_with_imu_topics_and_leaves_a_good_one_in_peace(place):
    folder, shell, environment = place
    with subprocess.Popen(
        [sys.executable, '-c', FAULTY],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as driver:
        try:
            assert driver.stdout.readline() == 'ready\n'
            told = shell('ros2 doctor --exclude-packages --report-failed')
        finally:
            os.kill(driver.pid, signal.SIGKILL)
    lines = [line for line in told.stderr.splitlines() if 'imu_calibration' in line]
    ours = [line.partition('Warning: ')[2] for line in lines]
    for words in (
        'ERROR: /bad/imu/data_raw: force unit: .*probably g',
        'ERROR: /bad/imu/data_raw: qos: .*driver .*driver: ',
        '/bad/imu/data_raw: frame: .*frame_id',
        '/bad/imu/data_raw: covariance: .*-0.0001',
        'ERROR: /strange/imu/data: type: .*sensor_msgs/msg/MagneticField',
    ):
        assert any(re.match(words, line) for line in ours), (words, told.stderr)
    assert not any('/good/' in line for line in ours), told.stderr
    failed, _, report = told.stdout.partition('Failed modules:')[2].partition('\n')
    assert 'imu' in failed.split(), told.stdout
    assert re.search(r'topic *: /good/imu/data_raw from /driver, reliable', report) and re.search(
        r'topic *: /bad/imu/data_raw from /driver, best effort', report
    )
