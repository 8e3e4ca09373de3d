"""compensator_node as a process over real DDS, by its own loop and by the public executor."""

import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.compensation.compensate import Transfer
from imu_calibration.core.documents import version_of
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.nodes.message_compensation import LiveCompensation
from msg_adapters.imu import FIELDS
from msg_adapters.write import encode_imu
from validation.imu_messages import parse_imu, patch_imu

from ros.forked_nodes import ForkedNodes
from ros.harness import Harness
from ros.live_station import free_domain
from worlds.compensation_cases import random_calibration

pytest.importorskip('rclpy')
pytestmark = pytest.mark.live

START_NS = 10**18
PERIOD_NS = 5_000_000
CALIBRATION = {name: random_calibration(seed) for seed, name in enumerate('ABCE')}
TEXT = {name: calibration_to_text(calibration) for name, calibration in CALIBRATION.items()}
POSE = (0.4, -0.3, 0.2), (0.3, 1.0, -2.0)
NODES = {
    'own': {'calibration_file': 'A', 'adopt': 'topic'},
    'public': {'calibration_file': 'B', 'adopt': 'topic', 'public_executor': True},
    'waiting': {},
    'passing': {'passthrough': True},
    'late': {'target_frame': 'base_link', 'target_xyz': list(POSE[0]), 'target_rpy': list(POSE[1])},
    'twice': {'calibration_file': 'A'},
}
"""
Parameters of the nodes by namespace; 'twice' listens to what 'own' publishes, which it calls
'clean'.
"""


def imu_messages(n, start=0, frame_id='imu_link'):
    """Messages number start ... start + n - 1 of a lively motion."""
    time_s = (start + np.arange(n)) * PERIOD_NS * 1e-9
    rate = np.stack([np.sin(3 * time_s), np.cos(2 * time_s), 0.5 * np.sin(5 * time_s)], axis=1)
    force = np.stack([np.sin(time_s), 0.3 * time_s, 9.8 * np.cos(time_s)], axis=1)
    stamps = START_NS + PERIOD_NS * (start + np.arange(n))
    return [row.tobytes() for row in encode_imu(ImuSamples(stamps, force, rate, frame_id))]


def raw(name):
    return f'/{name}/imu/data_raw'


def corrected(name):
    return '/own/clean' if name == 'own' else f'/{name}/imu/data_corrected'


@pytest.fixture(scope='module')
def bench(tmp_path_factory):
    """Every node of NODES with the harness connected to it, and the processes by name."""
    from sensor_msgs.msg import Imu
    from std_msgs.msg import String

    from imu_calibration.nodes.inputs import input_qos, latched_qos, output_qos

    folder = tmp_path_factory.mktemp('calibrations')
    for name, text in TEXT.items():
        folder.joinpath(f'{name}.yaml').write_text(text)
    domain_id, lock = free_domain()
    harness = Harness(domain_id)
    harness.publisher(String, '/late/imu/calibration', latched_qos()).publish(
        String(data=TEXT['C'])
    )
    with ForkedNodes(domain_id) as processes:
        harness.processes, harness.by_name = processes, {}
        for name, parameters in NODES.items():
            parameters = dict(parameters)
            if 'calibration_file' in parameters:
                parameters['calibration_file'] = folder / f'{parameters["calibration_file"]}.yaml'
            renamed = {
                'own': {'imu/data_corrected': corrected('own')},
                'twice': {'imu/data_raw': corrected('own')},
            }.get(name)
            harness.by_name[name] = processes.start(
                'compensator_node', parameters, namespace=f'/{name}', remappings=renamed
            )
        reliable, best_effort = output_qos(), input_qos()
        for name in NODES:
            harness.listen(Imu, corrected(name), input_qos(reliable=True))
            if name != 'twice':
                harness.publisher(Imu, raw(name), best_effort if name == 'public' else reliable)
                harness.publisher(String, f'/{name}/imu/calibration', latched_qos())
        for name in NODES:
            if name != 'twice':
                harness.wait(
                    lambda: harness.connected(raw(name)), what=f'a subscription of {raw(name)}'
                )
            harness.wait(
                lambda: harness.node.count_publishers(corrected(name)) > 0,
                what=f'a publisher of {corrected(name)}',
            )
        harness.spin(1.0)
        yield harness
    harness.close()
    lock.close()


def send(bench, name, messages, rate=400.0):
    """Publish messages of one node at a steady rate."""
    publisher, topic = bench._publishers[raw(name)], raw(name)
    assert bench.connected(topic)
    for data in messages:
        publisher.publish(data)
        bench.spin(1.0 / rate)


def sent_through(bench, name, messages, expected=None):
    """Send messages and return what came out, once as many came as expected (default: all)."""
    before = len(bench.received[corrected(name)])
    expected = len(messages) if expected is None else expected
    send(bench, name, messages)
    bench.wait(
        lambda: len(bench.received[corrected(name)]) >= before + expected,
        what=f'{expected} messages of {name}',
    )
    bench.spin(0.1)
    return bench.received[corrected(name)][before:]


