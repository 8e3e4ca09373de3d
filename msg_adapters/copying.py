"""
A copy of a recording with an additional corrected Imu topic; all other data are copied bit by bit.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from os import PathLike

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.preprocessing.sensor_join import OtherSensor
from msg_adapters.bag import open_recording
from msg_adapters.bag_writer import BagWriter
from msg_adapters.csv_log import LogOptions
from msg_adapters.decode import FrameChoice, in_order
from msg_adapters.definitions import is_standard, standard_definition
from msg_adapters.imu import IMU_TYPE, decode_imu, find_imu_layout, patch_imu_group
from msg_adapters.layout import NS_PER_S, Packed, group_by_layout


def copy_with_corrected(
    source: str | PathLike[str],
    destination: str | PathLike[str],
    imu_topic: str,
    *,
    corrected_topic: str,
    correct: Callable,
    propagate: Callable | None = None,
    frame_id: str | None = None,
    mat_ts: np.ndarray | None = None,
    late_ns: int = 0,
    source_frame_id: str | None = None,
    log: LogOptions = LogOptions(),
    check: Callable[[], None] | None = None,
    keep: Callable[[np.ndarray], np.ndarray] | None = None,
    other: OtherSensor | None = None,
) -> dict[str, int]:
    """
    Write a bag with all topics of another one, and the corrected Imu messages.

    Each corrected message is written after the measured one.

    Stamps and uncorrected fields are copied from the measured message. Its covariances follow the
    message definition: an absent quantity (first element -1) is unchanged, `propagate` is applied
    to the present ones.

    Parameters
    ----------
    source, destination : path-like
        The bag to read (rosbag2) and the folder to make.
    imu_topic, corrected_topic : str
        Topic to correct, and name of the new one.
    correct : callable
        ImuSamples -> object with `force` and `rate`, each (n, 3), for one block after the other in
        the order of the file; and with `marks` (n, 2), variances that replace the covariances of
        (force, rate) where they are not zero.
    propagate : callable, optional
        Called after each block for each distinct pair of covariances: measured (force, rate), each
        (3, 3) or None when unknown -> corrected (force, rate).
    frame_id : str, optional
        New frame of the corrected messages; `mat_ts` (target from sensor) then turns the
        orientation.
    late_ns : int
        Subtracted from the stamps of the corrected messages.
    source_frame_id : str, optional
        Frame of the messages that are corrected; see `msg_adapters.bag.open_recording`.
    log : LogOptions
        As for `msg_adapters.bag.open_recording`.
    check : callable, optional
        Called after the last block; an error that it raises removes the bag.
    keep : callable, optional
        Stamps of the next messages, shape (n,) -> which of them are corrected, bool, shape (n,).
    other : OtherSensor, optional
        A sensor on another topic, whose readings are added to the messages. Their covariance is
        unknown.

    Returns
    -------
    lost : dict
        Messages that could not be read or corrected, reason -> count.

    Raises
    ------
    InputError
        When the source is unsuitable or the destination cannot be written; all partial output is
        removed.

    """
    with open_recording(
        source, imu_topic, want_joints=False, want_temperature=False, log=log
    ) as recording:
        bag = recording.source
        _check(recording, corrected_topic)
        topics = [topic.name for topic in recording.topics]
        choice = FrameChoice(recording.imu_topic, source_frame_id)
        patch = _Patch(
            correct, propagate, frame_id, mat_ts, late_ns, choice, keep=keep, other=other
        )
        with BagWriter(destination, bag.storage) as writer:
            ids = np.array(
                [writer.add_topic(name, bag.definition(name), bag.qos(name)) for name in topics]
            )
            corrected_id = writer.add_topic(corrected_topic, standard_definition(IMU_TYPE))
            for raw in bag.stretches(topics):
                measured = np.flatnonzero(raw.topic == topics.index(recording.imu_topic))
                _write(writer, ids[raw.topic], raw, measured, corrected_id, patch)
            if check is not None:
                check()
        choice.check()
        return recording.lost | dict(patch.dropped)


def _check(recording, corrected_topic):
    bag, name = recording.source, recording.imu_topic
    if bag.ros1:
        raise InputError(
            f'{recording.path} must be a rosbag2 recording, it is of ROS 1; convert it with the'
            " command 'rosbags-convert' (pip install rosbags)",
            code='ros1_bag',
        )
    if not is_standard(IMU_TYPE, *bag.definitions.get(IMU_TYPE, ('', ''))):
        raise InputError(
            f'{recording.path} must be a rosbag2 recording with the standard Imu definition;'
            ' convert it first'
        )
    foreign = [topic.name for topic in recording.topics if ' ' in topic.type]
    if foreign:
        raise InputError(
            f'every topic of {recording.path} must be CDR to be copied, got {", ".join(foreign)};'
            ' record without them'
        )
    if corrected_topic in recording.message_counts:
        raise InputError(
            f'the corrected topic must be new, {recording.path} has {corrected_topic} already in'
            f' addition to {name}; choose another name',
            code='topic_taken',
        )


def _write(writer, topic_ids, raw, measured, corrected_id, patch):
    """Write one stretch, every corrected message after the measured one."""
    received_ns = raw.received_ns()
    done, corrected = (
        patch(raw.packed.select(measured), received_ns[measured])
        if len(measured)
        else (measured, [])
    )
    measured = measured[done]
    order = np.argsort(np.concatenate([np.arange(len(raw.packed)), measured]), kind='stable')
    topic_ids = np.concatenate([topic_ids, np.full(len(measured), corrected_id)])
    received_ns = np.concatenate([received_ns, received_ns[measured]])
    writer.write(
        topic_ids[order], received_ns[order], Packed.chain([raw.packed, *corrected]).select(order)
    )


class _Patch:
    """Makes corrected messages from measured ones."""

    def __init__(
        self, correct, propagate, frame_id, mat_ts, late_ns, choice, *, keep=None, other=None
    ):
        self.correct = correct
        self.propagate = propagate
        self.late_ns = late_ns
        self.choice = choice
        self.frame_id = frame_id
        self.mat_st = None if mat_ts is None else np.asarray(mat_ts).T
        self.dropped = Counter()
        self.keep, self.other = keep, other

    def __call__(self, packed, received_ns):
        """
        Return (index of the messages that could be corrected, their corrected messages).

        A zero stamp counts as the time of arrival.
        """
        # Messages of one layout are decoded together; messages of other IMUs are not changed.
        groups, n_broken = group_by_layout(packed, find_imu_layout)
        if n_broken:
            self.dropped['Imu message that cannot be decoded'] += n_broken
        groups = [group for group in groups if self.choice.wants(group[0].names[0], len(group[1]))]
        if not groups:
            return np.zeros(0, dtype=int), []
        done = np.sort(np.concatenate([index for _, index, _ in groups]))
        samples = in_order([(index, decode_imu(layout, group)) for layout, index, group in groups])
        stamp_ns = np.where(samples.stamp_ns == 0, received_ns[done], samples.stamp_ns)
        samples = replace(samples, stamp_ns=stamp_ns)

        # Without excluded times.
        if self.keep is not None:
            kept = self.keep(stamp_ns)
            if not kept.any():
                return np.zeros(0, dtype=int), []
            groups = [
                _selected(layout, index, group, kept[np.searchsorted(done, index)])
                for layout, index, group in groups
            ]
            done = done[kept]
            samples = samples.select(kept)

        # Correct all samples in order of time, then patch the bytes of each layout.
        order = np.argsort(np.concatenate([index for _, index, _ in groups]))
        if self.other is not None:
            samples = self.other.added_to(samples)
        corrected = self.correct(samples)
        tables = []
        for layout, index, group in groups:
            place = np.searchsorted(done, index)
            fields = self._fields(
                layout,
                group,
                (corrected.force[place], corrected.rate[place]),
                corrected.marks[place],
            )
            table = patch_imu_group(layout, group, fields, frame_id=self.frame_id)
            # Seconds (int32) and nanoseconds (uint32) of the stamp, without the delay.
            if self.late_ns:
                for place, values, kind in zip(
                    (4, 8),
                    np.divmod(layout.stamp_ns(group) - self.late_ns, NS_PER_S),
                    'iu',
                    strict=True,
                ):
                    table[:, place : place + 4] = (
                        values.astype(f'{layout.order}{kind}4').view(np.uint8).reshape(-1, 4)
                    )
            tables.append(Packed.of_rows(table))
        return done, [Packed.chain(tables).select(order)]

    def _fields(self, layout, packed, vectors, marks):
        """Return the new fields of one group: field name -> values."""
        measured = []
        for quantity in ('force', 'rate'):
            covariance = layout.column(packed, f'{quantity}_cov')
            if self.other is not None and quantity == self.other.quantity:
                covariance = np.zeros_like(covariance)  # unknown: the messages lack this sensor
            measured.append(covariance)
        absent = [covariance[:, :1] == -1.0 for covariance in measured]
        fields = {}
        for quantity, values, missing in zip(('force', 'rate'), vectors, absent, strict=True):
            fields[f'{quantity}_s'] = np.where(
                missing, layout.column(packed, f'{quantity}_s'), values
            )
        if self.propagate is not None:
            covariances = _propagated(self.propagate, np.concatenate(measured, axis=1))
            for k, (quantity, before, missing) in enumerate(
                zip(('force', 'rate'), measured, absent, strict=True)
            ):
                mark = marks[:, k : k + 1]
                after = np.where(
                    mark > 0, mark * np.eye(3).ravel(), covariances[:, 9 * k : 9 * k + 9]
                )
                fields[f'{quantity}_cov'] = np.where(missing, before, after)
        if self.mat_st is not None:
            orientation_cov = layout.column(packed, 'orientation_cov')
            fields['orientation'] = self._turned(
                layout.column(packed, 'orientation'), orientation_cov[:, 0]
            )
            turned = (self.mat_st.T @ orientation_cov.reshape(-1, 3, 3) @ self.mat_st).reshape(
                -1, 9
            )
            fields['orientation_cov'] = np.where(
                orientation_cov[:, :1] == -1.0, orientation_cov, turned
            )
        return fields

    def _turned(self, quaternion, first_cov):
        """Return the orientation of the target frame: ``mat_wt = mat_ws @ mat_st``."""
        from scipy.spatial.transform import Rotation  # here, because its import is slow

        given = (first_cov != -1.0) & np.isfinite(quaternion).all(axis=1) & quaternion.any(axis=1)
        turned = quaternion.copy()
        if given.any():
            turned[given] = (
                Rotation.from_quat(quaternion[given]) * Rotation.from_matrix(self.mat_st)
            ).as_quat()
        return turned


def _selected(layout, index, group, mask):
    """Return the messages of a group of one layout that a mask selects."""
    return layout, index[mask], group.select(np.flatnonzero(mask))


def _propagated(propagate, pairs):
    """
    Return the corrected covariances of measured ones, both (n, 18).

    Nine numbers of force, nine of rate.
    """
    # Most drivers publish constants: each distinct pair once.
    if (pairs == pairs[0]).all():
        distinct = pairs[:1]
        which = np.zeros(len(pairs), int)
    else:
        distinct, which = np.unique(pairs, axis=0, return_inverse=True)

    corrected = []
    for pair in distinct:
        # -1 in a message: not available; all zero: not known.
        force_cov, rate_cov = np.split(np.where(pair == -1.0, 0.0, pair), 2)
        propagated = propagate(
            force_cov.reshape(3, 3) if force_cov.any() else None,
            rate_cov.reshape(3, 3) if rate_cov.any() else None,
        )
        corrected.append(np.concatenate([covariance.ravel() for covariance in propagated]))
    return np.array(corrected)[which.ravel()]
