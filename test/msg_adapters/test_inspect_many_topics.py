"""Recordings of thousands of topics and records: looks at the topics and bytes read are counted."""

import struct
from contextlib import closing

import numpy as np
import pytest
from refusal import refused
from test_mcap_file import message, topic_records, write_file

from imu_calibration.api import inspect
from imu_calibration.api.inspect import MOST_IMUS, imu_topics_of
from imu_calibration.api.recordings import Topics
from imu_calibration.core.errors import InputError
from msg_adapters.bag import LISTED_TOPICS, open_recording
from msg_adapters.imu import IMU_TYPE
from msg_adapters.layout import Packed
from msg_adapters.mcap_file import MAGIC, McapFile
from msg_adapters.mcap_writer import record
from msg_adapters.storage import StorageFile, Stretch


class CountedFile(StorageFile):
    """A file of many topics, with two messages of each, that counts the looks at its topics."""

    def __init__(self, n_topics):
        super().__init__('many')
        self.n_looks = 0
        self._ids = {f'/topic{k}': [3 * k + 1] for k in range(n_topics)}

    @property
    def topic_ids(self):
        """Topic -> numbers."""
        self.n_looks += 1
        return self._ids

    def _stretches(self, _topics):
        topic_ids = np.array([3 * k + 1 for k in range(len(self._ids))] * 2)
        packed = Packed.join([b'x'] * len(topic_ids))
        yield Stretch(
            topic_ids,
            packed,
            lambda index: index,
        )


def test_topics_are_looked_up_once_for_a_stretch():
    """Each topic was searched in each stretch: 2,000 topics needed 5.4 s for 80,000 messages."""
    file = CountedFile(3000)
    wanted = [f'/topic{k}' for k in range(2999, 0, -1)]
    (raw,) = file.stretches([*wanted, '/absent'])
    np.testing.assert_array_equal(raw.topic, [*range(2998, -1, -1)] * 2)
    assert file.n_looks == 1
    assert list(file.stretches(['/absent'])) == list(file.stretches([])) == []


def imu_file(path, n_topics):
    """Write an MCAP file with a summary of Imu channels and one message of each."""
    content = b''.join(topic_records(k, f'/imu{k}', IMU_TYPE) for k in range(1, n_topics + 1))
    content += b''.join(message(k, k, bytes(400)) for k in range(1, n_topics + 1))
    return write_file(path, content)


def test_an_mcap_file_lists_its_channels_once_for_a_stretch(tmp_path, monkeypatch):
    path, looks = imu_file(tmp_path / 'x.mcap', 300), []
    topic_ids = McapFile.topic_ids.fget
    with closing(McapFile(path)) as file:
        monkeypatch.setattr(
            McapFile, 'topic_ids', property(lambda self: looks.append(1) or topic_ids(self))
        )
        n_messages = sum(len(raw.packed) for raw in file.stretches(list(file.types)))
    assert n_messages == 300 and len(looks) <= 4


def test_more_imus_than_can_be_inspected_are_refused_before_any_is_read(tmp_path, monkeypatch):
    """2,000 Imu channels were scanned three times each, 612 s."""
    opened = []
    monkeypatch.setattr(inspect, 'open_bag', lambda *_, **__: opened.append(1))
    path = imu_file(tmp_path / 'x.mcap', MOST_IMUS + 1)
    with refused(InputError, 'imu_topics_many', str(MOST_IMUS), str(MOST_IMUS + 1)):
        imu_topics_of(path, Topics())
    assert not opened
    assert [topics.imu for topics in imu_topics_of(path, Topics('/imu3', frame='imu'))] == ['/imu3']


def test_frames_count_as_imus(monkeypatch):
    frames = [f'frame{k}' for k in range(MOST_IMUS + 1)]
    monkeypatch.setattr(
        inspect, '_by_frame', lambda _, topics: [topics._replace(frame=name) for name in frames]
    )
    with refused(InputError, 'imu_topics_many', str(MOST_IMUS)):
        imu_topics_of('x.mcap', Topics('/imu'))
    del frames[-1]
    assert len(imu_topics_of('x.mcap', Topics('/imu'))) == MOST_IMUS


@pytest.mark.parametrize('topic', [None, '/other'])
def test_an_error_lists_the_first_topics_only(tmp_path, topic):
    path = imu_file(tmp_path / 'x.mcap', 150)
    code = {None: 'topic_ambiguous', '/other': 'topic_unknown'}[topic]
    with refused(InputError, code, 150 - LISTED_TOPICS) as caught:
        open_recording(path, topic)
    assert len(str(caught.value)) < 1000


OVERLAPPING = {
    'chunks that claim the rest of the file': struct.pack('<BQ', 0x06, 2**40) + bytes(41),
    'chunks that claim a long part of it': struct.pack('<BQ', 0x06, 60_000) + bytes(41),
    'messages that claim the rest': struct.pack('<BQ', 0x05, 2**40) + bytes(41),
    'a message and damage': message(1, 0, b'x') + bytes(18),
    'a message and a chunk': message(1, 0, b'') + record(0x06, bytes(10)),
}


@pytest.mark.parametrize('kind', OVERLAPPING)
def test_the_start_of_a_chunk_reads_no_byte_again(tmp_path, monkeypatch, kind):
    """
    The rest of the file was read for each of 60,000 starts, and 64 KiB for each single message.
    """
    one, n_starts, read = OVERLAPPING[kind], 2000, []
    data = MAGIC + one * n_starts
    starts = b''.join(
        record(0x08, struct.pack('<QQQ', 0, 0, len(MAGIC) + len(one) * k) + bytes(40))
        for k in range(n_starts)
    )
    path = tmp_path / 'x.mcap'
    path.write_bytes(data + starts + record(0x02, struct.pack('<QQI', len(data), 0, 0)) + MAGIC)
    original = McapFile._read

    def counted(self, position, size):
        content = original(self, position, size)
        read.append(len(content))
        return content

    monkeypatch.setattr(McapFile, '_read', counted)
    with closing(McapFile(path)) as file:
        assert sum(read) < 3 * path.stat().st_size
        read.clear()
        assert list(file.stretches(['/imu'])) == []
    assert sum(read) < 3 * path.stat().st_size


def test_many_parts_are_chained_in_order():
    """The sizes of all earlier parts were added for each part."""
    parts = [Packed.join([bytes([k % 251]) * (1 + k % 3), b'ab']) for k in range(3000)]
    chained = Packed.chain(parts)
    assert [bytes(chained.message(2 * k)) for k in (0, 1, 2999)] == [
        b'\0',
        b'\1\1',
        bytes([2999 % 251]) * 3,
    ]
    assert len(chained) == 6000
