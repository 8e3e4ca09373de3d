"""
What a driver can leave wrong in its messages beside the readings: each is named by one check.

Messages as they should be pass.
"""

import numpy as np
import pytest

from imu_calibration.core.samples import ImuSamples
from imu_calibration.preprocessing.recording_evidence import (
    ABSENT_MARK,
    GOOD,
    MESSAGE_QUANTITIES,
    NOTE,
    OLD,
    WARNING,
    MessageEvidence,
    check_messages,
)
from msg_adapters.imu_stream import ImuHeads
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu

KNOWN = np.diag([1e-4, 2e-4, 3e-4])
NONE = np.diag([ABSENT_MARK, 0.0, 0.0])
UNIT = np.array([0.0, 0.0, 0.6, 0.8])


def evidence(**changed):
    """Messages of a good driver, but for what is `changed`."""
    given = {
        'frame_ids': {'imu_link': 600},
        'covariances': dict(zip(MESSAGE_QUANTITIES, (KNOWN, KNOWN, NONE), strict=True)),
        'orientation': np.zeros(4),
        'age': np.full(600, 0.002),
    }
    return MessageEvidence(**given | changed)


def covariances(force=KNOWN, rate=KNOWN, orientation=NONE):
    """The three covariances of a message."""
    return {'covariances': dict(zip(MESSAGE_QUANTITIES, (force, rate, orientation), strict=True))}


def test_a_good_driver_is_left_in_peace():
    found = check_messages(evidence())
    assert {finding.severity for finding in found} == {GOOD} and {
        finding.check for finding in found
    } == {'frame', 'covariance', 'age'}


def test_without_a_message_nothing_is_said():
    assert check_messages(MessageEvidence()) == ()


@pytest.mark.parametrize(
    ('changed', 'check', 'severity', 'words'),
    [
        ({'frame_ids': {'': 600}}, 'frame', WARNING, '600 of 600 have an empty frame_id'),
        (
            {'frame_ids': {'left': 300, 'right': 300}},
            'frame',
            WARNING,
            "frame_ids are 'left', 'right'",
        ),
        (
            covariances(force=np.zeros((3, 3))),
            'covariance',
            NOTE,
            'specific force is unknown (zeros)',
        ),
        (covariances(rate=np.zeros((3, 3))), 'covariance', NOTE, 'angular rate is unknown (zeros)'),
        (covariances(rate=NONE), 'covariance', NOTE, 'angular rate in these messages'),
        (
            covariances(force=np.diag([1.0, np.nan, 1.0])),
            'covariance',
            WARNING,
            'finite and not negative',
        ),
        (covariances(force=np.diag([1.0, -2.0, 1.0])), 'covariance', WARNING, 'they are 1, -2, 1'),
        (covariances(rate=np.diag([1e-4, 1e-4, 0.0])), 'covariance', WARNING, 'greater than zero'),
        (
            covariances(rate=KNOWN + np.triu(np.full((3, 3), 1e-5), 1)),
            'covariance',
            WARNING,
            'must be symmetric',
        ),
        (covariances(orientation=np.zeros((3, 3))), 'orientation', WARNING, 'its length is 0'),
        (
            covariances(orientation=np.zeros((3, 3)))
            | {'orientation': np.array([0.0, 0.0, 0.0, 1.0])},
            'orientation',
            NOTE,
            'identity with an unknown',
        ),
        ({'age': np.full(9, OLD + 0.1)}, 'age', WARNING, 'they are 0.6 s behind it'),
        ({'age': np.full(9, -OLD - 0.1)}, 'age', WARNING, 'they are 0.6 s ahead of it'),
    ],
)
def test_each_fault_is_named(changed, check, severity, words):
    [finding] = [found for found in check_messages(evidence(**changed)) if found.severity != GOOD]
    assert (finding.check, finding.severity) == (check, severity) and words in finding.text


def test_an_orientation_that_is_given_passes():
    found = check_messages(evidence(**covariances(orientation=KNOWN), orientation=UNIT))
    assert all(finding.severity == GOOD for finding in found)


def test_single_stamps_that_are_late_are_no_clock():
    assert all(
        finding.severity == GOOD
        for finding in check_messages(evidence(age=np.array([0.01] * 9 + [3.0])))
    )


def messages(frame_id, stamp_ns=(10**18, 10**18 + 10**7)):
    """Serialized messages."""
    readings = np.ones((len(stamp_ns), 3))
    return [
        bytes(row)
        for row in Packed.of_rows(
            encode_imu(ImuSamples(np.array(stamp_ns), readings, readings, frame_id))
        ).views()
    ]


def test_what_stands_in_the_bytes_is_what_is_checked():
    heads = ImuHeads()
    for frame_id in ('imu_link', 'other'):
        for message in messages(frame_id):
            heads.add(message, 10**18 + 10**7)
    heads.add(b'no message at all', 10**18)
    heads.add(messages('imu_link', [0])[0], 10**18)  # without a stamp
    heads.add(messages('imu_link', [10**18])[0], 0)  # by a clock that says nothing
    found = heads.evidence()
    assert found.frame_ids == {'imu_link': 4, 'other': 2}
    np.testing.assert_allclose(found.age, [0.01, 0.0, 0.01, 0.0])
    assert (
        found.covariances['orientation'][0, 0] == ABSENT_MARK
        and not found.covariances['specific force'].any()
    )


def test_nothing_heard_is_nothing_known():
    assert check_messages(ImuHeads().evidence()) == ()
