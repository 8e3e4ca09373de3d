"""What nodes show to Foxglove while they run: over a real websocket, to whoever comes whenever, made only while somebody looks."""

import re
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.errors import InputError
from imu_calibration.use_cases.calibrate import calibrate
from imu_calibration.use_cases.foxglove_file import scene_of
from imu_calibration.use_cases.view import view
from imu_calibration.use_cases.view_messages import BAND, HEALTH, PARAMETERS, READINGS, RESIDUAL, SCHEMAS, SPECTRUM, SPHERE

pytest.importorskip('foxglove', reason='the extra view is not installed')
pytest.importorskip('tornado', reason='tornado is not installed')
from refusal import refused

from imu_calibration.use_cases.foxglove_server import AGAIN, FoxgloveServer  # noqa: E402

from ros.foxglove_client import FoxgloveClient  # noqa: E402
from ros.threads import until  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SESSION, TABLE = str(ROOT / 'bags/sample_session'), str(ROOT / 'bags/sample_session/table.yaml')


@pytest.fixture
def server():
    """A server of two topics, and the lines of its complaints."""
    complaints = []
    server = FoxgloveServer('/bench', host='127.0.0.1', port=0, topics=(HEALTH, READINGS), clock=lambda: 7, complain=complaints.append)
    server.complaints = complaints
    yield server
    server.close()


def test_nothing_is_made_while_nobody_looks_and_whoever_comes_later_sees_the_last(server):
    made = []
    for number in range(3):
        server.show(HEALTH, lambda number=number: made.append(number) or {'message': str(number)})
    time.sleep(0.3)
    assert made == []
    first = FoxgloveClient(server.address)
    until(lambda: first.received.get(HEALTH), 'the first message')
    assert first.received[HEALTH][0] == (7, {'message': '2'}) and made == [2]
    assert first.name_of_server == '/bench' and first.schemas[HEALTH] == SCHEMAS[HEALTH]['title']
    late = FoxgloveClient(server.address)
    until(lambda: late.received.get(HEALTH), 'the same for the second one', 10 * AGAIN)
    assert late.received[HEALTH][0] == (7, {'message': '2'}) and made == [2]
    server.show(HEALTH, lambda: {'message': 'new'})
    until(lambda: late.received[HEALTH][-1][1] == {'message': 'new'}, 'the news')


def test_of_a_stream_every_message_comes_once_in_order_and_little_is_kept_for_nobody(server):
    for number in range(1000):
        server.add(READINGS, lambda number=number: [(number, {}), (number, {})])
    client = FoxgloveClient(server.address)
    until(lambda: client.received.get(READINGS) and client.received[READINGS][-1][0] == 999, 'the last one')
    stamps = [stamp for stamp, _ in client.received[READINGS]]
    assert 10 < len(stamps) < 200 and stamps == sorted(stamps) and len(set(stamps)) == len(stamps) / 2
    time.sleep(1.5 * AGAIN)
    assert len(client.received[READINGS]) == len(stamps)


def test_what_cannot_be_shown_is_told_and_the_rest_goes_on(server):
    server.show(HEALTH, lambda: 1 / 0)
    server.show(READINGS, lambda: {'measured': {}})
    client = FoxgloveClient(server.address)
    until(lambda: client.received.get(READINGS), 'the other topic')
    until(lambda: server.complaints, 'the complaint')
    assert server.complaints[0].startswith(f'{HEALTH} cannot be shown: ZeroDivisionError') and not client.received[HEALTH]


def test_a_port_that_is_taken_is_one_sentence(server):
    port = int(server.address.rpartition(':')[2])
    with refused(InputError, 'address_taken', f'127.0.0.1:{port}', 'foxglove_port'):
        FoxgloveServer('/other', host='127.0.0.1', port=port, topics=(), clock=int, complain=print)


