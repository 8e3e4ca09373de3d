"""Copies with a corrected topic."""

from types import SimpleNamespace

import numpy as np
import pytest
from refusal import refused
from rosbags.highlevel import AnyReader
from test_bag import make_session

from imu_calibration.core.errors import InputError
from msg_adapters.copying import copy_with_corrected
from msg_adapters.imu import FIELDS
from msg_adapters.write import write_session
from validation.imu_messages import parse_imu, patch_imu


def raw_messages(path, topic):
    with AnyReader([path]) as reader:
        return [
            (stamp, bytes(data))
            for c, stamp, data in reader.messages(reader.topics[topic].connections)
        ]


def corrected_samples(force, rate):
    return SimpleNamespace(force=force, rate=rate, marks=np.zeros((len(force), 2)))


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_everything_else_is_copied_to_the_last_bit(tmp_path, storage):
    imu, joints, temperature = make_session()
    write_session(tmp_path / 'a', imu, joints, temperature=temperature, storage=storage)
    lost = copy_with_corrected(
        tmp_path / 'a',
        tmp_path / 'b',
        '/imu/data_raw',
        corrected_topic='/imu/data_corrected',
        correct=lambda samples: corrected_samples(2.0 * samples.force_s, samples.rate_s - 1.0),
    )
    assert lost == {}
    for topic in ('/imu/data_raw', '/joint_states', '/imu/temperature'):
        assert raw_messages(tmp_path / 'a', topic) == raw_messages(tmp_path / 'b', topic)
    corrected = raw_messages(tmp_path / 'b', '/imu/data_corrected')
    assert [stamp for stamp, _ in corrected] == [
        stamp for stamp, _ in raw_messages(tmp_path / 'a', '/imu/data_raw')
    ]
    parsed = [parse_imu(data) for _, data in corrected]
    np.testing.assert_array_equal([message.stamp_ns for message in parsed], imu.stamp_ns)
    np.testing.assert_array_equal(
        [message.doubles[FIELDS['force_s']] for message in parsed], 2.0 * imu.force_s
    )
    np.testing.assert_array_equal(
        [message.doubles[FIELDS['rate_s']] for message in parsed], imu.rate_s - 1.0
    )


@pytest.mark.parametrize('frame_id', [None, 'a', 'base_link_of_another_length'])
def test_covariances_and_frame_follow_the_message_definition(tmp_path, frame_id):
    imu, joints, _ = make_session(50)
    known = np.diag([1.0, 2.0, 3.0])
    write_session(tmp_path / 'a', imu, joints, rate_cov=known)
    noise, gain = 4.0 * np.eye(3), np.array([[2.0, 0, 0], [1, 1, 0], [0, 0, 1]])
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])

    def propagate(*measured):
        return [noise if cov is None else gain @ cov @ gain.T for cov in measured]

    copy_with_corrected(
        tmp_path / 'a',
        tmp_path / 'b',
        '/imu/data_raw',
        corrected_topic='/c',
        correct=lambda s: corrected_samples(s.force_s, s.rate_s),
        propagate=propagate,
        frame_id=frame_id,
        mat_ts=turn,
    )
    message = parse_imu(raw_messages(tmp_path / 'b', '/c')[7][1])
    assert message.frame_id == (frame_id or 'imu_link')
    # Was unknown.
    np.testing.assert_array_equal(message.doubles[FIELDS['force_cov']], noise.ravel())
    np.testing.assert_allclose(
        message.doubles[FIELDS['rate_cov']], (gain @ known @ gain.T).ravel(), rtol=1e-15
    )
    # Absent: left alone.
    assert message.doubles[FIELDS['orientation']] == (0, 0, 0, 1) and message.doubles[3 + 1] == -1.0


def test_a_failure_leaves_nothing_behind(tmp_path):
    imu, joints, _ = make_session(50)
    write_session(tmp_path / 'a', imu, joints)

    def fail(samples):
        raise InputError('no')

    with pytest.raises(InputError):
        copy_with_corrected(
            tmp_path / 'a', tmp_path / 'b', '/imu/data_raw', corrected_topic='/c', correct=fail
        )
    assert [path.name for path in tmp_path.iterdir()] == ['a']
    with refused(InputError, 'frame_unknown', 'elsewhere', 'imu_link'):
        copy_with_corrected(
            tmp_path / 'a',
            tmp_path / 'b',
            '/imu/data_raw',
            corrected_topic='/c',
            correct=lambda s: corrected_samples(s.force_s, s.rate_s),
            source_frame_id='elsewhere',
        )
    assert [path.name for path in tmp_path.iterdir()] == ['a']
    with refused(InputError, 'topic_taken'):
        copy_with_corrected(
            tmp_path / 'a',
            tmp_path / 'b',
            '/imu/data_raw',
            corrected_topic='/joint_states',
            correct=fail,
        )
    with refused(InputError, 'exists_already'):
        write_session(tmp_path / 'a', imu)


def test_a_patched_message_keeps_everything_else():
    from msg_adapters.write import encode_imu

    data = encode_imu(make_session(3)[0])[1].tobytes()
    patched = patch_imu(data, force_s=(1.0, 2.0, 3.0), frame_id='other')
    before, after = parse_imu(data), parse_imu(patched)
    assert (after.stamp_ns, after.frame_id) == (before.stamp_ns, 'other')
    assert after.doubles[FIELDS['force_s']] == (1.0, 2.0, 3.0)
    assert (
        patch_imu(patched, force_s=before.doubles[FIELDS['force_s']], frame_id='imu_link') == data
    )