def publish_calibration(bench, name, text):
    from std_msgs.msg import String

    bench._publishers[f'/{name}/imu/calibration'].publish(String(data=text))


def node_name(name):
    return f'{name}/compensator_node'


def force_of(data):
    return np.array(parse_imu(data).doubles[FIELDS['force_s']])


def wait_for_version(bench, name, text):
    bench.wait(
        lambda: bench.values(node_name(name)).get('calibration') == version_of(text),
        what=f'version {version_of(text)} of {name}',
    )


@pytest.mark.parametrize(('name', 'calibration'), [('own', 'A'), ('public', 'B')])
def test_each_loop_corrects_what_its_own_imu_sends(bench, name, calibration):
    messages = imu_messages(60)
    out = sent_through(bench, name, messages)
    live = LiveCompensation(CALIBRATION[calibration])
    expected = [live(data) for data in messages]
    bench.wait(
        lambda: 'derivative window [samples]' in bench.values(node_name(name)), what='period'
    )
    assert bench.values(node_name(name))['loop'] == (
        'wait set' if name == 'own' else 'public executor'
    )
    for got, wanted in zip(out, expected, strict=True):
        np.testing.assert_allclose(
            parse_imu(got).doubles[13:16], parse_imu(wanted).doubles[13:16], atol=1e-12
        )
        np.testing.assert_allclose(force_of(got), force_of(wanted), atol=1e-12)
        assert got[:12] == wanted[:12]
    assert {parse_imu(data).frame_id for data in out} == {'imu_link'}


def test_without_a_calibration_nothing_is_published_and_diagnostics_say_so(bench):
    send(bench, 'waiting', imu_messages(10))
    counted = 'passed or held back without calibration'
    bench.wait(
        lambda: int(bench.values(node_name('waiting')).get(counted, 0)) >= 10, what='a count of ten'
    )
    assert bench.received[corrected('waiting')] == []
    assert bench.values(node_name('waiting'))['calibration'] == 'none'
    # The bench publishes on the topic of calibrations: one is in progress.
    assert bench.statuses[node_name('waiting')].level == b'\0'
    publish_calibration(bench, 'waiting', TEXT['C'])
    wait_for_version(bench, 'waiting', TEXT['C'])
    assert len(sent_through(bench, 'waiting', imu_messages(10, 10))) == 10


def test_with_passthrough_messages_pass_until_there_is_a_calibration(bench):
    messages = imu_messages(5)
    assert sent_through(bench, 'passing', messages) == messages
    publish_calibration(bench, 'passing', TEXT['A'])
    wait_for_version(bench, 'passing', TEXT['A'])
    later = imu_messages(5, 5)
    assert all(
        before != after
        for before, after in zip(later, sent_through(bench, 'passing', later), strict=True)
    )


def test_a_late_joiner_gets_the_latched_calibration_and_moves_readings_to_its_target(bench):
    wait_for_version(bench, 'late', TEXT['C'])
    messages = imu_messages(3)
    out = sent_through(bench, 'late', messages)
    live = LiveCompensation(CALIBRATION['C'], Transfer.from_pose('base_link', *POSE))
    for got, data in zip(out, messages, strict=True):
        np.testing.assert_allclose(force_of(got), force_of(live(data)), atol=1e-12)
        assert (
            parse_imu(got).frame_id == 'base_link'
            and parse_imu(got).stamp_ns == parse_imu(data).stamp_ns
        )


def test_a_new_calibration_is_taken_over_without_a_gap_and_rolled_back(bench):
    from std_srvs.srv import Trigger

    name, messages = 'own', imu_messages(240, 1000)
    before = len(bench.received[corrected(name)])
    send(bench, name, messages[:60])
    publish_calibration(bench, name, TEXT['C'])
    send(bench, name, messages[60:])
    bench.wait(
        lambda: len(bench.received[corrected(name)]) >= before + len(messages), what='every message'
    )
    out = bench.received[corrected(name)][before:]
    assert [parse_imu(data).stamp_ns for data in out] == [
        parse_imu(data).stamp_ns for data in messages
    ]
    old, new = (LiveCompensation(CALIBRATION[calibration]) for calibration in 'AC')
    by_old, by_new = (
        [
            np.allclose(
                parse_imu(got).doubles[13:16], parse_imu(live(data)).doubles[13:16], atol=1e-12
            )
            for got, data in zip(out, messages, strict=True)
        ]
        for live in (old, new)
    )
    first = by_new.index(True)
    assert 55 < first < 240
    assert all(by_old[:first]) and all(by_new[first:]) and not any(by_new[:first])
    wait_for_version(bench, name, TEXT['C'])
    response = bench.call(Trigger, f'/{name}/compensator_node/reload')
    assert response.success and version_of(TEXT['A']) in response.message
    wait_for_version(bench, name, TEXT['A'])


def test_reload_without_a_file_says_so(bench):
    from std_srvs.srv import Trigger

    response = bench.call(Trigger, '/late/compensator_node/reload')
    assert not response.success and "'calibration_file'" in response.message


