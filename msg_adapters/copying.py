"""
A copy of a recording with an additional corrected Imu topic; all other data are copied bit by bit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from os import PathLike

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.preprocessing.sensor_join import OtherSensor
from msg_adapters.bag import Recording, open_recording
from msg_adapters.bag_writer import BagWriter
from msg_adapters.csv_log import LogOptions
from msg_adapters.decode import FrameChoice, in_order
from msg_adapters.definitions import is_standard, standard_definition
from msg_adapters.imu import IMU_TYPE, decode_imu, find_imu_layout, patch_imu_group
from msg_adapters.layout import (
    ENCAPSULATION_SIZE,
    FRAME_OFFSET,
    NS_PER_S,
    MessageLayout,
    Packed,
    group_by_layout,
)
from msg_adapters.storage import RawMessages


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
        Frame of the messages that are corrected; default: of all, which must have one frame.
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
            # Id in the new bag of each topic.
            ids = np.array(
                [writer.add_topic(name, bag.definition(name), bag.qos(name)) for name in topics]
            )
            corrected_id = writer.add_topic(corrected_topic, standard_definition(IMU_TYPE))
            imu_number = topics.index(recording.imu_topic)
            for raw in bag.stretches(topics):
                measured = np.flatnonzero(raw.topic == imu_number)
                _write(writer, ids[raw.topic], raw, measured, corrected_id, patch)
            # Within the writer: an error removes the bag.
            choice.check()
            if check is not None:
                check()
        return recording.lost | dict(patch.dropped)


def _check(recording: Recording, corrected_topic: str) -> None:
    """Raise InputError for a recording that cannot be copied, or a topic that it has already."""
    bag = recording.source
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
            f' addition to {recording.imu_topic}; choose another name',
            code='topic_taken',
        )


def _write(
    writer: BagWriter,
    topic_ids: np.ndarray,
    raw: RawMessages,
    measured: np.ndarray,
    corrected_id: int,
    patch: _Patch,
) -> None:
    """
    Write one stretch, every corrected message after the measured one.

    `topic_ids`: id of the topic of each message in the new bag, shape (n,); `measured`: index of
    the messages to correct; `corrected_id`: topic of the corrected ones.
    """
    received_ns = raw.received_ns()
    messages = raw.packed
    if len(measured):
        index, corrected = patch(raw.packed.select(measured), received_ns[measured])
        measured = measured[index]
        if len(index):
            messages = Packed.chain([raw.packed, corrected])
    # The corrected messages follow all others in `messages`; each has the place of its measured
    # one, and the stable sort places it after that.
    order = np.argsort(np.concatenate([np.arange(len(raw.packed)), measured]), kind='stable')
    topic_ids = np.concatenate([topic_ids, np.full(len(measured), corrected_id)])
    received_ns = np.concatenate([received_ns, received_ns[measured]])
    writer.write(topic_ids[order], received_ns[order], messages.select(order))


@dataclass(frozen=True, eq=False)
class _Patch:
    """Makes corrected messages from measured ones; arguments as for `copy_with_corrected`."""

    correct: Callable
    propagate: Callable | None
    frame_id: str | None
    """New frame; None: unchanged."""
    mat_ts: np.ndarray | None
    late_ns: int
    choice: FrameChoice
    """Selects the messages by their frame."""
    keep: Callable[[np.ndarray], np.ndarray] | None = None
    other: OtherSensor | None = None
    dropped: Counter = field(default_factory=Counter)
    """Reason -> messages that could not be corrected."""

    def __call__(self, packed: Packed, received_ns: np.ndarray) -> tuple[np.ndarray, Packed]:
        """
        Return (index of the messages that could be corrected, their corrected messages).

        A zero stamp counts as the time of arrival. `received_ns`: shape (n,).
        """
        # 1. Samples of the wanted messages, in the order of `packed`. `message_of_sample` and the
        #    index of each group are places in `packed`, and ascending.
        nothing = np.zeros(0, dtype=int), packed.select(np.zeros(0, dtype=int))
        groups = self._wanted_groups(packed)
        if not groups:
            return nothing
        message_of_sample = np.sort(np.concatenate([index for _, index, _ in groups]))
        samples = in_order([(index, decode_imu(layout, group)) for layout, index, group in groups])
        stamp_ns = np.where(samples.stamp_ns == 0, received_ns[message_of_sample], samples.stamp_ns)
        samples = replace(samples, stamp_ns=stamp_ns)

        # 2. Without excluded times.
        if self.keep is not None:
            is_used = self.keep(stamp_ns)
            if not is_used.any():
                return nothing
            message_of_sample = message_of_sample[is_used]
            samples = samples.select(is_used)
            groups = _groups_of(groups, message_of_sample)

        # 3. Correct all samples in order, then patch the bytes of each layout.
        if self.other is not None:
            samples = self.other.added_to(samples)
        corrected = self.correct(samples)
        tables = []
        for layout, index, group in groups:
            # The samples of the messages of this group.
            sample = np.searchsorted(message_of_sample, index)
            readings = {'force': corrected.force[sample], 'rate': corrected.rate[sample]}
            fields = self._fields(layout, group, readings, corrected.marks[sample])
            table = patch_imu_group(layout, group, fields, frame_id=self.frame_id)
            if self.late_ns:
                _write_stamps(table, layout.stamp_ns(group) - self.late_ns, layout.order)
            tables.append(Packed.of_rows(table))
        # 4. From the order of the groups to that of the messages.
        order = np.argsort(np.concatenate([index for _, index, _ in groups]))
        return message_of_sample, Packed.chain(tables).select(order)

    def _wanted_groups(self, packed: Packed) -> list[LayoutGroup]:
        """Return the messages that are corrected, by layout; those of other IMUs are unchanged."""
        groups, n_broken = group_by_layout(packed, find_imu_layout)
        if n_broken:
            self.dropped['Imu message that cannot be decoded'] += n_broken
        return [group for group in groups if self.choice.wants(group[0].names[0], len(group[1]))]

    def _fields(
        self,
        layout: MessageLayout,
        packed: Packed,
        readings: dict[str, np.ndarray],
        marks: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """
        Return the new fields of messages of one layout: field name -> values.

        `readings`: 'force', 'rate' -> corrected values, (n, 3); `marks`: variances of force and
        rate that replace their covariances where they are not zero, (n, 2).
        """
        # Measured covariances, (n, 9), and whether a message declares the quantity absent, (n, 1).
        measured_cov = {}
        absent = {}
        for quantity in readings:
            covariance = layout.column(packed, f'{quantity}_cov')
            if self.other is not None and quantity == self.other.quantity:
                covariance = np.zeros_like(covariance)  # unknown: the messages lack this sensor
            measured_cov[quantity] = covariance
            absent[quantity] = covariance[:, :1] == -1.0
        fields = {}
        for quantity, values in readings.items():
            measured = layout.column(packed, f'{quantity}_s')
            fields[f'{quantity}_s'] = np.where(absent[quantity], measured, values)
        if self.propagate is not None:
            pairs = np.concatenate(list(measured_cov.values()), axis=1)
            propagated = np.split(_propagated(self.propagate, pairs), 2, axis=1)
            for k, quantity in enumerate(readings):
                # A variance above zero replaces the covariance by a diagonal one.
                mark = marks[:, k : k + 1]
                after = np.where(mark > 0, mark * np.eye(3).ravel(), propagated[k])
                fields[f'{quantity}_cov'] = np.where(
                    absent[quantity], measured_cov[quantity], after
                )
        if self.mat_ts is not None:
            fields |= _orientation_fields(layout, packed, np.asarray(self.mat_ts))
        return fields


LayoutGroup = tuple[MessageLayout, np.ndarray, Packed]
"""A layout, the index of its messages, ascending, and these messages."""


def _groups_of(groups: list[LayoutGroup], used: np.ndarray) -> list[LayoutGroup]:
    """Return the groups without the messages whose index is not in `used`."""
    used_groups = []
    for layout, index, group in groups:
        is_used = np.isin(index, used)
        if is_used.any():
            used_groups.append((layout, index[is_used], group.select(np.flatnonzero(is_used))))
    return used_groups


def _orientation_fields(
    layout: MessageLayout, packed: Packed, mat_ts: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the orientation and its covariance in the target frame; absent ones unchanged."""
    covariance = layout.column(packed, 'orientation_cov')
    quaternion = layout.column(packed, 'orientation')
    turned = (mat_ts @ covariance.reshape(-1, 3, 3) @ mat_ts.T).reshape(-1, 9)
    return {
        'orientation': _orientation_of_target(quaternion, covariance[:, 0], mat_ts.T),
        'orientation_cov': np.where(covariance[:, :1] == -1.0, covariance, turned),
    }


