"""Messages of one topic to samples: complete groups of one layout at once."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from msg_adapters.definitions import standard_bytes
from msg_adapters.imu import (
    IMU_TYPE,
    TEMPERATURE_TYPE,
    decode_imu,
    decode_temperature,
    find_imu_layout,
    find_temperature_layout,
)
from msg_adapters.joint_state import (
    JOINT_STATE_TYPE,
    NO_NAMES,
    decode_joints,
    find_joint_layout,
)
from msg_adapters.layout import MessageLayout, Packed, UnusableMessage, group_by_layout

Arrivals = Callable[[], np.ndarray]
"""Returns the times of sending or reception of messages, int64, shape (n,); rarely needed."""
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
        Message bytes -> message object, for messages that are not standard CDR; each is then
        converted to it.
    choice : object, optional
        Its `wants` returns whether messages of a frame_id are used, as that of a FrameChoice.

    """

    def __init__(self, message_type: str, deserialize: Callable | None = None, choice: Any = None):
        self.message_type = message_type
        self.name = message_type.rpartition('/')[2]
        """Type without its package, for the reasons in the counts."""
        self.deserialize = deserialize
        self.choice = choice
        self.dropped = Counter()
        """Reason -> messages that gave no sample, since `take_counts`."""
        self.notes = Counter()
        """Reason -> messages that were used with a change, since `take_counts`."""

    def decode(self, packed: Packed, arrived_ns: Arrivals | None = None) -> Any:
        """
        Return the samples of a Packed in its order, or None when there are none.

        Counts unusable messages in `dropped`.

        Parameters
        ----------
        packed : Packed
            Messages of the topic.
        arrived_ns : callable, optional
            Times that replace the stamps that are zero, counted in `notes`.

        """
        if self.deserialize is not None:
            messages = map(packed.message, range(len(packed)))
            packed = Packed.join([self._standard(message) for message in messages])
        groups, n_broken = group_by_layout(packed, FIND_LAYOUT[self.message_type])
        if n_broken:
            self.dropped[f'{self.name} message that cannot be decoded'] += n_broken
        parts = []
        for layout, index, group in groups:
            samples = self._samples(layout, group)
            if samples is not None:
                parts.append((index, self._stamped(samples, index, arrived_ns)))
        return in_order(parts)

    def decode_group(self, layout: MessageLayout, packed: Packed) -> Any:
        """
        Return the samples of messages of one layout.

        None for messages that are not wanted (raises UnusableMessage).
        """
        if self.choice is not None and not self.choice.wants(layout.names[0], len(packed)):
            return None
        decode = decode_imu if self.message_type == IMU_TYPE else decode_temperature
        return decode(layout, packed)

    def _stamped(self, samples: Any, index: np.ndarray, arrived_ns: Arrivals | None) -> Any:
        """
        Return the samples with the time of arrival where a driver has set no stamp.

        `index`: place of each sample in the arrival times.
        """
        unset = samples.stamp_ns == 0
        if arrived_ns is None or not unset.any():
            return samples
        self.notes[f'{self.name} zero stamp'] += int(unset.sum())
        return replace(samples, stamp_ns=np.where(unset, arrived_ns()[index], samples.stamp_ns))

    def _samples(self, layout: MessageLayout, packed: Packed) -> Any:
        """Return the samples of messages of one layout; None, and counted, for unusable ones."""
        try:
            return self.decode_group(layout, packed)
        except UnusableMessage as error:
            self.dropped[str(error)] += len(packed)
            return None

    def _standard(self, data: bytes) -> bytes:
        """Return a message as standard CDR; no bytes for one that cannot be read."""
        # Called only with a definition that is not the standard one.
        assert self.deserialize is not None
        try:
            return standard_bytes(self.deserialize(data), self.message_type)
        # Rosbags' generated readers raise many kinds on broken bytes, and fields of other
        # definitions differ
        except Exception:
            return b''