@pytest.mark.parametrize(
    ('text', 'code'),
    [
        ('not: [a calibration', 'not_yaml'),
        (TEXT['E'].replace('frame_id: imu_link', 'frame_id: other_imu'), 'other_sensor'),
        (TEXT['E'].replace('imu_calibration/1', 'imu_calibration/7'), 'document_newer'),
        (calibration_to_text(replace(CALIBRATION['E'], decision={})), 'no_sensor_helps'),
    ],
    ids=['broken', 'other sensor', 'newer', 'unproven'],
)
def test_a_refused_document_leaves_the_old_one(bench, text, code):
    publish_calibration(bench, 'public', text)
    bench.wait(lambda: bench.values(node_name('public')).get('refused') == code, what=code)
    assert bench.statuses[node_name('public')].level == b'\2'
    assert bench.values(node_name('public'))['calibration'] == version_of(TEXT['B'])
    assert len(sent_through(bench, 'public', imu_messages(2, 500))) == 2


def test_bursts_of_nan_and_messages_of_another_sensor_are_held_back(bench):
    messages = imu_messages(60, 2000)
    broken = [
        patch_imu(data, force_s=(np.nan,) * 3) if 20 <= k < 30 else data
        for k, data in enumerate(messages)
    ]
    broken[40:45] = imu_messages(5, 2040, frame_id='somebody_else')
    out = sent_through(bench, 'own', broken, 45)
    assert len(out) == 45 and np.isfinite([parse_imu(data).doubles[13:] for data in out]).all()
    # Diagnostics may be told between two of the messages.
    told = {'not finite': '10', "frame_id 'somebody_else'": '5'}
    bench.wait(lambda: told.items() <= bench.values(node_name('own')).items(), what='both counts')


def test_two_imus_at_once_do_not_mix(bench):
    messages = imu_messages(20, 3000)
    before = {name: len(bench.received[corrected(name)]) for name in ('waiting', 'passing')}
    for data in messages:
        for name in before:
            bench._publishers[raw(name)].publish(data)
        bench.spin(0.005)
    for name, calibration in (('waiting', 'C'), ('passing', 'A')):
        bench.wait(
            lambda: len(bench.received[corrected(name)]) >= before[name] + 20,
            what=f'messages of {name}',
        )
        inverse = np.linalg.inv(CALIBRATION[calibration].value('gyroscope', 'matrix'))
        bias = CALIBRATION[calibration].value('gyroscope', 'bias')
        rate = [inverse @ (np.array(parse_imu(d).doubles[13:16]) - bias) for d in messages]
        np.testing.assert_allclose(
            [parse_imu(d).doubles[13:16] for d in bench.received[corrected(name)][before[name] :]],
            rate,
            atol=1e-12,
        )


def test_a_stream_that_is_corrected_already_is_refused(bench):
    bench.wait(
        lambda: (
            corrected('own') in bench.lines().get(node_name('twice'), '')
            and bench.statuses[node_name('twice')].level == b'\2'
        ),
        what='the refusal',
    )
    # Messages before the discovery of the mark, which takes long on a busy machine.
    bench.received[corrected('twice')].clear()
    assert len(sent_through(bench, 'own', imu_messages(5, 4000))) == 5
    bench.spin(0.5)
    assert bench.received[corrected('twice')] == []
    process = bench.processes.start(
        'compensator_node',
        {},
        namespace='/by_name',
        remappings={'imu/data_raw': '/late/imu/data_corrected'},
    )
    assert process.wait(timeout=30) == 1


def test_a_value_out_of_range_ends_the_node_with_one_line(bench, tmp_path):
    with tmp_path.joinpath('log').open('w+') as log:
        process = bench.processes.start(
            'compensator_node', {'covariance_rate': -1.0}, namespace='/wrong', output=log
        )
        assert process.wait(timeout=30) == 1
        log.seek(0)
        text = log.read()
    assert "'covariance_rate'" in text and '-1' in text and 'Traceback' not in text


@pytest.mark.parametrize(
    ('name', 'number'),
    [
        ('own', signal.SIGINT),
        ('waiting', signal.SIGTERM),
        ('public', signal.SIGTERM),
        ('passing', signal.SIGINT),
    ],
)
def test_signals_end_the_node_with_code_zero(bench, name, number):
    start = time.monotonic()
    assert bench.processes.end(bench.by_name[name], number) == 0
    assert time.monotonic() - start < 10.0


def test_a_node_killed_in_the_middle_is_replaced(bench):
    bench.by_name['late'].kill()
    bench.by_name['late'].wait()
    bench.statuses.pop(node_name('late'))
    bench.by_name['late'] = bench.processes.start('compensator_node', namespace='/late')
    bench.wait(
        lambda: bench.connected(raw('late'), 2),
        what='the new node beside what is left of the old one',
    )
    wait_for_version(bench, 'late', TEXT['C'])
    before, number = len(bench.received[corrected('late')]), iter(range(1000))

    def came_after_one_more():
        send(bench, 'late', imu_messages(1, next(number)), rate=20.0)
        return len(bench.received[corrected('late')]) > before

    bench.wait(came_after_one_more, what='a corrected message')
