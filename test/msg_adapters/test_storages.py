"""
A storage is one entry.

A third one, made here, is written, read, copied and offered by the command line like the two that
there are.
"""

import json
from base64 import b64decode, b64encode
from collections import Counter

import numpy as np
import pytest
from refusal import refused

from imu_calibration.cli.fleet_run import is_bag
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, JointSamples
from msg_adapters.bag import open_recording
from msg_adapters.copying import copy_with_corrected
from msg_adapters.layout import Packed
from msg_adapters.storage import StorageFile, Stretch
from msg_adapters.storages import STORAGES, Storage
from msg_adapters.write import write_session


class LinesWriter:
    """One JSON list a line."""

    def __init__(self, path, _ros_distro):
        self.file = open(path, 'x', encoding='utf-8')

    def add_topic(self, topic_id, name, definition, *, qos):
        """Declare a topic."""
        assert isinstance(qos, str)
        print(
            json.dumps(
                ['topic', topic_id, name, definition.type, definition.encoding, definition.text]
            ),
            file=self.file,
        )

    def write(self, topic_ids, received_ns, messages):
        """Append messages."""
        for topic_id, received, data in zip(
            topic_ids.tolist(), received_ns.tolist(), messages.views(), strict=True
        ):
            print(
                json.dumps(['message', topic_id, received, b64encode(data).decode()]),
                file=self.file,
            )

    def close(self, _information, _metadata):
        """Close."""
        self.file.close()

    abort = close


class LinesFile(StorageFile):
    """Reads all at once."""

    def __init__(self, path, unpack=None):
        super().__init__(path, unpack)
        lines = [json.loads(line) for line in self.path.read_text().splitlines()]
        topics = [line[1:] for line in lines if line[0] == 'topic']
        self.topic_ids = {name: [topic_id] for topic_id, name, *_ in topics}
        self.types = {name: kind for _, name, kind, *_ in topics}
        self.definitions = {kind: (encoding, text) for _, _, kind, encoding, text in topics}
        self.messages = [line[1:] for line in lines if line[0] == 'message']

    def count(self):
        """Return the number of messages of each topic."""
        counts = Counter(topic_id for topic_id, *_ in self.messages)
        return {name: counts[numbers[0]] for name, numbers in self.topic_ids.items()}

    def time_range(self):
        """Return the first and last receive time."""
        times = [received for _, received, _ in self.messages]
        return min(times), max(times)

    def close(self):
        """Nothing is open."""

    def _stretches(self, _topics):
        topic_ids, received, data = zip(*self.messages, strict=True)
        packed = Packed.join([b64decode(text) for text in data])
        yield Stretch(
            np.array(topic_ids),
            packed,
            lambda index: np.array(received)[index],
        )


@pytest.fixture
def lines():
    """Add the entry for the length of a test."""
    STORAGES.append(Storage('lines', '.lines', LinesFile, LinesWriter))
    yield
    STORAGES.pop()


def session(count=300):
    """A short recording."""
    rng, stamp_ns = np.random.default_rng(1), 1_700_000_000_000_000_000 + 10**7 * np.arange(count)
    return (
        ImuSamples(stamp_ns, rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), 'imu_link'),
        JointSamples(
            stamp_ns, rng.normal(size=(count, 1)), rng.normal(size=(count, 1)), ('inner',)
        ),
    )


@pytest.mark.usefixtures('lines')
def test_a_new_storage_is_written_read_and_copied(tmp_path):
    imu, joints = session()
    write_session(tmp_path / 'bag', imu, joints, storage='lines')
    assert (tmp_path / 'bag/bag_0.lines').exists() and is_bag(tmp_path / 'bag')
    copy_with_corrected(
        tmp_path / 'bag',
        tmp_path / 'copy',
        '/imu/data_raw',
        corrected_topic='/imu/data_corrected',
        correct=lambda part: type(
            'Corrected',
            (),
            {'force': part.force_s + 1, 'rate': part.rate_s, 'marks': np.zeros((len(part), 2))},
        ),
    )
    (tmp_path / 'copy/metadata.yaml').unlink()  # then the files say how many messages there are
    for path, topic, shift in (
        (tmp_path / 'bag', None, 0.0),
        (tmp_path / 'copy', '/imu/data_corrected', 1.0),
        (tmp_path / 'bag/bag_0.lines', None, 0.0),
    ):
        with open_recording(path, imu_topic=topic) as recording:
            (block,) = recording.blocks()
        np.testing.assert_array_equal(block.imu.force_s, imu.force_s + shift)
        np.testing.assert_array_equal(block.joints.position, joints.position)
        assert recording.source.storage == 'lines' and recording.message_counts[
            recording.imu_topic
        ] == len(imu)


@pytest.mark.usefixtures('lines')
def test_the_command_line_offers_it(tmp_path, capsys):
    assert (
        main(
            [
                'simulate',
                '--profile',
                'quick',
                '--storage',
                'lines',
                '--output',
                str(tmp_path / 'bag'),
            ]
        )
        == 0
    )
    assert main(['inspect', str(tmp_path / 'bag')]) == 0
    assert 'force unit' in capsys.readouterr().out


def test_without_the_entry_it_is_refused_with_those_there_are(tmp_path, capsys):
    with refused(InputError, 'storage_unknown', 'sqlite3', 'mcap', 'lines'):
        write_session(tmp_path / 'bag', session()[0], storage='lines')
    (tmp_path / 'bag_0.lines').write_text('')
    assert main(['inspect', str(tmp_path / 'bag_0.lines')]) == 1
    assert '.db3, .mcap' in capsys.readouterr().err