def _write_stamps(table: np.ndarray, stamp_ns: np.ndarray, order: str) -> None:
    """
    Write header stamps, ns, shape (n,), into messages: seconds, then nanoseconds, four bytes each.

    `table`: one message per row, uint8, changed in place; `order`: byte order, '<' or '>'.
    """
    seconds, nanoseconds = np.divmod(stamp_ns, NS_PER_S)
    middle = ENCAPSULATION_SIZE + 4
    table[:, ENCAPSULATION_SIZE:middle] = seconds.astype(order + 'i4')[:, None].view(np.uint8)
    table[:, middle:FRAME_OFFSET] = nanoseconds.astype(order + 'u4')[:, None].view(np.uint8)


def _orientation_of_target(
    quaternion: np.ndarray, first_cov: np.ndarray, mat_st: np.ndarray
) -> np.ndarray:
    """
    Return the orientation of the target frame, ``mat_wt = mat_ws @ mat_st``, shape (n, 4).

    `quaternion`: x, y, z, w of mat_ws; unchanged where it is invalid or declared absent, by the
    first element of its covariance `first_cov`, shape (n,).
    """
    from scipy.spatial.transform import Rotation  # here, because its import is slow

    is_valid = np.isfinite(quaternion).all(axis=1) & quaternion.any(axis=1)
    given = (first_cov != -1.0) & is_valid
    turned = quaternion.copy()
    if given.any():
        target = Rotation.from_quat(quaternion[given]) * Rotation.from_matrix(mat_st)
        turned[given] = target.as_quat()
    return turned


def _propagated(propagate: Callable, pairs: np.ndarray) -> np.ndarray:
    """
    Return the corrected covariances of measured ones, both (n, 18).

    Columns: nine numbers of force, nine of rate. `propagate`: as for `copy_with_corrected`.
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
