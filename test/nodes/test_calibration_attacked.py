"""
calibration_node against bad places, bad streams and bad luck.

It says what is wrong, answers, and keeps what was gathered.
"""

from dataclasses import replace

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState

from imu_calibration.document.calibration_text import calibration_from_text
from imu_calibration.nodes import calibration_node
from imu_calibration.nodes.calibration_node import CalibrationNode
from imu_calibration.nodes.calibration_status import advice_of
from imu_calibration.nodes.lifecycle import unknown_parameters
from imu_calibration.preprocessing.window import WindowSettings
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu, encode_joints

from ros.live_station import TABLE
from worlds.live_sessions import make_session

pytestmark = pytest.mark.live
OK, WARN, ERROR = range(3)
CALIBRATION, STREAMS = 'calibration_node: calibration', 'calibration_node: streams'


@pytest.fixture(scope='module')
def session():
    """IMU and joints of half a minute at 50 Hz: enough for a few windows."""
    return make_session(3, 50.0, seconds=30.0)[:2]


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """A node reports silent streams after half a second."""
    monkeypatch.setattr(calibration_node, 'MAX_SILENCE_SECONDS', 0.5)


def start(bench, folder, **parameters):
    """A node on the table that saves into `folder`."""
    return bench.start(
        CalibrationNode,
        {
            'table_file': str(TABLE),
            'save_file': str(folder / 'calibration.yaml'),
            'diagnosis_period': 0.0,
        }
        | parameters,
    )


def send(bench, imu, joints, topics=('imu/data_raw', 'joint_states')):
    """Publish samples in the order of their stamps."""
    qos = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)
    to = [
        bench.node.create_publisher(kind, topic, qos)
        for kind, topic in zip((Imu, JointState), topics)
    ]
    bench.until(
        lambda: all(publisher.get_subscription_count() for publisher in to), 'subscriptions'
    )
    queue = [
        (k / len(samples), publisher, bytes(message))
        for publisher, samples, encode in zip(to, (imu, joints), (encode_imu, encode_joints))
        for k, message in enumerate(Packed.of_rows(encode(samples)).views())
    ]
    for k, (_, publisher, message) in enumerate(sorted(queue, key=lambda entry: entry[0])):
        publisher.publish(message)
        if k % 100 == 0:
            bench.executor.spin_once(timeout_sec=0.005)
    return to


def gathered(bench, node):
    """Wait for windows."""
    bench.until(lambda: node.worker.state.gathered, 'windows')


def test_a_session_is_told_line_by_line_each_once(bench, session, tmp_path):
    node = start(bench, tmp_path)
    bench.until(
        lambda: (advice := advice_of(node.worker.state)) and bench.heard(advice, level='info'),
        'what is missing next',
    )
    send(bench, *session)
    gathered(bench, node)
    # A decision on the first windows is another one.
    for name, samples in zip(('imu', 'joints'), session, strict=True):
        count = str(len(samples))
        bench.until(lambda: bench.figure(STREAMS, f'{name} messages') == count, 'all messages')
    answer = bench.call('/calibration_node/solve')
    assert answer.success and answer.message.startswith('helps ')
    bench.until(
        lambda: bench.heard(
            'helps', '`ros2 service call /calibration_node/save std_srvs/srv/Trigger`'
        ),
        'the verdict',
    )
    saved = bench.call('/calibration_node/save')
    assert saved.success and saved.message.startswith('helps')
    assert all(
        f'{tmp_path}/{name}' in saved.message
        for name in ('calibration.yaml', 'calibration.accumulator.npz')
    )
    assert calibration_from_text(
        (tmp_path / 'calibration.yaml').read_text()
    ).decisions == dict.fromkeys(('accelerometer', 'gyroscope'), 'helps')
    assert (
        bench.heard(TABLE, 'outer, middle, inner', f'{tmp_path}/calibration.yaml', level='info')
        == 1
    )
    for values in (
        ('/imu/data_raw', '/tester', 'reliable'),
        ('/joint_states', '/tester', 'reliable'),
        ('~/save: ',),
    ):
        assert bench.heard(*values) == 1, (values, bench.said)
    assert bench.status[CALIBRATION].values and not bench.heard('Traceback')
    assert bench.heard('--', level='info') == 0  # nobody at a node has options of the command line


