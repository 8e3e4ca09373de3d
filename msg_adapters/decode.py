"""Messages of one topic to samples: complete groups of one layout at once, or object by object."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from msg_adapters.imu import (
    IMU_TYPE,
    TEMPERATURE_TYPE,
    decode_imu,
    decode_temperature,
    find_imu_layout,
    find_temperature_layout,
    imu_from_rows,
    imu_row,
    temperature_from_rows,
    temperature_row,
)
from msg_adapters.joint_state import JOINT_STATE_TYPE, decode_joints, find_joint_layout, joint_row, joints_from_rows
from msg_adapters.layout import MessageError, Packed, UnusableMessage, clean_name, group_by_layout

JOINT_PATIENCE = 1000
"""So many JointState messages may pass before one fits the table."""
KEPT_NAMES = 3
"""Different lists of joint names, or frames, that an error shows."""
OTHER_FRAME = 20
"""Smallest number of messages of a second IMU; fewer are attributed to damage."""


class Decoder:
    """
    Decode one topic.

    Parameters
    ----------
    message_type : str
        Imu or Temperature; JointState has its own class.
    deserialize : callable, optional
        Message bytes -> message object, for messages that are not standard CDR: all are then decoded in this general way.

    """

    def __init__(self, message_type: str, deserialize: Callable | None = None):
        self.find_layout, self.decode_layout, self.read_row, self.from_rows = _FUNCTIONS[message_type]
        self.name = message_type.rpartition('/')[2]
        self.deserialize = deserialize
        self.dropped, self.notes = Counter(), Counter()

    def decode(self, packed: Packed, arrived_ns: Callable[[], np.ndarray] | None = None) -> Any:
        """
        Return the samples of a Packed in its order, or None when there are none; counts unusable messages in `dropped`.

        Parameters
        ----------
        packed : Packed
        arrived_ns : callable, optional
            Returns the times of sending or reception, int64, shape (n,): used for messages whose stamp is zero, counted in `notes`.

        """
        if self.deserialize is not None:
            objects = [self._deserialized(packed.message(k)) for k in range(len(packed))]
            return self.decode_objects(objects, arrived_ns)
        groups, rest = group_by_layout(packed, self.find_layout)
        parts = [(index, self._decode_group(layout, group)) for layout, index, group in groups]
        parts += [(rest[k:k + 1], self._decode_alone(packed.message(number))) for k, number in enumerate(rest)]
        return in_order([(index, self._stamped(samples, index, arrived_ns)) for index, samples in parts if samples is not None])

    def decode_objects(self, messages: Iterable, arrived_ns: Callable[[], np.ndarray] | None = None) -> Any:
        """Return the samples of message objects, from rclpy or rosbags, or None when there are none; `arrived_ns` as for `decode`."""
        rows = [(k, row) for k, row in enumerate(map(self._row, messages)) if row is not None]
        return self._stamped(self.from_rows([row for _, row in rows]), np.array([k for k, _ in rows]), arrived_ns) if rows else None

    def _stamped(self, samples, index, arrived_ns):
        """Return the samples with the time of arrival where a driver has set no stamp."""
        unset = samples.stamp_ns == 0
        if arrived_ns is None or not unset.any():
            return samples
        self.notes[f'{self.name} zero stamp'] += int(unset.sum())
        return replace(samples, stamp_ns=np.where(unset, arrived_ns()[index], samples.stamp_ns))

    def _decode_group(self, layout, packed):
        try:
            return self.decode_layout(layout, packed)
        except MessageError as error:
            return self._drop(error, len(packed))

    def _decode_alone(self, data):
        try:
            layout = self.find_layout(data)
        except MessageError as error:
            return self._drop(error, 1)
        return self._decode_group(layout, Packed.join([data]))

    def _deserialized(self, data):
        try:
            return self.deserialize(data)
        except Exception as error:   # rosbags' generated readers raise many kinds on broken bytes
            return self._drop(error, 1)

    def _row(self, message):
        if message is None:
            return None
        try:
            return self.read_row(message)
        except (AttributeError, TypeError, ValueError, IndexError, OverflowError) as error:   # fields of another definition
            return self._drop(error, 1)

    def _drop(self, error, n_messages):
        reason = str(error) if isinstance(error, UnusableMessage) else f'{self.name} message that cannot be decoded'
        self.dropped[reason] += n_messages


class FrameChoice:
    """
    Selection of the Imu messages of one frame_id on a topic.

    Parameters
    ----------
    topic : str
        Its name for errors.
    frame_id : str, optional
        Frame of the messages to read; default: all messages; a second frame with OTHER_FRAME messages is refused.

    """

    def __init__(self, topic: str, frame_id: str | None = None):
        self.topic, self.frame_id, self.counts = topic, frame_id, Counter()

    def wants(self, frame_id: str, n_messages: int = 1) -> bool:
        """Return whether messages of a frame are used; raises InputError if the choice is ambiguous."""
        self.counts[frame_id] += n_messages
        if self.frame_id is None and sum(count >= OTHER_FRAME for count in self.counts.values()) > 1:
            raise InputError(f'{self.topic} must have messages of one frame_id, got {self._listed()}; choose one', key='frame_id',
                             code='frame_ambiguous')
        return self.frame_id is None or frame_id == self.frame_id

    def check(self) -> None:
        """Raise InputError if no message has the frame_id that was chosen."""
        if self.frame_id is not None and self.counts and self.frame_id not in self.counts:
            raise InputError(f"the frame_id must be one of {self.topic}, got '{self.frame_id}'; choose one of {self._listed()}",
                             key='frame_id', code='frame_unknown')

    def _listed(self):
        return ', '.join(f"'{name}'" for name, _ in self.counts.most_common(KEPT_NAMES))


class ImuDecoder(Decoder):
    """
    Decode Imu messages of the frame of a FrameChoice.

    Parameters
    ----------
    choice : FrameChoice
    deserialize : callable, optional
        As for Decoder.

    """

    def __init__(self, choice: FrameChoice, deserialize: Callable | None = None):
        super().__init__(IMU_TYPE, deserialize)
        self.choice, decode, read = choice, self.decode_layout, self.read_row
        self.decode_layout = lambda layout, packed: decode(layout, packed) if choice.wants(layout.names[0], len(packed)) else None
        self.read_row = lambda message: read(message) if choice.wants(clean_name(message.header.frame_id)) else None


class JointDecoder(Decoder):
    """
    Decode JointState, every message brought to one order of joints.

    Parameters
    ----------
    joint_names : sequence of str, optional
        Joints of the table; default: the joints of the first message that names any.
    deserialize : callable, optional
        As for Decoder.

    """

    def __init__(self, joint_names: Sequence[str] | None = None, deserialize: Callable | None = None):
        super().__init__(JOINT_STATE_TYPE, deserialize)
        self.asked = joint_names is not None
        self.names = () if joint_names is None else tuple(joint_names)
        self.seen = []
        self.n_messages, self.n_fitting = 0, 0
        self.decode_layout = lambda layout, packed: decode_joints(layout, packed, self._expected(layout.names))
        self.read_row = lambda message: joint_row(message, self._expected(tuple(map(clean_name, message.name))))
        self.from_rows = lambda rows: joints_from_rows(rows, self.names)

    def decode(self, packed: Packed, arrived_ns: Callable[[], np.ndarray] | None = None) -> Any:
        """As for Decoder; raises InputError when the names have not matched the table's for a number of messages."""
        return self._checked(super().decode(packed, arrived_ns), len(packed) if self.deserialize is None else 0)

    def decode_objects(self, messages: Iterable, arrived_ns: Callable[[], np.ndarray] | None = None) -> Any:
        """As for Decoder; raises InputError when the names have not matched the table's for a number of messages."""
        messages = list(messages)
        return self._checked(super().decode_objects(messages, arrived_ns), len(messages))

    def check(self) -> None:
        """Raise InputError when no message so far contains the joints of the table."""
        if self.asked and self.seen and not self.n_fitting:
            if any(set(self.names) <= set(names) for names in self.seen):
                raise InputError('JointState must have one position for each named joint, the messages so far do not; correct the '
                                 'driver, or choose a different topic', key='joint_topic')
            came = '; '.join(', '.join(names) or 'no names' for names in self.seen)
            missing = min(([name for name in self.names if name not in names] for names in self.seen), key=len)
            raise InputError(f'JointState must name the joints of the table ({", ".join(self.names)}), got {came}, which lacks '
                             f'{", ".join(missing)}; correct the names in the table description, or choose another topic',
                             key='joint_topic', code='joint_names')

    def _checked(self, samples, n_messages):
        self.n_messages += n_messages
        self.n_fitting += 0 if samples is None else len(samples)
        if self.n_messages >= JOINT_PATIENCE:
            self.check()
        return samples

    def _expected(self, names):
        if names not in self.seen and len(self.seen) < KEPT_NAMES:
            self.seen.append(names)
        if not self.asked and not self.names:
            self.names = names
        return self.names


