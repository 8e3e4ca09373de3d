"""Serialized messages of one topic to samples: whole groups of one layout at once, and the rest message by message."""

from collections import Counter

import numpy as np

from imu_calibration.errors import InputError
from msg_adapters.imu import IMU_TYPE, decode_imu, find_imu_layout, imu_from_message
from msg_adapters.joint_state import (JOINT_STATE_TYPE, JointsNotInMessage, decode_joints, find_joint_layout, joints_from_message)
from msg_adapters.layout import group_by_layout
from msg_adapters.stamps import MessageError
from msg_adapters.temperature import TEMPERATURE_TYPE, decode_temperature, find_temperature_layout, temperature_from_message

JOINT_PATIENCE = 1000
"""So many JointState messages may pass before one fits the table."""


class Decoder:
    """
    Decode one topic.

    Parameters
    ----------
    message_type : str
        Imu, JointState or Temperature.
    deserialize : callable, optional
        Message bytes -> message object, for what the layouts do not cover; raises ValueError or the like.
    standard : bool
        Whether the bag's definition is the standard one, as plain CDR; otherwise every message takes the general path.

    """

    def __init__(self, message_type, deserialize=None, standard=True):
        self.find_layout, self.decode_group, self.from_message = _FUNCTIONS[message_type]
        self.name = message_type.rpartition('/')[2]
        self.deserialize, self.standard = deserialize, standard
        self.dropped = Counter()

    def __call__(self, packed):
        """Return the samples of a Packed in its order, or None when it holds none; counts what it drops in `dropped`."""
        groups, rest = group_by_layout(packed, self.find_layout) if self.standard else ([], np.arange(len(packed)))
        parts = [(index, self._decode_group(layout, packed, index)) for layout, index in groups]
        parts += [(np.array([k]), self._decode_one(packed.message(k))) for k in rest]
        parts = sorted(((index, samples) for index, samples in parts if samples is not None), key=lambda part: part[0][0])
        if len(parts) < 2:
            return parts[0][1] if parts else None
        joined = type(parts[0][1]).concatenate(samples for _, samples in parts)
        return joined.select(np.argsort(np.concatenate([index for index, _ in parts]), kind='stable'))

    def _decode_group(self, layout, packed, index):
        return self.decode_group(layout, packed, index)

    def _decode_one(self, data):
        if self.deserialize is not None:
            try:
                return self.from_message(self.deserialize(data))
            except Exception as error:   # rosbags' generated readers raise many kinds on broken bytes
                return self._count(error)
        return self._count(None)

    def _count(self, error):
        self.dropped[f'{self.name} message that cannot be decoded'] += 1


class JointDecoder(Decoder):
    """Decoder of JointState that brings every message to one order of joints."""

    def __init__(self, joint_names=None, deserialize=None, standard=True):
        super().__init__(JOINT_STATE_TYPE, deserialize, standard)
        self.asked = tuple(joint_names) if joint_names is not None else None
        self.names = self.asked
        self.seen = {}
        self.n_messages, self.n_fitting = 0, 0

    def __call__(self, packed):
        """Decode; raises InputError when the names have not matched for long."""
        samples = super().__call__(packed)
        self.n_messages += len(packed)
        self.n_fitting += len(samples) if samples is not None else 0
        if self.n_messages >= JOINT_PATIENCE:
            self.check()
        return samples

    def check(self):
        """Raise InputError when no message so far has held the joints of the table."""
        if self.n_messages and not self.n_fitting and self.asked is not None and self.seen:
            came = '; '.join(', '.join(names) or '(no names)' for names in list(self.seen)[:3])
            raise InputError(f'JointState must name the joints of the table ({", ".join(self.asked)}), got {came}; '
                             'correct the names in the table description or choose another topic by --joint-topic')

    def _decode_group(self, layout, packed, index):
        try:
            return decode_joints(layout, packed, index, self._expect(layout.names))
        except JointsNotInMessage as reason:
            self.dropped[str(reason)] += len(index)
            return None

    def from_message_object(self, message):
        return joints_from_message(message, self._expect(tuple(message.name)))

    def _decode_one(self, data):
        self.from_message = self.from_message_object
        return super()._decode_one(data)

    def _count(self, error):
        if isinstance(error, JointsNotInMessage):
            self.dropped[str(error)] += 1
        else:
            super()._count(error)

    def _expect(self, names):
        self.seen[names] = None
        if self.names is None and names:
            self.names = names
        return self.names or ()


_FUNCTIONS = {
    IMU_TYPE: (find_imu_layout, decode_imu, imu_from_message),
    JOINT_STATE_TYPE: (find_joint_layout, None, None),
    TEMPERATURE_TYPE: (find_temperature_layout, decode_temperature, temperature_from_message),
}