def test_topics_that_are_mistyped_are_told_with_the_nearest_of_the_type(bench, session, tmp_path):
    node = start(bench, tmp_path)
    imu, joints = (
        (kind, bench.node.create_publisher(kind, topic, 10))
        for kind, topic in ((Imu, '/imu/data_rwa'), (JointState, '/table/joint_states'))
    )
    bench.until(
        lambda: bench.heard(
            'sensor_msgs/msg/Imu', '-r imu/data_raw:=/imu/data_rwa', level='warning'
        ),
        'the nearest Imu topic',
    )
    bench.until(
        lambda: bench.heard('-r joint_states:=/table/joint_states', level='warning'),
        'the nearest JointState topic',
    )
    bench.until(lambda: bench.lines().get(STREAMS, (0, ''))[0] == ERROR, 'the same on /diagnostics')
    assert imu and joints and not node.worker.state.gathered


@pytest.mark.parametrize('kind', ('a file as parent', 'a name too long'))
def test_a_place_that_cannot_be_written_is_told_at_the_start_and_costs_nothing(
    bench, session, tmp_path, kind
):
    (tmp_path / 'file').write_text('here already')
    place = {
        'a file as parent': tmp_path / 'file' / 'calibration.yaml',
        'a name too long': tmp_path / ('x' * 300 + '.yaml'),
    }[kind]
    node = start(bench, tmp_path, save_file=str(place), autosave_period=0.2)
    bench.until(lambda: bench.heard(place, level='error'), 'the place')
    send(bench, *session)
    gathered(bench, node)
    answer = bench.call('/calibration_node/save')
    assert not answer.success and str(place) in answer.message and '\n' not in answer.message
    bench.until(
        lambda: bench.lines().get(CALIBRATION, (0, ''))[0] == ERROR, 'an error on /diagnostics'
    )
    assert (tmp_path / 'file').read_text() == 'here already'
    if kind == 'a file as parent':
        (tmp_path / 'file').unlink()
        answer = bench.call('/calibration_node/save')
        assert answer.success and place.is_file(), answer.message