def test_what_stops_take_off_is_taken_off_what_is_shown():
    from imu_calibration.compensation.stop_watch import CorrectedStretch
    from imu_calibration.use_cases.view_messages import readings
    samples = np.column_stack([[0, 20_000_000], np.tile(np.arange(12.0), (2, 1))])
    offset, sd = (0.5, 0.0, -0.25), (np.full(3, 0.1), np.full(3, np.nan))
    (first, shown), (second, _) = readings(CorrectedStretch(10**18, samples, offset), sd)
    assert (first, second) == (10**18, 10**18 + 20_000_000)
    assert shown['corrected'] == {'gyroscope': {'x': -0.5, 'y': 1.0, 'z': 2.25}, 'accelerometer': {'x': 3.0, 'y': 4.0, 'z': 5.0}}
    assert shown['measured']['gyroscope'] == {'x': 6.0, 'y': 7.0, 'z': 8.0} and shown['low']['accelerometer'] == {}
    assert shown['high']['gyroscope']['x'] == pytest.approx(-0.5 + 0.1 * BAND)


pytest.importorskip('rclpy')


class Stand:
    """What a view asks of a node."""

    def __init__(self):
        self.said = []

    def get_logger(self):
        """Where lines go."""
        from ros.one_process import Ear
        return Ear(self.said)

    def get_fully_qualified_name(self):
        """As in ROS."""
        return '/bench'

    def get_clock(self):
        """The time is 5 s."""
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=5_000_000_000))


def test_a_calibration_is_shown_as_the_file_shows_it(monkeypatch):
    """Turned on after the solution; the spectrum is that of the windows that are still there."""
    from imu_calibration.calibration.coverage import table_coverage
    from imu_calibration.nodes.calibration_view import CalibrationView
    from imu_calibration.nodes.live_view import FoxgloveSettings
    result, node = calibrate(SESSION, TABLE, model_as_asked=True).result, Stand()
    monkeypatch.setattr('imu_calibration.use_cases.view.calibrate', lambda *given, **choices: SimpleNamespace(result=result))
    expected, coverage, shown = view(SESSION, TABLE), table_coverage(result, 'my_imu'), CalibrationView(node, FoxgloveSettings())
    shown.take_solution(result, result.gathered.kept)
    shown.take_coverage(coverage)
    assert not shown.is_on and node.said == []
    shown.change(FoxgloveSettings(foxglove=True, foxglove_port=0))
    [(level, line)] = node.said
    client = FoxgloveClient(line.rpartition(' ')[2])
    until(lambda: len(client.received) == 4 and all(client.received.values()), 'all topics')
    assert {topic: client.received[topic][0] for topic in expected.contents} == {topic: (5_000_000_000, content) for topic, content in expected.contents.items()}
    assert client.received[SPHERE][0][1] == scene_of(coverage, 'my_imu').encode()
    assert set(client.received) == {PARAMETERS, RESIDUAL, SPECTRUM, SPHERE} and level == 'info'
    shown.close()
    until(lambda: not client.is_alive(), 'the end of the connection')


def test_without_the_package_one_line_names_it_and_the_node_goes_on(monkeypatch):
    from imu_calibration.nodes.live_view import FoxgloveSettings, LiveView
    monkeypatch.setitem(sys.modules, 'foxglove', None)
    node = Stand()
    shown = LiveView(node, (HEALTH,), FoxgloveSettings(foxglove=True))
    shown.show(HEALTH, dict)
    assert not shown.is_on and node.said == [('warning', 'no view, the node continues without it: a view needs foxglove-sdk, which is '
                                              'not installed; install imu_calibration[view]')]


