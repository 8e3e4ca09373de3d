"""
MCAP files as other recorders lay them out: without chunks, without indexes, without a summary.
"""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_bag import make_session

from imu_calibration.core.samples import ImuSamples
from msg_adapters.bag import open_recording
from msg_adapters.definitions import standard_definition
from msg_adapters.imu import IMU_TYPE
from msg_adapters.joint_state import JOINT_STATE_TYPE
from msg_adapters.mcap_file import MAGIC, indexed_messages, walk
from msg_adapters.mcap_writer import prefixed_string, record
from msg_adapters.write import encode_imu, encode_joints


def message(channel, stamp_ns, data):
    return record(0x05, struct.pack('<HIQQ', channel, 0, stamp_ns, stamp_ns), data)


def topic_records(number, name, message_type):
    definition = standard_definition(message_type)
    return record(
        0x03,
        struct.pack('<H', number),
        prefixed_string(definition.type),
        prefixed_string('ros2msg'),
        prefixed_string(definition.text),
    ) + record(
        0x04,
        struct.pack('<HH', number, number),
        prefixed_string(name),
        prefixed_string('cdr'),
        prefixed_string(b''),
    )


def chunk(content):
    return record(
        0x06,
        struct.pack('<QQQI', 0, 0, len(content), 0),
        prefixed_string(''),
        struct.pack('<Q', len(content)),
        content,
    )


def write_file(path, data_section, finished=True):
    footer = record(0x0F, bytes(4)) + record(0x02, bytes(20)) + MAGIC if finished else b''
    path.write_bytes(
        MAGIC
        + record(0x01, prefixed_string('ros2'), prefixed_string('test'))
        + data_section
        + footer
    )
    return path


@pytest.fixture(scope='module')
def parts():
    """Definitions and messages of a session, in the order of a recorder."""
    imu, joints, _ = make_session(3000)
    imu_rows, joint_rows = encode_imu(imu), encode_joints(joints)
    messages = []
    for k, row in enumerate(imu_rows):
        messages.append(message(1, int(imu.stamp_ns[k]), row.tobytes()))
        if k % 5 == 0 and k < 2000:
            messages.append(message(2, int(imu.stamp_ns[k]), joint_rows[k // 5].tobytes()))
    return (
        imu,
        joints,
        topic_records(1, '/imu/data_raw', IMU_TYPE)
        + topic_records(2, '/joint_states', JOINT_STATE_TYPE),
        messages,
    )


def check(path, imu, joints, lost=False, counted=True):
    with open_recording(path) as recording:
        assert not counted or recording.message_counts == {
            '/imu/data_raw': 3000,
            '/joint_states': 400,
        }
        blocks = list(recording.blocks())
        assert bool(recording.lost) == lost
    read = ImuSamples.concatenate(block.imu for block in blocks)
    np.testing.assert_array_equal(read.force_s, imu.force_s)
    np.testing.assert_array_equal(
        np.concatenate([block.joints.position for block in blocks if block.joints]),
        joints.position[:400],
    )


@pytest.mark.parametrize('finished', [True, False])
def test_messages_outside_of_chunks(tmp_path, parts, finished):
    imu, joints, definitions, messages = parts
    check(
        write_file(tmp_path / 'x.mcap', definitions + b''.join(messages), finished),
        imu,
        joints,
        not finished,
    )


def test_chunks_without_indexes_and_definitions_in_the_middle(tmp_path, parts):
    imu, joints, definitions, messages = parts
    cut = len(messages) // 3
    first, middle, last = (
        b''.join(messages[part]) for part in (slice(cut), slice(cut, 2 * cut), slice(2 * cut, None))
    )
    data = chunk(definitions + first) + middle + chunk(definitions + last)
    private = record(0x80, b'of an application')
    check(write_file(tmp_path / 'x.mcap', private + data), imu, joints)


def test_an_index_that_is_wrong_is_not_believed(tmp_path, parts):
    imu, joints, definitions, messages = parts
    offsets = np.cumsum([0, *map(len, messages[:-1])])
    # Every offset one too large, and channel 2 forgotten.
    entries = np.stack([offsets, offsets + 1], axis=1)
    index = record(0x07, struct.pack('<H', 1), prefixed_string(entries.astype('<u8').tobytes()))
    check(
        write_file(
            tmp_path / 'x.mcap',
            definitions + chunk(b''.join(messages)) + index + chunk(definitions),
        ),
        imu,
        joints,
        counted=False,
    )


@given(
    st.lists(st.tuples(st.integers(1, 3), st.integers(0, 40), st.integers(1, 40)), max_size=20),
    st.integers(0, 30),
)
def test_walking_finds_every_message_whatever_the_pattern(runs, cut):
    records = [
        message(channel, 7, bytes(size)) for channel, size, count in runs for _ in range(count)
    ]
    content = b''.join(records) + record(0x0C, b'')
    whole = np.frombuffer(content, np.uint8)
    channel, found, others, end = walk(whole)
    assert end == len(content) and others == [(0x0C, b'')]
    assert len(found.start) == len(records)
    expected = np.cumsum([0, *map(len, records)])[:-1] + 31
    np.testing.assert_array_equal(found.start, expected)
    np.testing.assert_array_equal(found.size, [len(data) - 31 for data in records])
    cut = min(cut, len(content))
    _, shorter, _, end = walk(whole[: len(content) - cut])
    assert end <= len(content) - cut and len(shorter.start) == int(
        (found.start + found.size <= end).sum()
    )
    offsets = {number: found.start[channel == number] - 31 for number in (3, 1, 2)}
    indexed = indexed_messages(whole[:-9], list(offsets.items()))
    if records:
        np.testing.assert_array_equal(indexed[0], channel)
        np.testing.assert_array_equal(indexed[1].start, found.start)
        np.testing.assert_array_equal(indexed[1].size, found.size)
    else:
        assert indexed is None