def test_at_its_end_unsaved_motion_is_kept_where_a_place_was_given_and_told_lost_where_not(
    bench, session, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    kept, lost = (
        start(bench, tmp_path),
        bench.start(CalibrationNode, {'table_file': str(TABLE)}, namespace='/other'),
    )
    send(bench, *session)
    send(bench, *session, ('/other/imu/data_raw', '/other/joint_states'))
    for node in (kept, lost):
        gathered(bench, node)
    told = kept.close()
    assert f'{tmp_path}/calibration.accumulator.npz' in told and 'resume:=true' in told
    told = lost.close()
    assert '~/save' in told and "'save_file'" in told
    again = start(bench, tmp_path, resume=True)
    # Those that were still open count as well.
    assert again.worker.live.n_windows >= kept.worker.live.n_windows > 0
    assert (
        bench.heard(
            f' {again.worker.live.n_windows} ',
            f'{tmp_path}/calibration.accumulator.npz',
            level='info',
        )
        == 1
    )
    kept.close = lost.close = lambda: None


def test_motion_of_another_model_or_a_damaged_file_is_put_aside_and_the_session_begins(
    bench, session, tmp_path
):
    first = start(bench, tmp_path)
    send(bench, *session)
    gathered(bench, first)
    first.close()
    first.close = lambda: None
    other = start(bench, tmp_path, resume=True, accelerometer_model='bias+matrix+accel_quadratic')
    assert (
        other.worker.live.n_windows == 0 and (tmp_path / 'calibration.accumulator.npz.1').is_file()
    )
    assert bench.heard(f'{tmp_path}/calibration.accumulator.npz.1', level='error') == 1
    (tmp_path / 'calibration.accumulator.npz').write_bytes(b'damaged')
    assert start(bench, tmp_path, resume=True).worker.live.n_windows == 0
    assert (tmp_path / 'calibration.accumulator.npz.2').read_bytes() == b'damaged'
    (line,) = [
        line
        for level, line in bench.said
        if level == 'error' and f'{tmp_path}/calibration.accumulator.npz.2' in line
    ]
    assert ' 7 ' in line  # bytes
    assert not any(word in line for word in ('pickle', 'Error', 'numpy', 'without resume'))


def test_a_calibration_without_motion_so_far_is_no_fault(bench, tmp_path):
    start(bench, tmp_path)
    for service in ('solve', 'save'):
        assert not bench.call(f'/calibration_node/{service}').success
        assert bench.heard(f'~/{service}: ', level='info') == 1
        assert not bench.heard(f'~/{service}: ', level='error')
    bench.until(lambda: bench.lines().get(CALIBRATION, (ERROR, ''))[0] == OK, 'no fault')
    assert list(tmp_path.iterdir()) == []


def test_whatever_fails_within_is_told_and_the_session_goes_on(bench, session, tmp_path):
    node = start(bench, tmp_path)
    live = node.worker.live
    whole, live.push = live.push, lambda block: 1 / 0
    send(bench, *(samples.select(slice(0, 200)) for samples in session))
    bench.until(
        lambda: bench.heard('process messages', 'ZeroDivisionError', level='error'), 'the fault'
    )
    answer = bench.call('/calibration_node/save')
    assert not answer.success and not list(tmp_path.iterdir())
    live.push = whole
    bench.until(lambda: not node.worker.state.faults, 'that it is over')
    send(bench, *session)
    gathered(bench, node)
    assert bench.call('/calibration_node/save').success


def test_parameters_change_while_it_runs_or_say_why_not(bench, tmp_path):
    node = start(bench, tmp_path, setling=1.0)
    (line,) = unknown_parameters(node)
    assert "'setling'" in line and "'settling'" in line
    assert node.set_parameters([Parameter('settling', value=2.0)])[0].successful
    assert node._session_settings[WindowSettings].settling == 2.0
    # The place of `~/save` too: a participant must not redirect what it writes.
    for name, value in (
        ('model_as_asked', True),
        ('accelerometer_model', 'bias'),
        ('save_file', str(tmp_path / '.profile')),
    ):
        answer = node.set_parameters([Parameter(name, value=value)])[0]
        assert (
            not answer.successful
            and name in answer.reason
            and node.get_parameter(name).value != value
        )


def test_joint_states_without_positions_and_zero_stamps_are_named(bench, session, tmp_path):
    start(bench, tmp_path)
    imu = session[0].select(slice(0, 400))
    silent = bench.node.create_publisher(JointState, 'joint_states', 100)
    bench.until(silent.get_subscription_count, 'a subscription')
    for _ in range(20):
        silent.publish(JointState(name=['outer', 'middle', 'inner']))
    bench.until(lambda: bench.heard('/joint_states', '20 ', 'JointState'), 'the empty position')
    assert not bench.heard('outer, middle, inner', level='warning') and not bench.heard(
        'outer, middle, inner', level='error'
    )
    to = bench.node.create_publisher(Imu, 'imu/data_raw', 1000)
    bench.until(to.get_subscription_count, 'a subscription')
    for message in Packed.of_rows(
        encode_imu(replace(imu, stamp_ns=np.zeros(len(imu), np.int64)))
    ).views():
        to.publish(bytes(message))
    bench.until(
        lambda: bench.figure(STREAMS, 'Imu zero stamp') == '400', 'the same on /diagnostics'
    )