@pytest.mark.live
def test_a_compensator_shows_what_it_does(bench, tmp_path):
    """Raw beside corrected with the band of the published covariance; turned on while it runs, its address said once."""
    from rclpy.parameter import Parameter
    from sensor_msgs.msg import Imu

    from imu_calibration.calibration.document import calibration_to_text
    from imu_calibration.nodes.compensator_node import CompensatorNode
    from imu_calibration.nodes.qos import output_qos
    from imu_calibration.samples import ImuSamples
    from msg_adapters.encode import encode_imu
    from msg_adapters.imu import FIELDS, parse_imu

    from worlds.compensation_cases import random_calibration
    calibration = random_calibration(1, frame_id='imu_link')
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(calibration))
    node = bench.start(CompensatorNode, {'calibration_file': str(tmp_path / 'calibration.yaml'), 'foxglove_port': 0, 'public_executor': True,
                                         'covariance_rate': 0.0})
    assert node.compensation.watch.listener is None
    [answer] = node.set_parameters([Parameter('foxglove', value=True)])
    assert answer.successful and bench.heard('Foxglove finds it at ws://127.0.0.1:', 'info') == 1
    address = next(line for _, line in bench.said if 'Foxglove' in line).rpartition(' ')[2]
    client = FoxgloveClient(address)
    until(lambda: len(client.received) == 3, 'the topics')

    corrected, n = [], 200
    bench.node.create_subscription(Imu, 'imu/data_corrected', corrected.append, output_qos(), raw=True)
    publisher = bench.node.create_publisher(Imu, 'imu/data_raw', output_qos())
    bench.until(publisher.get_subscription_count, 'the compensator')
    rng = np.random.default_rng(0)
    raw = ImuSamples(10**18 + 10_000_000 * np.arange(n), rng.normal(size=(n, 3)) + [0, 0, 9.8], rng.normal(size=(n, 3)), 'imu_link')
    for row in encode_imu(raw):
        publisher.publish(row.tobytes())
    bench.until(lambda: len(corrected) == n, 'the corrected messages')
    until(lambda: len(client.received[READINGS]) >= n // 2 - 20, 'the readings')
    published = {parse_imu(data).stamp_ns: np.array(parse_imu(data).doubles) for data in corrected}
    for stamp, shown in client.received[READINGS]:
        k = (stamp - raw.stamp_ns[0]) // 10_000_000
        for sensor, name, reading in (('gyroscope', 'rate', raw.rate_s), ('accelerometer', 'force', raw.force_s)):
            value, variance = published[stamp][FIELDS[f'{name}_s']], published[stamp][FIELDS[f'{name}_cov']].reshape(3, 3).diagonal()
            found = {which: [shown[which][sensor][axis] for axis in 'xyz'] for which in shown}
            assert np.allclose(found['measured'], reading[k]) and np.allclose(found['corrected'], value)
            if k > n / 2:   # before, the derivative of the rate is still settling, and the covariance with it
                assert np.allclose([found['high'] - value, value - found['low']], BAND * np.sqrt(variance), rtol=1e-6)
    stamps = np.array([stamp for stamp, _ in client.received[READINGS]])
    assert np.diff(stamps).min() >= 10_000_000 and np.median(np.diff(stamps)) == 20_000_000   # 100 Hz shown at 50
    until(lambda: client.received[HEALTH] and client.received[PARAMETERS], 'health and parameters')
    assert client.received[HEALTH][-1][1]['outcome'] == 'waiting'
    assert [row['name'] for row in client.received[PARAMETERS][0][1]['parameters']] == list(calibration.param_names)
    [answer] = node.set_parameters([Parameter('foxglove', value=False)])
    assert answer.successful and node.compensation.watch.listener is None
    until(lambda: not client.is_alive(), 'the end of the connection')


def test_the_layout_asks_for_what_a_compensator_shows():
    """As the layout classes of foxglove-sdk 0.30 wrote it; every field is one of the schema of its topic."""
    asked = set(re.findall(r'"(/imu/[^"]+)"', (ROOT / 'config/compensate.foxglove.json').read_text()))
    assert {path.partition('.')[0] for path in asked} == {READINGS, HEALTH, PARAMETERS} and len(asked) == 2 * 3 * 4 + 3
    for path in asked:
        topic, *names = path.split('.')
        schema = SCHEMAS[topic]
        for name in names:
            schema = schema['properties'][name]


@pytest.mark.live
def test_asked_for_in_vain_while_it_runs_the_answer_names_the_package(bench, monkeypatch):
    from rclpy.parameter import Parameter

    from imu_calibration.nodes.compensator_node import CompensatorNode
    monkeypatch.setitem(sys.modules, 'foxglove', None)
    node = bench.start(CompensatorNode)
    [answer] = node.set_parameters([Parameter('foxglove', value=True)])
    assert not answer.successful and 'needs foxglove-sdk, which is not installed' in answer.reason
    assert not node.get_parameter('foxglove').value
