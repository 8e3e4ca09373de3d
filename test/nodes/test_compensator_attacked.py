"""
compensator_node against bad calibrations, bad documents, bad streams.

It refuses, says so, and keeps what it had.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from refusal import refused
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import String

from imu_calibration.core.documents import version_of
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.effects.base import Role
from imu_calibration.nodes import compensator_diagnostics, compensator_node, inputs
from imu_calibration.nodes.adoption import CompensatorSettings
from imu_calibration.nodes.compensator_node import CompensatorNode
from imu_calibration.nodes.inputs import latched_qos
from imu_calibration.nodes.lifecycle import unknown_parameters
from imu_calibration.preprocessing.stamping import COUNTED, REGULAR, StampLine
from msg_adapters.write import encode_imu

from ros.live_station import Station
from worlds.compensation_cases import random_calibration

pytestmark = [pytest.mark.live, pytest.mark.usefixtures('executor_only')]
OK, WARN, ERROR = range(3)
PROOF = {
    sensor: ProofEntry(0.1, 0.01, (0.05, 0.2), unit='m/s^2', windows=12)
    for sensor in ('accelerometer', 'gyroscope')
}
GOOD, OTHER = (random_calibration(seed, proof=PROOF, decision={}) for seed in (1, 2))
GOOD_TEXT, OTHER_TEXT = map(calibration_to_text, (GOOD, OTHER))
WORSE = {sensor: replace(part, after=0.2, ci95=(1.5, 2.5)) for sensor, part in PROOF.items()}
MESSAGES = [
    row.tobytes()
    for row in encode_imu(
        ImuSamples(
            10**18 + 5_000_000 * np.arange(50),
            np.tile([2.0, 4.0, 8.8], (50, 1)),
            np.full((50, 3), 0.1),
            'imu_link',
        )
    )
]
STATUS = 'compensator_node: compensation'


class Sender(Node):
    """Another node that publishes."""

    def __init__(self, **options):
        super().__init__('sender', **options)


@pytest.fixture
def place(tmp_path):
    """A file with a good calibration."""
    (tmp_path / 'good.yaml').write_text(GOOD_TEXT)
    return tmp_path / 'good.yaml'


def damaged(before, after):
    """The text of the other calibration with a piece replaced."""
    assert before in OTHER_TEXT
    return OTHER_TEXT.replace(before, after)


REFUSED = {
    'unproven': (calibration_to_text(replace(OTHER, proof={}, decision={})), 'no_sensor_helps'),
    'harms': (calibration_to_text(replace(OTHER, proof=WORSE)), 'no_sensor_helps'),
    'scalar noise': (damaged('noise_sd: [', 'noise_sd: 7\n    old: ['), 'part_value'),
    'brackets': ('[' * 200_000, 'document_limit'),
    'aliases': ('a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]', 'yaml_alias'),
    'another sensor': (damaged('frame_id: imu_link', 'frame_id: other_link'), 'other_sensor'),
    'huge': ('a: ' + 'x' * 3_000_000, 'document_limit'),
}
"""Document and the code of its refusal."""


def test_nothing_bad_displaces_what_is_in_force(bench, place):
    node = bench.start(CompensatorNode, {'calibration_file': str(place), 'adopt': 'topic'})
    publisher = bench.node.create_publisher(String, 'imu/calibration', latched_qos())
    bench.until(publisher.get_subscription_count, 'a subscription')
    expected = [node.convert(data, {'source_timestamp': 1}) for data in MESSAGES]
    for name, (text, code) in REFUSED.items():
        bench.status.clear()
        bench.said.clear()
        publisher.publish(String(data=text))
        bench.until(lambda: bench.figure(STATUS, 'refused') == code, f'the refusal of {name}')
        assert (
            bench.shows(STATUS, version_of(GOOD_TEXT), level=ERROR)
            and '\n' not in bench.lines()[STATUS][1]
        )
        assert bench.figure(STATUS, 'calibration') == version_of(GOOD_TEXT)
        assert [node.convert(data, {'source_timestamp': 1}) is None for data in MESSAGES] == [
            out is None for out in expected
        ]
    publisher.publish(String(data=OTHER_TEXT))
    bench.until(
        lambda: bench.figure(STATUS, 'decision') == 'helps' and not bench.figure(STATUS, 'refused'),
        'the good one',
    )
    assert bench.heard(version_of(OTHER_TEXT), '/imu/calibration', 'helps', level='info') == 1
    publisher.publish(String(data=OTHER_TEXT + '\n'))  # another document that says the same
    bench.until(lambda: node.adopted.version == version_of(OTHER_TEXT + '\n'), 'the same again')
    assert not bench.heard(version_of(OTHER_TEXT + '\n'), level='info')
    assert node.set_parameters([Parameter('anyway', value=True)])[0].successful
    publisher.publish(String(data=REFUSED['unproven'][0]))
    bench.until(
        lambda: node.adopted.version == version_of(REFUSED['unproven'][0]),
        'the unproven one, with consent',
    )
    bench.until(
        lambda: bench.shows(STATUS, 'accelerometer', 'unproven', level=WARN),
        'a warning all the same',
    )
    assert node.set_parameters([Parameter('anyway', value=False)])[0].successful
    half = calibration_to_text(
        replace(OTHER, proof=PROOF | {'accelerometer': WORSE['accelerometer']})
    )
    publisher.publish(String(data=half))
    bench.until(
        lambda: (
            bench.shows(STATUS, 'accelerometer', 'harms', level=WARN)
            and bench.figure(STATUS, 'not corrected') == 'accelerometer'
        ),
        'a word on the sensor that is left',
    )
    assert node.adopted.version == version_of(half)
    answer = bench.call('/compensator_node/reload')
    assert answer.success and version_of(GOOD_TEXT) in answer.message


def test_a_file_that_was_named_is_not_displaced_unless_asked(bench, place):
    node = bench.start(CompensatorNode, {'calibration_file': str(place)})
    bench.node.create_publisher(String, 'imu/calibration', latched_qos()).publish(
        String(data=OTHER_TEXT)
    )
    bench.until(
        lambda: bench.heard('/imu/calibration', 'adopt', 'file_then_topic', level='warning'),
        'a word about it',
    )
    assert node.adopted.version == version_of(GOOD_TEXT)
    assert node.set_parameters([Parameter('adopt', value='topic')])[0].successful
    assert node.adopted.version == version_of(OTHER_TEXT)  # what was heard meanwhile
    assert [
        CompensatorSettings(calibration_file=name, adopt=adopt).takes_topic
        for adopt in ('file', 'topic', 'file_then_topic')
        for name in ('', 'a.yaml')
    ] == [False, False, True, True, True, False]


def test_parameters_change_while_it_runs_or_say_why_not(bench, place, tmp_path):
    node = bench.start(CompensatorNode, {'calibration_file': str(place)})

    def change(**values):
        return node.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()]
        )

    for values, words in (
        ({'calibration_file': str(tmp_path / 'other.yaml')}, 'read-only'),
        ({'noise_file': '/dev/zero'}, 'read-only'),
        ({'adopt': 'nobody'}, 'file_then_topic'),
        ({'public_executor': True}, 'public_executor'),
        ({'target_xyz': [1.0, 0.0, 0.0]}, 'target_frame'),
    ):
        answer = change(**values)
        assert not answer.successful and words in answer.reason and '\n' not in answer.reason
        assert node.adopted.version == version_of(GOOD_TEXT)
    place.write_text(OTHER_TEXT)  # ~/reload reads the same path again
    assert bench.call('/compensator_node/reload').success and node.adopted.version == version_of(
        OTHER_TEXT
    )
    place.write_text('frame_id: [')
    answer = bench.call('/compensator_node/reload')
    assert (
        not answer.success
        and node.refusal == 'not_yaml'
        and node.adopted.version == version_of(OTHER_TEXT)
    )
    assert change(target_frame='base_link', target_xyz=[1.0, 0.0, 0.0]).successful
    assert node.compensation.transfer.frame_id == 'base_link'


def test_a_misspelt_parameter_is_told(bench):
    node = bench.start(
        CompensatorNode, {'calibration_fiel': 'a.yaml', 'reliable': True, 'covariance_rate': 2.0}
    )
    lines = unknown_parameters(node)
    assert len(lines) == 2 and "'calibration_fiel'" in lines[0] and "'calibration_file'" in lines[0]
    assert "'reliable'" in lines[1]


def test_whatever_a_message_does_the_stream_goes_on(bench, place, monkeypatch):
    node = bench.start(CompensatorNode, {'calibration_file': str(place)})
    node.convert(MESSAGES[0], {'source_timestamp': 1})
    monkeypatch.setattr(node.compensation, 'correct', lambda *arguments: 1 / 0)
    assert node.convert(MESSAGES[1], {'source_timestamp': 1}) is None
    monkeypatch.undo()
    bench.until(lambda: bench.shows(STATUS, 'ZeroDivisionError', level=ERROR), 'a word about it')
    assert node.convert(MESSAGES[2], {'source_timestamp': 1}) is not None


def test_a_temperature_that_is_nan_or_stops_is_told(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(compensator_diagnostics, 'COLD', 1.5)
    warm = random_calibration(3, ('accel_thermal_bias',), proof=PROOF)
    (tmp_path / 'warm.yaml').write_text(calibration_to_text(warm))
    node = bench.start(CompensatorNode, {'calibration_file': str(tmp_path / 'warm.yaml')})
    publisher = bench.node.create_publisher(Temperature, 'imu/temperature', 10)
    bench.until(publisher.get_subscription_count, 'a subscription')
    node.convert(MESSAGES[0], {'source_timestamp': 1})
    bench.until(
        lambda: (
            bench.figure(STATUS, 'no temperature yet') == '1'
            and bench.shows(STATUS, 'temperature', level=WARN)
        ),
        'that it waits',
    )
    publisher.publish(Temperature(temperature=float('nan')))
    bench.until(lambda: bench.shows(STATUS, '/imu/temperature', 'finite'), 'NaN')
    publisher.publish(Temperature(temperature=28.0))
    bench.until(lambda: node.compensation.warming is not None, 'the temperature')
    bench.until(
        lambda: bench.shows(STATUS, '28.0 C', '/imu/temperature', '/tester'), 'that it stopped'
    )


def test_any_publisher_connects_and_two_are_told(bench, place, monkeypatch):
    monkeypatch.setattr(inputs, 'SEVERAL_AFTER', 0.5)
    node = bench.start(CompensatorNode, {'calibration_file': str(place)})
    reliable = bench.node.create_publisher(
        Imu, 'imu/data_raw', QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
    )
    bench.until(reliable.get_subscription_count, 'a subscription')
    bench.until(lambda: 'reliable' in node.imu.source() and node.imu.publishers, 'the publisher')
    assert node.imu.reliable
    other = bench.start(Sender)
    best_effort = other.create_publisher(
        Imu, 'imu/data_raw', QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    bench.until(best_effort.get_subscription_count, 'its subscription')
    assert not node.imu.reliable
    bench.until(
        lambda: bench.shows(STATUS, '2', '/imu/data_raw', '/sender', '/tester', level=WARN),
        'that there are two',
    )
    other.destroy_publisher(best_effort)
    bench.until(lambda: node.imu.reliable and not bench.shows(STATUS, '/sender'), 'that it is over')


def test_a_topic_that_is_mistyped_is_told_with_the_nearest(bench, place):
    bench.node.create_publisher(Imu, '/imu/data_rwa', 10)
    bench.start(CompensatorNode, {'calibration_file': str(place)})
    bench.until(lambda: bench.shows(STATUS, '-r imu/data_raw:=/imu/data_rwa'), 'the nearest topic')
    bench.until(
        lambda: bench.heard('-r imu/data_raw:=/imu/data_rwa', level='warning'),
        'the same on the terminal',
    )


def test_a_new_calibration_is_no_error(bench, place):
    """The counts of the one before belong to the past; an ERROR came after each new calibration."""
    node = bench.start(CompensatorNode, {'calibration_file': str(place), 'adopt': 'topic'})
    publisher = bench.node.create_publisher(String, 'imu/calibration', latched_qos())
    foreign = encode_imu(
        ImuSamples(np.array([10**18]), np.ones((1, 3)), np.ones((1, 3)), 'foreign')
    )[0].tobytes()
    node.convert(foreign, {'source_timestamp': 1})
    bench.until(lambda: bench.lines().get(STATUS, (0, ''))[0] == ERROR, 'the foreign frame')
    bench.until(lambda: bench.lines()[STATUS][0] != ERROR, 'that it is over')
    publisher.publish(String(data=OTHER_TEXT))
    bench.until(lambda: node.adopted.version == version_of(OTHER_TEXT), 'the new one')
    for data in MESSAGES:
        node.convert(data, {'source_timestamp': 1})
    for _ in range(2):
        bench.status.clear()
        bench.until(lambda: STATUS in bench.status, 'diagnostics')
        assert bench.lines()[STATUS][0] != ERROR


def test_a_missing_file_ends_the_node_unless_it_is_waited_for(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(compensator_node, 'LOOK_FOR_FILE', 0.05)
    missing = tmp_path / 'later.yaml'
    with refused(InputError, 'calibration_missing', str(missing), 'wait_for_file'):
        bench.start(CompensatorNode, {'calibration_file': str(missing)})
    node = bench.start(
        CompensatorNode,
        {'calibration_file': str(missing), 'wait_for_file': True},
        namespace='patient',
    )
    bench.until(lambda: bench.heard(missing, level='info'), 'the line')
    assert node.adopted is None
    missing.write_text(GOOD_TEXT)
    bench.until(lambda: node.adopted is not None, 'the calibration')


def test_a_folder_is_the_calibration_in_it(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(compensator_node, 'LOOK_FOR_FILE', 0.05)
    with refused(InputError, 'calibration_missing', 'calibration.yaml'):
        bench.start(CompensatorNode, {'calibration_file': str(tmp_path)})
    node = bench.start(
        CompensatorNode,
        {'calibration_file': str(tmp_path), 'wait_for_file': True},
        namespace='patient',
    )
    (tmp_path / 'calibration.yaml').write_text(GOOD_TEXT)
    bench.until(lambda: node.adopted is not None, 'the calibration')
    assert node.adopted.version == version_of(GOOD_TEXT)


def test_the_process_of_a_node_whose_file_is_missing_ends_with_code_1(tmp_path):
    with Station(tmp_path / 'out.txt') as station:
        process = station.start('compensator_node', {'calibration_file': tmp_path / 'none.yaml'})
        assert process.wait(60) == 1
        station.processes.running.clear()
    lines = (tmp_path / 'out.txt').read_text().splitlines()
    assert all(
        topic in lines[0]
        for topic in (
            '/imu/data_raw',
            '/imu/calibration',
            '/imu/temperature',
            '/imu/data_corrected',
        )
    )
    assert lines[1].startswith('error: ') and 'none.yaml' in lines[1] and len(lines) == 2


def test_a_temperature_in_kelvin_is_refused(bench, tmp_path):
    thermal = random_calibration(1, ('accel_thermal_bias',), proof=PROOF)
    (tmp_path / 'warm.yaml').write_text(calibration_to_text(thermal))
    node = bench.start(CompensatorNode, {'calibration_file': str(tmp_path / 'warm.yaml')})
    for temperature, used in ((298.15, None), (25.0, 25.0), (float('nan'), 25.0), (310.0, 25.0)):
        node._on_temperature(Temperature(temperature=temperature))
        assert node.diagnostics._temperature == used
        assert node.compensation.warming == (
            None if used is None else used - thermal.model.temperature_ref_c
        )
    node.diagnostics.publish_now()
    assert bench.heard('/imu/temperature', '310.0', level='warning') == 1


def test_a_calibration_in_progress_is_no_fault(bench, monkeypatch):
    monkeypatch.setattr(compensator_diagnostics, 'QUIET', 1e9)  # no driver here
    bench.start(CompensatorNode, {'adopt': 'topic'})
    bench.until(lambda: bench.shows(STATUS, 'waiting for a calibration', level=WARN), 'no sender')
    publisher = bench.node.create_publisher(String, 'imu/calibration', latched_qos())
    bench.until(publisher.get_subscription_count, 'a subscription')
    bench.until(lambda: bench.shows(STATUS, '/tester', level=OK), 'a sender without a document')
    unproven = REFUSED['unproven'][0]
    for text in (unproven, unproven + '\n'):  # two versions of the session
        publisher.publish(String(data=text))
        bench.until(lambda: bench.figure(STATUS, 'refused') == 'no_sensor_helps', 'the refusal')
        bench.until(lambda: bench.shows(STATUS, 'unproven', level=OK), 'no fault')
    assert bench.heard('/imu/calibration', 'unproven', level='info') == 1
    assert not bench.heard('unproven', level='error')
    bench.status.clear()
    publisher.publish(String(data=REFUSED['harms'][0]))
    bench.until(lambda: bench.shows(STATUS, 'refused', level=ERROR), 'a fault')
    publisher.publish(String(data=GOOD_TEXT))
    bench.until(lambda: bench.figure(STATUS, 'calibration') == version_of(GOOD_TEXT), 'the good')


def test_how_the_stamps_are_is_said_at_most_once_a_minute_without_a_rate_of_losses(
    bench, place, monkeypatch
):
    node, now = bench.start(CompensatorNode, {'calibration_file': str(place)}), [1000.0]
    monkeypatch.setattr(compensator_diagnostics, 'monotonic', lambda: now[0])
    states = [StampLine(REGULAR, 5_000_000.0), StampLine(COUNTED, 6_000_000.0)]
    slope = SimpleNamespace(line=None)
    for second in range(121):
        now[0], slope.line = 1000.0 + second, states[second % 2]
        node.diagnostics._tell_stamps(SimpleNamespace(slope=slope))
    said = [bench.heard(str(state), level='info') for state in states]
    assert sum(said) == 2  # at 1 s and 62 s
    assert 'Hz' not in str(states[1])


def test_with_two_publishers_nothing_is_adopted_and_later_the_last_document_of_the_remaining_one(
    bench,
):
    node = bench.start(CompensatorNode, {'adopt': 'topic'})
    first = bench.node.create_publisher(String, 'imu/calibration', latched_qos())
    bench.until(first.get_subscription_count, 'a subscription')
    first.publish(String(data=GOOD_TEXT))
    bench.until(lambda: node.adopted is not None, 'the first one')
    second = bench.node.create_publisher(String, 'imu/calibration', latched_qos())
    bench.until(second.get_subscription_count, 'another subscription')
    second.publish(String(data=OTHER_TEXT))
    bench.until(
        lambda: bench.heard('/imu/calibration', '/tester, /tester', level='warning'), 'the refusal'
    )
    assert node.adopted.version == version_of(GOOD_TEXT)
    bench.node.destroy_publisher(first)
    bench.until(lambda: node.adopted.version == version_of(OTHER_TEXT), 'the one that stays')


def test_a_calibration_that_harms_at_rest_gives_way_to_the_previous_one(bench, place):
    """
    A gyroscope bias of 0.01 rad/s too much with a copied proof.

    The same document is not adopted again.
    """
    node = bench.start(CompensatorNode, {'calibration_file': str(place), 'adopt': 'topic'})
    publisher = bench.node.create_publisher(String, 'imu/calibration', latched_qos())
    bench.until(publisher.get_subscription_count, 'a subscription')
    values = GOOD.values.copy()
    values[GOOD.model.slices['gyroscope', 'bias']] += 0.01
    harmful = calibration_to_text(replace(GOOD, values=values))
    publisher.publish(String(data=harmful))
    bench.until(lambda: node.adopted.version == version_of(harmful), 'the harmful one')
    readings = np.random.default_rng(1).normal(0, [[0.02] * 3 + [0.002] * 3], (1000, 6)) + [
        0,
        0,
        9.8,
        0,
        0,
        0,
    ]
    readings[:, 3:] += GOOD.of('gyroscope', Role.OFFSET)
    imu = ImuSamples(
        10**18 + 5_000_000 * np.arange(1000),
        readings[:, :3] + GOOD.of('accelerometer', Role.OFFSET),
        readings[:, 3:],
        'imu_link',
    )
    for row in encode_imu(imu):
        node.convert(row.tobytes(), {'source_timestamp': 1})
    bench.until(lambda: node.adopted.version == version_of(GOOD_TEXT), 'the previous one')
    assert bench.heard(version_of(harmful), version_of(GOOD_TEXT), level='error') == 1
    publisher.publish(String(data=harmful))
    bench.until(
        lambda: (
            bench.figure(STATUS, 'refused') == 'increased_error'
            and bench.shows(STATUS, version_of(harmful), level=ERROR)
        ),
        'the refusal',
    )
    assert node.adopted.version == version_of(GOOD_TEXT)


def test_a_mark_without_its_topic_does_not_stop_the_output(bench, place):
    """A silent publisher of another node on `imu/data_raw/correction` ended the publication."""
    node = bench.start(CompensatorNode, {'calibration_file': str(place)})
    mark = node.imu.topic_name + compensator_node.MARK
    stranger = bench.start(Sender)
    stranger.create_publisher(String, mark, latched_qos())
    bench.until(lambda: node.count_publishers(mark), 'the mark')
    node.look_for_correction()
    assert not node.corrected_already
    assert node.convert(MESSAGES[0], {'source_timestamp': 1}) is not None
    stranger.create_publisher(Imu, node.imu.topic_name, 10)
    bench.until(lambda: node.count_publishers(node.imu.topic_name), 'the topic')
    node.look_for_correction()
    assert '/sender' in node.corrected_already
    assert node.convert(MESSAGES[0], {'source_timestamp': 1}) is None