def taken_counts(decoders: Iterable[Decoder]) -> tuple[dict[str, int] | None, ...]:
    """Return ({reason: messages dropped}, {reason: messages used with a change}) since the last call; None for none."""
    totals: tuple[Counter[str], ...] = Counter(), Counter()
    for decoder in decoders:
        for total, own in zip(totals, (decoder.dropped, decoder.notes), strict=True):
            total.update(own)
            own.clear()
    return tuple(dict(total) or None for total in totals)


def in_order(parts: Sequence[Any]) -> Any:
    """Join (index, samples) pairs in the order of the indices; None when there are none."""
    if len(parts) < 2:
        return parts[0][1] if parts else None
    parts = sorted(parts, key=lambda part: part[0][0])   # so that the frame is that of the first message
    joined = type(parts[0][1]).concatenate(samples for _, samples in parts)
    return joined.select(np.argsort(np.concatenate([index for index, _ in parts]), kind='stable'))


_FUNCTIONS: dict[str, tuple[Callable, ...]] = {
    IMU_TYPE: (find_imu_layout, decode_imu, imu_row, imu_from_rows),
    JOINT_STATE_TYPE: (find_joint_layout, decode_joints, joint_row, joints_from_rows),
    TEMPERATURE_TYPE: (find_temperature_layout, decode_temperature, temperature_row, temperature_from_rows),
}
