"""A copy of a recording with a corrected Imu topic beside the others; everything else stays as it is, to the last bit."""

from collections import Counter

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.errors import InputError
from msg_adapters.bag import open_recording
from msg_adapters.bag_writer import BagWriter
from msg_adapters.decode import in_order
from msg_adapters.definitions import is_standard, standard_definition
from msg_adapters.encode import rows
from msg_adapters.imu import IMU_TYPE, decode_imu, find_imu_layout, patch_imu_group
from msg_adapters.layout import group_by_layout
from msg_adapters.stamps import MessageError


def copy_with_corrected(source, destination, imu_topic, corrected_topic, correct, covariances=None, gains=None,
                        frame_id=None, mat_ts=None, storage=None):
    """
    Write a bag with all topics of another one and the corrected Imu messages behind the measured ones.

    Stamps, and whatever is not corrected, come from the measured message. Its covariances follow the message definition: an
    absent quantity (first element -1) is left alone, an unknown covariance (zeros) becomes that of `covariances`, a known
    one is carried through `gains`: ``G C G'``.

    Parameters
    ----------
    source, destination : path-like
        The bag to read (rosbag2) and the folder to make.
    imu_topic, corrected_topic : str
        Topic to correct, and name of the new one.
    correct : callable
        ImuSamples -> object with `force` and `rate`, each (n, 3), for one block after the other in the order of the file.
    covariances : callable or tuple, optional
        Covariances of corrected (force, rate), each (3, 3); a callable is asked after every block.
    gains : tuple of ndarray, optional
        Derivatives of corrected (force, rate) with respect to measured ones, each (3, 3).
    frame_id : str, optional
        New frame of the corrected messages; `mat_ts` (target from sensor) then turns the orientation.
    storage : str, optional
        'sqlite3' or 'mcap'; default as the source.

    Returns
    -------
    lost : dict
        What could not be read or corrected, reason -> count.

    Raises
    ------
    InputError
        When the source does not fit or the destination cannot be written; nothing is left behind then.

    """
    with open_recording(source, imu_topic, want_joints=False, want_temperature=False) as recording:
        bag = recording.source
        _check(recording, corrected_topic)
        topics = [topic.name for topic in recording.topics]
        patch = _Patch(correct, covariances, gains, frame_id, mat_ts)
        with BagWriter(destination, storage or bag.storage) as writer:
            ids = np.array([writer.add_topic(name, bag.definition(name), bag.qos(name)) for name in topics])
            corrected_id = writer.add_topic(corrected_topic, standard_definition(IMU_TYPE))
            for raw in bag.raw_stretches(topics):
                measured = np.flatnonzero(raw.topic == topics.index(recording.imu_topic))
                _write(writer, ids[raw.topic], raw, measured, corrected_id, patch)
        return recording.lost | dict(patch.dropped)


def _check(recording, corrected_topic):
    bag, name = recording.source, recording.imu_topic
    if bag.ros1 or not is_standard(IMU_TYPE, *bag.definitions.get(IMU_TYPE, ('', ''))):
        raise InputError(f'{recording.path} must be a rosbag2 recording with the standard Imu definition; convert it first')
    foreign = [topic.name for topic in recording.topics if ' ' in topic.type]
    if foreign:
        raise InputError(f'every topic of {recording.path} must be CDR to be copied, got {", ".join(foreign)}; record without them')
    if corrected_topic in recording.message_counts:
        raise InputError(f'the corrected topic must be new, {recording.path} has {corrected_topic} already beside {name}; choose another name')


def _write(writer, topic_ids, raw, measured, corrected_id, patch):
    """Write one stretch, every corrected message behind the measured one."""
    messages = [raw.packed.view(k) for k in range(len(raw.packed))]
    done, corrected = patch(raw.packed.select(measured)) if len(measured) else (measured, [])
    measured = measured[done]
    order = np.argsort(np.concatenate([np.arange(len(messages)), measured]), kind='stable').tolist()
    topic_ids = np.concatenate([topic_ids, np.full(len(measured), corrected_id)])
    received_ns = np.concatenate([raw.received_ns, raw.received_ns[measured]])
    messages += corrected
    writer.write(topic_ids[order], received_ns[order], [messages[k] for k in order])


class _Patch:
    """Makes corrected messages from measured ones."""

    def __init__(self, correct, covariances, gains, frame_id, mat_ts):
        self.correct, self.covariances, self.gains = correct, covariances, gains or (None, None)
        self.frame_id, self.mat_st = frame_id, None if mat_ts is None else np.asarray(mat_ts).T
        self.dropped = Counter()

    def __call__(self, packed):
        """Return (index of the messages that could be corrected, their corrected messages)."""
        groups, rest = group_by_layout(packed, find_imu_layout)
        for k in rest:
            try:
                groups.append((find_imu_layout(packed.message(k)), np.array([k]), packed.select([k])))
            except MessageError:
                self.dropped['Imu message that cannot be decoded'] += 1
        if not groups:
            return np.zeros(0, dtype=int), []
        done = np.sort(np.concatenate([index for _, index, _ in groups]))
        corrected = self.correct(in_order([(index, decode_imu(layout, group)) for layout, index, group in groups]))
        known = self.covariances() if callable(self.covariances) else self.covariances or (None, None)
        messages = [None] * len(done)
        for layout, index, group in groups:
            place = np.searchsorted(done, index)
            fields = self._fields(layout, group, (corrected.force[place], corrected.rate[place]), known)
            for k, message in zip(place.tolist(), rows(patch_imu_group(layout, group, fields, self.frame_id)), strict=True):
                messages[k] = message
        return done, messages

    def _fields(self, layout, packed, vectors, known):
        """Return the new fields of one group: field name -> values."""
        fields = {}
        for quantity, values, noise, gain in zip(('force', 'rate'), vectors, known, self.gains, strict=True):
            measured, covariance = layout.column(packed, f'{quantity}_s'), layout.column(packed, f'{quantity}_cov')
            absent, unknown = covariance[:, 0] == -1.0, ~covariance.any(axis=1)
            fields[f'{quantity}_s'] = np.where(absent[:, np.newaxis], measured, values)
            fields[f'{quantity}_cov'] = _new_covariance(covariance, absent, unknown, noise, gain)
        if self.mat_st is not None:
            fields['orientation'] = self._turned(layout.column(packed, 'orientation'), layout.column(packed, 'orientation_cov', 1)[:, 0])
        return fields

    def _turned(self, quaternion, first_cov):
        """Return the orientation of the target frame: ``mat_wt = mat_ws @ mat_st``."""
        given = (first_cov != -1.0) & np.isfinite(quaternion).all(axis=1) & quaternion.any(axis=1)
        turned = quaternion.copy()
        if given.any():
            turned[given] = (Rotation.from_quat(quaternion[given]) * Rotation.from_matrix(self.mat_st)).as_quat()
        return turned


def _new_covariance(covariance, absent, unknown, noise, gain):
    covariance = covariance.copy()
    if noise is not None:
        covariance[unknown] = np.ravel(noise)
    known = ~absent & ~unknown
    if gain is not None and known.any():
        covariance[known] = (gain @ covariance[known].reshape(-1, 3, 3) @ gain.T).reshape(-1, 9)
    return covariance
