"""Messages received on topics, collected into blocks: the same samples as from a bag."""

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.core.samples import SampleBlock
from msg_adapters.decode import Decoder, JointDecoder, take_counts
from msg_adapters.imu import IMU_TYPE, TEMPERATURE_TYPE
from msg_adapters.layout import Packed, UnusableMessage, clean_name


class LiveGatherer:
    """
    Keep messages until `flush` turns them into a SampleBlock.

    Adding is cheap and may happen in another thread than `flush`. Every topic gives serialized
    messages (a subscription with ``raw=True``), which are decoded many at once.

    Parameters
    ----------
    joint_names : sequence of str, optional
        Joints of the table, in its order; default: the joints of the first message.
    max_messages : int
        Largest number of stored messages of one kind; the oldest are discarded first and counted as
        dropped.
    frame_id : str, optional
        Imu messages of another frame are counted as dropped; '' selects the frame of the first
        message, None any frame.

    """

    def __init__(
        self,
        joint_names: Sequence[str] | None = None,
        max_messages: int = 1_000_000,
        frame_id: str | None = None,
    ):
        choice = None if frame_id is None else OneFrame(clean_name(frame_id))
        imu = Decoder(IMU_TYPE, choice=choice)
        # Keys: fields of a SampleBlock.
        self._topics = {
            'imu': _Topic(imu, max_messages),
            'joints': _Topic(JointDecoder(joint_names), max_messages),
            'temperature': _Topic(Decoder(TEMPERATURE_TYPE), max_messages),
        }
        self.add_imu = self._topics['imu'].add
        self.add_joints = self._topics['joints'].add
        self.add_temperature = self._topics['temperature'].add
        """Add a serialized message, and when it was sent, ns."""

    def __len__(self) -> int:
        return sum(len(topic.waiting) for topic in self._topics.values())

    def flush(self) -> SampleBlock:
        """
        Return the messages since the last call as a SampleBlock.

        Raises
        ------
        InputError
            When the JointState messages have not named the joints of the table for long.

        """
        samples = {name: topic.take() for name, topic in self._topics.items()}
        dropped, notes = take_counts(topic.decoder for topic in self._topics.values())
        return SampleBlock(**samples, dropped=dropped, notes=notes)


@dataclass
class OneFrame:
    """Selection of the messages of one frame; other messages are counted as dropped."""

    frame_id: str
    """The frame; '' selects that of the first message."""

    def wants(self, frame_id: str, _n_messages: int) -> bool:
        """Return whether messages of a frame are used; raises UnusableMessage for another frame."""
        self.frame_id = self.frame_id or frame_id
        if frame_id != self.frame_id:
            raise UnusableMessage(f"Imu message of another frame than '{self.frame_id}'")
        return True


class _Topic:
    """Messages of one topic that wait for `flush`."""

    def __init__(self, decoder: Decoder, max_messages: int):
        self.decoder = decoder
        self.max_messages = max_messages
        self.lock = threading.Lock()
        """For the two fields below, which two threads change."""
        self.waiting: deque[tuple[bytes, int]] = deque()
        """(serialized message, time of sending in ns or 0) since the last `take`."""
        self.n_lost = 0
        """Messages discarded since the last `take`, because too many were waiting."""

    def add(self, message: bytes, sent_ns: int = 0) -> None:
        """Keep a message; the oldest one is discarded when there are too many."""
        with self.lock:
            self.waiting.append((message, sent_ns))
            if len(self.waiting) > self.max_messages:
                self.waiting.popleft()
                self.n_lost += 1

    def take(self) -> Any:
        """Return the samples of the messages since the last call, None without any."""
        with self.lock:
            messages = self.waiting
            n_lost = self.n_lost
            self.waiting = deque()
            self.n_lost = 0
        if n_lost:
            reason = f'{self.decoder.name} message that was dropped because the queue was full'
            self.decoder.dropped[reason] += n_lost
        packed = Packed.join([message for message, _ in messages])
        sent_ns = np.array([sent for _, sent in messages], np.int64)
        # Times of sending replace zero stamps, if the middleware gives them.
        return self.decoder.decode(packed, (lambda: sent_ns) if np.all(sent_ns) else None)