class FrameChoice:
    """
    Selection of the Imu messages of one frame_id on a topic.

    Parameters
    ----------
    topic : str
        Its name for errors.
    frame_id : str, optional
        Frame of the messages to read; default: all messages; a second frame with OTHER_FRAME
        messages is refused.

    """

    def __init__(self, topic: str, frame_id: str | None = None):
        self.topic = topic
        self.frame_id = frame_id
        self.counts = Counter()
        """frame_id -> messages so far."""
        self._n_frequent = 0
        """Frames with at least OTHER_FRAME messages."""

    def wants(self, frame_id: str, n_messages: int = 1) -> bool:
        """
        Return whether messages of a frame are used; raises InputError if the choice is ambiguous.
        """
        n_before = self.counts[frame_id]
        self.counts[frame_id] = n_before + n_messages
        # A frame is counted once, in the call that reaches the threshold.
        if n_before < OTHER_FRAME <= n_before + n_messages:
            self._n_frequent += 1
        if self.frame_id is None and self._n_frequent > 1:
            raise InputError(
                f'{self.topic} must have messages of one frame_id, got {self._listed()};'
                ' choose one',
                key='frame_id',
                code='frame_ambiguous',
            )
        return self.frame_id is None or frame_id == self.frame_id

    def check(self) -> None:
        """Raise InputError if no message has the frame_id that was chosen."""
        if self.frame_id is not None and self.counts and self.frame_id not in self.counts:
            raise InputError(
                f"the frame_id must be one of {self.topic}, got '{self.frame_id}'; choose one of"
                f' {self._listed()}',
                key='frame_id',
                code='frame_unknown',
            )

    def _listed(self) -> str:
        """Return the most frequent frames as text."""
        return ', '.join(f"'{name}'" for name, _ in self.counts.most_common(KEPT_NAMES))


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

    def __init__(
        self, joint_names: Iterable[str] | None = None, deserialize: Callable | None = None
    ):
        super().__init__(JOINT_STATE_TYPE, deserialize)
        self.requires_names = joint_names is not None
        """Whether the joints of a table must occur."""
        self.names = () if joint_names is None else tuple(joint_names)
        """Joints of the samples, in their order; () before a message has named any."""
        self.seen_names = []
        """The first KEPT_NAMES different lists of joints in the messages."""
        self.n_messages = 0
        self.n_fitting = 0
        """Messages that contain the joints `names`."""

    def decode(self, packed: Packed, arrived_ns: Arrivals | None = None) -> Any:
        """
        As for Decoder.

        Raises InputError when the names have not matched the table's for a number of messages.
        """
        samples = super().decode(packed, arrived_ns)
        self.n_messages += len(packed)
        self.n_fitting += 0 if samples is None else len(samples)
        if self.n_messages >= JOINT_PATIENCE:
            self.check()
        return samples

    def decode_group(self, layout: MessageLayout, packed: Packed) -> Any:
        """
        Return the JointSamples in the order of the table.

        Its joints are those of the first message where none were given.
        """
        if layout.names not in self.seen_names and len(self.seen_names) < KEPT_NAMES:
            self.seen_names.append(layout.names)
        # Without a table the first message that names joints determines them.
        if not self.requires_names and not self.names:
            self.names = layout.names
        if not self.names:
            raise UnusableMessage(NO_NAMES)
        return decode_joints(layout, packed, self.names)

    def check(self) -> None:
        """Raise InputError when no message so far contains the joints of the table."""
        if not self.requires_names or not self.seen_names or self.n_fitting:
            return
        # All joints are named, so the messages were refused for their positions.
        if any(set(self.names) <= set(names) for names in self.seen_names):
            raise InputError(
                'JointState must have one position for each named joint, the messages so far do'
                ' not; correct the driver, or choose a different topic',
                key='joint_topic',
            )
        got = '; '.join(', '.join(names) or 'no names' for names in self.seen_names)
        # Of the list that lacks fewest joints.
        missing_joints = []
        for names in self.seen_names:
            missing_joints.append([name for name in self.names if name not in names])
        missing = min(missing_joints, key=len)
        raise InputError(
            f'JointState must name the joints of the table ({", ".join(self.names)}), got'
            f' {got}, which lacks {", ".join(missing)}; correct the names in the'
            ' table description, or choose another topic',
            key='joint_topic',
            code='joint_names',
        )


def take_counts(
    decoders: Iterable[Decoder],
) -> tuple[dict[str, int] | None, dict[str, int] | None]:
    """
    Return the sums of `dropped` and of `notes` over the decoders, and set these counts to zero.

    None in place of a sum without entries.
    """
    dropped: Counter[str] = Counter()
    notes: Counter[str] = Counter()
    for decoder in decoders:
        dropped.update(decoder.dropped)
        notes.update(decoder.notes)
        decoder.dropped.clear()
        decoder.notes.clear()
    return dict(dropped) or None, dict(notes) or None


def in_order(parts: Sequence[tuple[np.ndarray, Any]]) -> Any:
    """
    Join parts (index, samples) to samples in ascending order of the index; None without a part.

    The index of a part is ascending, shape (n,), for its n samples.
    """
    if not parts:
        return None
    if len(parts) == 1:
        return parts[0][1]
    # The joined samples have the frame of the first part, which must be that of the first message.
    parts = sorted(parts, key=lambda part: part[0][0])
    joined = type(parts[0][1]).concatenate(samples for _, samples in parts)
    index = np.concatenate([index for index, _ in parts])
    return joined.select(np.argsort(index, kind='stable'))


FIND_LAYOUT: dict[str, Callable[[bytes], MessageLayout]] = {
    IMU_TYPE: find_imu_layout,
    JOINT_STATE_TYPE: find_joint_layout,
    TEMPERATURE_TYPE: find_temperature_layout,
}
"""Message type -> function from bytes to MessageLayout (raises MessageError)."""
